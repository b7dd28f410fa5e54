"""Conversations of vectors: which firmware a device has, and whether two devices hold one node id."""

from __future__ import annotations

from typing import Any

import pytest

from protocols.wire import CanFrame
from protocols.words import ClearFault, Idle, Velocity
from tests.protocols.odrive_can.conversation import Talk, device, frame


def address(node: int, serial: int) -> CanFrame:
    """The answer to discovery (as vector address_reply06 has it)."""
    return CanFrame(node << 5 | 6, bytes([node]) + serial.to_bytes(6, "little") + b"\0")


@pytest.mark.parametrize("expected", ["auto", "0.5", "0.6"])
def test_vectors_of_firmware_0_6(expected: str) -> None:
    talk = Talk([device(poll_ms=0, firmware=expected)], every=0)
    talk.up()
    talk.run(250)
    wrong = " fault" if expected == "0.5" else " ready"
    assert [line for _, line in talk.lines if f"State left{wrong} IDLE" in str(line)]


def test_vectors_of_an_axis_of_0_5_that_is_told_apart_by_what_it_answers() -> None:
    talk = Talk([device(poll_ms=60)], "0.5", every=0)
    talk.beat()
    talk.place()
    talk.run(150)
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.run(500)
    talk.answer("Get_Iq", Iq_Measured=1.0)
    talk.run(120)
    talk.tell("Get_Bus_Voltage_Current", Bus_Voltage=25.0)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?0x0 | 3?Get_Bus_Voltage_Current | 63?Set_Axis_Node_ID
        100…600/100 > 3?0x0 | 3?Get_Bus_Voltage_Current
        201 < Feedback voltage=24
        601 > 3?Get_Encoder_Estimates
        700 < State left ready IDLE
        770 < Feedback voltage=25
        heard 91, bad 0, foreign 0
        """)


@pytest.mark.parametrize(("expected", "answers"), [("auto", 5), ("0.6", 5), ("0.5", 2)])
def test_vectors_of_how_many_answers_tell_0_5(expected: str, answers: int) -> None:
    talk = Talk([device(poll_ms=0, firmware=expected)], "0.5", every=0)
    talk.beat()
    talk.place()
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.run(100 * (answers - 1))
    assert talk.driver.nodes[3].identity.line == ""
    talk.run(10)
    assert talk.driver.nodes[3].identity.line == "0.5"
    assert bool([line for _, line in talk.lines if "Fault" in str(line)]) == (expected == "0.6")


def test_vectors_of_a_device_that_answers_nothing() -> None:
    talk = Talk([device(poll_ms=0)], every=0)
    talk.beat()
    talk.place()
    talk.run(1300)
    talk.ask(ClearFault("left"))
    talk.run(300)
    talk.version()
    talk.run(400)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        100…1000/100 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        1000 < Fault left 12884901888 firmware unknown it sends heartbeats but does not answer Get_Version,
            nor as 0.5.x would: do our frames arrive? look at cable and bit rate with a bus monitor, and for
            a second host
        1000 < State left fault IDLE
        1300…1400/100 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        1300 < State left initialising IDLE, asking for its firmware
        1420 > -
        1500 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        1540 > -
        1600 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        1601 > 3?Get_Encoder_Estimates
        1660 > 3:Clear_Errors 0
        1700 < State left ready IDLE
        1700 < Done ClearFault left
        heard 221, bad 0, foreign 0
        """)


