"""The load on a joint: the torque that carries it goes on when it is held, and when its device is taken over;
and no spring of the device pulls with more than the limit of torque."""

from __future__ import annotations

from dataclasses import replace

from gateway.core.limits import Limits, no_stronger, softened, spring_within
from protocols import messages as msg
from protocols.messages import SECOND, Command, Feedback, Nanos
from protocols.plugin import Spec

BY_TORQUE = (msg.Position, msg.Velocity)
"""What a loop of our own reaches by torque."""
FADING: Nanos = SECOND
"""In this time the torque that carries a load fades, when its device is taken over, and when it is lowered at
the end of a run."""


class Load:
    """What carries the load of one joint. State is plain data."""

    def __init__(self, spec: Spec, ratio: float, *, by_torque: bool) -> None:
        kinds: set[type[Command]] = {msg.Hold, *BY_TORQUE}
        able = {kind for kind in kinds if f"{kind.__name__}.torque" in spec.ranges}
        self._carries = able | {*BY_TORQUE} if by_torque else able
        """Commands that take its torque."""
        self._holds = msg.Hold in able
        self._spring = None if spec.gains is None else tuple(gain * ratio * ratio for gain in spec.gains)
        """Stiffness and damping that the device makes of Position, Velocity and Hold [N·m/rad, N·m·s/rad]"""
        self._held: float | None = None
        """rad, where the first of the present Holds was given."""
        self._taken_over: tuple[Nanos, float] = (0, 0.0)
        """When a device was first commanded that ran already, and the torque that it gave then [N·m]."""

    def hold(self, out: Command) -> msg.Hold:
        """Return the command to hold after another, with the torque that has carried the load so far."""
        if self._holds and isinstance(out, msg.Position | msg.Impedance | msg.Hold):
            return msg.Hold(out.motor, out.torque)
        return msg.Hold(out.motor)

    def carried(
        self, now: Nanos, out: Command, here: Feedback, limits: Limits, *, taken_over: bool
    ) -> Command:
        """Return a command with the torque that a running device gave when it was taken over, less and less
        of it: a spring that begins where its load stands gives none, and drops it."""
        if not isinstance(out, (msg.Hold, *BY_TORQUE)):
            return out
        if taken_over:
            self._taken_over = now, here.torque or 0.0
        since, carried = self._taken_over
        torque = carried * (1.0 - (now - since) / FADING)
        if torque * carried <= 0.0 or out.torque or type(out) not in self._carries:
            return out
        return replace(out, torque=limits.torque_now(torque, here))

    def pulls(self, out: Command) -> bool:
        """True if the device makes a spring of a command: it pulls by where the shaft will be."""
        return isinstance(out, msg.Impedance) or self._spring is not None

    def softened(
        self, out: Command, here: Feedback, there: Feedback, limits: Limits, *, armed: bool
    ) -> Command:
        """Return a command that the device makes a spring of, softened where that would pull too hard now, or
        once it is in force.

        Args:
            out: within the limits.
            here: the motion now,
            there: and when this is in force.
            limits: of now.
            armed: whether the device is, so that it holds where it was when it was first to.
        """
        if not isinstance(out, msg.Hold) or not armed or self._held is None:
            self._held = here.position
        if isinstance(out, msg.Impedance):
            return no_stronger(spring_within(out, there, limits), here, limits)
        if self._spring is None or not isinstance(out, (msg.Hold, *BY_TORQUE)):
            return out
        stiffness, damping = self._spring
        for motion in (there, here):
            softer = softened(out, self._held, stiffness, damping, motion, limits)
            if isinstance(softer, msg.Impedance):
                return no_stronger(no_stronger(softer, there, limits), here, limits)
        return out
