"""The host's end: a board only receives, so all that is known of a motor is what it was sent.

Rules. A share of the power drives a motor; full power is taken to be `full_scale`. A velocity of 0 is sent as
reverse 0, Idle as forward 0: the same to the board, and told apart by the guard. The mode is what was sent
last, and lapses with the serial timeout, which is sent before a motor is driven, and again while it is, since
nobody knows whether it has arrived.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols.frames import Frame
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos
from protocols.plugin import Device
from protocols.sabertooth import table as st
from protocols.sabertooth.options import Options
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import NEVER

AGAIN: Nanos = 500 * MILLISECOND
"""Period of the serial timeout while a motor is driven."""
RESTS = 10
"""Times that it is sent to rest, since it confirms none."""
SENT, LAPSED, AT_REST = "open loop: as sent", "open loop: its serial timeout has passed", "open loop: at rest"


@dataclass(slots=True)
class Motor:
    """What one motor was sent. Plain data."""

    driven: bool = False
    at: Nanos = -NEVER
    """When it was last sent anything,"""
    bounded: Nanos = -NEVER
    """and its serial timeout."""
    woken: bool = False
    """The byte of the baud rate was sent."""
    noted: Nanos = -NEVER
    """When its state was last looked at,"""
    reported: Nanos = -NEVER
    """and of what was sent when it was reported."""
    lapsed: bool = False

    def look(self, now: Nanos, timeout: Nanos) -> None:
        """Note that its serial timeout has passed, if it has."""
        self.noted = now
        if self.driven and now - self.at > timeout:
            self.driven, self.lapsed = False, True

    def report(self) -> tuple[Mode, str]:
        """Return its state, as it is reported now."""
        self.reported = self.at
        if self.driven:
            return Mode.ARMED, SENT
        return Mode.READY, LAPSED if self.lapsed else AT_REST

    def begin(self) -> None:
        """Begin to drive it: its serial timeout goes first."""
        self.bounded, self.lapsed = -NEVER, False

    def wakes(self) -> bool:
        """True if the byte of the baud rate is to be sent; then it counts as sent."""
        before, self.woken = self.woken, True
        return not before

    def bounds(self, now: Nanos) -> bool:
        """True if its serial timeout is to be sent; then it counts as sent."""
        due = now - self.bounded >= AGAIN
        self.bounded = now if due else self.bounded
        return due

    def send(self, now: Nanos, *, driven: bool) -> None:
        """Note what it is sent."""
        self.driven, self.at = driven, now

    def forget(self) -> None:
        """Forget what it was sent: the line was away."""
        self.driven = self.woken = self.lapsed = False
        self.at = self.bounded = self.reported = -NEVER


class SabertoothAdapter(LineAdapter[Motor]):
    """What boards are sent; they have no transmitter."""

    name = "sabertooth"
    blind = True

    def own(self, device: Device) -> Motor:
        return Motor()

    def timing(self, options: Options) -> Timing:
        return Timing(NEVER, confirmations=RESTS)

    def notice(self, now: Nanos, host: Host[Motor]) -> Sequence[Event]:
        """Report what it was sent as its state."""
        own = host.own
        own.look(now, host.options.timeout_ms * MILLISECOND)
        if host.phase is Phase.RELEASING and own.reported == own.at:
            return ()  # it counts as released when it was sent to rest often enough
        mode, detail = own.report()
        return host.on_report(now, Report(host, host.address, mode, detail))

    def poll_due(self, host: Host[Motor]) -> Nanos:
        at: Nanos = host.own.noted + host.options.feedback_ms * MILLISECOND
        return at

    # -- sent -----------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        host.own.begin()
        return self._drive(now, host, 0.0)

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        return self._drive(now, host, getattr(command, "velocity", 0.0) / host.options.full_scale)

    def _drive(self, now: Nanos, host: Host[Motor], share: float) -> Sequence[Frame]:
        frames: list[Frame] = []
        own = host.own
        if host.options.autobaud and own.wakes():
            frames.append(Exchange(st.PACKETS.encode("AUTOBAUD"), None, Rank.QUESTION))
        if own.bounds(now):
            units = host.options.timeout_ms // st.TIMEOUT_UNIT_MS
            frames.append(self._message(host, "SERIALTIMEOUT", units, "timeout"))
        own.send(now, driven=True)
        value = round(share * st.FULL)
        way = "FORWARD" if value > 0 else "REVERSE"
        frames.append(self._message(host, f"M{st.BOARDS.side(host.address)}{way}", abs(value), "power"))
        return frames

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own.send(now, driven=False)
        name = f"M{st.BOARDS.side(host.address)}FORWARD"
        return (self._message(host, name, 0, "power", Rank.RELEASE),)

    @staticmethod
    def _message(
        host: Host[Motor], name: str, value: int, about: str, rank: Rank = Rank.SET_POINT
    ) -> Exchange:
        frame = st.PACKETS.encoder(name)(st.BOARDS.board(host.address), value=value)
        return Exchange(frame, None, rank, f"{host.address} {about}")
