"""The path of a base by its joints, as a function of factors on what its robot file says of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Base
from protocols.messages import SECOND, Nanos


class Factors(NamedTuple):
    """What the motion by the joints is multiplied with; by the robot file alone: (1, 1, 0, 1)."""

    distance: float = 1.0
    """Forward: of wheels, their true radius as a share of the stated one"""
    turn: float = 1.0
    veer: float = 0.0
    """rad to the left that each metre ahead adds: one side rolls farther"""
    sideways: float = 1.0


class WheelPath:
    """Positions of a base by its joints [m, m, rad], between the first and the last common sample."""

    def __init__(
        self, body: Base, samples: Mapping[str, Sequence[tuple[Nanos, float]]], began: Nanos
    ) -> None:
        """`samples`: angles [rad] of every joint, in order. Raises ValueError for fewer than two common
        ones."""
        series = [np.array(samples[name], dtype=np.float64).reshape(-1, 2) for name in body.joints]
        times = [(one[:, 0] - began) / SECOND for one in series]
        first = max((float(one[0]) for one in times if len(one)), default=0.0)
        last = min((float(one[-1]) for one in times if len(one)), default=0.0)
        grid = np.unique(max(times, key=len, default=np.zeros(0)))
        self.t: Floats = grid[(grid >= first) & (grid <= last)]
        """s after `began`"""
        if len(self.t) < 2 or not all(map(len, times)):
            raise ValueError("no two moments at which every joint's angle is known")
        angles = np.column_stack(
            [np.interp(self.t, t, one[:, 1]) for t, one in zip(times, series, strict=True)]
        ).tolist()
        travels = [body.travel(a, b)[:3] for a, b in pairwise(angles)]
        self.steps: Floats = np.array(travels)
        """m ahead, rad to the left, m to the left, of each step"""

    def cumulative(self, factors: Factors) -> Floats:
        """Return x, y and yaw at each moment."""
        distance, turn = factors.distance * self.steps[:, 0], factors.turn * self.steps[:, 1]
        aside = factors.sideways * self.steps[:, 2]
        yaw = np.concatenate([[0.0], np.cumsum(turn + factors.veer * distance)])
        middle = (yaw[1:] + yaw[:-1]) / 2.0
        c, s = np.cos(middle), np.sin(middle)
        x, y = np.cumsum(distance * c - aside * s), np.cumsum(distance * s + aside * c)
        return np.column_stack([np.concatenate([[0.0], x]), np.concatenate([[0.0], y]), yaw])

    def poses(self, factors: Factors, at: Floats) -> Floats:
        """Return x, y and yaw at some times [s], held beyond the ends."""
        path = self.cumulative(factors)
        return np.column_stack([np.interp(at, self.t, column) for column in path.T])

    def travelled(self, at: Floats) -> Floats:
        """Return what is shown by the robot file up to some times: m ahead, rad, m to the left, and m in any
        direction."""
        ways = np.column_stack([self.steps, np.hypot(self.steps[:, 0], self.steps[:, 2])])
        sums = np.vstack([np.zeros(4), np.cumsum(ways, axis=0)])
        return np.column_stack([np.interp(at, self.t, column) for column in sums.T])


def after(first: Floats, second: Floats) -> Floats:
    """Return poses (n × 3) composed: the second in the frame of the first."""
    c, s = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y = second[..., 0], second[..., 1]
    return np.stack(
        [first[..., 0] + c * x - s * y, first[..., 1] + s * x + c * y, first[..., 2] + second[..., 2]],
        axis=-1,
    )


def seen_from(first: Floats, second: Floats) -> Floats:
    """Return poses in the frame of others; yaw is not wrapped."""
    dx, dy = second[..., 0] - first[..., 0], second[..., 1] - first[..., 1]
    c, s = np.cos(first[..., 2]), np.sin(first[..., 2])
    return np.stack([c * dx + s * dy, c * dy - s * dx, second[..., 2] - first[..., 2]], axis=-1)
