"""Positions and velocities by torque, where the device has no loops of its own, or shall not use them."""

from __future__ import annotations

from math import inf

from brain.control.pid import Loop, LoopSettings
from gateway.core.limits import Limits
from protocols.messages import SECOND, Command, Feedback, Nanos, Position, Torque, Velocity
from protocols.plugin import Spec

ROUNDING = 1e-9
"""Share of a device's largest torque that is never asked for, lest it be refused after the gear."""


class TorqueLoop:
    """The loop of one joint. State is plain data."""

    def __init__(self, settings: LoopSettings, spec: Spec, gear: float, longest: Nanos) -> None:
        self._settings, self._loop = settings, Loop()
        able = spec.ranges.get("Torque.torque")
        most = min(-able.low, able.high) if able else inf
        self._strongest = gear * most * (1.0 - ROUNDING)
        """N·m at the output shaft that the device can be commanded"""
        self._longest = longest / SECOND
        """s that a step counts at most"""

    def torque(self, out: Command, dt: float, measured: Feedback, limits: Limits, *, armed: bool) -> Command:
        """Return the torque with which a set-point is reached, `dt` seconds after the last; any other command
        as it is."""
        loop = self._loop
        if not isinstance(out, (Position, Velocity)):
            loop.reset()
            return out
        ahead = 0.0
        if isinstance(out, Position):
            ahead = out.position - (measured.position or 0.0)
        dt, most, speed = (
            min(dt, self._longest),
            min(limits.torque, self._strongest),
            measured.velocity or 0.0,
        )
        torque = loop.step(ahead, out.velocity, speed, out.torque, dt, most, self._settings)
        if not armed:
            loop.reset()
            torque = 0.0
        return Torque(out.motor, limits.torque_now(torque, measured))
