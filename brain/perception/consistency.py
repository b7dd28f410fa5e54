"""Whether the filter is as sure as it may be: what each sensor's innovations say of the covariances.

Rules. NIS is an innovation's squared Mahalanobis distance, a chi-square of as many degrees of freedom as
the measurement has numbers, if the covariances are honest (Bar-Shalom, Li, Kirubarajan 2001, section 5.4).
Every measurement that was judged by the gate counts once, as it was first judged, refused ones too.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Nis:
    """Of one sensor, since the start."""

    count: int = 0
    """Measurements."""
    freedom: int = 0
    """Their degrees of freedom together."""
    total: float = 0.0
    beyond: int = 0
    """Measurements beyond the 95 % quantile: one in twenty of an honest filter."""

    def add(self, distance: float, quantile: float, freedom: int) -> None:
        """One more squared distance, and the 95 % quantile for its degrees of freedom."""
        self.count += 1
        self.freedom += freedom
        self.total += distance
        self.beyond += distance > quantile

    @property
    def mean(self) -> float:
        """Per degree of freedom: 1 if the covariances are honest, more if the filter is too sure, less if
        it is less sure than it could be; 0 before the first measurement."""
        return self.total / self.freedom if self.freedom else 0.0
