"""The host's end: what a board is sent, and what its feedback reports of each motor.

Rules. Both motors are in one message: it is made at the end of a step, of what was given in this step; a
motor that was given nothing gets 0. None goes out in a step in which nothing was given, so that silence, the
board's own watchdog, lets its motors coast. Nothing enables or disarms a motor, and nothing says that it is
enabled: it counts as armed while it is commanded, and the feedback returns what was sent (the timeout makes
0 of that). A board takes a message only behind a pause, so two are never sent at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import Frame
from protocols.hoverboard import table as hb
from protocols.hoverboard.options import Options
from protocols.messages import MILLISECOND, Command, Feedback, Mode, Nanos
from protocols.plugin import Device
from protocols.toolkit.host import Host, Report, counted_once
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import NEVER, MotorDriver, Rx
from protocols.toolkit.table import Values
from protocols.toolkit.turns import LONGEST, Shaft

PACE: Nanos = 2 * MILLISECOND
"""From one message to the next at least: 0.7 ms of bytes, and a pause"""
ECHO: Nanos = 100 * MILLISECOND
"""Time within which the feedback must return what is sent"""
SENT = 64
"""Messages that are remembered, to know their echo"""


@dataclass(slots=True)
class Wheel:
    """What is known of one motor beyond its phase. Plain data."""

    shaft: Shaft = field(default_factory=lambda: Shaft(0.0, longest=LONGEST))
    """Its position is the integral of its speed, since a board counts nothing."""
    driven: bool = False
    """It is commanded."""

    def drive(self, *, driven: bool) -> None:
        """Record whether it is commanded."""
        self.driven = driven


class HoverboardAdapter(LineAdapter[Wheel]):
    """What a board is sent, and what it reports."""

    name, confirmations = "hoverboard", 4

    def __init__(self) -> None:
        super().__init__(hb.FEEDBACK.framing)
        self._options: Options | None = None
        self._given: dict[int, int] = {}
        """Counts that were given in this step, by address."""
        self._sent: list[tuple[Nanos, tuple[int, int]]] = []
        """The last messages, and when they were sent."""

    def own(self, device: Device) -> Wheel:
        if self._options not in (None, device.options):
            raise ValueError(f"{device.name}: both motors of a board have the same options")
        self._options = device.options
        return Wheel()

    def forget(self, now: Nanos, host: Host[Wheel]) -> None:
        host.own.shaft.forget(host.own.shaft.position)

    # -- received -------------------------------------------------------------------------------------

    def unasked(self, t: Nanos, message: bytes, driver: MotorDriver[Wheel]) -> Sequence[Report[Wheel] | Rx]:
        decoded = hb.FEEDBACK.decode(message, "from_device")
        if decoded is None or not decoded.name:
            return (Rx.MALFORMED,)
        values = decoded.values
        there = [
            host
            for address, name in ((hb.LEFT, "left"), (hb.RIGHT, "right"))
            if (host := driver.at.get(address)) is not None and values[name] != hb.UNKNOWN
        ]
        return counted_once(self._report(t, host, values) for host in there) or (Rx.IGNORED,)

    def _report(self, t: Nanos, host: Host[Wheel], values: Values) -> Report[Wheel]:
        own, options = host.own, host.options
        rpm = values["left" if host.address == hb.LEFT else "right"]
        own.shaft.add(t, None, options.sign(host.address) * rpm * hb.RPM)
        inside = abs(rpm) < (1 << 15) - 1  # it may as well be faster
        feedback = Feedback(
            host.name,
            t,
            own.shaft.position,
            own.shaft.velocity + 0.0 if inside else None,
            voltage=values["voltage"],
            temperature=values["temperature"],
        )
        echo = values["steer"], values["speed"]
        mode, detail = self._mode(t, host, echo)
        return Report(host, host.address, mode, detail, feedback=feedback)

    def _mode(self, t: Nanos, host: Host[Wheel], echo: tuple[int, int]) -> tuple[Mode, str]:
        options: Options = host.options
        recent = {what for at, what in self._sent if t - at <= hb.TIMEOUT_MS * MILLISECOND}
        if host.own.driven:
            if echo in recent:
                return Mode.ARMED, "commanded"
            late = t - host.since > ECHO
            return Mode.READY, "its feedback does not return what it is sent" if late else "released"
        if hb.unmix(*echo, tank=options.tank).of(host.address):
            return Mode.ARMED, "commanded" if echo in recent else "commanded by another host"
        return Mode.READY, "released"

    # -- sent -----------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Wheel], command: Command) -> Sequence[Frame]:
        host.own.drive(driven=True)
        self._given[host.address] = 1  # little enough to be enabled by, too little to turn
        return ()

    def command(self, now: Nanos, host: Host[Wheel], command: Command) -> Sequence[Frame]:
        options = host.options
        number = command.torque if isinstance(command, msg.Torque) else getattr(command, "velocity", 0.0)
        host.own.drive(driven=True)
        self._given[host.address] = round(number / options.unit) or options.least
        return ()

    def release(self, now: Nanos, host: Host[Wheel]) -> Sequence[Frame]:
        host.own.drive(driven=False)
        self._given[host.address] = 0
        return ()

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        given, options = self._given, self._options
        if not given or options is None:
            return ()
        if self._sent and now - self._sent[-1][0] < PACE:  # what lets go is not lost for that
            self._given = {address: 0 for address, counts in given.items() if not counts}
            return ()
        self._given = {}
        both = hb.mix(given.get(hb.LEFT, 0), given.get(hb.RIGHT, 0), tank=options.tank)
        self._sent = [*self._sent[-SENT:], (now, both)]
        return (hb.COMMANDS.encode("command", steer=both[0], speed=both[1]),)

    def poll_bus_due(self) -> Nanos:
        return self._sent[-1][0] + PACE if self._given and self._sent else NEVER