def test_vectors_of_a_device_that_answers_the_roll_call_and_no_other_question_of_0_6() -> None:
    talk = Talk([device(poll_ms=0)], every=0)
    talk.beat()
    talk.place()
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.hear(address(3, 10))
    talk.run(1150)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 < Feedback voltage=24
        100…1000/100 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        1000 < Fault left 12884901888 firmware unknown it sends heartbeats but does not answer Get_Version,
            nor as 0.5.x would: do our frames arrive? look at cable and bit rate with a bus monitor, and for
            a second host
        1000 < State left fault IDLE
        heard 139, bad 0, foreign 0
        """)


def test_vectors_of_heartbeats_with_extended_identifiers_that_contradict_each_other() -> None:
    talk = Talk([device(poll_ms=0, firmware="0.5", is_extended=True)], "0.5", every=0)
    for state in (8, 1, 8, 1):
        talk.tell("Heartbeat", extended=True, Axis_State=state)
        talk.run(50)
    talk.is_as_told("""
        0 < State left initialising CLOSED_LOOP_CONTROL, asking for its firmware
        0 > x3?0x0 | x3?Get_Bus_Voltage_Current
        20…90/10 > x3?Get_Encoder_Estimates
        50 < State left initialising IDLE, asking for its firmware
        100 < State left initialising CLOSED_LOOP_CONTROL, asking for its firmware
        100 > x3?0x0 | x3?Get_Encoder_Estimates | x3?Get_Bus_Voltage_Current
        110…190/10 > x3?Get_Encoder_Estimates
        150 < State left initialising IDLE, asking for its firmware
        150 < Found odrive_can 3 None its heartbeats contradict each other in turn True
        150 < Fault left 8589934592 node id 3 is held twice its heartbeats contradict each other in turn
            take one off the bus, or give it another node id (SetId with its serial number)
        heard 4, bad 0, foreign 0
        """)


def test_vectors_of_a_heartbeat_that_is_read_before_the_line_is_known() -> None:
    talk = Talk([device(poll_ms=0)], every=0)
    talk.tell("Heartbeat", Axis_State=1, Procedure_Result=3)
    talk.line = "0.5"
    talk.tell("Heartbeat", Axis_State=1, Axis_Error=0x40, Motor_Error_Flag=1, Trajectory_Done_Flag=1)
    talk.is_as_told("""
        0 < State left ready IDLE, DISARMED, asking for its firmware
        0 < Fault left 64 MISSING_INPUT no valid set-point check what is sent, and which input mode is set
        0 < State left fault IDLE, asking for its firmware
        heard 2, bad 0, foreign 0
        """)


def test_vectors_of_a_device_that_is_not_what_the_robot_file_says() -> None:
    talk = Talk([device(poll_ms=0, firmware="0.6")], "0.5", every=0)
    talk.beat(1, 0x40, Motor_Error_Flag=1)
    talk.place()
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.answer("Get_Motor_Error", Motor_Error=1)
    talk.run(1100)
    talk.ask(Velocity("left", 1.0))
    talk.ask(ClearFault("left"))
    talk.run(200)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?0x0 | 3?Get_Bus_Voltage_Current | 63?Set_Axis_Node_ID
        1 < Feedback voltage=24
        100…400/100 > 3?0x0 | 3?Get_Bus_Voltage_Current
        401 < Fault left 12884901888 firmware 0.5.x it sends heartbeats and answers questions, but not
            Get_Version say firmware = "0.5" in the robot file, or update the device
        401 < State left fault IDLE
        401 > 3?Get_Encoder_Estimates
        500 < Fault left 1407374883553344 MOTOR_FAILED the motor has an error of its own read the motor's
            error
        1100 > -
        1100 > 3?0x0
        1100 < State left initialising IDLE, asking for its firmware
        1200 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1220 > -
        heard 149, bad 0, foreign 0
        """)


