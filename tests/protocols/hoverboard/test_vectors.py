"""Values ↔ bytes, both ways: those of the vendor's sketch, compiled; and what the firmware makes of them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from protocols import messages as msg
from protocols.hoverboard import plugin
from protocols.hoverboard import table as hb
from protocols.hoverboard.options import Options, Settings
from protocols.messages import Feedback
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of

VECTORS = {vector.name: vector.frame for vector in vectors_of(plugin)}
RPM = math.pi / 30.0


def board(**options: Any) -> list[Device]:
    of = Options(**options)
    return [Device("left", hb.LEFT, of, Settings()), Device("right", hb.RIGHT, of, Settings())]


def frame(name: str) -> bytes:
    found = VECTORS[name]
    assert isinstance(found, bytes)
    return found


def test_no_vector_is_left_out() -> None:
    assert set(VECTORS) == {"cmd_steer0_speed300", "cmd_zero", "feedback", "feedback_bad_checksum"}


def test_what_a_host_sends_and_a_board_obeys() -> None:
    assert hb.COMMANDS.encode("command", steer=0, speed=300) == frame("cmd_steer0_speed300")
    assert hb.COMMANDS.encode("command", steer=0, speed=0) == frame("cmd_zero")
    decoder = plugin.decoder(board(full_scale=70.0))
    assert decoder.decode(0, frame("cmd_steer0_speed300")) == []  # not before it was sent little
    assert decoder.decode(0, frame("cmd_zero")) == [msg.Idle("left"), msg.Idle("right")]
    obeyed = decoder.decode(0, frame("cmd_steer0_speed300"))
    assert [(type(each), getattr(each, "motor", "")) for each in obeyed] == [
        *((msg.Arm, "left"), (msg.Velocity, "left"), (msg.Arm, "right"), (msg.Velocity, "right"))
    ]
    assert [e.velocity for e in obeyed if isinstance(e, msg.Velocity)] == pytest.approx([21.0, 21.0])


@pytest.mark.parametrize(
    ("options", "command", "zero"),
    [
        ({"control": "speed"}, msg.Velocity("right", 300 * RPM), msg.Velocity("right", 0.0)),
        ({"control": "torque", "torque_full": 10.0}, msg.Torque("right", 3.0), msg.Idle("right")),
        ({"tank": True, "full_scale": 70.0}, msg.Velocity("right", 21.0), msg.Idle("right")),
    ],
)
def test_the_same_bytes_to_other_builds(options: dict[str, Any], command: Any, zero: Any) -> None:
    decoder = plugin.decoder(board(**options)[1:])
    assert decoder.decode(0, frame("cmd_zero")) == [zero]
    arm, obeyed = decoder.decode(0, frame("cmd_steer0_speed300"))
    assert arm == msg.Arm("right")
    assert type(obeyed) is type(command)
    for name in ("velocity", "torque"):
        assert getattr(obeyed, name, 0.0) == pytest.approx(getattr(command, name, 0.0))


def test_what_a_board_reports() -> None:
    values = {"steer": 0, "speed": 300, "right": 298, "left": -297, "voltage": 39.65, "temperature": 35.7}
    assert hb.FEEDBACK.encode("feedback", **values, led=0) == frame("feedback")
    driver = plugin.driver(board())
    events = [each for each in driver.receive(0, frame("feedback")) if isinstance(each, Feedback)]
    assert [each.motor for each in events] == ["left", "right"]
    assert [each.voltage for each in events] == pytest.approx([39.65, 39.65])
    assert [each.temperature for each in events] == pytest.approx([35.7, 35.7])
    assert [each.velocity for each in events] == pytest.approx([-297 * RPM, -298 * RPM])
    assert (driver.counters.accepted, driver.counters.malformed) == (1, 0)
    upright = plugin.driver(board(mirrored=False)[1:]).receive(0, frame("feedback"))
    assert [e.velocity for e in upright if isinstance(e, Feedback)] == pytest.approx([298 * RPM])


@pytest.mark.parametrize(
    ("build", "reported"),
    [
        ({}, {"steer": 0, "speed": 100, "right": -27, "left": 28}),
        ({"mirrored": False, "left_mirrored": True}, {"steer": 0, "speed": 150, "right": 118, "left": -116}),
    ],
    ids=["as delivered for USART (issue 346)", "both directions inverted (issue 58)"],
)
def test_what_real_boards_report_while_they_drive_forwards(
    build: dict[str, bool], reported: dict[str, int]
) -> None:
    """Printed by users of EFeru/hoverboard-firmware-hack-FOC; signs as its `calcAvgSpeed` has them."""
    packet = hb.FEEDBACK.encode("feedback", **reported, voltage=39.8, temperature=24.3, led=0)
    events = [e for e in plugin.driver(board(**build)).receive(0, packet) if isinstance(e, Feedback)]
    assert [e.velocity for e in events] == pytest.approx(
        [abs(reported["left"]) * RPM, abs(reported["right"]) * RPM]
    )


def test_a_wrong_checksum_is_skipped_as_by_the_sketch() -> None:
    driver = plugin.driver(board())
    assert driver.receive(0, frame("feedback_bad_checksum")) == []
    assert driver.counters.malformed == 1
    assert driver.receive(0, frame("feedback"))


def test_resynchronised_on_cd_ab_behind_half_a_message() -> None:
    for cut in range(18):
        driver = plugin.driver(board())
        events = driver.receive(0, frame("feedback")[cut:] + frame("feedback"))
        assert sum(isinstance(each, Feedback) for each in events) == (4 if cut == 0 else 2)


@pytest.mark.parametrize("tank", [False, True])
def test_what_is_mixed_is_what_the_firmware_makes_of_it(tank: bool) -> None:
    """To the count, for each pair that a range permits; and nothing beyond an input's range."""
    most = Options(tank=tank).most
    for left in range(-most, most + 1, 37):
        for right in (*range(-most, most + 1, 41), left, left + 1 if left < most else left):
            steer, speed = hb.mix(left, right, tank=tank)
            assert max(abs(steer), abs(speed)) <= hb.MOST
            assert hb.unmix(steer, speed, tank=tank) == (left, right)


def test_equal_numbers_have_the_sync_as_checksum_and_are_no_other_message() -> None:
    """Behind a damaged message its checksum would begin one whose steer is 0xABCD."""
    decoder = plugin.decoder(board(tank=True))
    good = hb.COMMANDS.encode("command", steer=1, speed=1)
    damaged = bytes([*good[:5], good[5] ^ 0x80, *good[6:]])
    assert good[-2:] == b"\xcd\xab"
    obeyed = decoder.decode(0, damaged + good[:6] + good)
    assert [each.velocity for each in obeyed if isinstance(each, msg.Velocity)] == [0.07, 0.07]


def test_both_motors_of_a_board_are_built_alike() -> None:
    left, _ = board()
    with pytest.raises(ValueError, match="both motors of a board have the same options"):
        plugin.driver([left, board(tank=True)[1]])
    with pytest.raises(ValueError, match="the left motor of a board has 1, the right one 2"):
        plugin.spec(Device("third", 3, Options(), Settings()))
