"""What the host sends to a moteus: the data of its frames, and the names of their messages.

Rules. The mode is the first register of a frame. Registers that a frame does not name fall back to their
defaults, and that of the position is 0: so the position is always named. The watchdog timeout is named in
every frame that moves a motor, and never off. Torque is position control whose gains are scaled to zero, the
integrator's too. NaN ("not given") is a constant of this file. Revolutions at the output shaft, s, N·m.
Layouts: mjbots/moteus@db1a762 `docs/protocol/registers.md`; the grouping of registers is moteus 1.1.1's.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

from protocols.frames import CanFrame, Frame
from protocols.moteus import codec
from protocols.moteus.codec import F32, INT32, WRITE, Console, Query, Subframe, Values, header, to_single
from protocols.moteus.registers import Mode, Register, mode_name

STOP = bytes.fromhex("010000")
DISCOVER = bytes.fromhex("1804d00211d802")
"""Query for the UUID as four int32, and whether the device can be addressed by it (moteus 1.1.1
`transport.py`)."""
IDENTIFY = header(codec.READ, Register.MODEL_NUMBER, INT32, 3) + DISCOVER
"""Query for model, firmware and register map as well."""

_POSITION_MODE = bytes((WRITE + 1, Register.MODE, Mode.POSITION))
_SETPOINT = _POSITION_MODE + header(WRITE, Register.COMMAND_POSITION, F32, 3)
_SCALED = _POSITION_MODE + header(WRITE, Register.COMMAND_POSITION, F32, 5)
_SCALED_LIMITED = _POSITION_MODE + header(WRITE, Register.COMMAND_POSITION, F32, 6)
_MAX_TORQUE = header(WRITE, Register.COMMAND_POSITION_MAX_TORQUE, F32, 1)
_TIMEOUT = header(WRITE, Register.COMMAND_TIMEOUT, F32, 1)
_TIMEOUT_LIMITS = header(WRITE, Register.COMMAND_TIMEOUT, F32, 3)
_ILIMIT = header(WRITE, Register.COMMAND_ILIMIT_SCALE, F32, 1)
_MOVE = struct.Struct("<5s3f2sf")
_MOVE_LIMITED = struct.Struct("<5s3f2sf2s3f")
_PUSH = struct.Struct("<6s5f2sf2sf")
_PUSH_LIMITED = struct.Struct("<6s6f2s3f2sf")


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits in every frame that moves a motor: finite numbers above 0, or None for the device's own."""

    timeout: float
    """s, of the watchdog"""
    torque: float | None = None
    """N·m"""
    velocity: float | None = None
    """rev/s"""
    acceleration: float | None = None
    """rev/s²"""

    @property
    def only_timeout(self) -> bool:
        """True if the watchdog timeout is the only one of them."""
        return self.torque is None and self.velocity is None and self.acceleration is None


def position_command(position: float | None, velocity: float, torque: float, limits: Limits) -> bytes:
    """Encode position control; position None: go on from the device's own set-point at this velocity."""
    p = nan if position is None else to_single(position)
    v, t = to_single(velocity), to_single(torque)
    if limits.only_timeout:
        return _MOVE.pack(_SETPOINT, p, v, t, _TIMEOUT, limits.timeout)
    max_torque, max_velocity, max_acceleration = _registers_of(limits)
    rest = (_MAX_TORQUE, max_torque, _TIMEOUT_LIMITS, limits.timeout, max_velocity, max_acceleration)
    return _MOVE_LIMITED.pack(_SETPOINT, p, v, t, *rest)


def torque_command(position: float, torque: float, limits: Limits) -> bytes:
    """Encode torque alone: all gains are scaled to 0. The position is the measured one, so that nothing jumps
    afterwards."""
    p, t = to_single(position), to_single(torque)
    if limits.only_timeout:
        return _PUSH.pack(_SCALED, p, 0.0, t, 0.0, 0.0, _TIMEOUT, limits.timeout, _ILIMIT, 0.0)
    max_torque, max_velocity, max_acceleration = _registers_of(limits)
    rest = (_TIMEOUT_LIMITS, limits.timeout, max_velocity, max_acceleration, _ILIMIT, 0.0)
    return _PUSH_LIMITED.pack(_SCALED_LIMITED, p, 0.0, t, 0.0, 0.0, max_torque, *rest)


def _registers_of(limits: Limits) -> tuple[float, float, float]:
    """Return torque, velocity and acceleration, NaN for the device's own."""
    torque, velocity, acceleration = limits.torque, limits.velocity, limits.acceleration
    return (
        nan if torque is None else torque,
        nan if velocity is None else velocity,
        nan if acceleration is None else acceleration,
    )


def masked(uuid: bytes, rest: bytes) -> bytes:
    """Address the rest of a frame to the device whose UUID begins so (a multiple of four bytes)."""
    numbers = struct.unpack(f"<{len(uuid) // 4}i", uuid)
    return codec.encode(Values(WRITE, Register.UUID_MASK1, INT32, numbers)) + rest


def console(line: str) -> bytes:
    """Encode a line for the diagnostic console."""
    return codec.encode(Console(codec.TO_DEVICE, 1, line.encode("ascii") + b"\n"))


# -- the names of messages -----------------------------------------------------------------------------


def names(frame: Frame) -> Sequence[str]:
    """Return the names of the messages in a frame to a device: a command by mode and registers, "read",
    a console line.

    A name holds the registers that are written, so that messages of one name differ in their values only."""
    if not isinstance(frame, CanFrame) or frame.remote or frame.id & 0x80:
        return ()
    subframes, well_formed = codec.parse(frame.data)
    if not well_formed or any(isinstance(s, Values) and s.code != WRITE for s in subframes):
        return ()
    others = dict.fromkeys(name for s in subframes if (name := _name_of(s)))
    command = _command_name(subframes)
    return (*((command,) if command else ()), *others)


def _name_of(subframe: Subframe) -> str:
    match subframe:
        case Query():
            return "read"
        case Console(code, _, data) if code == codec.TO_DEVICE:
            words = data.decode("ascii", "replace").split()
            return f"console: {' '.join(words[:3] if words[:2] == ['conf', 'set'] else words[:2])}"
        case Console():
            return "console: read"
    return ""


def written(subframes: Sequence[Subframe]) -> dict[int, float | None]:
    """Return the registers that a frame writes, with the last value of each."""
    values: dict[int, float | None] = {}
    for subframe in subframes:
        if isinstance(subframe, Values) and subframe.code == WRITE:
            for register, raw in enumerate(subframe.raw, subframe.start):
                values[register] = codec.from_raw(register, subframe.resolution, raw)
    return values


def _command_name(subframes: Sequence[Subframe]) -> str:
    values = written(subframes)
    if not values:
        return ""
    rest = " ".join(f"{register:03X}" for register in sorted(values) if register != Register.MODE)
    kind = _kind(values) if Register.MODE in values else "write"
    return f"{kind} {rest}".rstrip()


def _kind(values: dict[int, float | None]) -> str:
    mode = int(values[Register.MODE] or 0)
    if mode == Mode.STOPPED:
        return "stop"
    if mode != Mode.POSITION:
        return mode_name(mode)
    scales = (values.get(Register.COMMAND_KP_SCALE, 1.0), values.get(Register.COMMAND_KD_SCALE, 1.0))
    if scales == (0.0, 0.0):
        return "torque"
    return "velocity" if values.get(Register.COMMAND_POSITION, 0.0) is None else "position"
