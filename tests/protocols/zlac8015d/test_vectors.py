"""Values ↔ bytes, both ways: those of package canopen 2.4.1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from protocols import messages as msg
from protocols.canopen import sdo
from protocols.canopen.objects import from_bytes, parse, to_bytes
from protocols.frames import CanFrame
from protocols.messages import Obeyed
from protocols.plugin import Device
from protocols.reference_vectors import Vector, vectors_of
from protocols.zlac8015d import plugin
from protocols.zlac8015d import table as z
from protocols.zlac8015d.options import Options, Settings
from tests.protocols.helpers import acts

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
WRITTEN = [name for name, vector in VECTORS.items() if vector.meaning.keys() >= {"object", "value"}]
RPM = {
    "velocity_both_L100_R-50": {"left": 100, "right": -50},
    "velocity_left_100": {"left": 100},
    "velocity_right_-100": {"right": -100},
}


def data_of(vector: Vector) -> bytes:
    assert isinstance(vector.frame, CanFrame)
    return vector.frame.data


@pytest.mark.parametrize("name", WRITTEN)
def test_values_are_those_of_the_package(name: str) -> None:
    vector = VECTORS[name]
    key, reading = parse(vector.meaning["object"]), name.endswith("_response")
    assert key is not None
    value: Any = to_bytes(z.OBJECTS[key].type, vector.meaning["value"])
    if reading:
        assert sdo.decode_response(data_of(vector)) == sdo.Uploaded(*key, value)
    else:
        assert sdo.encode(sdo.Download(*key, value)) == data_of(vector)
    assert from_bytes(z.OBJECTS[key].type, value) == vector.meaning["value"]


def obeyed(*names: str) -> list[Sequence[Obeyed]]:
    """Return what both motors obey in each of these, one after the other."""
    devices = [Device(name, at, Options(), Settings()) for name, at in (("left", 1), ("right", 129))]
    decoder = plugin.decoder(devices)
    return [acts(decoder.decode(0, VECTORS[name].frame)) for name in names]


ENABLED = ("velocity_mode", "velocity_both_0", "shutdown", "switch_on", "enable")


def test_what_enables_and_disables() -> None:
    *before, enabled, stopped, moved, disabled, reset = obeyed(
        *ENABLED, "quick_stop", "velocity_both_L100_R-50", "disable", "reset_fault"
    )
    assert before == [[]] * 4
    assert enabled == [
        each for name in ("left", "right") for each in (msg.Arm(name), msg.Velocity(name, 0.0))
    ]
    assert stopped == [msg.Velocity("left", 0.0), msg.Velocity("right", 0.0)]
    assert moved == []
    assert disabled == [msg.Idle("left"), msg.Idle("right")]
    assert [type(each) for each in reset] == [msg.ClearFault, msg.Idle] * 2


@pytest.mark.parametrize("name", RPM)
def test_what_moves(name: str) -> None:
    *_, moved = obeyed(*ENABLED, name)
    rpm = {each.motor: each.velocity / z.RPM for each in moved if isinstance(each, msg.Velocity)}
    assert rpm == pytest.approx(RPM[name])


def test_nothing_moves_before_it_is_enabled_or_in_another_mode() -> None:
    assert obeyed("velocity_both_L100_R-50", "velocity_left_100", "enable") == [[], [], []]
    *_, moved = obeyed(*ENABLED[1:], "velocity_left_100")
    assert moved == [msg.Velocity("left", 0.0)]


@pytest.mark.parametrize(
    ("word", "state"),
    [(0x0000, z.OFF), (0x0040, z.OFF), (0x0031, z.READY), (0x1423, z.SWITCHED_ON), (0x5427, z.ENABLED),
     (0x4007, z.QUICK_STOP), (0x0008, z.FAULT), (0x0028, z.FAULT), (0x000F, z.FAULT)],
)  # fmt: skip
def test_states_of_the_manual(word: int, state: int) -> None:
    assert z.state_of(word) == state
