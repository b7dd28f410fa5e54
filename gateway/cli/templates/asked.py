"""What is particular to a serial line on which devices speak only when asked.

FILL IN (clauses "one sends", "awaited", "lost", "dead", "newest" and "later") what is answered, by how many
bytes, and how long the device waits before it answers; and what is asked how often. Where each end sends when
it likes, remove this file and what `__init__` takes from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import Rank
from protocols.messages import Command, Nanos, Request, Velocity
from protocols.plugin import Device, FeedbackKind
from protocols.toolkit.duplicates import AnswerCount
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import MotorDriver, Pending, Rx
from protocols.toolkit.table import Decoded

from .driver import ANSWER, MotorAdapter
from .line_serial import SIZE, Line, question
from .table import PERIOD
from .twin import MotorTwin


def read_only(frame: Frame) -> bool:
    """True for whole questions and nothing else."""
    found = Line().read(frame, "to_device")
    asked = all(isinstance(each, Decoded) and each.name == "ask" for each in found)
    return isinstance(frame, bytes) and bool(found) and asked and len(frame) == len(found) * SIZE


ASKED: dict[str, Any] = {"line": "half-duplex", "feedback": FeedbackKind.POLLED, "read_only": read_only}
"""Fields of the spec."""


class AskedAdapter(MotorAdapter):
    """What devices are sent, with what they answer: this one answers everything with its status."""

    def __init__(self) -> None:
        super().__init__()
        self._line: Any = Line()
        self._asked: dict[str, Nanos] = {}
        """When each device was last asked."""

    def _report(
        self, t: Nanos, decoded: Decoded, driver: MotorDriver[AnswerCount]
    ) -> Report[AnswerCount] | Rx:
        report = super()._report(t, decoded, driver)
        # Two with one address garble each other's answers: they are not noticed by how many come.
        return report if isinstance(report, Rx) else replace(report, duplicate="")

    def arm(self, now: Nanos, host: Host[AnswerCount], command: Command) -> Sequence[Frame]:
        return (question("run", host.address, Rank.SET_POINT, velocity=0.0),)

    def command(self, now: Nanos, host: Host[AnswerCount], command: Command) -> Sequence[Frame]:
        velocity = command.velocity if isinstance(command, Velocity) else 0.0
        return (question("run", host.address, Rank.SET_POINT, velocity=velocity),)

    def release(self, now: Nanos, host: Host[AnswerCount]) -> Sequence[Frame]:
        return (question("stop", host.address, Rank.RELEASE),)

    def poll(self, now: Nanos, host: Host[AnswerCount]) -> Sequence[Frame]:
        if now < self.poll_due(host):
            return ()
        self._asked[host.name] = now
        return (question("ask", host.address, Rank.QUESTION),)

    def poll_due(self, host: Host[AnswerCount]) -> Nanos:
        return self._asked.get(host.name, -PERIOD) + PERIOD

    def begin(
        self,
        now: Nanos,
        request: Request,
        host: Host[AnswerCount] | None,
        driver: MotorDriver[AnswerCount],
    ) -> Pending[AnswerCount] | str:
        if host is None or not isinstance(request, msg.ClearFault):
            return "the device cannot do that"
        frames = (question("clear", host.address, Rank.QUESTION),)
        return Pending(request, host.name, now, now + ANSWER, now, host, frames)


class AskedTwin(MotorTwin):
    """One device, which sends nothing unasked."""

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self._line = Line()

    def cyclic(self) -> Mapping[str, Nanos]:
        return {}

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        super().on_frame(t, frame)
        for each in self._line.read(frame, "to_device"):
            if isinstance(each, Decoded) and each.address == self.device.address and each.name:
                self.reply(t, self.report("status"))
