"""Benchmark samples of moteus, measured beside the vendor's package on the same frames.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame's data. The package does what its documentation shows: `Controller.make_position` and `make_stop` with
the registers that our driver writes and queries, `parse_reply` on the data. It makes a command without
padding and without a frame; ours makes the whole frame, padded. Bare `struct` knows its message beforehand,
checks nothing and makes no frame: it is the lower bound.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from protocols.moteus.codec import Reply, command_id, decode, make_frame
from protocols.moteus.messages import FAST, STOP, Setpoints

RIVAL = ("moteus", "moteus", "the vendor's package")
ADDRESS = 5
SETPOINTS = Setpoints(0.1, gains=(2.0, 4.0))


@dataclass(frozen=True, slots=True)
class Prepared:
    """What the package's calls need."""

    controller: Any
    fast: Any
    parse: Callable[[bytes], Mapping[int, Any]]


def prepared(moteus: Any) -> Prepared:  # noqa: ANN401 -- a package without types
    """Return a controller, and the query of our driver."""
    fast = moteus.QueryResolution()
    fast.voltage = fast.temperature = moteus.multiplex.IGNORE
    return Prepared(moteus.Controller(id=ADDRESS, transport=object()), fast, moteus.protocol.parse_reply)


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]
    values: Mapping[str, float] = field(default_factory=dict)
    """Arguments of `make_position`; {} for a stop, or a reply to decode."""
    data: bytes = b""
    """The data to decode; b"" to encode."""

    def theirs(self, known: Prepared) -> Callable[[], Any]:
        """Return the same operation in the package."""
        if self.data:
            parse, data = known.parse, self.data
            return lambda: parse(data)
        controller, query, values = known.controller, known.fast, self.values
        if not values:
            return lambda: controller.make_stop(query_override=query).data
        return lambda: controller.make_position(**values, query_override=query).data

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or registers
        """True if encoding gave the same bytes, or decoding the same registers."""
        if not isinstance(ours, Reply):
            return bool(ours.data.rstrip(b"\x50") == theirs == struct)
        reply = {register: value for register, value in ours.values.items() if value is not None}
        return _near(reply, dict(theirs)) and _near(dict(zip(reply, struct, strict=True)), reply, 2e4)


def _near(one: Mapping[int, float], other: Mapping[int, float], scale: float = 1e-6) -> bool:
    """True if all registers agree within `scale`: bare struct does not scale them."""
    return one.keys() == other.keys() and all(abs(one[key] - other[key]) <= scale for key in one)


_MOVE = struct.Struct("<5sfff2sf6s")
_SPRING = struct.Struct("<6sfffff2sfff2sf6s")
_REPLY = struct.Struct("<2xb2xfff2xb")
_DETAILS = struct.Struct("<2xb3xffff3xhhhhhh11x")
_SHORT = bytes.fromhex("21000a2f01000000be0000c03f000040bf210f00")
_LONG = bytes.fromhex(
    "21000a2c0401000000be0000c03f000040bf0000204124060a270101000200f5009d0100005050505050505050505050"
)
_TO = command_id(ADDRESS)

SAMPLES = (
    Sample(
        "encode position with a query",
        lambda: make_frame(_TO, SETPOINTS.position(0.25, -1.5, 0.125) + FAST),
        lambda: _MOVE.pack(b"\x01\x00\x0a\x0f\x20", 0.25, -1.5, 0.125, b"\x0d\x27", 0.1, FAST),
        {"position": 0.25, "velocity": -1.5, "feedforward_torque": 0.125, "watchdog_timeout": 0.1},
    ),
    Sample(
        "encode impedance with a query",
        lambda: make_frame(_TO, SETPOINTS.spring(0.25, -1.5, 0.125, 1.0, 1.0) + FAST),
        lambda: _SPRING.pack(
            *(b"\x01\x00\x0a\x0c\x05\x20", 0.25, -1.5, 0.125, 0.5, 0.25),
            *(b"\x0f\x27", 0.1, -1, -1, b"\x0d\x2b", 0, FAST),
        ),
        {
            "position": 0.25,
            "velocity": -1.5,
            "feedforward_torque": 0.125,
            "kp_scale": 0.5,
            "kd_scale": 0.25,
            "watchdog_timeout": 0.1,
            "velocity_limit": -1.0,
            "accel_limit": -1.0,
            "ilimit_scale": 0.0,
        },
    ),
    Sample("encode stop with a query", lambda: make_frame(_TO, STOP + FAST), lambda: STOP + FAST),
    Sample("decode state", lambda: decode(_SHORT), lambda: _REPLY.unpack(_SHORT), {}, _SHORT),
    Sample("decode state and details", lambda: decode(_LONG), lambda: _DETAILS.unpack(_LONG), {}, _LONG),
)
