"""The device's end, from the same declaration: what its messages command turns a shaft, which it reports.

Rules. It obeys as the command decoder does. A message that reports several motors is sent by the twin of the
first of them, for all. What the file has and nothing declares is sent with its initial value.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from protocols import messages as msg
from protocols.dbc.database import Raw
from protocols.dbc.table import FAULT, FAULTS, memory_of
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Mode, Nanos
from protocols.plugin import Device, Twin
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.servo import Encoder, Gains


class DbcTwin(ServoFirmware):
    """One motor."""

    faults = FAULTS

    def __init__(self, device: Device, seed: int) -> None:
        settings = device.settings
        super().__init__(device, seed, Gains(20.0, settings.gain, 10.0 * settings.gain, settings.torque))
        self.encoder = Encoder()
        self.memory = memory_of(device)
        self.others: tuple[DbcTwin, ...] = ()
        """The twins of the same bus, itself among them, in order"""
        self.counts: dict[str, int] = {}
        if self.memory.declared.fault is None:
            self.faults = {}

    def join(self, others: Sequence[Twin]) -> None:
        """Note the other twins of its bus."""
        found = [self, *(each for each in others if isinstance(each, DbcTwin))]
        self.others = tuple(sorted(found, key=lambda each: (each.device.address, each.device.name)))

    def _sharing(self, name: str) -> Iterator[DbcTwin]:
        """Yield the twins that a message reports."""
        return (each for each in self.others or (self,) if name in each.memory.declared.from_device)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for obeyed in self.memory.obey(frame):
            if isinstance(obeyed, msg.COMMANDS):
                self.feed(t)
            self.obey(t, obeyed)

    def disarm(self) -> None:
        super().disarm()
        self.memory.disarm()

    def timeout(self) -> Nanos:
        on = self.mode is Mode.ARMED
        return round(self.device.options.timeout_ms * MILLISECOND) if on else 0

    def cyclic(self) -> Mapping[str, Nanos]:
        period = round(self.device.options.feedback_ms * MILLISECOND)
        return dict.fromkeys(self.memory.declared.from_device, period)

    def report(self, name: str) -> Frame | None:
        if next(self._sharing(name)) is not self:
            return None
        message = self.memory.declared.messages[name]
        raws: dict[str, Raw] = {}
        for each in self._sharing(name):
            raws |= each.reported(name)
        if message.counter:
            count = self.counts[name] = self.counts.get(name, -1) + 1
            raws[message.counter] = count % (1 << message.signals[message.counter].bits)
        return message.encode(raws)

    def reported(self, name: str) -> dict[str, Raw]:
        """Return what it has to say in a message."""
        of, settings = self.memory.declared, self.device.settings
        values = {
            **self.measured(),
            "current": self.torque / settings.torque_constant,
            "voltage": settings.voltage,
            "temperature": settings.temperature,
        }
        if self.device.options.feedback.within_turn:
            values["position"] %= 6.283185307179586
        raws = {
            number.signal.name: number.sensed(values[key])
            for key, number in of.fed.items()
            if number.message == name
        }
        if of.state is not None and of.state[0].message == name:
            raws[of.state[0].signal.name] = of.state[1][0] if self.mode is Mode.ARMED else of.state[2]
        if of.fault is not None and of.fault[0].message == name:
            raws[of.fault[0].signal.name] = of.fault[1] + FAULT * (self.mode is Mode.FAULT)
        return raws
