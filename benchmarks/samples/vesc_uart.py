"""Benchmark samples of VESC packets, measured beside pyvesc-fix on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. Both make the whole packet with its checksum from
plain values, and check and decode one from its bytes. Bare `struct` knows the message beforehand, makes and
checks no checksum: it is the lower bound.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from struct import Struct
from types import ModuleType
from typing import Any

from protocols.toolkit.serial import Stream
from protocols.vesc_uart.table import DIRECT, EVERYTHING, FORMAT, PACKETS, decode_values, encode_values

RIVAL = ("pyvesc", "pyvesc-fix", "the usual package")
_SET = Struct(">BBBiHB")
_VALUES = Struct(">hhiiiihihiiiiiiBiB")
_GIVEN = {"temp_fet": 41.5, "rpm": -12345.0, "v_in": 24.5, "tachometer": -4242.0, "controller_id": 23.0}
ANSWER = FORMAT.frame(encode_values(EVERYTHING, _GIVEN, selective=False))


def _found_as_pyvesc() -> None:
    """Let the package be imported as the one that it replaces: by that name it imports its own parts."""
    spec = find_spec("pyvesc_fix")
    if spec is not None and "pyvesc" not in sys.modules:
        alias = ModuleType("pyvesc")
        alias.__path__ = list(spec.submodule_search_locations or ())
        sys.modules["pyvesc"] = alias


_found_as_pyvesc()


def prepared(package: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return its functions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return tuple(
            import_module(f"{package.__name__}.{part}") for part in ("protocol.interface", "VESC.messages")
        )


@dataclass(frozen=True, slots=True)
class Sample:
    """One packet in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]

    def theirs(self, known: Any) -> Callable[[], Any]:  # noqa: ANN401 -- a package without types
        """Return the same operation in the package."""
        interface, messages = known
        if "decode" in self.what:
            return lambda: interface.decode(ANSWER)[0]
        return lambda: interface.encode(messages.SetRPM(3000))

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- bytes, or values
        """True if encoding gave the same bytes, or decoding the same values."""
        if isinstance(ours, bytes):
            return bool(ours == theirs and ours[:7] == struct[:7])
        values, raw = ours[1], struct
        told = (theirs.temp_fet, theirs.rpm, theirs.v_in, theirs.tachometer)
        mine = tuple(values[name] for name in ("temp_fet", "rpm", "v_in", "tachometer"))
        return bool(mine == told and raw[7] == mine[1])


def _decoded() -> Any:  # noqa: ANN401 -- mask and values
    (payload,) = Stream(FORMAT).feed(ANSWER)  # `messages` would split the same bytes once
    return decode_values(payload) if isinstance(payload, bytes) else None


SAMPLES = (
    Sample(
        "encode SET_RPM",
        lambda: PACKETS.encoder("SET_RPM")(DIRECT, value=3000),
        lambda: _SET.pack(2, 5, 8, 3000, 0xF804, 3),
    ),
    Sample("decode GET_VALUES", _decoded, lambda: _VALUES.unpack_from(ANSWER, 3)),
)
