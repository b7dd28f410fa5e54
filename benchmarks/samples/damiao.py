"""Benchmark samples of damiao, measured beside the vendor-style package damiao-motor on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame. The package does what its `DaMiaoMotor` does for each command and feedback, without a frame; ours
makes the frame. Bare `struct` knows its message beforehand and checks nothing: it is the lower bound.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from protocols.damiao.table import table_of
from protocols.frames import CanFrame

RIVAL = ("damiao_motor.core.motor", "damiao-motor", "damiao-motor's class of a motor")
TABLE = table_of("4310")
ENCODE = TABLE.encoder("MIT")
NUMBERS = {"position": 1.0, "velocity": -2.0, "stiffness": 50.0, "damping": 1.5, "torque": 3.0}
_COMMAND = CanFrame(1, bytes.fromhex("8a3c7771994cca65"))
_FEEDBACK = CanFrame(0x11, bytes.fromhex("11851e799899211c"))
_EIGHT = struct.Struct(">HHHH")


def prepared(motor: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return a motor of the package, without a bus."""
    return motor.DaMiaoMotor(1, 0x11, None, motor_type="4310")


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]
    encodes: bool

    def theirs(self, known: Any) -> Callable[[], Any]:  # noqa: ANN401 -- a package without types
        """Return the same operation in the package."""
        if not self.encodes:
            return lambda: known.decode_sensor_feedback(_FEEDBACK.data)
        p, v, kp, kd, t = NUMBERS.values()
        return lambda: known.encode_cmd_msg(p, v, t, kp, kd)

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or numbers
        """True if encoding gave the same bytes, or decoding the same position."""
        if self.encodes:
            return bool(theirs == struct == ours.data == _COMMAND.data)
        return bool(abs(ours["position"] - theirs["pos"]) < 1e-9 and struct == _EIGHT.unpack(_FEEDBACK.data))


SAMPLES = (
    Sample(
        "encode MIT",
        lambda: ENCODE(1, **NUMBERS),
        lambda: _EIGHT.pack(0x8A3C, 0x7771, 0x994C, 0xCA65),
        True,
    ),
    Sample(
        "decode feedback",
        lambda: TABLE.read("feedback", _FEEDBACK.data),
        lambda: _EIGHT.unpack(_FEEDBACK.data),
        False,
    ),
)
