"""What moteus controllers would obey: remembers their command registers and decodes frames into messages.

Rules. `CommandState` is what one device remembers of its commands; the twin's firmware runs on the very same
class, so decoder and twin cannot disagree on what is obeyed. Writing the mode begins a command: all other
command registers fall back to their defaults, and without it they change nothing that is obeyed. A frame for
one UUID is skipped by the others from the mask on; a decoder that does not know a device's UUID takes the
frame for that device's. The decoder knows neither faults nor timeouts, except the one fault that is in the
command itself: it takes a mode as granted. Source: mjbots/moteus@1f4a195 `fw/moteus_controller.cc` (Write),
`docs/protocol/registers.md` (UUID mask, defaults, fault 45).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite, isnan, nan, tau

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Nanos, Obeyed, Request
from protocols.moteus.codec import (
    BROADCAST,
    INT32,
    TO_DEVICE,
    WRITE,
    Console,
    Subframe,
    Values,
    from_raw,
    parse,
)
from protocols.moteus.options import ADDRESS_MAX, SERIAL_BYTES, Options, Settings, serial_of, torque_constant
from protocols.moteus.registers import RISING, Mode, Register
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
"""Values of the command registers at the beginning of each command; NaN is "not given"."""
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
"""Registers that act at once by being written."""
GAIN_SCALES = (Register.COMMAND_KP_SCALE, Register.COMMAND_KD_SCALE, Register.COMMAND_ILIMIT_SCALE)
"""All of them are 0 for a torque alone: an integrator that is left on goes on pushing."""
NOT_COMMANDED = (Mode.FAULT, *RISING, Mode.TIMEOUT)
"""Modes that only the device itself enters."""
ZEROING = 1e-9
"""rev: an output position set to less than this is zero."""
_MODES, _REGISTERS = frozenset(Mode), frozenset(Register)


@dataclass(slots=True)
class CommandState:
    """The command registers of one device, its id and console input. Revolutions, N·m."""

    motor: str
    address: int
    prefix: int
    kt: float
    """N·m/A"""
    uuid: bytes | None
    """None: not known (to a decoder)."""
    command: dict[int, float] = field(default_factory=lambda: dict(DEFAULTS))
    mode: int = Mode.STOPPED
    """The mode that was last commanded."""
    line: bytes = b""
    """Console input of a line that has not ended yet."""

    def write(self, register: int, value: float | None) -> int:
        """Write a register. Returns the number of the write error, or 0."""
        if register == Register.MODE:
            mode = -1 if value is None else int(value)
            if mode not in _MODES or mode in NOT_COMMANDED:
                return BAD_VALUE
            self.mode, self.command = mode, dict(DEFAULTS)
            return 0
        register = SHADOWS.get(register, register)
        if register in DEFAULTS:
            self.command[register] = nan if value is None else value
            return 0
        if register in ACTIONS or Register.UUID_MASK1 <= register <= Register.UUID_MASK4:
            return 0
        return NOT_WRITEABLE if register in _REGISTERS else UNKNOWN

    def message(self) -> Command | Request:
        """Return what the command registers amount to now."""
        get = self.command.__getitem__
        feed_forward = _finite(get(Register.COMMAND_FEEDFORWARD_TORQUE))
        match self.mode:
            case Mode.STOPPED:
                return msg.Idle(self.motor)
            case Mode.POSITION:
                return msg.Idle(self.motor) if self._trips() else self._position(feed_forward)
            case Mode.CURRENT:
                return msg.Torque(self.motor, _finite(get(Register.COMMAND_Q_CURRENT)) * self.kt)
            case Mode.ZERO_VELOCITY | Mode.BRAKE:
                return msg.Velocity(self.motor, 0.0)
            case Mode.STAY_WITHIN:  # inside its bounds it gives only the feed-forward
                return msg.Torque(self.motor, feed_forward)
        return msg.WriteParameter(self.motor, "mode", float(self.mode))

    def _trips(self) -> bool:
        """True if a stop position is commanded together with a limit: fault 45, and no torque."""
        get = self.command.__getitem__
        limits = (get(Register.COMMAND_VELOCITY_LIMIT), get(Register.COMMAND_ACCEL_LIMIT))
        return not isnan(get(Register.COMMAND_STOP_POSITION)) and any(limit >= 0.0 for limit in limits)

    def _position(self, feed_forward: float) -> Command:
        get = self.command.__getitem__
        position, velocity = get(Register.COMMAND_POSITION), _finite(get(Register.COMMAND_VELOCITY))
        if not any(get(register) for register in GAIN_SCALES):
            return msg.Torque(self.motor, feed_forward)
        if isfinite(position):
            return msg.Position(self.motor, position * tau, velocity * tau, feed_forward)
        return msg.Velocity(self.motor, velocity * tau, feed_forward)

    def console_lines(self, data: bytes) -> list[str]:
        """Take a piece of console input. Returns the lines that it completes."""
        *lines, self.line = (self.line + data).replace(b"\r", b"\n").split(b"\n")
        self.line = self.line[-256:]
        return [line.decode("ascii", "replace").strip() for line in lines if line.strip()]

    def set_id(self, line: str) -> bool:
        """Take a new id from a console line. Returns False if the line sets none."""
        address = _id_in(line)
        self.address = address or self.address
        return address is not None


def _id_in(line: str) -> int | None:
    """Return the id that a console line sets, or None."""
    words = line.split()
    if len(words) != 4 or words[:3] != ["conf", "set", "id.id"] or not words[3].isdecimal():
        return None
    address = int(words[3][:4])
    return address if 1 <= address <= ADDRESS_MAX else None


def command_state(device: Device, uuid: bytes | None) -> CommandState:
    """Return the state of a device after power-on."""
    options: Options = device.options
    settings: Settings = device.settings
    return CommandState(device.name, device.address, options.can_prefix, torque_constant(settings), uuid)


def _finite(value: float) -> float:
    return value if isfinite(value) else 0.0


def is_addressed(state: CommandState, frame: CanFrame) -> bool:
    """True if a frame is for this device, or for all. Whether it is extended does not matter."""
    return (
        not frame.remote
        and frame.id >> 16 == state.prefix
        and not frame.id & 0x80
        and frame.id & 0x7F in (state.address, BROADCAST)
    )


def effective(state: CommandState, data: bytes) -> tuple[list[Subframe], bool]:
    """Return what a device takes of a frame's data: all up to a flaw, or to a UUID that is not its own; and
    whether its UUID fits, since else there is no reply either."""
    taken: list[Subframe] = []
    for subframe in parse(data)[0]:
        if isinstance(subframe, Values):
            if subframe.code != WRITE:
                continue
            if not _matches(state.uuid, subframe):
                return taken, False
        taken.append(subframe)
    return taken, True


def _matches(uuid: bytes | None, subframe: Values) -> bool:
    """True if a UUID fits the masks that are written, if any."""
    for register, raw in enumerate(subframe.raw, subframe.start):
        at = register - Register.UUID_MASK1
        if 0 <= at < 4:
            if subframe.resolution != INT32:
                return False
            if uuid is not None and struct.pack("<i", int(raw)) != uuid[4 * at : 4 * at + 4]:
                return False
    return True


class MoteusDecoder:
    """Decodes what the moteus controllers of one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.states = [command_state(device, _known_uuid(device)) for device in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:  # noqa: ARG002 -- the interface's
        """Return the messages that the devices would obey; [] if none would do anything."""
        if not isinstance(frame, CanFrame):
            return []
        return [m for state in self.states if is_addressed(state, frame) for m in obey(state, frame.data)]


def _known_uuid(device: Device) -> bytes | None:
    settings: Settings = device.settings
    return bytes.fromhex(settings.uuid) if settings.uuid else None


def obey(state: CommandState, data: bytes) -> list[Obeyed]:
    """Apply a frame's data to a device. Returns what that makes it do."""
    messages: list[Obeyed] = []
    commanded, mask = False, bytearray()
    for subframe in effective(state, data)[0]:
        if isinstance(subframe, Values):
            for register, raw in enumerate(subframe.raw, subframe.start):
                if Register.UUID_MASK1 <= register <= Register.UUID_MASK4:
                    mask += struct.pack("<i", int(raw))
                    continue
                value = from_raw(register, subframe.resolution, raw)
                taken = state.write(register, value) == 0
                commanded |= taken and register == Register.MODE
                messages += _action(state.motor, register, value) if taken else ()
        elif isinstance(subframe, Console) and subframe.code == TO_DEVICE and subframe.channel == 1:
            messages += _console(state, subframe.data, bytes(mask))
    if not commanded:
        return messages
    command = state.message()
    return [*(() if isinstance(command, msg.Idle) else (msg.Arm(state.motor),)), command, *messages]


def _action(motor: str, register: int, value: float | None) -> Sequence[Request]:
    """Return what a register does at once by being written."""
    if register not in ACTIONS:
        return ()
    name = Register(register).name.lower()
    if register in (Register.SET_OUTPUT_EXACT, Register.SET_OUTPUT_NEAREST):
        if value is None:
            return ()
        return (msg.Zero(motor),) if abs(value) < ZEROING else (msg.WriteParameter(motor, name, value),)
    return (msg.WriteParameter(motor, name, value or 0.0),)


def _console(state: CommandState, data: bytes, mask: bytes) -> list[Request]:
    """Return what console input makes a device do."""
    requests: list[Request] = []
    for line in state.console_lines(data):
        if state.uuid is None and mask:  # it is not known here which of the devices this is
            address = _id_in(line)
            if address is not None:
                serial = mask[:SERIAL_BYTES].ljust(SERIAL_BYTES, b"\0")
                requests.append(msg.SetId("", serial_of(serial), address))
        elif state.set_id(line):
            requests.append(msg.SetId("", serial_of(state.uuid or bytes(16)), state.address))
        if line == "conf write":
            requests.append(msg.WriteParameter(state.motor, "conf_write", 1.0))
    return requests
