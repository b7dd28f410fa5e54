"""What the host sends to a moteus: the data of its frames, and the names of their messages.

Rules. The mode is the first register of a frame. Registers that a frame does not name fall back to their
defaults, and that of the position is 0: so the position is always named. The watchdog timeout is named in
every frame that moves a motor, and never off. Torque is stay-within, by default without bounds: the gains
stay as configured, so that the device still damps its shaft after a timeout, which position control with
gains scaled to zero would not (mjbots/moteus@db1a762 `fw/bldc_servo_control.h`, ISR_DoZeroVelocity); no
position is named, of which a distance could trip fault 49. Revolutions at the output shaft, s, N·m. Layouts:
the same, `docs/protocol/registers.md`; the grouping of registers is moteus 1.1.1's.
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

FAST = read(tb.MODE, INT8) + read(tb.POSITION, F32, 3) + read(tb.FAULT, INT8)
"""The query that is sent all the time."""
FULL = read(tb.MODE, INT8) + read(tb.POSITION, F32, 4) + read(tb.MOTOR_TEMPERATURE, INT16, 6)
"""Now and then: current, motor temperature, trajectory, home state, voltage, temperature as well."""
DISCOVER = read(tb.UUID.start, INT32, 4) + read(NUMBERS["uuid_mask_capable"], INT8)
"""Query for the UUID, and whether the device can be addressed by it (moteus 1.1.1 `transport.py`)."""
IDENTIFY = read(tb.MODEL_NUMBER, INT32, 3) + DISCOVER
"""Query for model, firmware and register map as well."""

_MODES = {mode: write(tb.MODE, mode, resolution=INT8) for mode in Mode}
STOP = _MODES[Mode.STOPPED]
AT_REST: Mapping[str, bytes] = {"damp": _MODES[Mode.ZERO_VELOCITY], "brake": _MODES[Mode.BRAKE]}
"""Commands of velocity 0, by the option `at_rest`."""
_MOVE, _SPRING, _PUSH = struct.Struct("<5s3f"), struct.Struct("<6s5f"), struct.Struct("<19sf")


class Setpoints:
    """The data that move one device."""

    def __init__(
        self,
        timeout: float,
        limits: Sequence[float] = (),
        within: Sequence[float | None] = (None, None),
        gains: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Make what is the same in all of them. `limits`: of torque, velocity and acceleration, 0 for those
        configured on the device; without any of the three they are not named. `within`: bounds of torque.
        `gains`: stiffness and damping at scale 1."""
        self._gains = gains
        most, *fastest = (each or None for each in limits) if any(limits) else (None,)
        torque = write(NUMBERS["command_position_max_torque"], most) if any(limits) else b""
        start, until = NUMBERS["command_position"], NUMBERS["command_timeout"]
        self._move = _MODES[Mode.POSITION] + header(WRITE, start, F32, 3)
        self._after_move = torque + write(until, timeout, *fastest)
        # The largest torque follows the scales of the gains: it is one more register of the same subframe.
        self._spring = _MODES[Mode.POSITION] + header(WRITE, start, F32, 6 if torque else 5)
        no_trajectory, no_integrator = (-1.0, -1.0), write(NUMBERS["command_ilimit_scale"], 0.0)
        self._after_spring = torque[-4:] + write(until, timeout, *no_trajectory) + no_integrator
        bounds = write(NUMBERS["command_within_lower_bound"], *within, 0.0)[:-4]
        self._push = _MODES[Mode.STAY_WITHIN] + write(start, None) + bounds
        ended = (most, timeout) if torque else (timeout,)
        self._after_push = write(NUMBERS["command_within_timeout"] + 1 - len(ended), *ended)

    def position(self, position: float | None, velocity: float, torque: float) -> bytes:
        """Encode position control; None: go on from the device's own set-point at this velocity."""
        at = nan if position is None else to_single(position)
        return _MOVE.pack(self._move, at, to_single(velocity), to_single(torque)) + self._after_move

    def spring(
        self, position: float, velocity: float, torque: float, stiffness: float, damping: float
    ) -> bytes:
        """Encode position control without integrator and trajectory, its gains scaled to these."""
        scales = (to_single(stiffness) / self._gains[0], to_single(damping) / self._gains[1])
        values = map(to_single, (position, velocity, torque, *scales))
        return _SPRING.pack(self._spring, *values) + self._after_spring

    def torque(self, torque: float) -> bytes:
        """Encode torque alone."""
        return _PUSH.pack(self._push, to_single(torque)) + self._after_push


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
    if mode == Mode.POSITION and written.get(NUMBERS["command_position"], 0.0) is None:
        kind = "velocity"
    return " ".join((kind, *(f"{register:03X}" for register in sorted(written) if register != tb.MODE)))
