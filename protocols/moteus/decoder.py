"""What moteus controllers would obey: the command registers remembered, a frame becomes the words it means.

Rules. `Axis` is what one device remembers of what it was told; the twin's firmware runs on the very same
object, so ear and twin cannot disagree on what is obeyed. Writing the mode begins a command: all other
command registers fall back to their defaults, and without it they change nothing that is obeyed. A frame for
one UUID is skipped by the others from the mask on; an ear that was not told a device's UUID takes it for that
device's. The ear knows neither faults nor timeouts, but for the one fault that is in the command itself: it
takes a mode as granted. Source: mjbots/moteus@1f4a195 `fw/moteus_controller.cc` (Write),
`docs/protocol/registers.md` (UUID mask, defaults, fault 45).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import isfinite, isnan, nan, tau

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Nanos, Request
from protocols.moteus.codec import (
    BROADCAST,
    INT32,
    TO_DEVICE,
    WRITE,
    Stream,
    Subframe,
    Values,
    parse,
    quantity,
)
from protocols.moteus.options import ADDRESS_MAX, SERIAL_BYTES, Options, Settings, serial_of, torque_constant
from protocols.moteus.registers import Mode, Register
from protocols.plugin import Device

UNKNOWN, NOT_WRITEABLE, BAD_VALUE = 1, 2, 3
"""Numbers of write errors; an unknown register is 1 for reading too."""
DEFAULTS: dict[int, float] = {
    Register.COMMAND_POSITION: 0.0,
    Register.COMMAND_VELOCITY: 0.0,
    Register.COMMAND_FEEDFORWARD_TORQUE: 0.0,
    Register.COMMAND_KP_SCALE: 1.0,
    Register.COMMAND_KD_SCALE: 1.0,
    Register.COMMAND_POSITION_MAX_TORQUE: nan,
    Register.COMMAND_STOP_POSITION: nan,
    Register.COMMAND_TIMEOUT: 0.0,
    Register.COMMAND_VELOCITY_LIMIT: nan,
    Register.COMMAND_ACCEL_LIMIT: nan,
    Register.COMMAND_FIXED_VOLTAGE_OVERRIDE: nan,
    Register.COMMAND_ILIMIT_SCALE: 1.0,
    Register.COMMAND_FIXED_CURRENT_OVERRIDE: nan,
    Register.COMMAND_IGNORE_POSITION_BOUNDS: 0.0,
    Register.COMMAND_WITHIN_LOWER_BOUND: 0.0,
    Register.COMMAND_WITHIN_UPPER_BOUND: 0.0,
    Register.COMMAND_Q_CURRENT: 0.0,
    Register.COMMAND_D_CURRENT: 0.0,
    **{Register(r): 0.0 for r in (0x10, 0x11, 0x12, 0x14, 0x15, 0x16, 0x18, 0x19, 0x1A, 0x1B, 0x1E)},
}
"""Of the command registers, at the beginning of each command; NaN is "not given"."""
SHADOWS: dict[int, int] = {
    Register.COMMAND_WITHIN_FEEDFORWARD_TORQUE: Register.COMMAND_FEEDFORWARD_TORQUE,
    Register.COMMAND_WITHIN_KP_SCALE: Register.COMMAND_KP_SCALE,
    Register.COMMAND_WITHIN_KD_SCALE: Register.COMMAND_KD_SCALE,
    Register.COMMAND_WITHIN_MAX_TORQUE: Register.COMMAND_POSITION_MAX_TORQUE,
    Register.COMMAND_WITHIN_TIMEOUT: Register.COMMAND_TIMEOUT,
    Register.COMMAND_WITHIN_ILIMIT_SCALE: Register.COMMAND_ILIMIT_SCALE,
    Register.COMMAND_WITHIN_IGNORE_POSITION_BOUNDS: Register.COMMAND_IGNORE_POSITION_BOUNDS,
}
"""Registers that are another name of one above."""
ACTIONS = (
    Register.SET_OUTPUT_NEAREST,
    Register.SET_OUTPUT_EXACT,
    Register.REQUIRE_REINDEX,
    Register.RECAPTURE_POSITION_VELOCITY,
)
CONTROL = (Register.COMMAND_KP_SCALE, Register.COMMAND_KD_SCALE, Register.COMMAND_ILIMIT_SCALE)
"""All of them are scaled to zero for a torque alone: an integrator that is left on goes on pushing."""
NOT_COMMANDED = (*(Mode.FAULT, Mode.ENABLING, Mode.CALIBRATING, Mode.CALIBRATION_COMPLETE), Mode.TIMEOUT)
"""Modes that the device enters by itself only."""
ZEROING = 1e-9
"""rev: a position set to less than this is zero."""


@dataclass(slots=True)
class Axis:
    """What one device remembers of what it was told. Revolutions, N·m."""

    motor: str
    address: int
    prefix: int
    kt: float
    """N·m/A"""
    uuid: bytes | None
    """None: not known (to an ear)."""
    command: dict[int, float] = field(default_factory=lambda: dict(DEFAULTS))
    mode: int = Mode.STOPPED
    """The mode that was last commanded."""
    line: bytes = b""
    """What the console has of a line that has not ended yet."""

    def write(self, register: int, value: float | None) -> int:
        """A register is written; the number of the error, or 0."""
        if register == Register.MODE:
            wanted = -1 if value is None else int(value)
            if wanted not in frozenset(Mode) or wanted in NOT_COMMANDED:
                return BAD_VALUE
            self.mode, self.command = wanted, dict(DEFAULTS)
            return 0
        register = SHADOWS.get(register, register)
        if register in DEFAULTS:
            self.command[register] = nan if value is None else value
            return 0
        if register in ACTIONS or Register.UUID_MASK1 <= register <= Register.UUID_MASK4:
            return 0
        return NOT_WRITEABLE if register in _KNOWN else UNKNOWN

    def word(self) -> Sequence[Command | Request]:
        """What the command registers amount to now."""
        get = self.command.__getitem__
        push = _finite(get(Register.COMMAND_FEEDFORWARD_TORQUE))
        match self.mode:
            case Mode.STOPPED:
                return (msg.Idle(self.motor),)
            case Mode.POSITION:
                return (msg.Idle(self.motor) if self._trips() else self._position(push),)
            case Mode.CURRENT:
                return (msg.Torque(self.motor, _finite(get(Register.COMMAND_Q_CURRENT)) * self.kt),)
            case Mode.ZERO_VELOCITY | Mode.BRAKE:
                return (msg.Velocity(self.motor, 0.0),)
            case Mode.STAY_WITHIN:  # inside its bounds it gives nothing but this
                return (msg.Torque(self.motor, push),)
        return (msg.WriteParameter(self.motor, "mode", float(self.mode)),)

    def _trips(self) -> bool:
        """Whether a stop position is commanded together with a limit: fault 45, and no torque."""
        get = self.command.__getitem__
        limits = (get(Register.COMMAND_VELOCITY_LIMIT), get(Register.COMMAND_ACCEL_LIMIT))
        return not isnan(get(Register.COMMAND_STOP_POSITION)) and any(limit >= 0.0 for limit in limits)

    def _position(self, push: float) -> Command:
        get = self.command.__getitem__
        position, velocity = get(Register.COMMAND_POSITION), _finite(get(Register.COMMAND_VELOCITY))
        if not any(get(register) for register in CONTROL):
            return msg.Torque(self.motor, push)
        if isfinite(position):
            return msg.Position(self.motor, position * tau, velocity * tau, push)
        return msg.Velocity(self.motor, velocity * tau, push)

    def console(self, data: bytes) -> list[str]:
        """A piece of the console's input; the lines that it completes."""
        *lines, self.line = (self.line + data).replace(b"\r", b"\n").split(b"\n")
        self.line = self.line[-256:]
        return [line.decode("ascii", "replace").strip() for line in lines if line.strip()]

    def renamed(self, line: str) -> bool:
        """Take a new id from a console's line, if it gives one."""
        words = line.split()
        if len(words) != 4 or words[:3] != ["conf", "set", "id.id"] or not words[3].isdecimal():
            return False
        address = int(words[3][:4])
        if not 1 <= address <= ADDRESS_MAX:
            return False
        self.address = address
        return True