def test_vectors_of_a_device_of_another_line_and_of_one_that_is_replaced() -> None:
    talk = Talk([device(poll_ms=0)], every=20)
    talk.up()
    talk.version(minor=7)
    talk.run(150)
    talk.ask(ClearFault("left"))
    talk.version(minor=5)
    talk.run(250)
    talk.version()
    talk.ask(ClearFault("left"))
    talk.run(250)
    talk.mute()
    talk.ask(ClearFault("left"))
    talk.run(400)
    talk.line = "0.5"
    talk.beat()
    talk.place()
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.run(700)
    talk.line = "0.6"
    talk.tell("Get_Version", Fw_Version_Minor=6, Fw_Version_Revision=9)
    talk.run(10)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 < Fault left 12884901888 firmware 0.7.10 it says so by Get_Version this driver speaks 0.5.x and
            0.6.x: update it
        1 < State left fault IDLE
        150 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        150 < Fault left 12884901888 firmware 0.7.10 it says so by Get_Version this driver speaks 0.5.x and
            0.6.x: update it
        400 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        400 < State left ready IDLE
        510…520/10 > 3:Clear_Errors 0
        600 < Done ClearFault left  (× 2)
        650 > 3:Clear_Errors 0
        660…760/10 > 3?Get_Encoder_Estimates
        770 > 3:Clear_Errors 0 | 3?Get_Encoder_Estimates
        780…840/10 > 3?Get_Encoder_Estimates
        850 > 3?Get_Encoder_Estimates | 3?Heartbeat
        860…880/10 > 3?Get_Encoder_Estimates
        890 < State left offline nothing heard
        890 > 3:Clear_Errors 0 | 3?Get_Version
        950 > 3?Heartbeat
        980 > 3?Get_Encoder_Estimates
        990 > 3?Get_Version
        1010 > 3:Clear_Errors 0
        1050 > 3?Heartbeat
        1080 > 3?Get_Encoder_Estimates
        1090 > 3?0x0
        1100 < State left initialising IDLE, asking for its firmware
        1130 > 3:Clear_Errors
        1190 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1191 < Feedback voltage=24
        1250 < Refused ClearFault left its firmware is not known
        1290 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1390 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1490 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1590 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1591 > 3?Get_Encoder_Estimates
        1600 < State left ready IDLE
        1750 < Fault left 12884901888 firmware 0.6.9 it was told apart as 0.5.x and now answers Get_Version:
            replaced, or two at one node id look for a second device, then clear
        1750 < State left fault IDLE
        1750 > 3?Get_Encoder_Estimates
        heard 159, bad 0, foreign 0
        """)


@pytest.mark.parametrize(
    ("line", "signals", "seems"),
    [
        ("0.5", {}, ""),
        ("0.5", {"Trajectory_Done_Flag": 1}, "0.5"),
        ("0.5", {"Axis_State": 8, "Trajectory_Done_Flag": 1}, "0.5"),
        ("0.5", {"Controller_Error_Flag": 1, "Axis_Error": 0x200}, "0.5"),
        ("0.5", {"Motor_Error_Flag": 1, "Axis_Error": 0x40}, ""),
        ("0.5", {"Axis_State": 1, "Axis_Error": 0x80000}, "0.5"),
        ("0.5", {"Encoder_Error_Flag": 1, "Axis_Error": 0x100}, ""),
        ("0.5", {"Encoder_Error_Flag": 1, "Motor_Error_Flag": 1, "Axis_Error": 0x140}, ""),
        (
            "0.5",
            {
                "Encoder_Error_Flag": 1,
                "Motor_Error_Flag": 1,
                "Controller_Error_Flag": 1,
                "Axis_Error": 0x340,
                "Trajectory_Done_Flag": 1,
            },
            "0.5",
        ),
        ("0.6", {}, ""),
        ("0.6", {"Axis_State": 8}, ""),
        ("0.6", {"Axis_State": 8, "Procedure_Result": 1}, "0.6"),
        ("0.6", {"Axis_State": 1, "Procedure_Result": 1}, ""),
        ("0.6", {"Axis_State": 1, "Procedure_Result": 2}, "0.6"),
        ("0.6", {"Axis_State": 1, "Procedure_Result": 3, "Axis_Error": 0x200}, "0.6"),
        ("0.6", {"Axis_State": 1, "Trajectory_Done_Flag": 1}, "0.6"),
        ("0.6", {"Axis_State": 1, "Trajectory_Done_Flag": 1, "Axis_Error": 0x100}, ""),
        ("0.6", {"Axis_Error": 0x2000000}, "0.6"),
    ],
)
def test_vectors_of_heartbeats_that_tell_the_line_by_their_shape(
    line: str, signals: dict[str, Any], seems: str
) -> None:
    talk = Talk([device(poll_ms=0)], line)
    talk.tell("Heartbeat", **signals)
    assert talk.driver.nodes[3].identity.seems == seems
    assert talk.driver.nodes[3].identity.line == ""


@pytest.mark.parametrize(
    "data",
    [
        "0000000001020001",
        "0000000001000201",
        "0000000401000001",
        "0000000201000001",
        "0000000201000000",
        "0000000001010100",
    ],
)
def test_vectors_of_heartbeats_that_no_line_would_send(data: str) -> None:
    """Bytes seven and eight of 0.5.x beside what only 0.6.x has, and the reverse."""
    talk = Talk([device(poll_ms=0)])
    talk.hear(CanFrame(0x61, bytes.fromhex(data)))
    wanted = {"0000000201000000": "0.6", "0000000001010100": "0.6"}
    assert talk.driver.nodes[3].identity.seems == wanted.get(data, "")


# -- two devices at one node id ------------------------------------------------------------------------


def test_vectors_of_two_that_answer_the_roll_call() -> None:
    talk = Talk([device(poll_ms=0)], every=0)
    talk.up()
    talk.run(240)
    for serial in (10, 11, 10, 11):
        talk.hear(address(3, serial))
        talk.run(10)
    for serial in (12, 13):
        talk.hear(address(7, serial))
        talk.hear(address(63, serial + 2))
    talk.run(10)
    talk.ask(ClearFault("left"))
    talk.run(110)
    talk.hear(address(3, 11))
    talk.run(10)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        250 < Found odrive_can 3 10 node id 3 is held twice: by 00000000000A and 00000000000B True
        250 < Found odrive_can 3 11 node id 3 is held twice: by 00000000000A and 00000000000B True
        250 < Fault left 8589934592 node id 3 is held twice two devices answer to it: serial numbers
            00000000000A and 00000000000B take one off the bus, or give it another node id (SetId with its
            serial number)
        280 < Found odrive_can 7 12 node id 7 is held twice: by 00000000000C and 00000000000D True
        280 < Found odrive_can 7 13 node id 7 is held twice: by 00000000000C and 00000000000D True
        290 > 3:Clear_Errors 0
        300 < Done ClearFault left
        400 < Found odrive_can 3 10 node id 3 is held twice: by 00000000000A and 00000000000B True
        400 < Found odrive_can 3 11 node id 3 is held twice: by 00000000000A and 00000000000B True
        400 < Fault left 8589934592 node id 3 is held twice two devices answer to it: serial numbers
            00000000000A and 00000000000B take one off the bus, or give it another node id (SetId with its
            serial number)
        heard 56, bad 0, foreign 0
        """)


