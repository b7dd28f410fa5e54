"""Benchmark samples of cubemars, measured beside TMotorCANControl on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame. The package (GPL) runs in a process of its own, with a bus that keeps one message; its manager is
made without its constructor, which calls sudo. It scales by 2ⁿ where firmware and ours have 2ⁿ − 1: the
numbers here come to the same with both. Bare `struct` knows its message beforehand and checks nothing: it is
the lower bound.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.measure import Elsewhere
from protocols.cubemars.table import MIT
from protocols.frames import CanFrame

RIVAL = ("", "TMotorCANControl", "TMotorCANControl's manager of MIT mode")
NUMBERS = {"position": -6.0, "velocity": -20.0, "stiffness": 50.0, "damping": 1.5, "torque": -3.0}
_REPLY = CanFrame(0, bytes.fromhex("01851e7d787f1e00"))
_FIVE, _STATE = struct.Struct(">HHBHB"), struct.Struct(">BHHBbB")
ELSEWHERE = f"""
from TMotorCANControl.mit_can import CAN_Manager

class Bus:
    def send(self, message):
        self.message = message

CAN_Manager.__del__ = lambda self: None
manager, bus = object.__new__(CAN_Manager), Bus()
manager.bus, manager.debug, reply = bus, False, {_REPLY.data!r}
p, v, kp, kd, t = {tuple(NUMBERS.values())}

def encode():
    manager.MIT_controller(1, "AK80-9", p, v, kp, kd, t)
    return bus.message.data

CALLS = {{"encode": encode, "decode": lambda: manager.parse_MIT_message(reply, "AK80-9")}}
"""


def prepared(elsewhere: Elsewhere) -> Elsewhere:
    """Return the process of the package."""
    return elsewhere


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]

    def theirs(self, known: Elsewhere) -> Callable[[], Any]:
        """Return the same operation in the package."""
        return known.call(self.what.split()[0])

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or numbers
        """True if encoding gave the same bytes, or decoding the same position and torque."""
        if self.what.startswith("encode"):
            return bool(bytes(theirs) == struct == ours.data)
        same = abs(ours["position"] - theirs[0]) + abs(ours["torque"] - theirs[2]) < 1e-9
        return same and bool(struct == _STATE.unpack(_REPLY.data))


SAMPLES = (
    Sample(
        "encode MIT control",
        lambda: MIT.encode("control", 1, **NUMBERS),
        lambda: _FIVE.pack(17039, 1228 << 4 | 409 >> 8, 409 & 255, 1228 << 4 | 1706 >> 8, 1706 & 255),
    ),
    Sample("decode MIT reply", lambda: MIT.read("reply", _REPLY.data), lambda: _STATE.unpack(_REPLY.data)),
)
