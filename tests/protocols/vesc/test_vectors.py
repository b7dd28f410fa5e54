"""Values ↔ bytes, both ways: those of the vendor's code, compiled."""

from __future__ import annotations

import math
from dataclasses import astuple, replace
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Feedback, Obeyed
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.vesc import plugin
from protocols.vesc.options import Options, Settings
from protocols.vesc.table import TABLE
from tests.protocols.helpers import acts

DEVICE = Device("left", 23, Options(pole_pairs=5, torque_constant=0.1), Settings(supply=24.0))
VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
SENT: dict[str, tuple[str, dict[str, Any], Obeyed | None]] = {
    "doc_example_set_current_51A_id23": ("SET_CURRENT", {"value": 51.0}, msg.Torque("left", 5.1)),
    "can_set_duty_-0.25": ("SET_DUTY", {"value": -0.25}, msg.Velocity("left", -60.0)),
    "can_set_current_brake_7.5": ("SET_CURRENT_BRAKE", {"value": 7.5}, msg.Velocity("left", 0.0)),
    "can_set_erpm_-12000": ("SET_RPM", {"value": -12000}, msg.Velocity("left", -80.0 * math.pi)),
    "can_set_pos_270.5deg": ("SET_POS", {"value": 270.5}, msg.Position("left", math.radians(270.5))),
    "can_set_current_rel_-0.5": ("SET_CURRENT_REL", {"value": -0.5}, msg.Torque("left", -1.0)),
    "can_set_handbrake_3A": ("SET_CURRENT_HANDBRAKE", {"value": 3.0}, msg.Hold("left")),
    "can_ping_id23_from_254": ("PING", {"host": 254}, None),
}
"""Message, numbers, and what the controller obeys."""
REPORTED: dict[str, tuple[str, dict[str, float], Feedback | None]] = {
    "can_status1": (
        "STATUS_1",
        {"velocity": -3500, "current": 12.3, "duty": -0.456},
        Feedback("left", 0, None, -70.0 / 3.0 * math.pi, -1.23, -12.3),
    ),
    "can_status2": ("STATUS_2", {"ampere_hours": 1.5, "charged": 0.25}, None),
    "can_status3": ("STATUS_3", {"watt_hours": 36.5, "charged": 2.0}, None),
    "can_status4": (
        "STATUS_4",
        {"fet": 41.5, "motor": -12.0, "supply": -3.5, "angle": 270.5},
        Feedback("left", 0, temperature=41.5),
    ),
    "can_status5": (
        "STATUS_5",
        {"position": -4242, "voltage": 24.5},
        Feedback("left", 0, -282.8 * math.pi, voltage=24.5),
    ),
    "can_status6": ("STATUS_6", {"adc1": 1.25, "adc2": 0.5, "adc3": 3.25, "ppm": -0.75}, None),
    "can_pong_from_23": ("PONG", {"host": 254, "hardware": 0}, None),
}


def numbers(message: object) -> list[float]:
    """The numbers of a message, those that are not given as NaN."""
    return [math.nan if value is None else value for value in astuple(message)[1:]]  # type: ignore[call-overload]


def test_no_vector_is_left_out() -> None:
    assert VECTORS.keys() == SENT.keys() | REPORTED.keys()


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends_and_a_controller_obeys(name: str) -> None:
    message, values, does = SENT[name]
    frame = VECTORS[name].frame
    assert isinstance(frame, CanFrame)
    assert TABLE.encode(message, 23, **values) == frame
    for_all = replace(frame, id=frame.id | 0xFF)
    for each in (frame, for_all):
        obeyed = acts(plugin.decoder([DEVICE]).decode(0, each))
        assert [type(one) for one in obeyed] == ([msg.Arm, type(does)] if does else [])
        assert numbers(obeyed[-1]) == pytest.approx(numbers(does)) if does else not obeyed
    assert plugin.decoder([replace(DEVICE, address=24)]).decode(0, frame) == []


@pytest.mark.parametrize("name", REPORTED)
def test_what_a_controller_reports(name: str) -> None:
    message, values, feedback = REPORTED[name]
    frame = VECTORS[name].frame
    assert TABLE.encode(message, 23, **values) == frame
    events = plugin.driver([DEVICE]).receive(0, frame)
    reported = [numbers(event) for event in events if isinstance(event, Feedback)]
    assert len(reported) == (feedback is not None)
    for each in reported:
        assert each == pytest.approx(numbers(feedback), nan_ok=True)


def test_six_bytes_of_a_current_are_read_as_the_firmware_reads_them() -> None:
    """A delay first, other than the vendor's page has it: 1.2 s, then 5 A."""
    frame = CanFrame(0x117, bytes.fromhex("04b0 00001388"), extended=True)
    assert acts(plugin.decoder([DEVICE]).decode(0, frame))[1:] == [msg.Torque("left", 0.5)]


@pytest.mark.parametrize(
    ("data", "does"),
    [
        ("fe00 08 ffffd120", msg.Velocity("left", -80.0 * math.pi)),
        ("fe02 06 00001388", msg.Torque("left", 0.5)),
        ("fe00 06 00000000", msg.Idle("left")),
    ],
)
def test_commands_of_the_serial_protocol_in_one_frame_are_obeyed_too(data: str, does: msg.Command) -> None:
    obeyed = plugin.decoder([DEVICE]).decode(0, CanFrame(0x817, bytes.fromhex(data), extended=True))
    assert type(obeyed[-1]) is type(does)
    assert numbers(obeyed[-1]) == pytest.approx(numbers(does))