def test_vectors_of_one_that_was_replaced_and_of_one_that_moved() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)], every=0)
    talk.up()
    talk.up(4)
    talk.hear(address(3, 10))
    talk.run(10_001)
    talk.hear(address(3, 11))
    talk.run(10)
    talk.hear(address(4, 11))
    talk.hear(address(3, 12))
    talk.run(10_000)
    talk.hear(address(4, 13))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 < State right initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 4?Get_Version | 4?Get_Bus_Voltage_Current |
            63?Address
        1 > 3?Get_Encoder_Estimates | 4?Get_Encoder_Estimates
        100 < State left ready IDLE
        100 < State right ready IDLE
        5000…20000/5000 > 63?Address
        20011 < Found odrive_can 4 11 node id 4 is held twice: by 00000000000B and 00000000000D True
        20011 < Found odrive_can 4 13 node id 4 is held twice: by 00000000000B and 00000000000D True
        20011 < Fault right 8589934592 node id 4 is held twice two devices answer to it: serial numbers
            00000000000B and 00000000000D take one off the bus, or give it another node id (SetId with its
            serial number)
        heard 4413, bad 0, foreign 0
        """)


@pytest.mark.parametrize(
    ("beats", "twice"),
    [
        (((8, 0), (1, 0), (8, 0), (1, 0)), True),
        (((1, 0), (1, 2), (1, 0), (1, 2)), True),
        (((1, 0), (1, 0), (1, 0), (1, 0)), False),
        (((8, 0), (1, 0), (8, 0), (8, 0)), False),
        (((8, 0), (1, 0), (1, 0), (1, 0)), False),
        (((8, 0), (1, 0), (8, 0), (9, 0)), False),
        (((8, 0), (1, 0), (9, 0), (1, 0)), False),
        (((8, 0), (1, 0), (8, 0)), False),
        (((1, 0), (8, 0), (1, 0), (8, 0), (1, 0), (8, 0)), True),
    ],
)
def test_vectors_of_heartbeats_that_contradict_each_other(
    beats: tuple[tuple[int, int], ...], twice: bool
) -> None:
    talk = Talk([device(poll_ms=0)], every=0)
    talk.version()
    talk.tell("Get_Version", Fw_Version_Minor=6)
    for state, error in beats:
        talk.beat(state, error << 8)
        talk.cycle(0, "Heartbeat")
        talk.tell("Heartbeat", Axis_State=state, Axis_Error=error << 8)
        talk.run(50)
    told = (
        "150 < Fault left 8589934592 node id 3 is held twice its heartbeats contradict each other in turn "
        "take one off the bus, or give it another node id (SetId with its serial number)"
    )
    assert [line for _, line in talk.lines if "held twice" in str(line)] == [told] * twice
    found = "150 < Found odrive_can 3 None its heartbeats contradict each other in turn True"
    assert [str(line) for _, line in talk.lines if "Found" in str(line)] == [found] * twice
    asked = [str(line) for _, line in talk.lines if "63?Address" in str(line)]
    assert len(asked) == 1 + twice


def test_vectors_of_heartbeats_that_we_asked_for() -> None:
    """What we had it do in between is no contradiction."""
    talk = Talk([device(poll_ms=0)], every=10)
    talk.up()
    talk.run(210)
    for state in (8, 1, 8, 1):
        talk.run(20, Velocity("left", 0.0))
        talk.beat(state)
        talk.run(80, Velocity("left", 0.0))
        talk.tell("Get_Error")
    for state in (8, 1, 8, 1):
        talk.tell("Heartbeat", Axis_State=state)
        talk.run(20, Idle("left"))
    assert not [line for _, line in talk.lines if "held twice" in str(line)]


@pytest.mark.parametrize(
    ("places", "every", "twice"),
    [
        ((0.0, 1.0), 10, 9),
        ((0.0, 0.06), 10, 9),
        ((0.0, 0.04), 10, 0),
        ((0.0, -1.0), 100, 9),
        ((0.0, -1.0), 249, 9),
        ((0.0, -1.0), 250, 9),
        ((0.0, -1.0), 251, 0),
        ((0.0, 1.0, 2.0, 3.0), 10, 0),
        ((0.0, 1.0, 1.0), 10, 25),
        ((0.0, 1.0, 0.5), 10, 0),
    ],
)
def test_vectors_of_places_that_contradict_each_other(
    places: tuple[float, ...], every: int, twice: int
) -> None:
    """`twice`: the estimate from which on it is known, counted from 0."""
    talk = Talk([device(poll_ms=0, feedback_ms=100, offline_ms=1000)], every=0)
    talk.version()
    talk.beat()
    talk.run(10)
    told: list[int] = []
    for at in range(40):
        talk.tell("Get_Encoder_Estimates", Pos_Estimate=places[at % len(places)])
        talk.run(every)
        if not told and any("positions contradict" in str(line) for _, line in talk.lines):
            told.append(at)
    assert told == [twice] * bool(twice)
    assert sum("Fault" in str(line) for _, line in talk.lines) == bool(twice)


@pytest.mark.parametrize(("velocity", "twice"), [(24.0, True), (26.0, False)])
def test_vectors_of_a_shaft_that_turns_so_fast_that_it_may_be_anywhere(velocity: float, twice: bool) -> None:
    """There and back 0.55 turns in 10 ms: 0.05 turns, and twice the velocity that it tells."""
    talk = Talk([device(poll_ms=0)], every=0)
    talk.up()
    talk.cycle(0, "Get_Encoder_Estimates")
    for at in range(30):
        talk.hear(frame("Get_Encoder_Estimates", Pos_Estimate=0.55 * (at % 2), Vel_Estimate=velocity))
        talk.run(10)
    assert any("contradict" in str(line) for _, line in talk.lines) == twice
