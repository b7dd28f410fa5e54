"""What the brain believes and wants, as values that a recorder or a screen may read. No logic."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from protocols.messages import Goal, Nanos

Floats = npt.NDArray[np.float64]


class BrainState(StrEnum):
    """The brain's own state."""

    INITIALISING = "initialising"
    """Waiting for the first feedback of every motor and the first reading of every sensor."""
    READY = "ready"
    """Everything is heard; nothing is asked for."""
    RUNNING = "running"
    DEGRADED = "degraded"
    """Something is missing or late: slow, and then stop."""
    STOPPED = "stopped"
    """An operator stopped it, a joint is in fault, or what was missing did not come back."""


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose in the plane: m, m, rad in (-pi, pi]."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """The filter's state at time t, in the frame "odom"."""

    t: Nanos
    pose: Pose
    linear: float
    """m/s, forward"""
    angular: float
    """rad/s, to the left"""
    covariance: Floats
    """3 × 3, of x, y, yaw"""


@dataclass(frozen=True, slots=True)
class MapView:
    """The occupancy grid: log-odds, row = y, column = x; unknown is exactly 0."""

    version: int
    """Grows at each change."""
    resolution: float
    """m per cell"""
    origin_x: float
    """m, of the lower left corner of cell (0, 0)"""
    origin_y: float
    log_odds: npt.NDArray[np.float32]
    """rows × columns; must not be written to"""


@dataclass(frozen=True, slots=True)
class Belief:
    """All of it, after a step."""

    state: BrainState
    reason: str
    """Why the state is what it is, in one sentence; "" where it needs none."""
    estimate: Estimate | None
    """None for a body that does not move about (bare joints), and before the first feedback."""
    goal: Goal | None
    path: tuple[tuple[float, float], ...]
    """The path wanted [m], in the frame "odom"; empty if there is none."""
    path_version: int
    map: MapView | None
    rejected: dict[str, int]
    """How many measurements the chi-square gate refused, by sensor."""
    reached: int
    """How many goals were reached so far."""
    raw: Pose | None = None
    """Dead reckoning by the wheels alone, for comparison; nothing is steered by it."""
