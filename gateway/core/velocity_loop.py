"""Positions by velocity, where the device takes no positions: a valve, a motor that is driven open loop."""

from __future__ import annotations

from gateway.core.limits import Limits, clamp
from protocols.messages import SECOND, Command, Feedback, Hold, Nanos, Position, Velocity


class VelocityLoop:
    """The loop of one joint. State is plain data."""

    def __init__(self, gain: float, longest: Nanos) -> None:
        self._gain = gain
        """1/s: velocity per difference of the position"""
        self._longest = longest / SECOND
        """s that a step counts at most"""
        self._velocity = 0.0
        """The last that was commanded"""

    def velocity(
        self, out: Command, dt: float, measured: Feedback, limits: Limits, *, armed: bool
    ) -> Command:
        """Return the velocity with which a position is reached or held, `dt` seconds after the last; any
        other command as it is."""
        if not isinstance(out, (Position, Hold)):
            self._velocity = getattr(out, "velocity", 0.0)
            return out
        wanted = 0.0
        if isinstance(out, Position) and measured.position is not None:
            wanted = out.velocity + self._gain * (out.position - measured.position)
        change = limits.acceleration * min(dt, self._longest)
        moved = self._velocity + clamp(clamp(wanted, limits.velocity) - self._velocity, change)
        self._velocity = moved if armed else 0.0
        return Velocity(out.motor, self._velocity)
