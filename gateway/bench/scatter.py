"""How sure a least-squares solution is, by how its residuals scatter (Newey and West 1987)."""

from __future__ import annotations

from brain.belief import Floats


def covariance(pull: Floats, inverse: Floats, together: int) -> Floats:
    """Return the covariance of a solution.

    `pull`: of each comparison, its Jacobian times its residual (n × parameters), in the order of time, of
    which so many neighbours may be wrong together; `inverse`: of the normal equations."""
    meat = pull.T @ pull
    for lag in range(1, together + 1):
        both = pull[lag:].T @ pull[:-lag]
        meat += (1.0 - lag / (together + 1.0)) * (both + both.T)
    found: Floats = inverse @ meat @ inverse
    return found
