"""What a user would write or take instead of our perception: bare filterpy, numpy, Bresenham in a loop.

Rules. Each does the same work on the same numbers as ours, in the plainest way; a test holds that the results
agree. None of it is used by the robot.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from filterpy.kalman import ExtendedKalmanFilter

from brain.belief import Floats

Model: TypeAlias = Callable[[Floats], tuple[Floats, Floats, Floats]]
"""From a state to the state one step later, the motion's Jacobian F, and the noise Q of that step."""


class BareFilterpy:
    """Predict and update with filterpy's own filter, the distance taken, nothing gated and nothing kept."""

    def __init__(self, x: Floats, P: Floats, H: Floats, R: Floats, model: Model) -> None:
        self.filter: Any = ExtendedKalmanFilter(dim_x=len(x), dim_z=len(H))
        self.filter.x, self.filter.P, self.filter.R = x, P, R
        self._H, self._model = H, model

    def step(self, z: Floats) -> float:
        """The Mahalanobis distance of a measurement that is taken in."""
        H = self._H
        x, self.filter.F, self.filter.Q = self._model(self.filter.x)
        self.filter.predict()
        self.filter.x = x
        self.filter.update(z, lambda _: H, lambda x: H @ x)
        return float(self.filter.mahalanobis)


class PlainNumpy:
    """The same in numpy: F P Fᵀ + Q, then Joseph's form."""

    def __init__(self, x: Floats, P: Floats, H: Floats, R: Floats, model: Model) -> None:
        self.x, self.P = x, P
        self._H, self._R, self._I, self._model = H, R, np.eye(len(x)), model

    def step(self, z: Floats) -> float:
        """The Mahalanobis distance of a measurement that is taken in."""
        H = self._H
        x, F, Q = self._model(self.x)
        P = F @ self.P @ F.T + Q
        y = z - H @ x
        inverse = np.linalg.inv(H @ P @ H.T + self._R)
        K = P @ H.T @ inverse
        rest = self._I - K @ H
        self.x, self.P = x + K @ y, rest @ P @ rest.T + K @ self._R @ K.T
        return float(np.sqrt(y @ inverse @ y))


class BresenhamLoop:
    """Log-odds by a loop over beams and cells, as tutorials have it: all beams clear, all ends are hits."""

    def __init__(self, shape: tuple[int, int], hit: float, miss: float, low: float, high: float) -> None:
        self.log_odds: npt.NDArray[np.float32] = np.zeros(shape, dtype=np.float32)
        self._hit, self._miss, self._low, self._high = hit, miss, low, high

    def add(self, start: tuple[int, int], ends: list[tuple[int, int]]) -> None:
        """One scan: from the cell of the lidar to the cells (row, column) in which beams end."""
        for end in ends:
            for row, column in bresenham(start, end)[:-1]:
                self.log_odds[row, column] = max(self._low, self.log_odds[row, column] - self._miss)
            self.log_odds[end] = min(self._high, self.log_odds[end] + self._hit)

    def add_by(self, line: Any, start: tuple[int, int], ends: list[tuple[int, int]]) -> None:  # noqa: ANN401 -- skimage.draw.line
        """The same with another line function: (row, column, row, column) → (rows, columns)."""
        for end in ends:
            rows, columns = line(*start, *end)
            rows, columns = rows[:-1], columns[:-1]
            self.log_odds[rows, columns] = np.maximum(self._low, self.log_odds[rows, columns] - self._miss)
            self.log_odds[end] = min(self._high, self.log_odds[end] + self._hit)


def bresenham(start: tuple[int, int], end: tuple[int, int]) -> list[tuple[int, int]]:
    """The cells from one to another, both included (Bresenham 1965, for all octants)."""
    (row, column), (to_row, to_column) = start, end
    down, across = abs(to_row - row), -abs(to_column - column)
    step_row, step_column = (1 if row < to_row else -1), (1 if column < to_column else -1)
    error = down + across
    cells = [(row, column)]
    while (row, column) != (to_row, to_column):
        twice = 2 * error
        if twice >= across:
            error += across
            row += step_row
        if twice <= down:
            error += down
            column += step_column
        cells.append((row, column))
    return cells
