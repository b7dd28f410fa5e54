"""The filter's linear algebra, in two engines that give the same numbers.

Rules. A state is 7 numbers, its covariance the 28 numbers of the lower triangle by rows; both are tuples that
are never changed. STRUCTURED is written out in floats: it multiplies by nothing that is 0 or 1, decorrelates
a measurement by the Cholesky factor of its noise and applies the components one after another. FILTERPY gives
the same matrices to `filterpy.kalman.ExtendedKalmanFilter`. The mean of a prediction is the caller's: its
arcs are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from brain.belief import Floats

X, Y, YAW, BIAS, SCALE, SLIP, TURN = range(7)
SIZE = 7
Vector: TypeAlias = tuple[float, ...]
"""x, y, yaw; gyro bias; distance scale; turn slip; angle of the gyro less that of the wheels."""
Packed: TypeAlias = tuple[float, ...]
"""Lower triangle of a 7 × 7 covariance, by rows."""
Result: TypeAlias = tuple[Vector, Packed, float]
"""State and covariance after an update, and the squared Mahalanobis distance of its innovation."""
LOWER = np.tril_indices(SIZE)
AT = tuple(tuple(max(i, j) * (max(i, j) + 1) // 2 + min(i, j) for j in range(SIZE)) for i in range(SIZE))
"""Index of a pair of states in the lower triangle."""


def unpacked(packed: Packed) -> Floats:
    """Return the whole 7 × 7 matrix."""
    P = np.empty((SIZE, SIZE))
    P[LOWER] = packed
    P.T[LOWER] = packed
    return P


def pack(P: Floats) -> Packed:
    """Return the lower triangle of a symmetric matrix."""
    packed: list[float] = ((P + P.T) / 2.0)[LOWER].tolist()
    return tuple(packed)


class Move(NamedTuple):
    """What one travel does to errors: derivatives of the new state by the old one, and noise."""

    yaw_x: float
    """d x / d yaw, and so on"""
    yaw_y: float
    scale_x: float
    scale_y: float
    slip_x: float
    slip_y: float
    slip_yaw: float
    """d yaw / d slip, and d turn / d slip"""
    dt: float
    """s: d turn / d bias"""
    keep: float
    """d slip / d slip"""
    noise_xx: float
    noise_xy: float
    noise_yy: float
    noise_bias: float
    noise_scale: float
    noise_slip: float
    noise_turn: float


class Engine(Protocol):
    """The three operations."""

    def predict(self, packed: Packed, move: Move) -> Packed:
        """Return the covariance after a travel."""

    def turn(self, x: Vector, packed: Packed, innovation: float, variance: float) -> Result:
        """Correct by a measurement of TURN."""

    def update(self, x: Vector, packed: Packed, rows: Sequence[int], y: Vector, noise: Floats) -> Result:
        """Correct by a measurement of these states with innovations y and a noise of m × m."""


class Structured:
    """Plain floats."""

    def predict(self, packed: Packed, move: Move) -> Packed:
        """Return the covariance after a travel: F P F' + Q, written out."""
        (
            xx, yx, yy, hx, hy, hh, bx, by, bh, bb, sx, sy, sh, sb, ss,
            ex, ey, eh, eb, es, ee, gx, gy, gh, gb, gs, ge, gg,
        ) = packed  # fmt: skip
        ax, ay, cx, cy, tx, ty, te, dt, keep, qxx, qxy, qyy, qb, qs, qe, qg = move
        # rows of F P
        Xe = ex + ax * eh + cx * es + tx * ee
        Xs = sx + ax * sh + cx * ss + tx * es
        Xb = bx + ax * bh + cx * sb + tx * eb
        Xh = hx + ax * hh + cx * sh + tx * eh
        Xg = gx + ax * gh + cx * gs + tx * ge
        Ye = ey + ay * eh + cy * es + ty * ee
        Ys = sy + ay * sh + cy * ss + ty * es
        Yb = by + ay * bh + cy * sb + ty * eb
        Yh = hy + ay * hh + cy * sh + ty * eh
        Yg = gy + ay * gh + cy * gs + ty * ge
        He = eh + te * ee
        Hb = bh + te * eb
        Ge = ge + dt * eb + te * ee
        Gb = gb + dt * bb + te * eb
        return (
            xx + ax * hx + cx * sx + tx * ex + ax * Xh + cx * Xs + tx * Xe + qxx,
            yx + ax * hy + cx * sy + tx * ey + ay * Xh + cy * Xs + ty * Xe + qxy,
            yy + ay * hy + cy * sy + ty * ey + ay * Yh + cy * Ys + ty * Ye + qyy,
            Xh + te * Xe, Yh + te * Ye, hh + te * (eh + He),
            Xb, Yb, Hb, bb + qb,
            Xs, Ys, sh + te * es, sb, ss + qs,
            keep * Xe, keep * Ye, keep * He, keep * eb, keep * es, keep * keep * ee + qe,
            Xg + dt * Xb + te * Xe, Yg + dt * Yb + te * Ye, gh + te * ge + dt * Hb + te * He,
            Gb, gs + dt * sb + te * es, keep * Ge, gg + dt * gb + te * ge + dt * Gb + te * Ge + qg,
        )  # fmt: skip

    def turn(self, x: Vector, packed: Packed, innovation: float, variance: float) -> Result:
        """Correct by a measurement of TURN: one division, and no matrix."""
        (
            xx, yx, yy, hx, hy, hh, bx, by, bh, bb, sx, sy, sh, sb, ss,
            ex, ey, eh, eb, es, ee, gx, gy, gh, gb, gs, ge, gg,
        ) = packed  # fmt: skip
        S = gg + variance
        kx, ky, kh, kb, ks, ke, left = gx / S, gy / S, gh / S, gb / S, gs / S, ge / S, variance / S
        x0, x1, x2, x3, x4, x5, x6 = x
        d = innovation
        state = (
            x0 + kx * d, x1 + ky * d, x2 + kh * d, x3 + kb * d, x4 + ks * d, x5 + ke * d, x6 + gg / S * d,
        )  # fmt: skip
        covariance = (
            xx - kx * gx, yx - ky * gx, yy - ky * gy, hx - kh * gx, hy - kh * gy, hh - kh * gh,
            bx - kb * gx, by - kb * gy, bh - kb * gh, bb - kb * gb,
            sx - ks * gx, sy - ks * gy, sh - ks * gh, sb - ks * gb, ss - ks * gs,
            ex - ke * gx, ey - ke * gy, eh - ke * gh, eb - ke * gb, es - ke * gs, ee - ke * ge,
            left * gx, left * gy, left * gh, left * gb, left * gs, left * ge, left * gg,
        )  # fmt: skip
        return state, covariance, d * d / S

    def update(self, x: Vector, packed: Packed, rows: Sequence[int], y: Vector, noise: Floats) -> Result:
        """Correct by whitened components, one after another."""
        count = len(rows)
        white = np.linalg.inv(np.linalg.cholesky(noise)).tolist()
        P = [[packed[k] for k in line] for line in AT]
        shift = [0.0] * SIZE
        distance = 0.0
        for line in white:
            c = [sum(line[j] * P[i][rows[j]] for j in range(count)) for i in range(SIZE)]
            S = 1.0 + sum(line[j] * c[rows[j]] for j in range(count))
            residual = sum(line[j] * (y[j] - shift[rows[j]]) for j in range(count))
            distance += residual * residual / S
            for i in range(SIZE):
                gain = c[i] / S
                shift[i] += gain * residual
                P[i] = [p - gain * value for p, value in zip(P[i], c, strict=True)]
        corrected = tuple(a + b for a, b in zip(x, shift, strict=True))
        return corrected, tuple(P[i][j] for i in range(SIZE) for j in range(i + 1)), distance


