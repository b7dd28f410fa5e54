"""The host's end: a board only listens, so all that is known of a motor is what it was told.

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
from protocols.toolkit.motor_driver import NEVER, Adapter, MotorDriver, Rx

AGAIN: Nanos = 500 * MILLISECOND
"""Period of the serial timeout while a motor is driven."""
TOLD_OFTEN = 10
"""Times that it is told to rest, since it confirms none."""
NOTED: Nanos = 50 * MILLISECOND
"""Period in which it is looked whether what it was told has lapsed."""
TOLD, LAPSED, RESTS = "open loop: as told", "open loop: its serial timeout has passed", "open loop: at rest"


@dataclass(slots=True)
class Motor:
    """What one motor was told. Plain data."""

    driven: bool = False
    sent: Nanos = -NEVER
    """When it was last told anything,"""
    bounded: Nanos = -NEVER
    """and its serial timeout."""
    woken: bool = False
    """The byte of the baud rate was sent."""
    noted: Nanos = -NEVER
    released: Nanos = -NEVER
    """When it was told what was last reported."""
    lapsed: bool = False


class SabertoothAdapter(Adapter[Motor]):
    """What boards are told."""

    name = "sabertooth"
    blind = True

    def __init__(self) -> None:
        self._skipping = False
        """Bytes have come: whose they are is not known, and they are counted once."""

    def own(self, device: Device) -> Motor:
        return Motor()

    def timing(self, options: Options) -> Timing:
        return Timing(NEVER, confirmations=TOLD_OFTEN)

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        before, self._skipping = self._skipping, self._skipping or isinstance(frame, bytes)
        return () if before and isinstance(frame, bytes) else (Rx.IGNORED,)  # it has no transmitter

    def forget(self, now: Nanos, host: Host[Motor]) -> None:
        host.own = Motor()

    def notice(self, now: Nanos, host: Host[Motor]) -> Sequence[Event]:
        """Report what it was told as its state."""
        own = host.own
        if own.driven and now - own.sent > host.options.timeout_ms * MILLISECOND:
            own.driven, own.lapsed = False, True
        own.noted = now
        if host.phase is Phase.RELEASING and own.released == own.sent:
            return ()  # it counts as released when it was told so often enough
        own.released = own.sent
        mode = Mode.ARMED if own.driven else Mode.READY
        detail = TOLD if own.driven else LAPSED if own.lapsed else RESTS
        return host.on_report(now, Report(host, host.address, mode, detail))

    def poll_due(self, host: Host[Motor]) -> Nanos:
        return host.own.noted + NOTED

    # -- sent -----------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        host.own.bounded, host.own.lapsed = -NEVER, False
        return self._tell(now, host, 0.0)

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        return self._tell(now, host, getattr(command, "velocity", 0.0) / host.options.full_scale)

    def _tell(self, now: Nanos, host: Host[Motor], share: float) -> Sequence[Frame]:
        own, frames = host.own, list[Frame]()
        if host.options.autobaud and not own.woken:
            own.woken = True
            frames.append(Exchange(st.PACKETS.encode("AUTOBAUD"), None, Rank.QUESTION))
        if now - own.bounded >= AGAIN:
            own.bounded = now
            units = host.options.timeout_ms // st.TIMEOUT_UNIT_MS
            frames.append(self._say(host, "SERIALTIMEOUT", units, "timeout"))
        own.driven, own.sent = True, now
        value = round(share * st.FULL)
        way = "FORWARD" if value > 0 else "REVERSE"
        frames.append(self._say(host, f"M{st.side_of(host.address)}{way}", abs(value), "power"))
        return frames

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own.driven, host.own.sent = False, now
        name = f"M{st.side_of(host.address)}FORWARD"
        return (self._say(host, name, 0, "power", Rank.RELEASE),)

    @staticmethod
    def _say(host: Host[Motor], name: str, value: int, about: str, rank: Rank = Rank.SET_POINT) -> Exchange:
        frame = st.PACKETS.encode(name, st.board_of(host.address), value=value)
        return Exchange(frame, None, rank, f"{host.address} {about}")
