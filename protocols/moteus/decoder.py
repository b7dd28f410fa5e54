"""What moteus controllers obey: their command registers, id and console; and the command decoder.

Rules. `Memory` is what one device keeps of the frames it received; the twin's firmware runs on the very same
class, so decoder and twin cannot disagree. Writing the mode begins a command: all other command registers
fall back to their defaults, and without it they change nothing that is obeyed. A frame for one UUID is
skipped by the others from the mask on, its command too; a decoder that does not know a device's UUID takes
the frame for that device's. The decoder knows neither faults nor timeouts, except the one fault that is in
the command itself: it takes a mode as granted. Source: mjbots/moteus@db1a762 `fw/moteus_controller.cc`
(Write, CompleteFrame), `fw/bldc_servo_control.h` (PrepareCommand: limits, fault 45).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy, deepcopy
from math import inf, isclose, isfinite, isnan, nan, tau
from typing import Any, NamedTuple

from protocols import messages as msg
from protocols.asked import set_id
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Nanos, Obeyed, Request
from protocols.moteus import codec
from protocols.moteus import table as tb
from protocols.moteus.codec import INT8, INT32, READ, TO_DEVICE, WRITE, Subframe
from protocols.moteus.loops import MOST_TORQUE, WATCHDOG_MODES, Settings, given, limits_of
from protocols.moteus.table import NAMES, Mode
from protocols.plugin import Device
from protocols.toolkit.servo import clamp

UNKNOWN, NOT_WRITEABLE = 1, 2
"""Numbers of write errors; an unknown register is 1 for reading too."""
DEFAULTS: Mapping[str, float] = {
    **{NAMES[number]: 0.0 for number in (*range(0x010, 0x02E), 0x040, 0x041) if number in NAMES},
    **dict.fromkeys(("command_kp_scale", "command_kd_scale", "command_ilimit_scale"), 1.0),
    **dict.fromkeys(("command_velocity_limit", "command_accel_limit", "command_stop_position"), nan),
    **dict.fromkeys(("command_fixed_voltage_override", "command_fixed_current_override"), nan),
    "command_position_max_torque": MOST_TORQUE,
}
"""The command registers as they are at the beginning of each command; NaN is "not given"."""
COMMAND_NAMES: Mapping[int, str] = {
    number: name if name in DEFAULTS else name.replace("within_max", "position_max").replace("within_", "")
    for number, name in NAMES.items()
    if name in DEFAULTS or name.startswith("command_within_")
}
"""The command register in which a number is kept: those of stay-within are other numbers of the same."""
BRIEF = 0.001
"""s: a watchdog timeout below, or a negative one, is over before the command is executed."""
SENT = frozenset(
    {Mode.STOPPED, Mode.POSITION, Mode.STAY_WITHIN, Mode.ZERO_VELOCITY, Mode.BRAKE, Mode.TIMEOUT}
)
"""Modes that are sent here, or that stand for one."""
_OTHERS = "timeout position_max_torque stop_position ignore_position_bounds"
_OTHERS += " fixed_voltage_override fixed_current_override"
OTHERS = tuple(f"command_{name}" for name in _OTHERS.split())
"""What a command says beside its numbers,"""
TRAJECTORY = "command_velocity_limit", "command_accel_limit"
"""and that of position control;"""
GAINS = "command_kp_scale", "command_kd_scale", "command_ilimit_scale"
"""and its gains, where they are no numbers of the command."""
COMMANDED = frozenset(Mode) - {Mode.FAULT, *tb.RISING}
"""A command of another mode is accepted, and ignored."""
WRITEABLE = frozenset({tb.MODE, *tb.ACTIONS, *tb.UUID_MASK, *COMMAND_NAMES})
"""Registers to be written, as far as is known here."""
SHAPES_KEPT = 4
"""Most shapes of one length that a decoder remembers."""


class Shape(NamedTuple):
    """Frames that differ in their numbers alone, and that write the mode, then numbers of its command, and
    read: what is sent while a motor turns. They are taken apart by one `struct`."""

    mask: int
    """Of the data as an integer, the first byte lowest: all but the numbers."""
    rest: int
    """The data under the mask."""
    numbers: Callable[[bytes], tuple[Any, ...]]
    """Returns the mode, then the numbers as they are encoded."""
    registers: tuple[tuple[str, int, int], ...]
    """Of each number: its command register, by name and number, and the resolution."""


def shape_of(data: bytes) -> Shape | None:
    """Return the shape of a frame; None if it does anything else, or is not encoded as is usual here."""
    mask, layout, registers, at, end = bytearray(b"\xff" * len(data)), "<", [], 0, 0
    for subframe in codec.parse(data)[0]:
        code, register, resolution, raw, *_ = subframe
        encoded = codec.encode(subframe)
        if code not in (WRITE, READ) or data[at : at + len(encoded)] != encoded:
            return None
        at += len(encoded)
        if code == WRITE:
            size = codec.SIZES[resolution] * len(raw)
            mask[at - size : at] = bytes(size)
            layout += f"{at - size - end}x{len(raw)}{codec.CODES[resolution]}"
            registers += [(number, resolution) for number in range(register, register + len(raw))]
            end = at
    written = registers[1:]
    if not registers or registers[0] != (tb.MODE, INT8) or data[at:].strip(bytes((codec.NOP,))):
        return None
    if any(register not in COMMAND_NAMES for register, _ in written):
        return None
    kept = int.from_bytes(mask, "little")
    return Shape(
        kept,
        int.from_bytes(data, "little") & kept,
        struct.Struct(f"{layout}{len(data) - end}x").unpack,
        tuple((COMMAND_NAMES[register], register, resolution) for register, resolution in written),
    )


class Shapes:
    """The shapes that were seen. Copies of a decoder share them: what is remembered changes no answer."""

    def __init__(self) -> None:
        self._seen: dict[int, list[Shape]] = {}
        """By length."""

    def __deepcopy__(self, memo: object) -> Shapes:
        """It is shared."""
        return self

    def of(self, data: bytes) -> Shape | None:
        """Return the shape of a frame; None if it has none."""
        if len(data) < 2 or data[0] & ~0b11 or data[1] != tb.MODE:  # it does not begin by writing the mode
            return None
        seen, number = self._seen.setdefault(len(data), []), int.from_bytes(data, "little")
        for shape in seen:
            if number & shape.mask == shape.rest:
                return shape
        made = shape_of(data)
        if made is not None and len(seen) < SHAPES_KEPT:
            seen.append(made)
        return made


class Memory:
    """What one device keeps of the frames it received. Revolutions, N·m. Plain data."""

    def __init__(self, device: Device, uuid: bytes) -> None:
        """`uuid`: b"" if it is not known (to a decoder)."""
        self.settings: Settings = device.settings
        self.motor, self.address, self.uuid = device.name, device.address, uuid
        self.prefix: int = device.options.can_prefix
        self.gains: tuple[float, float] = device.options.gains
        self.own: dict[str, float] = DEFAULTS | device.options.stated
        """The command registers as they are in all commands of the driver."""
        self.within: tuple[float, float] = (device.options.within_min, device.options.within_max)
        self.command = {**DEFAULTS}
        self.mode: int = Mode.STOPPED  # as last commanded
        self.begun = False  # the last frame began a command
        self.chosen = True  # its UUID mask fits: else there is no reply either
        self._line = b""  # console input of a line that has not ended yet

    def is_addressed(self, frame: CanFrame) -> bool:
        """True if a frame is for this device, or for all. Whether it is extended does not matter."""
        if frame.remote or frame.id & 0x80 or frame.id >> 16 != self.prefix:
            return False
        return frame.id & 0x7F in (self.address, codec.BROADCAST)

    def obey(self, data: bytes) -> Iterator[Request | Subframe]:
        """Take a frame's data, up to a flaw or a UUID mask that does not fit. Yields in order what the device
        does at once, and as subframes what it does not accept, and what it has to answer."""
        self.begun, self.chosen, mask = False, True, b""
        for subframe in codec.parse(data)[0]:
            for at, part in _mask(subframe):
                self.chosen &= part != b"" and self.uuid[4 * at : 4 * at + 4] in (part, b"")
                mask += part
            if not self.chosen:
                self.begun = False
                return
            if subframe.code == WRITE:
                for register, value in subframe.quantities():
                    number = self._write(register, value)
                    if number:
                        yield Subframe(codec.WRITE_ERROR, register, number=number)
                    elif register in tb.ACTIONS:
                        yield from self._act(NAMES[register], value)
            elif subframe.code != TO_DEVICE:
                yield subframe
            elif subframe.register == 1:
                yield from self._console(subframe.data, mask)

    def command_by(self, shape: Shape, data: bytes) -> bool:
        """Take a frame of a known shape, as `obey` would; False: its mode is none, and nothing was taken."""
        mode, *numbers = shape.numbers(data)
        if mode not in range(len(Mode)):
            return False
        self.mode, self.begun, self.chosen = mode, mode in COMMANDED, True
        self.command = command = {**DEFAULTS}
        for (name, register, resolution), raw in zip(shape.registers, numbers, strict=True):
            value = codec.from_raw(register, resolution, raw)
            command[name] = nan if value is None else value
        return True

    def __deepcopy__(self, memo: object) -> Memory:
        """Copy what frames change: all else is constant. The guard does that every few frames."""
        made = copy(self)
        made.become_another()
        return made

    def become_another(self) -> None:
        """Have a command of its own from now on, and no longer that of the memory that it is a copy of."""
        self.command = {**self.command}

    def _write(self, register: int, value: float | None) -> int:
        """Write a register. Returns the number of the write error, or 0."""
        name = COMMAND_NAMES.get(register)
        if name is not None:
            self.command[name] = nan if value is None else value
        elif register == tb.MODE:
            mode = -1 if value is None else int(value)
            if mode not in range(len(Mode)):
                return UNKNOWN
            self.mode, self.command, self.begun = mode, {**DEFAULTS}, mode in COMMANDED
        elif register not in tb.ACTIONS and register not in tb.UUID_MASK:
            return NOT_WRITEABLE if register in NAMES else UNKNOWN
        return 0

    def _act(self, name: str, value: float | None) -> Iterator[Request]:
        """Yield what a register does at once by being written."""
        output = name.startswith("set_output")
        if output and value is not None and abs(value) < 1e-9:
            yield msg.Zero(self.motor)
        elif not output or value is not None:
            yield msg.WriteParameter(self.motor, name, value or 0.0)

    def _console(self, data: bytes, mask: bytes) -> Iterator[Request | Subframe]:
        """Take a piece of console input. Yields what its lines make the device do, and other lines."""
        *lines, self._line = (self._line + data).replace(b"\r", b"\n").split(b"\n")
        self._line = self._line[-256:]
        for line in lines:
            text = " ".join(line.decode("ascii", "replace").split())
            id_set = re.fullmatch(r"conf set id\.id (\d{1,4})\d*", text)
            if id_set and 0 < int(id_set[1]) <= codec.ADDRESS_MAX:
                # With a mask, and no UUID to compare with, it is not known which device this is.
                self.address = self.address if mask and not self.uuid else int(id_set[1])
                serial = codec.serial_of((self.uuid or mask).ljust(codec.SERIAL_BYTES, b"\0"))
                yield msg.SetId("", serial, int(id_set[1]))
            elif text == "conf write":
                yield msg.WriteParameter(self.motor, "conf_write", 1.0)
            elif text:
                yield Subframe(TO_DEVICE, 1, data=text.encode())

    def stranger(self) -> Memory:
        """Return a device of which no UUID is known, to read what is not for this one."""
        other = deepcopy(self)
        other.become_unknown()
        return other

    def become_unknown(self) -> None:
        """Forget the UUID."""
        self.uuid = b""

    def begins(self) -> Sequence[Obeyed]:
        """Return the command that the last frame began, if it did. In timeout a device is not armed: it is in
        a fault, in which it damps."""
        if not self.begun:
            return ()
        timeout = self.command["command_timeout"] or self.settings.default_timeout_s
        lost = self.mode == Mode.TIMEOUT or (self.mode in WATCHDOG_MODES and timeout < BRIEF)
        command = self._meaning(Mode.TIMEOUT if lost else self.mode)
        return (command,) if lost or isinstance(command, msg.Idle) else (msg.Arm(self.motor), command)

    def besides(self, command: Obeyed) -> Sequence[msg.Kept]:
        """Return what the last command says beside its numbers that is not as the options have it."""
        if self.mode not in SENT:
            return (msg.Kept(self.motor, "mode", float(self.mode)),)
        if self.mode not in (Mode.POSITION, Mode.STAY_WITHIN):
            return ()
        if self.mode == Mode.STAY_WITHIN or isinstance(command, msg.Impedance):
            names = OTHERS  # a trajectory is none of theirs, and their gains are their numbers
        else:
            names = (
                (*OTHERS, *TRAJECTORY) if isinstance(command, msg.Torque) else (*OTHERS, *TRAJECTORY, *GAINS)
            )
        return [
            msg.Kept(self.motor, tb.beside(name), self.command[name])
            for name in names
            if not _is_same(self.command[name], self.own[name])
        ]

    def _meaning(self, mode: int) -> Command | Request:
        """Return what the command registers amount to now."""
        motor, get, settings = self.motor, self.command.__getitem__, self.settings
        push = given(get("command_feedforward_torque"), 0.0)
        fastest, _ = limits_of(self.command, settings)
        if mode == Mode.STOPPED or (fastest < inf and not isnan(get("command_stop_position"))):
            return msg.Idle(motor)  # the latter is fault 45
        match mode:
            case Mode.POSITION:
                kp, kd, ilimit = (given(get(f"command_{gain}_scale"), 1.0) for gain in ("kp", "kd", "ilimit"))
                position = get("command_position") * tau
                velocity = clamp(given(get("command_velocity"), 0.0), fastest) * tau
                soft, known = not ilimit, all(self.gains)  # an integrator that is left on goes on pushing
                if soft and not known and not kp and not kd:
                    return msg.Torque(motor, push)
                if not isfinite(position):
                    return msg.Velocity(motor, velocity, push)
                if soft and known:
                    return msg.Impedance(
                        motor, position, velocity, push, kp * self.gains[0], kd * self.gains[1]
                    )
                return msg.Position(motor, position, velocity, push)
            case Mode.CURRENT:
                return msg.Torque(motor, given(get("command_q_current"), 0.0) * settings.torque_constant)
            case Mode.TIMEOUT if settings.timeout_mode == Mode.STOPPED:
                return msg.Idle(motor)
            case Mode.ZERO_VELOCITY | Mode.BRAKE | Mode.TIMEOUT:
                return msg.Velocity(motor, 0.0)
            case Mode.STAY_WITHIN if self._has_own_bounds():
                return msg.Torque(motor, push)  # inside them it gives only that
        return msg.WriteParameter(motor, "mode", float(mode))

    def _has_own_bounds(self) -> bool:
        """True if stay-within has the bounds of the options: between others it may pull anywhere."""
        low, high = (self.command[f"command_within_{end}_bound"] * tau for end in ("lower", "upper"))
        return _is_same(low, self.within[0]) and _is_same(high, self.within[1])


def _is_same(bound: float, own: float) -> bool:
    """True if two bounds are the same, as binary32; NaN: none."""
    return bound == own or isclose(bound, own, rel_tol=1e-6) or (isnan(bound) and isnan(own))


def _mask(subframe: Subframe) -> Sequence[tuple[int, bytes]]:
    """Return which quarters of a UUID a subframe demands; b"" for one that is no int32."""
    if subframe.code != WRITE or subframe.register + len(subframe.raw) <= tb.UUID_MASK.start:
        return ()
    return [
        (at - tb.UUID_MASK.start, struct.pack("<i", raw) if subframe.resolution == INT32 else b"")
        for at, raw in enumerate(subframe.raw, subframe.register)
        if at in tb.UUID_MASK
    ]


class MoteusDecoder:
    """Decodes what the moteus controllers of one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._memories = [Memory(each, bytes.fromhex(each.settings.uuid)) for each in devices]
        self._shapes = Shapes()

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return the messages that the devices would obey; [] if none would do anything."""
        obeyed: list[Obeyed] = []
        for memory in self._memories:
            if isinstance(frame, CanFrame) and memory.is_addressed(frame):
                usual = (shape := self._shapes.of(frame.data)) is not None and memory.command_by(
                    shape, frame.data
                )
                done = () if usual else memory.obey(frame.data)
                at_once = [_as_setting(memory.motor, each) for each in done if not _answers(each)]
                begun = memory.begins()
                obeyed += [*begun, *(memory.besides(begun[-1]) if begun else ()), *at_once]
                if usual:
                    continue
                if memory.chosen:
                    obeyed += _refused(memory.motor, frame.data)
                else:  # for another device, which is asked for its id
                    obeyed += [
                        msg.Kept(memory.motor, set_id(each.serial), float(each.address))
                        for each in memory.stranger().obey(frame.data)
                        if isinstance(each, msg.SetId)
                    ]
        return obeyed


def _answers(done: Request | Subframe) -> bool:
    """True if a frame made a device only answer."""
    return isinstance(done, Subframe) and done.code != TO_DEVICE


def _as_setting(motor: str, done: Request | Subframe) -> Obeyed:
    """Return a line of the console that is not known as a setting: it may be anything."""
    return msg.Kept(motor, f"console: {done.data!r}", 1.0) if isinstance(done, Subframe) else done


def _refused(motor: str, data: bytes) -> Iterator[msg.Kept]:
    """Yield the registers that a frame writes, and that are none to be written as far as is known here."""
    for subframe in codec.parse(data)[0]:
        for register, value in subframe.quantities() if subframe.code == WRITE else ():
            if register not in WRITEABLE:
                yield msg.Kept(motor, tb.name_of(register), nan if value is None else value)
