"""What moteus controllers obey: their command registers, id and console; and the command decoder.

Rules. `Memory` is what one device keeps of the frames it received; the twin's firmware runs on the very same
class, so decoder and twin cannot disagree. Writing the mode begins a command: all other command registers
fall back to their defaults, and without it they change nothing that is obeyed. A frame for one UUID is skipped
by the others from the mask on; a decoder that does not know a device's UUID takes the frame for that device's.
The decoder knows neither faults nor timeouts, except the one fault that is in the command itself: it takes a
mode as granted. Source: mjbots/moteus@1f4a195 `fw/moteus_controller.cc` (Write), `docs/protocol/registers.md`
(UUID mask, defaults, fault 45).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, nan, tau

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Nanos, Obeyed, Request
from protocols.moteus import table as reg
from protocols.moteus.codec import (
    ADDRESS_MAX,
    BROADCAST,
    INT32,
    SERIAL_BYTES,
    TO_DEVICE,
    WRITE,
    WRITE_ERROR,
    Subframe,
    parse,
    quantities,
    serial_of,
)
from protocols.moteus.settings import torque_constant
from protocols.moteus.table import LATCHED, NAMES, RISING, Mode
from protocols.plugin import Device

UNKNOWN, NOT_WRITEABLE, BAD_VALUE = 1, 2, 3
"""Numbers of write errors; an unknown register is 1 for reading too."""
_FIELDS = (
    *range(0x010, 0x013),
    *range(0x014, 0x017),
    *range(0x018, 0x01F),
    *range(0x020, 0x02E),
    0x040,
    0x041,
)
"""The command registers."""
DEFAULTS: Mapping[str, float] = {
    **{NAMES[number]: 0.0 for number in _FIELDS},
    **{f"command_{gain}_scale": 1.0 for gain in ("kp", "kd", "ilimit")},
    **{f"command_{limit}_limit": nan for limit in ("velocity", "accel")},
    **{f"command_fixed_{what}_override": nan for what in ("voltage", "current")},
    "command_position_max_torque": nan,
    "command_stop_position": nan,
}
"""Values of the command registers at the beginning of each command; NaN is "not given"."""


_STAY_WITHIN = {
    number: name.replace("within_max", "position_max").replace("within_", "")
    for number, name in NAMES.items()
    if name.startswith("command_within_") and name not in DEFAULTS
}
COMMAND_NAMES: Mapping[int, str] = {number: NAMES[number] for number in _FIELDS} | _STAY_WITHIN
"""The command register in which a number is kept: those of stay-within are other numbers of the same."""
COMMANDED = frozenset(Mode) - {*LATCHED, *RISING}
"""The others only the device itself enters."""


@dataclass(slots=True)
class Memory:
    """What one device keeps of the frames it received. Revolutions, N·m."""

    motor: str
    address: int
    prefix: int
    kt: float
    """N·m/A"""
    uuid: bytes | None
    """None: not known (to a decoder)."""
    command: dict[str, float] = field(default_factory=lambda: {**DEFAULTS})
    mode: int = Mode.STOPPED
    """The mode that was last commanded."""
    begun: bool = False
    """The last frame began a command."""
    line: bytes = b""
    """Console input of a line that has not ended yet."""

    def is_addressed(self, frame: CanFrame) -> bool:
        """True if a frame is for this device, or for all. Whether it is extended does not matter."""
        number = frame.id
        fits = not frame.remote and number >> 16 == self.prefix and not number & 0x80
        return fits and number & 0x7F in (self.address, BROADCAST)

    def chosen(self, data: bytes) -> tuple[list[Subframe], bool]:
        """Return what the device takes of a frame's data: all up to a flaw, or to a UUID mask that does not
        fit; and whether it fits, since else there is no reply either."""
        taken: list[Subframe] = []
        for subframe in parse(data)[0]:
            for at, part in _mask(subframe):
                if not part or (self.uuid is not None and self.uuid[4 * at : 4 * at + 4] != part):
                    return taken, False
            taken.append(subframe)
        return taken, True

    def obey(self, subframes: Sequence[Subframe]) -> Iterator[Request | Subframe]:
        """Take a frame. Yields in order what the device does at once, and as subframes what it does not
        accept, and all that is not for it to do but to answer."""
        self.begun, masks = False, b""
        for subframe in subframes:
            if subframe.code == WRITE:
                masks += b"".join(raw for _, raw in _mask(subframe))
                for register, value in quantities(subframe):
                    number = self.write(register, value)
                    if number:
                        yield Subframe(WRITE_ERROR, register, number=number)
                    else:
                        yield from self._action(register, value)
            elif subframe.code != TO_DEVICE:
                yield subframe
            elif subframe.register == 1:
                yield from self._console(subframe.data, masks)

    def write(self, register: int, value: float | None) -> int:
        """Write a register. Returns the number of the write error, or 0."""
        if register == reg.MODE:
            mode = -1 if value is None else int(value)
            if mode not in COMMANDED:
                return BAD_VALUE
            self.mode, self.command, self.begun = mode, {**DEFAULTS}, True
            return 0
        name = COMMAND_NAMES.get(register)
        if name is not None:
            self.command[name] = nan if value is None else value
        elif register not in reg.ACTIONS and register not in reg.UUID_MASK:
            return NOT_WRITEABLE if register in NAMES else UNKNOWN
        return 0

    def _action(self, register: int, value: float | None) -> Iterator[Request]:
        """Yield what a register does at once by being written."""
        name = NAMES.get(register, "")
        if name.startswith("set_output"):
            if value is not None:
                zero = abs(value) < 1e-9
                yield msg.Zero(self.motor) if zero else msg.WriteParameter(self.motor, name, value)
        elif register in reg.ACTIONS:
            yield msg.WriteParameter(self.motor, name, value or 0.0)

    def _console(self, data: bytes, mask: bytes) -> Iterator[Request | Subframe]:
        """Take a piece of console input. Yields what its lines make the device do, and other lines."""
        *lines, self.line = (self.line + data).replace(b"\r", b"\n").split(b"\n")
        self.line = self.line[-256:]
        for line in lines:
            words = line.decode("ascii", "replace").split()
            address = _id_in(words)
            if address is not None:
                if self.uuid is not None or not mask:  # else it is not known here which device this is
                    self.address = address
                yield msg.SetId("", serial_of(self.uuid or mask.ljust(SERIAL_BYTES, b"\0")), address)
            elif words == ["conf", "write"]:
                yield msg.WriteParameter(self.motor, "conf_write", 1.0)
            elif words:
                yield Subframe(TO_DEVICE, 1, data=" ".join(words).encode())

    def begins(self) -> Sequence[Obeyed]:
        """Return the command that the last frame began, if it did."""
        if not self.begun:
            return ()
        command = self.message()
        return (command,) if isinstance(command, msg.Idle) else (msg.Arm(self.motor), command)

    def message(self) -> Command | Request:
        """Return what the command registers amount to now."""
        motor, push = self.motor, self.given("feedforward_torque")
        match self.mode:
            case Mode.STOPPED:
                return msg.Idle(motor)
            case Mode.POSITION:
                limited = any(
                    self.command[f"command_{limit}_limit"] >= 0.0 for limit in ("velocity", "accel")
                )
                if limited and not math.isnan(self.command["command_stop_position"]):
                    return msg.Idle(motor)  # fault 45
                # An integrator that is left on goes on pushing: that is no torque alone.
                if not any(self.command[f"command_{gain}_scale"] for gain in ("kp", "kd", "ilimit")):
                    return msg.Torque(motor, push)
                position, velocity = self.command["command_position"], self.given("velocity") * tau
                if isfinite(position):
                    return msg.Position(motor, position * tau, velocity, push)
                return msg.Velocity(motor, velocity, push)
            case Mode.CURRENT:
                return msg.Torque(motor, self.given("q_current") * self.kt)
            case Mode.ZERO_VELOCITY | Mode.BRAKE:
                return msg.Velocity(motor, 0.0)
            case Mode.STAY_WITHIN:  # inside its bounds it gives only the feed-forward
                return msg.Torque(motor, push)
        return msg.WriteParameter(motor, "mode", float(self.mode))

    def given(self, name: str, default: float = 0.0) -> float:
        """Return a command register, or a default where it is "not given"."""
        value = self.command[f"command_{name}"]
        return default if math.isnan(value) else value


def memory(device: Device, uuid: bytes | None) -> Memory:
    """Return the memory of a device after power-on."""
    kt = torque_constant(device.settings.motor_kv)
    return Memory(device.name, device.address, device.options.can_prefix, kt, uuid)


def _mask(subframe: Subframe) -> list[tuple[int, bytes]]:
    """Return which quarters of a UUID a subframe demands; b"" for one that is no int32."""
    if subframe.code != WRITE or subframe.register + len(subframe.raw) <= reg.UUID_MASK.start:
        return []
    return [
        (at - reg.UUID_MASK.start, struct.pack("<i", raw) if subframe.resolution == INT32 else b"")
        for at, raw in enumerate(subframe.raw, subframe.register)
        if at in reg.UUID_MASK
    ]


def _id_in(words: Sequence[str]) -> int | None:
    """Return the id that a console line sets, or None."""
    if len(words) != 4 or words[:3] != ["conf", "set", "id.id"] or not words[3].isdecimal():
        return None
    address = int(words[3][:4])
    return address if 1 <= address <= ADDRESS_MAX else None


class MoteusDecoder:
    """Decodes what the moteus controllers of one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.memories = [memory(each, bytes.fromhex(each.settings.uuid) or None) for each in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return the messages that the devices would obey; [] if none would do anything."""
        obeyed: list[Obeyed] = []
        for device in self.memories:
            if isinstance(frame, CanFrame) and device.is_addressed(frame):
                done = device.obey(device.chosen(frame.data)[0])
                at_once = [each for each in done if not isinstance(each, Subframe)]
                obeyed += [*device.begins(), *at_once]
        return obeyed
