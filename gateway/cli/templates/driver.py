"""The host's end: what the device is sent in each phase, and what its messages report.

FILL IN what arms the real device, what is polled, which requests it has. The clauses "passive", "jump",
"disarm", "faults", "offline", "duplicates" and "replies" check it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Feedback, Mode, Nanos, Request, Velocity
from protocols.plugin import Device
from protocols.toolkit.duplicates import AnswerCount
from protocols.toolkit.host import Host, Report, Timing
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.table import Decoded

from .line import Line, encode
from .table import FAULTS, NAME, PERIOD, TABLE

ANSWER: Nanos = 200 * MILLISECOND
"""Timeout of a request."""
OFFLINE: Nanos = 100 * MILLISECOND
"""Time without a message after which a device is offline."""
MODES = {0: (Mode.READY, "ready"), 1: (Mode.ARMED, "running"), 2: (Mode.FAULT, "fault")}


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver. FILL IN: typed fields with defaults, or none."""


class MotorAdapter(Adapter[AnswerCount]):
    """What devices are sent, and what they report."""

    name = NAME
    faults = FAULTS

    def __init__(self) -> None:
        self._line = Line()

    def own(self, device: Device) -> AnswerCount:
        return AnswerCount()

    def timing(self, options: Options) -> Timing:
        return Timing(OFFLINE)

    def interrupted(self) -> None:
        self._line.drop()

    # -- received -------------------------------------------------------------------------------------

    def receive(
        self, t: Nanos, frame: Frame, driver: MotorDriver[AnswerCount]
    ) -> Sequence[Report[AnswerCount] | Rx]:
        found = self._line.read(frame, "from_device")
        return [each if isinstance(each, Rx) else self._report(t, each, driver) for each in found]

    def _report(
        self, t: Nanos, decoded: Decoded, driver: MotorDriver[AnswerCount]
    ) -> Report[AnswerCount] | Rx:
        host, values = driver.at.get(decoded.address), decoded.values
        if host is None:
            return Rx.IGNORED
        if not decoded.name or values["mode"] not in MODES or values["fault"] not in (0, *FAULTS):
            return Rx.MALFORMED
        mode, detail = MODES[values["mode"]]
        velocity = values["velocity"]
        # FILL IN (clause "saturated"): at the end of its range a value may as well be beyond it.
        _, fastest = TABLE.row("status").field("velocity").ends()
        feedback = Feedback(host.name, t, values["position"], velocity if abs(velocity) < fastest else None)
        host.own.ask(round((t - (host.received_at or t)) / PERIOD))
        faults = [values["fault"]] if values["fault"] else []
        return Report(host, host.address, mode, detail, faults, feedback, duplicate=host.own.add(t))

    # -- sent -----------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[AnswerCount], command: Command) -> Sequence[Frame]:
        return (encode("run", host.address, velocity=0.0),)

    def command(self, now: Nanos, host: Host[AnswerCount], command: Command) -> Sequence[Frame]:
        velocity = command.velocity if isinstance(command, Velocity) else 0.0
        return (encode("run", host.address, velocity=velocity),)

    def release(self, now: Nanos, host: Host[AnswerCount]) -> Sequence[Frame]:
        return (encode("stop", host.address),)

    def begin(
        self,
        now: Nanos,
        request: Request,
        host: Host[AnswerCount] | None,
        driver: MotorDriver[AnswerCount],
    ) -> Pending[AnswerCount] | str:
        if host is None or not isinstance(request, msg.ClearFault):
            return "the device cannot do that"
        frames = (encode("clear", host.address),)
        return Pending(request, host.name, now, now + ANSWER, now, host, frames)