class Filterpy:
    """`filterpy.kalman.ExtendedKalmanFilter` on the same numbers."""

    def __init__(self) -> None:
        from filterpy.kalman import ExtendedKalmanFilter  # here, because it takes seconds to import

        self._filter: Any = ExtendedKalmanFilter(dim_x=SIZE, dim_z=1)

    def predict(self, packed: Packed, move: Move) -> Packed:
        """Return the covariance after a travel."""
        ax, ay, cx, cy, tx, ty, te, dt, keep, qxx, qxy, qyy, qb, qs, qe, qg = move
        F = np.eye(SIZE)
        F[X, [YAW, SCALE, SLIP]] = ax, cx, tx
        F[Y, [YAW, SCALE, SLIP]] = ay, cy, ty
        F[YAW, SLIP], F[SLIP, SLIP] = te, keep
        F[TURN, [BIAS, SLIP]] = dt, te
        Q = np.diag([qxx, qyy, 0.0, qb, qs, qe, qg])
        Q[X, Y] = Q[Y, X] = qxy
        self._filter.x, self._filter.P = np.zeros(SIZE), unpacked(packed)
        self._filter.F, self._filter.Q = F, Q
        self._filter.predict()
        return pack(self._filter.P)

    def turn(self, x: Vector, packed: Packed, innovation: float, variance: float) -> Result:
        """Correct by a measurement of TURN."""
        return self.update(x, packed, (TURN,), (innovation,), np.array([[variance]]))

    def update(self, x: Vector, packed: Packed, rows: Sequence[int], y: Vector, noise: Floats) -> Result:
        """Correct by a measurement of these states."""
        H = np.eye(SIZE)[list(rows)]
        self._filter.x, self._filter.P = np.zeros(SIZE), unpacked(packed)
        self._filter.update(np.array(y), lambda _: H, lambda state: H @ state, R=noise)
        corrected = tuple(a + b for a, b in zip(x, self._filter.x.tolist(), strict=True))
        return corrected, pack(self._filter.P), float(self._filter.mahalanobis) ** 2


def cross_zeroed(packed: Packed, state: int, variance: float) -> Packed:
    """Return a covariance in which one state has this variance and no correlation."""
    new = list(packed)
    for other in range(SIZE):
        new[AT[state][other]] = 0.0
    new[AT[state][state]] = variance
    return tuple(new)


def relative(packed: Packed, rows: Sequence[int], shared: Floats) -> tuple[Packed, Floats]:
    """Split a covariance into what is relative to a map and the map's own share, 7 × 7.

    The map was drawn from the estimate: pose error = map error + error relative to the map, and only the
    latter shows in a match. `shared` is the map's covariance; it counts up to the pose's own, and explains
    the errors of the other states in proportion to the pose's."""
    P = unpacked(packed)
    pose = P[np.ix_(rows, rows)]
    root = np.linalg.cholesky(pose + np.eye(len(rows)) * 1e-12)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ ((shared + shared.T) / 2.0) @ inverse.T)
    part = P[:, rows] @ inverse.T @ vectors
    share: Floats = (part * np.clip(values, 0.0, 1.0)) @ part.T
    return pack(P - share), share


ENGINES: dict[str, type[Structured] | type[Filterpy]] = {"structured": Structured, "filterpy": Filterpy}
