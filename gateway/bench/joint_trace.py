"""What one joint was told and did: set-points on the wire, and its feedback, at the output shaft."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from brain.belief import Floats
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.core.tick import Tick
from gateway.errors import UserError
from protocols.messages import SECOND, Command, Feedback, Nanos, Velocity
from protocols.plugin import CommandDecoder


@dataclass(slots=True)
class JointTrace:
    """Of one joint; `take` gets the ticks in order."""

    robot: Robot
    joint: str
    began: Nanos | None = None
    position: list[tuple[float, float]] = field(default_factory=list)
    """s after the beginning, rad; so are the others"""
    velocity: list[tuple[float, float]] = field(default_factory=list)
    """rad/s"""
    torque: list[tuple[float, float]] = field(default_factory=list)
    """N·m, as reported"""
    commanded: list[tuple[float, float]] = field(default_factory=list)
    """rad/s: what the device would obey; not a number where it was told something else"""

    _bus: str = field(init=False)
    _ratio: float = field(init=False)
    _decoder: CommandDecoder = field(init=False)

    def __post_init__(self) -> None:
        if self.joint not in self.robot.motors:
            known = ", ".join(self.robot.motors)
            raise UserError(f"{self.robot.name} has no motor {self.joint!r}; it has {known}")
        motor = self.robot.motors[self.joint]
        self._bus, self._ratio = motor.bus, motor.joint.gear * motor.joint.sign
        self._decoder = decoder_of(self.robot, motor.bus)

    def take(self, tick: Tick) -> None:
        """Keep what a tick says of the joint."""
        self.began = tick.now if self.began is None else self.began
        for event in tick.outputs.events:
            if isinstance(event, Feedback) and event.motor == self.joint:
                t = (event.t - self.began) / SECOND
                for row, value in (
                    (self.position, event.position),
                    (self.velocity, event.velocity),
                    (self.torque, event.torque),
                ):
                    if value is not None and (not row or t > row[-1][0]):
                        row.append((t, value))
        now = (tick.now - self.began) / SECOND
        for packet in tick.outputs.packets:
            if packet.bus != self._bus:
                continue
            for one in self._decoder.decode(packet.t, packet.frame):
                if isinstance(one, Command) and one.motor == self.joint:
                    self._told(now, one)

    def _told(self, now: float, one: Command) -> None:
        value = one.velocity / self._ratio if isinstance(one, Velocity) else np.nan
        if not self.commanded or now > self.commanded[-1][0]:
            self.commanded.append((now, value))
        else:
            self.commanded[-1] = (now, value)


def traced(robot: Robot, joint: str, ticks: Iterable[Tick]) -> JointTrace:
    """Return the trace of a joint. Raises UserError for a joint that is not there."""
    trace = JointTrace(robot, joint)
    for tick in ticks:
        trace.take(tick)
    return trace


def columns(rows: list[tuple[float, float]]) -> tuple[Floats, Floats]:
    """Return times and values."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]
