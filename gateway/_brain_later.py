"""Stand-ins for the brain's settings; to be removed with the first commit of `brain.brain`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Mount:
    """As brain.perception.mount.Mount."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0


@dataclass(frozen=True, slots=True)
class Differential:
    """As brain.bodies.differential.Differential."""

    left: str
    right: str
    wheel_radius: float
    wheel_separation: float
    radius: float
    max_linear: float
    max_angular: float
    max_linear_acceleration: float
    max_angular_acceleration: float

    def __post_init__(self) -> None:
        for name in ("wheel_radius", "wheel_separation", "radius", "max_linear", "max_angular"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be greater than 0")


@dataclass(frozen=True, slots=True)
class Joints:
    """As brain.bodies.joints.Joints."""

    motors: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class BrainSettings:
    """As brain.brain.BrainSettings."""

    body: Literal["differential", "joints"] = "joints"
    differential: Differential | None = None
    joints: Joints | None = None
