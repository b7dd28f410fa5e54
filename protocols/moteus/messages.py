"""What our end says to a moteus: the data of its frames, and the names of their messages.

Rules. The mode is the first register of a frame. Registers that a frame does not name fall back to their
defaults, and that of the position is 0: so the position is always named. The watchdog is named in every frame
that moves a motor, and never off. Torque is position control whose gains are scaled to zero, the integrator's
too. NaN ("not given") is a constant of this file. Revolutions at the output shaft, s, N·m. Layouts:
mjbots/moteus@db1a762 `docs/protocol/registers.md`; the grouping of registers is moteus 1.1.1's.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

from protocols.frames import CanFrame, Frame
from protocols.moteus.codec import (
    F32,
    INT32,
    TO_DEVICE,
    WRITE,
    Ask,
    Stream,
    Subframe,
    Values,
    encode,
    head,
    parse,
    quantity,
    single,
    write,
)
from protocols.moteus.registers import Mode, Register, mode_name

STOP = bytes.fromhex("010000")
DISCOVER = bytes.fromhex("1804d00211d802")
"""UUID as four int32, and whether the device can be told apart by it (moteus 1.1.1 `transport.py`)."""
IDENTIFY = head(0x10, Register.MODEL_NUMBER, INT32, 3) + DISCOVER
"""Model, firmware and register map as well."""

_MODE = bytes((WRITE + 1, Register.MODE, Mode.POSITION))
_HEADS = {
    name: head(WRITE, start, F32, count)
    for name, start, count in (
        ("inputs", Register.COMMAND_POSITION, 3),
        ("scaled", Register.COMMAND_POSITION, 5),
        ("scaled and limited", Register.COMMAND_POSITION, 6),
        ("most", Register.COMMAND_POSITION_MAX_TORQUE, 1),
        ("time", Register.COMMAND_TIMEOUT, 1),
        ("time and limits", Register.COMMAND_TIMEOUT, 3),
        ("integrator", Register.COMMAND_ILIMIT_SCALE, 1),
    )
}
_MOVE = struct.Struct("<5s3f2sf")
_MOVE_LIMITED = struct.Struct("<5s3f2sf2s3f")
_PUSH = struct.Struct("<6s5f2sf2sf")
_PUSH_LIMITED = struct.Struct("<6s6f2s3f2sf")
_INPUTS = _MODE + _HEADS["inputs"]
_SCALED = _MODE + _HEADS["scaled"]
_SCALED_LIMITED = _MODE + _HEADS["scaled and limited"]


@dataclass(frozen=True, slots=True)
class Limits:
    """What stands in every frame that moves a motor: finite numbers above 0, or None for the device's own."""

    timeout: float
    """s"""
    torque: float | None = None
    """N·m"""
    velocity: float | None = None
    """rev/s"""
    acceleration: float | None = None
    """rev/s²"""

    @property
    def plain(self) -> bool:
        """Whether the watchdog is the only one of them."""
        return self.torque is None and self.velocity is None and self.acceleration is None


def move(position: float | None, velocity: float, torque: float, limits: Limits) -> bytes:
    """Position control; no position: go on from where the device's set-point is, with this velocity."""
    p = nan if position is None else single(position)
    v, t = single(velocity), single(torque)
    if limits.plain:
        return _MOVE.pack(_INPUTS, p, v, t, _HEADS["time"], limits.timeout)
    most, fastest, hardest = _given(limits)
    parts = (_HEADS["most"], most, _HEADS["time and limits"], limits.timeout, fastest, hardest)
    return _MOVE_LIMITED.pack(_INPUTS, p, v, t, *parts)


def push(position: float, torque: float, limits: Limits) -> bytes:
    """Torque alone. The set-point of the position goes with the shaft, so that nothing jumps afterwards."""
    p, t = single(position), single(torque)
    if limits.plain:
        time, integrator = _HEADS["time"], _HEADS["integrator"]
        return _PUSH.pack(_SCALED, p, 0.0, t, 0.0, 0.0, time, limits.timeout, integrator, 0.0)
    most, fastest, hardest = _given(limits)
    parts = (_HEADS["time and limits"], limits.timeout, fastest, hardest, _HEADS["integrator"], 0.0)
    return _PUSH_LIMITED.pack(_SCALED_LIMITED, p, 0.0, t, 0.0, 0.0, most, *parts)


def _given(limits: Limits) -> tuple[float, float, float]:
    most, fastest, hardest = limits.torque, limits.velocity, limits.acceleration
    return (
        nan if most is None else most,
        nan if fastest is None else fastest,
        nan if hardest is None else hardest,
    )


def masked(uuid: bytes, rest: bytes) -> bytes:
    """For the one device whose UUID begins so (a multiple of four bytes): the rest of the frame."""
    words = struct.unpack(f"<{len(uuid) // 4}i", uuid)
    return encode(Values(WRITE, Register.UUID_MASK1, INT32, words)) + rest


def console(line: str) -> bytes:
    """A line for the diagnostic console."""
    return encode(Stream(TO_DEVICE, 1, line.encode("ascii") + b"\n"))


def ask(register: int, resolution: int) -> bytes:
    """One register is asked for."""
    return encode(Ask(register, resolution, 1))


def set_register(register: int, value: float) -> bytes:
    """One register is written, as binary32."""
    return write(register, value)


# -- what a frame says, by name ------------------------------------------------------------------------


def names(frame: Frame) -> Sequence[str]:
    """The messages to a device in a frame: a command by its mode and registers, a question, a console's line.

    A name holds the registers that are written, so that messages of one name differ in their values only."""
    if not isinstance(frame, CanFrame) or frame.remote or frame.id & 0x80:
        return ()
    subframes, sound = parse(frame.data)
    if not sound or any(isinstance(s, Values) and s.code != WRITE for s in subframes):
        return ()
    said = dict.fromkeys(name for s in subframes if (name := _named(s)))
    command = _command(subframes)
    return (*((command,) if command else ()), *said)


def _named(subframe: Subframe) -> str:
    match subframe:
        case Ask():
            return "read"
        case Stream(code, _, data) if code == TO_DEVICE:
            return f"console: {_verb(data)}"
        case Stream():
            return "console: read"
    return ""


def _verb(data: bytes) -> str:
    words = data.decode("ascii", "replace").split()
    return " ".join(words[:3] if words[:2] == ["conf", "set"] else words[:2])


def written(subframes: Sequence[Subframe]) -> dict[int, float | None]:
    """The registers that a frame writes, the last value of each."""
    out: dict[int, float | None] = {}
    for subframe in subframes:
        if isinstance(subframe, Values) and subframe.code == WRITE:
            for i, raw in enumerate(subframe.raw):
                register = subframe.start + i
                out[register] = quantity(register, subframe.resolution, raw)
    return out


def _command(subframes: Sequence[Subframe]) -> str:
    values = written(subframes)
    if not values:
        return ""
    rest = " ".join(f"{register:03X}" for register in sorted(values) if register != Register.MODE)
    if Register.MODE not in values:
        return f"write {rest}"
    return f"{_kind(values)} {rest}".rstrip()


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
