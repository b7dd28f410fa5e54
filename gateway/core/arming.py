"""Whether a device is armed, and whether by us: what it reports of its state, against Idle and set-points.

Rules. Idle disarms within `DISARMING`; what is armed afterwards, or still driven, does not obey, or another
has armed it. What disarms while it is commanded has done so by itself. A device obeys once it is armed, was
sent a set-point, and has reported its motion since both.
"""

from __future__ import annotations

from gateway.core.faults import ARMED_AGAINST_IDLE, STILL_ARMED, Finding
from gateway.core.following import FAST
from gateway.core.measured import Measured
from protocols import messages as msg
from protocols.messages import MILLISECOND, Command, Mode, Nanos

DISARMING: Nanos = 500 * MILLISECOND
"""Time for a device to disarm after Idle, and to report it."""
AT_REST = 0.02
"""Fraction of the velocity limit below which a braking joint is at rest."""
NOT_SLOWED = 0.9
"""Share of its speed: a shaft that was let go, and is faster than that after `DISARMING`, is driven on."""


class Arming:
    """The state of one device, and what it was sent. State is plain data."""

    def __init__(self) -> None:
        self.mode = Mode.OFFLINE
        self.detail = ""
        self.armed = False
        """Whether its last report of a mode was ARMED."""
        self.owned = False
        """Whether any command but Idle has been sent: only then is the stop command sent."""
        self.idle = True
        """Whether the last command sent was Idle."""
        self._idle_at: Nanos = 0
        """When the first of the present Idles was sent."""
        self._idle_speed = 0.0
        """How fast the shaft turned then [rad/s]."""
        self._idle_until: Nanos | None = None
        """When the last Idle was sent, if the device has not been disarmed since."""
        self.driven_since: Nanos | None = None
        """When the first of the present set-points was sent; None: none was, since Idle."""
        self._armed_at: Nanos = 0
        self._commanded_at: Nanos | None = None
        """When the first command was sent since it is ARMED; None: none was."""
        self._disarmed = True
        """Whether the device has reported being disarmed since the last command but Idle."""

    def on_state(self, event: msg.State, *, braking: bool) -> bool:
        """Note what it reports; return whether it has disarmed itself. `braking`: that ends in Idle, too."""
        by_itself = self._is_unexpected_disarm(event, braking)
        if event.mode is not Mode.OFFLINE:  # an offline device may still be armed
            if event.mode is Mode.ARMED and not self.armed:
                self._armed_at = event.t
            self.armed = event.mode is Mode.ARMED
            self._commanded_at = self._commanded_at if self.armed else None
            self._disarmed = self._disarmed or not self.armed
        self.mode, self.detail = event.mode, event.detail
        return by_itself

    def _is_unexpected_disarm(self, event: msg.State, braking: bool) -> bool:
        if not self.armed or event.mode not in (Mode.READY, Mode.INITIALISING):
            return False
        idle_until, self._idle_until = self._idle_until, None
        obeyed = idle_until is not None and event.t - idle_until <= DISARMING  # a command came after Idle
        return not (obeyed or braking or self.idle)

    def on_sent(self, now: Nanos, out: Command, speed: float) -> None:
        """Note what is sent, and how fast the shaft turns [rad/s]."""
        before, self.idle = self.idle, isinstance(out, msg.Idle)
        if self.armed and self._commanded_at is None:
            self._commanded_at = now
        if not self.idle:
            self.owned = True
            self._disarmed = False
            self.driven_since = now if self.driven_since is None else self.driven_since
        else:
            self.driven_since = None
            self._idle_until = now if self.armed else None
            if not before:
                self._idle_at, self._idle_speed = now, speed

    def on_held_back(self) -> None:
        """Note that the driver sends the device no set-point yet: it still prepares it."""
        self.driven_since = None

    def obeys(self, measured: Measured) -> bool:
        """True if it is armed, was sent a set-point, and has reported its motion since both."""
        if measured.open_loop:
            return self.mode is Mode.ARMED
        sent, received = self.driven_since, measured.received_at
        answered = sent is not None and received is not None and received > max(sent, self._armed_at)
        return answered and self.mode is Mode.ARMED

    def shows_arming(self, measured: Measured) -> bool:
        """True if it has certainly reported its motion since it was armed: what came with that report of its
        state may be older, and a device may have stopped its shaft when it was armed."""
        since, received = self._commanded_at, measured.received_at
        return since is not None and received is not None and received > since

    def against_idle(
        self, now: Nanos, measured: Measured, fastest: float, *, turned_on: bool
    ) -> Finding | None:
        """Return what is wrong if the device is armed, or drives its shaft, against our will: it does not
        obey, or a late frame or another host has armed it.

        Args:
            now: the time of the step [ns].
            measured: its motion.
            fastest: its limit of velocity [rad/s].
            turned_on: whether it turned otherwise than commanded before it was let go.
        """
        if not self.owned or not self.idle or now - self._idle_at <= DISARMING:
            return None
        speed = abs(measured.feedback.velocity or 0.0)
        if self.mode is Mode.ARMED:
            return ARMED_AGAINST_IDLE if self._disarmed else STILL_ARMED, "still armed"
        if measured.lost(now):
            return None
        if speed > (1.0 + FAST) * fastest:
            return STILL_ARMED, "still turns at more than its limit of velocity"
        if turned_on and speed > max(NOT_SLOWED * self._idle_speed, AT_REST * fastest):
            return STILL_ARMED, "still turns as fast as before it was let go"
        return None
