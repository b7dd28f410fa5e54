"""What the host sends to a moteus: the data of its frames, and the names of their messages.

Rules. The mode is the first register of a frame. Registers that a frame does not name fall back to their
defaults, and that of the position is 0: so the position is always named. The watchdog timeout is named in
every frame that moves a motor, and never off. Torque is position control whose gains are scaled to zero, the
integrator's too. Revolutions at the output shaft, s, N·m. Layouts: mjbots/moteus@db1a762
`docs/protocol/registers.md`; the grouping of registers is moteus 1.1.1's.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from math import nan

from protocols.frames import CanFrame, Frame
from protocols.moteus import codec
from protocols.moteus import table as tb
from protocols.moteus.codec import F32, INT8, INT16, INT32, WRITE, Subframe, header, read, to_single, write
from protocols.moteus.table import NUMBERS, Mode

STOP = write(tb.MODE, Mode.STOPPED, resolution=INT8)
FAST = read(tb.MODE, INT8) + read(tb.POSITION, F32, 3) + read(tb.FAULT, INT8)
"""The query that is sent all the time."""
FULL = read(tb.MODE, INT8) + read(tb.POSITION, F32, 4) + read(tb.MOTOR_TEMPERATURE, INT16, 6)
"""Now and then: current, motor temperature, trajectory, home state, voltage, temperature as well."""
DISCOVER = read(tb.UUID.start, INT32, 4) + read(NUMBERS["uuid_mask_capable"], INT8)
"""Query for the UUID, and whether the device can be addressed by it (moteus 1.1.1 `transport.py`)."""
IDENTIFY = read(tb.MODEL_NUMBER, INT32, 3) + DISCOVER
"""Query for model, firmware and register map as well."""

_POSITION_MODE = write(tb.MODE, Mode.POSITION, resolution=INT8)
_MOVE, _PUSH = struct.Struct("<5s3f"), struct.Struct("<6s5f")


class Setpoints:
    """The data that move one device."""

    def __init__(self, timeout: float, *limits: float | None) -> None:
        """Make what is the same in all of them. `limits`: of torque, velocity and acceleration, above 0, or
        None for those configured on the device; without any of the three they are not named."""
        most, *fastest = limits or (None,)
        torque = write(NUMBERS["command_position_max_torque"], most) if limits else b""
        rest = write(NUMBERS["command_timeout"], timeout, *fastest)
        start = NUMBERS["command_position"]
        self._move = _POSITION_MODE + header(WRITE, start, F32, 3)
        self._after_move = torque + rest
        # The largest torque follows the scales of the gains: it is one more register of the same subframe.
        self._push = _POSITION_MODE + header(WRITE, start, F32, 6 if limits else 5)
        self._after_push = torque[-4:] + rest + write(NUMBERS["command_ilimit_scale"], 0.0)

    def position(self, position: float | None, velocity: float, torque: float) -> bytes:
        """Encode position control; None: go on from the device's own set-point at this velocity."""
        at = nan if position is None else to_single(position)
        return _MOVE.pack(self._move, at, to_single(velocity), to_single(torque)) + self._after_move

    def torque(self, position: float, torque: float) -> bytes:
        """Encode torque alone: all gains are scaled to 0. The position is the measured one, so that nothing
        jumps afterwards."""
        at, push = to_single(position), to_single(torque)
        return _PUSH.pack(self._push, at, 0.0, push, 0.0, 0.0) + self._after_push


def masked(uuid: bytes, rest: bytes) -> bytes:
    """Address the rest of a frame to the device whose UUID begins so (a multiple of four bytes)."""
    numbers = struct.unpack(f"<{len(uuid) // 4}i", uuid)
    return codec.encode(Subframe(WRITE, tb.UUID_MASK.start, INT32, numbers)) + rest


def console(line: str) -> bytes:
    """Encode a line for the diagnostic console."""
    return codec.encode(Subframe(codec.TO_DEVICE, 1, data=line.encode("ascii") + b"\n"))


def names(frame: Frame) -> Sequence[str]:
    """Return the names of the messages in a frame to a device: a command by mode and registers, "read",
    a console line. Messages of one name write the same registers."""
    if not isinstance(frame, CanFrame) or frame.remote or frame.id & 0x80:
        return ()
    subframes, well_formed = codec.parse(frame.data)
    if not well_formed or any(each.code == codec.REPLY for each in subframes):
        return ()
    unnamed = (WRITE, codec.WRITE_ERROR, codec.READ_ERROR)
    written = dict(pair for each in subframes if each.code == WRITE for pair in each.quantities())
    others = dict.fromkeys(_name(each) for each in subframes if each.code not in unnamed)
    return (*((_command_name(written),) if written else ()), *others)


def _name(subframe: Subframe) -> str:
    if subframe.code == codec.READ:
        return "read"
    words = subframe.data.decode("ascii", "replace").split() if subframe.code == codec.TO_DEVICE else ["read"]
    return f"console: {' '.join(words[:3] if words[:2] == ['conf', 'set'] else words[:2])}"


def _command_name(written: Mapping[int, float | None]) -> str:
    mode, kind = int(written.get(tb.MODE, -1) or 0), "write"
    if tb.MODE in written:
        kind = "stop" if mode == Mode.STOPPED else tb.mode_name(mode)
    if mode == Mode.POSITION:
        gains = {written.get(NUMBERS["command_kp_scale"]), written.get(NUMBERS["command_kd_scale"])}
        at = written.get(NUMBERS["command_position"], 0.0)
        kind = "torque" if gains == {0.0} else "velocity" if at is None else kind
    return " ".join((kind, *(f"{register:03X}" for register in sorted(written) if register != tb.MODE)))
