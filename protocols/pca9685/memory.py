"""The registers of a chip as one output sees them, and what that does by them: for decoder and twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.asked import waiting
from protocols.frames import Frame
from protocols.messages import Nanos, Obeyed
from protocols.pca9685 import table as pt
from protocols.pca9685.options import Options
from protocols.plugin import Device
from protocols.toolkit import i2c


def registers() -> dict[int, int]:
    """Return the registers of a chip that was switched on, those that are not 0."""
    return dict(pt.RESET_VALUES)


@dataclass(slots=True)
class Output:
    """What one output makes of the transfers on its bus; of a motor that is reversible also the next one."""

    name: str
    address: int
    options: Options
    registers: dict[int, int] = field(default_factory=registers)
    pointer: int = 0

    def get(self, register: int) -> int:
        """Return the content of a register."""
        return self.registers.get(register, 0)

    @property
    def awake(self) -> bool:
        """Whether outputs are driven"""
        return not self.get(pt.MODE1) & pt.SLEEP

    def pair(self, beside: int = 0) -> tuple[int, int]:
        """Return when this output, or one beside it, goes on and off."""
        at = pt.LED0 + 4 * (pt.channel(self.address) + beside)
        return self.get(at) | self.get(at + 1) << 8, self.get(at + 2) | self.get(at + 3) << 8

    def high(self, beside: int = 0) -> int:
        """Return for how many counts of a period it is high."""
        on, off = self.pair(beside)
        if off & pt.FULL:
            return 0
        return pt.COUNTS if on & pt.FULL else (off - on) % pt.COUNTS

    def does(self) -> msg.Command:
        """Return what is on it does while it is awake."""
        name, options = self.name, self.options
        if options.kind == "servo":
            count = self.high()
            if not count:
                return msg.Idle(name)
            return msg.Position(name, options.position(count * options.count_us))
        if all(self.pair(beside) == (0, pt.FULL) for beside in range(1 + options.reversible)):
            return msg.Idle(name)
        share = (self.high() - (self.high(1) if options.reversible else 0)) / pt.COUNTS
        return msg.Velocity(name, share * options.full_scale)

    def obey(self, frame: Frame) -> Sequence[Obeyed]:
        """Apply a transfer; return what the output then does."""
        found = i2c.parse(frame)
        if found is None:
            return ()
        if found.address == i2c.GENERAL_CALL:
            return self._reset() if found.written == bytes((pt.SOFTWARE_RESET,)) else ()
        if found.address != pt.chip(self.address):
            return ()
        self.pointer = found.written[0]
        before = self.registers.copy()
        written = found.written[1:]
        kept = [each for value in written for each in self._write(value)]
        if self.registers == before and not self._touches(found.written):
            return kept
        return [*kept, *self._now(was_awake=not before.get(pt.MODE1, 0) & pt.SLEEP, touched=found.written)]

    def _touches(self, written: bytes) -> bool:
        """True if what was written is to its own registers."""
        first = pt.LED0 + 4 * pt.channel(self.address)
        end = first + 4 * (1 + self.options.reversible)
        return len(written) > 1 and (first <= written[0] < end or pt.ALL_LED <= written[0] < pt.PRE_SCALE)

    def _now(self, *, was_awake: bool, touched: bytes) -> Sequence[Obeyed]:
        if not self.awake:
            if was_awake:
                return (msg.Idle(self.name),)
            held = self.does()
            if not self._touches(touched):
                return ()
            return (held,) if isinstance(held, msg.Idle) else waiting(held)
        if was_awake and not self._touches(touched):
            return ()
        does = self.does()
        return (does,) if isinstance(does, msg.Idle) else (msg.Arm(self.name), does)

    def _reset(self) -> Sequence[Obeyed]:
        self.registers = registers()
        return (msg.Idle(self.name),)

    def _write(self, value: int) -> list[Obeyed]:
        """Write a byte where the pointer is; return what is kept of it that is no output's."""
        at, name = self.pointer, pt.register(self.pointer)
        if self.get(pt.MODE1) & pt.AUTO_INCREMENT:
            self.pointer = self.pointer + 1 & 0xFF
        if name == "LED":
            self._set(at, value)
            return []
        if name == "ALL_LED":
            for output in pt.CHANNELS:
                self._set(pt.LED0 + 4 * output + at - pt.ALL_LED, value)
            return [msg.Kept(self.name, name, float(value))]
        if name == "reserved" or (name == "PRE_SCALE" and self.awake):
            return [msg.Kept(self.name, name, float(value))]
        self._set(at, max(value, pt.LEAST_SCALE) if name == "PRE_SCALE" else value & ~pt.RESTART)
        return [msg.Kept(self.name, name, float(value))]

    def _set(self, register: int, value: int) -> None:
        self.registers[register] = value

    def load(self, register: int, data: bytes) -> None:
        """Take over what was read from the chip."""
        self.registers |= dict(enumerate(data, register))

    def read(self, count: int) -> bytes:
        """Return so many bytes from where the pointer is."""
        step = bool(self.get(pt.MODE1) & pt.AUTO_INCREMENT)
        found = bytes(self.get(self.pointer + at * step & 0xFF) for at in range(count))
        self.pointer = self.pointer + count * step & 0xFF
        return found


def output_of(device: Device) -> Output:
    """Return an output as it is when its chip is switched on."""
    return Output(device.name, device.address, device.options)


class OutputDecoder:
    """The command decoder of the outputs on one bus."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._outputs = [output_of(each) for each in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the outputs would obey in a transfer."""
        return [one for output in self._outputs for one in output.obey(frame)]
