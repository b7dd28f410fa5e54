"""Cameras whose images can be looked at: those of the simulated world, and real ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from brain.perception.mount import Mount
from gateway.buses import Bus
from gateway.core.robot import Robot

if TYPE_CHECKING:
    from gateway.buses.camera import CameraBus
    from gateway.buses.virtual import TwinWorld
    from gateway.ros.images import Camera
    from gateway.vision.camera import Seen


@dataclass(frozen=True, slots=True)
class RealCamera:
    """A camera of this machine, or a video file in its place, as a sensor of a robot."""

    name: str
    mount: Mount
    bus: CameraBus

    @property
    def seen(self) -> Seen | None:
        """Its newest image"""
        return self.bus.seen


def cameras_of(robot: Robot, buses: Mapping[str, Bus], twins: TwinWorld | None) -> list[Camera]:
    """Return those of a robot."""
    from gateway.buses.camera import CameraBus

    real = [
        RealCamera(name, sensor.mount, bus)
        for name, sensor in robot.sensors.items()
        if isinstance(bus := buses.get(sensor.bus), CameraBus)
    ]
    drawn = [] if twins is None else twins.world.cameras()
    return [*(one for one in drawn if one.name not in {each.name for each in real}), *real]
