"""The brain's estimate, map, path and state as values for recorder and user interface. No logic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from brain.region import Region, Tile, about, region_of
from protocols.messages import Command, Goal, Nanos, Task

Floats = npt.NDArray[np.float64]
BrainTask: TypeAlias = Task | Command
"""A task for the brain; a Command is a target for a bare joint."""


class BrainState(StrEnum):
    """The brain's own state."""

    INITIALISING = "initialising"
    """Waiting for the first feedback of every motor and the first reading of every sensor."""
    READY = "ready"
    """Every source reports; there is no task."""
    RUNNING = "running"
    DEGRADED = "degraded"
    """A measurement is late or missing: slow, then standing still."""
    STOPPED = "stopped"
    """Stopped by an operator, by a joint in fault, or by a source that did not come back."""


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose in the plane: m, m, rad in (-pi, pi]."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """The filter's state at time t."""

    t: Nanos
    pose: Pose
    """In the frame "map": as well as it is known, so it leaps when that is corrected"""
    linear: float
    """m/s, forward"""
    angular: float
    """rad/s, to the left"""
    covariance: Floats
    """3 × 3, of x, y, yaw"""
    lateral: float = 0.0
    """m/s, to the left"""
    odom: Pose = Pose(0.0, 0.0, 0.0)
    """In the frame "odom": by wheels and gyro alone, it drifts and never leaps"""


@dataclass(frozen=True, slots=True)
class MapView:
    """The occupancy map, in tiles that views share until these change; put together only where needed."""

    version: int
    """Incremented at each change."""
    resolution: float
    """m per cell"""
    tiles: Mapping[Tile, npt.NDArray[Any]]
    """Log-odds by row and column of tiles, all of one size: row = y, column = x; unknown is exactly 0"""
    unit: float = 1.0
    """Log-odds of 1 in a tile"""
    corner: tuple[float, float] = (0.0, 0.0)
    """m: lower left one of the tile (0, 0)"""
    here: Tile = (0, 0)
    """Where it is looked at"""

    @property
    def region(self) -> Region:
        """The tiles of `log_odds`: all; of a very large map those about `here`."""
        return about(self.here, region_of(self.tiles))

    @property
    def origin_x(self) -> float:
        """m, of the lower left corner of `log_odds`"""
        return self.corner[0] + self.region[1].start * self._size[1] * self.resolution

    @property
    def origin_y(self) -> float:
        """m"""
        return self.corner[1] + self.region[0].start * self._size[0] * self.resolution

    @property
    def log_odds(self) -> npt.NDArray[np.float32]:
        """rows × columns"""
        (rows, columns), (height, width) = self.region, self._size
        whole = np.zeros((len(rows) * height, len(columns) * width), dtype=np.float32)
        for (row, column), tile in self.tiles.items():
            if row in rows and column in columns:
                y, x = (row - rows.start) * height, (column - columns.start) * width
                np.multiply(tile, self.unit, out=whole[y : y + height, x : x + width], casting="unsafe")
        return whole

    @property
    def _size(self) -> tuple[int, int]:
        height, width = next(iter(self.tiles.values())).shape
        return height, width


@dataclass(frozen=True, slots=True)
class MissionView:
    """The mission, and how far it is."""

    name: str
    phase: str
    """running, paused, done, failed or dropped"""
    step: str
    """Number of the present step, from 1: "3", or "4.1" within a Repeat or Try; "" at the end"""
    text: str
    """What the present step is, in words"""
    steps: int
    """How many steps it has, those within others not counted"""
    reason: str
    """Why it is paused, or has failed; "" if that needs none"""


@dataclass(frozen=True, slots=True)
class SystemState:
    """The state of one of the three systems, and why."""

    name: str
    """perception, planning or control"""
    state: str
    reason: str
    """Why the state was entered, or ""."""


@dataclass(frozen=True, slots=True)
class Belief:
    """The brain's output for observers, after a step."""

    state: BrainState
    reason: str
    """Cause of the state, in one sentence; "" if it needs none."""
    estimate: Estimate | None
    """None for bare joints, and before the first feedback."""
    goal: Goal | None
    path: tuple[tuple[float, float], ...]
    """Planned path [m] in the frame "map"; empty if there is none."""
    path_version: int
    map: MapView | None
    rejected: dict[str, int]
    """Number of measurements rejected by the chi-square gate, by motor or sensor."""
    reached: int
    """Number of goals reached so far."""
    raw: Pose | None = None
    """Dead reckoning by the wheels alone, for comparison; not used for control."""
    mission: MissionView | None = None
    """The present mission, or the last; None before the first"""
    systems: tuple[SystemState, ...] = ()
    """Of perception, planning and control"""
    explained: tuple[str, ...] = ()
    """What, if it was wrong, would make wheels, gyro and scans agree; it stays told"""
