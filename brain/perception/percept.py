"""What perception knows at one moment, as a value."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from brain.belief import Estimate, Pose
from brain.bodies.plane import arc
from brain.perception.consistency import Verdict
from brain.perception.map import Map
from brain.perception.motion_check import Contradiction
from brain.perception.movers import Moving
from protocols.messages import MILLISECOND, Nanos, seconds

MAX_EXTRAPOLATION: Nanos = 100 * MILLISECOND
"""An estimate is extrapolated to now by its own twist, by at most this much."""


@dataclass(frozen=True, slots=True)
class Sight:
    """Where a base is, what is about it, and how far to trust that."""

    estimate: Estimate | None
    """None before all joints have reported"""
    pose: Pose | None
    """The estimate's in the frame "map", extrapolated to now,"""
    odom: Pose | None
    """and in the frame "odom" """
    raw: Pose
    """Dead reckoning by the wheels alone"""
    map: Map
    moving: tuple[Moving, ...]
    """What moves, in the frame of `pose`,"""
    suspects: tuple[Moving, ...]
    """and in that of `raw`, with what may move"""
    marker: Callable[[int], Pose | None]
    """Returns the pose of a marker on the map that is seen now, its x axis out of its face"""
    verdict: Verdict
    contradictions: tuple[Contradiction, ...]
    rejected: Mapping[str, int]
    """Number of measurements rejected by the chi-square gate, by motor or sensor"""
    absent: Mapping[str, str]
    """Why the newest reading of a sensor shows nothing, by sensor"""
    helpful: frozenset[str]
    """The sensors that are not needed"""


def extrapolated(estimate: Estimate, pose: Pose, now: Nanos) -> Pose:
    """Return a pose of the newest estimate, extrapolated to now by its twist."""
    dt = seconds(min(max(now - estimate.t, 0), MAX_EXTRAPOLATION))
    return arc(pose, estimate.linear * dt, estimate.angular * dt, estimate.lateral * dt)