_KNOWN = frozenset(Register)


def axis_of(device: Device, uuid: bytes | None) -> Axis:
    """A device as it stands after power-on."""
    options: Options = device.options
    settings: Settings = device.settings
    return Axis(device.name, device.address, options.can_prefix, torque_constant(settings), uuid)


def _finite(value: float) -> float:
    return value if isfinite(value) else 0.0


@dataclass(frozen=True, slots=True)
class One:
    """One register of a subframe, written or asked for: what a device takes in one go."""

    register: int
    resolution: int
    value: float | None = None
    asked: bool = False


def addressed(axis: Axis, frame: CanFrame) -> bool:
    """Whether a frame is for this device, or for all. Whether it is extended does not matter."""
    return (
        not frame.remote
        and frame.id >> 16 == axis.prefix
        and not frame.id & 0x80
        and frame.id & 0x7F in (axis.address, BROADCAST)
    )


def effective(axis: Axis, data: bytes) -> Iterator[Subframe]:
    """What a device takes of a frame's data: all up to a flaw, or to a UUID that is not its own."""
    for subframe in parse(data)[0]:
        if isinstance(subframe, Values) and subframe.code == WRITE:
            if not _matches(axis.uuid, subframe):
                return
            yield subframe
        elif not isinstance(subframe, Values):
            yield subframe


