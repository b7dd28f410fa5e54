"""Values ↔ bytes, both ways: those of Pololu's guide, and of the vendor's own code, compiled."""

from __future__ import annotations

from typing import Any

import pytest

from protocols import messages as msg
from protocols.maestro import plugin
from protocols.maestro import table as mt
from protocols.maestro.options import Options, Settings
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of

VECTORS = {vector.name: vector.frame for vector in vectors_of(plugin)}
SENT: dict[str, tuple[bool, str, int, dict[str, Any]]] = {
    "set_target_channel_0": (False, "SETTARGET", 0, {"value": 6000}),
    "set_target_channel_2": (False, "SETTARGET", 2, {"value": 6000}),
    "set_target_board_12": (False, "SETTARGET", 1200, {"value": 6000}),
    "set_speed": (False, "SETSPEED", 5, {"value": 140}),
    "set_acceleration": (False, "SETACCELERATION", 3, {"value": 4}),
    "set_acceleration_200": (False, "SETACCELERATION", 3, {"value": 200}),
    "off": (False, "SETTARGET", 1, {"value": 0}),
    "get_position": (False, "GETPOSITION", 4, {}),
    "get_errors": (False, "GETERRORS", 0, {}),
    "go_home": (False, "GOHOME", 0, {}),
    "crc_set_target": (True, "SETTARGET", 2, {"value": 6000}),
    "crc_set_speed": (True, "SETSPEED", 5, {"value": 140}),
    "crc_board_12_set_target": (True, "SETTARGET", 1200, {"value": 6000}),
    "crc_board_12_get_position": (True, "GETPOSITION", 1203, {}),
}
"""With CRC or without, message, address and numbers."""


def test_no_vector_is_left_out() -> None:
    assert set(VECTORS) == set(SENT)


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends_and_a_board_reads(name: str) -> None:
    checked, message, address, values = SENT[name]
    packets = mt.PACKETS[checked]
    assert packets.encode(message, address, **values) == VECTORS[name]
    (decoded,), whole = packets.in_frame(VECTORS[name])
    assert decoded is not None
    assert whole
    assert (decoded.name, decoded.address, decoded.values) == (message, address, values)


def test_the_guides_example_of_a_crc() -> None:
    assert mt.crc7(bytes((0x83, 0x01))) == 0x17  # 5.d


@pytest.mark.parametrize(
    ("name", "address", "does"),
    [
        ("set_target_channel_2", 2, [msg.Arm("servo"), msg.Position("servo", 0.0)]),
        ("set_target_channel_2", 3, []),
        ("set_target_board_12", 1200, [msg.Arm("servo"), msg.Position("servo", 0.0)]),
        ("set_target_board_12", 0, []),
        ("off", 1, [msg.Idle("servo")]),
        ("get_position", 4, []),
        ("set_speed", 5, [msg.Kept("servo", "SETSPEED", 140.0)]),
        ("go_home", 5, [msg.Kept("servo", "GOHOME", 1.0)]),
        ("go_home", 1205, []),
    ],
)
def test_what_a_channel_obeys(name: str, address: int, does: list[msg.Obeyed]) -> None:
    decoder = plugin.decoder([Device("servo", address, Options(), Settings())])
    assert list(decoder.decode(0, VECTORS[name])) == does


def test_a_target_at_either_end() -> None:
    options = Options(low_us=1100.0, high_us=1900.0, travel=1.6)
    decoder = plugin.decoder([Device("servo", 2, options, Settings())])
    for pulse, position in ((1100.0, -0.8), (1500.0, 0.0), (1900.0, 0.8), (2100.0, 1.2)):
        frame = mt.PACKETS[False].encode("SETTARGET", 2, value=round(4 * pulse))
        _, does = decoder.decode(0, frame)
        assert isinstance(does, msg.Position)
        assert does.position == pytest.approx(position)
