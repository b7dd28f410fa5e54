"""The host's end: what controllers are sent, and what their feedback reports.

Rules. Four controllers share one frame, with a current for each: a frame is made at the end of a step, of
the currents that were given in this step; one that was given none gets 0, which lets go. A frame goes out
only if one of its four was given something. No word enables a controller, and no report says that it is
driven: it counts as armed while it was last sent a current other than 0, and when it measures one that we did
not send. Released, it is sent 0 for the time in which its timeout lets it go, whatever it received; and from
then on again and again, if it was ever commanded: a late frame may drive it with less than is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Feedback, Mode, Nanos, Request, seconds
from protocols.plugin import Device
from protocols.robomaster import table as rm
from protocols.robomaster.options import Options
from protocols.toolkit.duplicates import ShaftCheck
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.motor_driver import NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.table import Values

CLEARED: Nanos = 1000 * MILLISECOND
"""Time in which an error must have passed after ClearFault"""
AGAIN: Nanos = 50 * MILLISECOND
"""Period of 0 to a controller that was commanded once, and is not now"""
APART = 0.5
"""rad by which the positions of two rotors differ at least, to be noticed as two"""


@dataclass(slots=True)
class Controller:
    """What is known of one controller beyond its phase. Plain data."""

    group: str
    slot: str
    idle_current: float
    """A"""
    timeout: Nanos
    """After which it has let go, if it got nothing"""
    shaft: ShaftCheck = field(default_factory=lambda: ShaftCheck(APART))
    heard_at: Nanos | None = None
    position: float = 0.0
    """rad of the rotor, with its turns since it was first reported"""
    velocity: float = 0.0
    """rad/s"""
    current: float = 0.0
    """A, measured"""
    error: int = 0
    sent: int = 0
    """Counts that it was last sent,"""
    sent_at: Nanos = 0
    """and when."""

    def forget(self) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.heard_at, self.sent, self.current, self.error = None, 0, 0.0, 0

    def see(self, t: Nanos, values: Values, options: Options) -> None:
        """Record its feedback. The rotor is where its angle says, in the turn that is nearest to where its
        velocity has brought it."""
        angle, velocity = values["angle"] * math.tau / rm.COUNTS, values["velocity"] * rm.RPM
        since = seconds(0 if self.heard_at is None else t - self.heard_at)
        expected = self.position + 0.5 * (self.velocity + velocity) * since
        self.position = expected + math.remainder(angle - expected, math.tau)
        self.heard_at, self.velocity = t, velocity
        self.current = values["current"] * options.ampere
        self.error = values["error"] if options.error_byte else 0

    def send(self, now: Nanos, counts: int) -> int:
        """Record the current that it is sent, and return it."""
        self.sent, self.sent_at = counts, now
        return counts

    def mode(self, t: Nanos) -> tuple[Mode, str]:
        """Return its mode, and a name for it."""
        if self.error:
            return Mode.FAULT, f"error {self.error}"
        fed = self.sent and t - self.sent_at <= self.timeout
        if fed or abs(self.current) > self.idle_current:
            return Mode.ARMED, "driven"
        return Mode.READY, "timeout" if self.sent else "released"


class RoboMasterAdapter(Adapter[Controller]):
    """What controllers are sent, and what they report."""

    name = "robomaster"
    faults, latch = rm.FAULTS, True

    def __init__(self) -> None:
        self.controllers: dict[int, tuple[str, Controller]] = {}
        """By the number of the feedback: name, and what is known."""
        self.given: dict[str, int] = {}
        """Counts that were given in this step, by name."""

    def own(self, device: Device) -> Controller:
        options: Options = device.options
        number = device.address + options.of_model.feedback
        if number in self.controllers:
            raise ValueError(
                f"{device.name} and {self.controllers[number][0]} both report by {0x200 + number:#x}: IDs 1 "
                "to 4 of a GM6020 are 5 to 8 of a C610 or C620; give one another ID"
            )
        timeout = (11 * options.timeout_ms // 10 + 5) * MILLISECOND
        own = Controller(*options.of_model.group_of(device.address), options.idle_current, timeout)
        self.controllers[number] = device.name, own
        return own

    def timing(self, options: Options) -> Timing:
        reports = (11 * options.timeout_ms // 10 + 5) // rm.PERIOD_MS
        return Timing(options.offline_ms * MILLISECOND, confirmations=reports)

    # -- received -------------------------------------------------------------------------------------

    def receive(
        self, t: Nanos, frame: Frame, driver: MotorDriver[Controller]
    ) -> Sequence[Report[Controller] | Rx]:
        decoded = rm.TABLE.decode(frame, "from_device")
        if decoded is None or not isinstance(frame, CanFrame) or frame.id & 0xF not in self.controllers:
            return (Rx.IGNORED,)
        host, values = driver.hosts[self.controllers[frame.id & 0xF][0]], decoded.values
        if not decoded.name or values["angle"] >= rm.COUNTS:
            return (Rx.MALFORMED,)
        own, options = host.own, host.options
        own.see(t, values, options)
        mode, detail = own.mode(t)
        full = abs(values["velocity"]) >= (1 << 15) - 1  # it may as well be faster
        feedback = Feedback(
            host.name,
            t,
            own.position,
            None if full else own.velocity,
            values["current"] * options.torque,
            own.current,
            temperature=float(values["temperature"]) or None,  # a C610 has none
        )
        two = own.shaft.add(t, own.position, own.velocity)
        faults = (rm.ERROR,) if own.error else ()
        duplicate = "positions of two rotors" if two else ""
        return (Report(host, host.address, mode, detail, faults, feedback, duplicate),)

    # -- sent -----------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Controller], command: Command) -> Sequence[Frame]:
        self.given[host.name] = 1  # a count drives nothing
        return ()

    def command(self, now: Nanos, host: Host[Controller], command: Command) -> Sequence[Frame]:
        wanted = round(getattr(command, "torque", 0.0) / host.options.torque)
        self.given[host.name] = wanted or 1  # 0 lets go
        return ()

    def release(self, now: Nanos, host: Host[Controller]) -> Sequence[Frame]:
        self.given[host.name] = 0
        return ()

    def poll(self, now: Nanos, host: Host[Controller]) -> Sequence[Frame]:
        if now >= self.poll_due(host):
            self.given.setdefault(host.name, 0)
        return ()

    def poll_due(self, host: Host[Controller]) -> Nanos:
        rests = host.once_commanded and host.phase not in (Phase.ARMING, Phase.ARMED)
        return host.own.sent_at + AGAIN if rests else NEVER

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        given, self.given = self.given, {}
        frames: dict[str, dict[str, int]] = {}
        for name, own in self.controllers.values():
            if name in given:
                frames[own.group] = dict.fromkeys(rm.SLOTS, 0)
        for name, own in self.controllers.values():
            if own.group in frames:
                frames[own.group][own.slot] = own.send(now, given.get(name, 0))
        return [rm.TABLE.encode(group, **currents) for group, currents in frames.items()]

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Controller] | None, driver: MotorDriver[Controller]
    ) -> Pending[Controller] | str:
        if isinstance(request, msg.ClearFault) and host is not None:  # its errors pass by themselves
            return Pending(request, host.name, now, now + CLEARED, now, host, sent=1)
        return "the device cannot do that on this bus"
