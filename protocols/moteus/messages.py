"""What the host sends to a moteus: the data of its frames, and the names of their messages.

Rules. The mode is the first register of a frame. Registers that a frame does not name fall back to their
defaults, and that of the position is 0: so the position is always named. The watchdog timeout is named in
every frame that moves a motor, and never off. Torque is position control whose gains are scaled to zero, the
integrator's too. NaN ("not given") is a constant of this file. Revolutions at the output shaft, s, N·m.
Layouts: mjbots/moteus@db1a762 `docs/protocol/registers.md`; the grouping of registers is moteus 1.1.1's.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from math import nan

from protocols.frames import CanFrame, Frame
from protocols.moteus import codec
from protocols.moteus import table as reg
from protocols.moteus.codec import F32, INT8, INT16, INT32, WRITE, Subframe, header, read, to_single, write
from protocols.moteus.table import NUMBERS, Mode

STOP = write(reg.MODE, Mode.STOPPED, resolution=INT8)
FAST = read(reg.MODE, INT8) + read(reg.POSITION, F32, 3) + read(reg.FAULT, INT8)
"""The query that is sent all the time; the reply has 20 bytes."""
FULL = read(reg.MODE, INT8) + read(reg.POSITION, F32, 4) + read(reg.MOTOR_TEMPERATURE, INT16, 6)
"""Now and then: current, motor temperature, trajectory, home state, voltage, temperature as well."""
DISCOVER = read(reg.UUID.start, INT32, 4) + read(NUMBERS["uuid_mask_capable"], INT8)
"""Query for the UUID, and whether the device can be addressed by it (moteus 1.1.1 `transport.py`)."""
IDENTIFY = read(reg.MODEL_NUMBER, INT32, 3) + DISCOVER
"""Query for model, firmware and register map as well."""

_POSITION_MODE = write(reg.MODE, Mode.POSITION, resolution=INT8)
_MOVE, _PUSH = struct.Struct("<5s3f"), struct.Struct("<6s5f")


class Setpoints:
    """The data that move one device. Its limits, the same in each, are finite numbers above 0 [s, N·m, rev/s,
    rev/s²], or None for those configured on the device."""

    def __init__(
        self,
        timeout: float,
        torque: float | None = None,
        velocity: float | None = None,
        acceleration: float | None = None,
    ) -> None:
        limited = (torque, velocity, acceleration) != (None, None, None)
        limits = write(NUMBERS["command_timeout"], timeout, *((velocity, acceleration) if limited else ()))
        most = write(NUMBERS["command_position_max_torque"], torque) if limited else b""
        no_integrator = write(NUMBERS["command_ilimit_scale"], 0.0)
        start = NUMBERS["command_position"]
        self._move = _POSITION_MODE + header(WRITE, start, F32, 3)
        self._after_move = most + limits
        # The largest torque follows the scales of the gains: it is one more register of the same subframe.
        self._push = _POSITION_MODE + header(WRITE, start, F32, 6 if limited else 5)
        self._after_push = most[-4:] + limits + no_integrator

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
    return codec.encode(Subframe(WRITE, reg.UUID_MASK.start, INT32, numbers)) + rest


def console(line: str) -> bytes:
    """Encode a line for the diagnostic console."""
    return codec.encode(Subframe(codec.TO_DEVICE, 1, data=line.encode("ascii") + b"\n"))


# -- the names of messages -----------------------------------------------------------------------------


def names(frame: Frame) -> Sequence[str]:
    """Return the names of the messages in a frame to a device: a command by mode and registers, "read",
    a console line.

    A name holds the registers that are written, so that messages of one name differ in their values only."""
    if not isinstance(frame, CanFrame) or frame.remote or frame.id & 0x80:
        return ()
    subframes, well_formed = codec.parse(frame.data)
    if not well_formed or any(s.code == codec.REPLY for s in subframes):
        return ()
    written = {at: value for s in subframes if s.code == WRITE for at, value in codec.quantities(s)}
    others = [_name(s) for s in subframes if s.code not in (WRITE, codec.WRITE_ERROR, codec.READ_ERROR)]
    return (*((_command_name(written),) if written else ()), *dict.fromkeys(others))


def _name(subframe: Subframe) -> str:
    if subframe.code == codec.READ:
        return "read"
    if subframe.code != codec.TO_DEVICE:
        return "console: read"
    words = subframe.data.decode("ascii", "replace").split()
    return f"console: {' '.join(words[:3] if words[:2] == ['conf', 'set'] else words[:2])}"


def _command_name(written: Mapping[int, float | None]) -> str:
    kind = "write"
    if reg.MODE in written:
        mode = int(written[reg.MODE] or 0)
        kind = "stop" if mode == Mode.STOPPED else reg.mode_name(mode)
        if mode == Mode.POSITION:
            if written.get(NUMBERS["command_kp_scale"]) == written.get(NUMBERS["command_kd_scale"]) == 0.0:
                kind = "torque"
            elif written.get(NUMBERS["command_position"], 0.0) is None:
                kind = "velocity"
    return " ".join((kind, *(f"{register:03X}" for register in sorted(written) if register != reg.MODE)))