def for_another(axis: Axis, data: bytes) -> bool:
    """Whether a frame is for a device with another UUID: then it is not answered either."""
    writes = (s for s in parse(data)[0] if isinstance(s, Values) and s.code == WRITE)
    return not all(_matches(axis.uuid, subframe) for subframe in writes)


def _matches(uuid: bytes | None, subframe: Values) -> bool:
    """Whether a UUID fits the masks that are written, if any."""
    for i, raw in enumerate(subframe.raw):
        at = subframe.start + i - Register.UUID_MASK1
        if 0 <= at < 4:
            if subframe.resolution != INT32:
                return False
            if uuid is not None and struct.pack("<i", int(raw)) != uuid[4 * at : 4 * at + 4]:
                return False
    return True


class MoteusDecoder:
    """What the moteus controllers of one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.axes = [axis_of(device, _known_uuid(device)) for device in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:  # noqa: ARG002 -- the interface's
        """The words that the devices would obey; [] if none would do anything."""
        if not isinstance(frame, CanFrame):
            return []
        return [w for axis in self.axes if addressed(axis, frame) for w in obey(axis, frame.data)]


def _known_uuid(device: Device) -> bytes | None:
    settings: Settings = device.settings
    return bytes.fromhex(settings.uuid) if settings.uuid else None


def obey(axis: Axis, data: bytes) -> list[Command | Request]:
    """Let a device hear a frame's data; what that makes it do, in words."""
    words: list[Command | Request] = []
    commanded, mask = False, bytearray()
    for subframe in effective(axis, data):
        if isinstance(subframe, Values):
            for i, raw in enumerate(subframe.raw):
                register = subframe.start + i
                if Register.UUID_MASK1 <= register <= Register.UUID_MASK4:
                    mask += struct.pack("<i", int(raw))
                    continue
                value = quantity(register, subframe.resolution, raw)
                taken = axis.write(register, value) == 0
                commanded |= taken and register == Register.MODE
                words += _acted(axis.motor, register, value) if taken else ()
        elif isinstance(subframe, Stream) and subframe.code == TO_DEVICE and subframe.channel == 1:
            words += _typed(axis, subframe.data, bytes(mask))
    return [*(axis.word() if commanded else ()), *words]


def _acted(motor: str, register: int, value: float | None) -> Sequence[Request]:
    """What a register does at once, by being written."""
    if register not in ACTIONS:
        return ()
    name = Register(register).name.lower()
    if register in (Register.SET_OUTPUT_EXACT, Register.SET_OUTPUT_NEAREST):
        if value is None:
            return ()
        return (msg.Zero(motor),) if abs(value) < ZEROING else (msg.WriteParameter(motor, name, value),)
    return (msg.WriteParameter(motor, name, value or 0.0),)


def _typed(axis: Axis, data: bytes, mask: bytes) -> list[Request]:
    words: list[Request] = []
    for line in axis.console(data):
        if axis.uuid is None and mask:  # which of the devices it is, is not known here
            other = Axis("", 0, 0, 1.0, None)
            if other.renamed(line):
                serial = mask[:SERIAL_BYTES].ljust(SERIAL_BYTES, b"\0")
                words.append(msg.SetId("", int.from_bytes(serial, "big"), other.address))
        elif axis.renamed(line):
            words.append(msg.SetId("", serial_of(axis.uuid or bytes(16)), axis.address))
        if line == "conf write":
            words.append(msg.WriteParameter(axis.motor, "conf_write", 1.0))
    return words
