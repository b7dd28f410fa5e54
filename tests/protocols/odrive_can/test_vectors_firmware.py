"""Conversations of vectors: which firmware a device has, and how it is told.

What vouches: the devices' bytes are cantools' with the DBCs 0.6.10 and 0.5.6, replies to discovery
are as vector address_reply06 has them; what is expected is derived by hand from the README ("Two firmware
lines") and the docstrings of `identify`. See `talk`.
"""

from __future__ import annotations

from typing import Any

import pytest

from protocols.frames import CanFrame
from protocols.messages import ClearFault, Idle, Velocity, Zero
from tests.protocols.odrive_can.conversation import address, device, frame
from tests.protocols.odrive_can.talk import Talk, standing

# -- the firmware line ------------------------------------------------------------------------------------


@pytest.mark.parametrize("expected", ["auto", "0.5", "0.6"])
def test_vectors_of_firmware_0_6(expected: str) -> None:
    talk = Talk([device(poll_ms=0, firmware=expected)])
    talk.up()
    talk.run(100, Velocity("left", 0.0))
    wrong = """
        1 < Fault left 0x300000000 firmware 0.6.10: *the robot file states 0.5
        1 < State left fault: IDLE
    """
    talk.reports(f"""
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        {wrong.strip() if expected == "0.5" else ""}
    """)
    talk.run(100, Velocity("left", 0.0))
    # What is not what the robot file says is never armed.
    armed = """
        0 < State left ready: IDLE
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        10…90 > 3:Set_Input_Vel 0 0
    """
    talk.reports(armed if expected != "0.5" else "")


@pytest.mark.parametrize(("expected", "answers"), [("auto", 5), ("0.6", 5), ("0.5", 2)])
def test_vectors_of_firmware_0_5(expected: str, answers: int) -> None:
    """Five answers in half a second, or two where the robot file says so; Get_Version is never answered."""
    talk = Talk([device(poll_ms=0, firmware=expected)], "0.5")
    talk.up05()
    talk.handle(CanFrame(0x7E6, bytes.fromhex("03303373345f38")))  # an assignment is no reply to discovery
    known = 100 * (answers - 1) + 1
    talk.run(known)
    talk.reports(
        """
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        1 < left voltage 24
    """,
        foreign=1,
    )
    talk.run(100)
    wrong = """
        0 < Fault left 0x300000000 firmware 0.5.x: *
        0 < State left fault: IDLE
    """
    talk.reports(wrong if expected == "0.6" else "99 < State left ready: IDLE")
    talk.run(99, Velocity("left", 0.0))
    assert bool(talk.lines) == (expected != "0.6")


def test_vectors_of_a_request_with_more_than_one_reply() -> None:
    """An answer counts once for each asking: what comes unasked, or again, tells nothing of our frames."""
    talk = Talk([device(poll_ms=0)], "0.5")
    talk.up05()
    talk.run(50)
    for _ in range(10):
        talk.report("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.run(100)
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        1 < left voltage 24
    """)


@pytest.mark.parametrize("expected", ["auto", "0.5", "0.6"])
def test_vectors_of_a_device_that_answers_nothing(expected: str) -> None:
    talk = Talk([device(poll_ms=0, firmware=expected)])
    talk.beat()
    talk.place()
    talk.run(1300, Velocity("left", 1.0))
    # Silence proves nothing: a fault, and no guess.
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        900-1100 < Fault left 0x300000000 firmware unknown: *
        900-1100 < State left fault: IDLE
    """)
    if expected == "0.5":
        return
    talk.ask(ClearFault("left"))
    talk.run(300)
    talk.version()
    talk.run(200)
    # Clearing goes out when its language is known.
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        301-400 > 3:Clear_Errors 0
        400 < State left ready: IDLE
        400 < Done ClearFault left:*
    """)


def test_vectors_of_a_device_that_answers_discovery_but_not_get_version() -> None:
    talk = Talk([device(poll_ms=0)])
    talk.beat()
    talk.place()
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.handle(address(3, 10))
    talk.run(1150)
    # No 0.5.x does: then it is not one, however often it answers the other question.
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        1 < left voltage 24
        900-1100 < Fault left 0x300000000 firmware unknown: *
        900-1100 < State left fault: IDLE
    """)


def test_vectors_of_a_device_of_another_line_than_stated() -> None:
    talk = Talk([device(poll_ms=0, firmware="0.6")], "0.5")
    talk.up05()
    talk.beat(1, 0x40, Motor_Error_Flag=1)
    talk.answer("Get_Motor_Error", Motor_Error=1)
    talk.run(550, Velocity("left", 1.0))
    # Its heartbeats can be read then; its parts are not asked.
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        1 < left voltage 24
        401 < Fault left 0x300000000 firmware 0.5.x: *
        401 < State left fault: IDLE
        500 < Fault left 0x5000000000040 MOTOR_FAILED: *
    """)


def test_vectors_of_a_line_that_is_not_supported() -> None:
    talk = Talk([device(poll_ms=0)])
    talk.up()
    talk.version(minor=7)
    talk.run(150, Velocity("left", 1.0))
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        1 < Fault left 0x300000000 firmware 0.7.10: *
        1 < State left fault: IDLE
    """)
    talk.version()
    talk.ask(ClearFault("left"))
    talk.run(150)
    # Its firmware was updated; it is asked anew. Heartbeats at 50 and 150.
    talk.reports("""
        50 < State left ready: IDLE
        1-149 > 3:Clear_Errors 0
    """)
    talk.run(10)
    talk.reports("0 < Done ClearFault left:*")


@pytest.mark.parametrize("expected", ["auto", "0.5"])
def test_vectors_of_an_axis_of_0_5_that_is_replaced_by_0_6(expected: str) -> None:
    talk = Talk([device(poll_ms=0, firmware=expected)], "0.5")
    talk.up05()
    talk.run(600)
    talk.stage()
    talk.handle(frame("Get_Version", Fw_Version_Minor=6, Fw_Version_Revision=9))
    talk.run(300, Velocity("left", 1.0))
    talk.reports("""
        0 < Fault left 0x300000000 firmware 0.6.9: *replaced, or two at one node id
        0 < State left fault: IDLE
    """)


def test_vectors_of_a_device_of_0_6_that_is_replaced_by_0_5_while_it_is_off() -> None:
    talk = standing()
    talk.mute()
    talk.run(300)
    talk.line = "0.5"
    talk.up05()
    talk.run(600)
    talk.reports("""
        240 < State left offline: no frames received
        300 < State left initialising: IDLE, identifying its firmware
        300-401 < left voltage 24
        800-900 < State left ready: IDLE
    """)


def test_vectors_of_both_lines_on_one_bus() -> None:
    """The same words, each in its own language."""
    talk = Talk([device(poll_ms=0), device("axis", 4, poll_ms=0)], others={4: "0.5"})
    talk.up()
    talk.up05(4)
    talk.run(600)
    talk.stage()
    talk.ask(Zero("left"), Zero("axis"), ClearFault("left"), ClearFault("axis"))
    talk.run(10)
    talk.reports("""
        0 > 3:Set_Absolute_Position 0 | 4:Set_Linear_Count 0 | 3:Clear_Errors 0 | 4:Clear_Errors
        0 < Done ClearFault left:*
        0 < Done Zero left:*
        0 < Done ClearFault axis: and every axis of its board
        0 < Done Zero axis:*
    """)
    talk.beat(1, 0x1000)
    talk.beat(1, 0x1000, node=4)
    talk.run(10)
    talk.reports("""
        0 < Fault left 0x1000 CURRENT_LIMIT_VIOLATION: *
        0 < State left fault: IDLE
        0 < Fault axis 0x5000000001000 MIN_ENDSTOP_PRESSED: *
        0 < State axis fault: IDLE
    """)


# -- who only listens -------------------------------------------------------------------------------------

READY, ARMED, FAULT = (
    "State left ready: IDLE",
    "State left armed: CLOSED_LOOP_CONTROL",
    "State left fault: IDLE",
)
UNREAD = "State left initialising: IDLE"


@pytest.mark.parametrize(
    ("line", "signals", "reported"),
    [
        ("0.5", {}, [UNREAD]),
        ("0.5", {"Trajectory_Done_Flag": 1}, [READY]),
        ("0.5", {"Axis_State": 8, "Trajectory_Done_Flag": 1}, [ARMED]),
        (
            "0.5",
            {"Controller_Error_Flag": 1, "Axis_Error": 0x200},
            ["Fault left 0x5000000000200 CONTROLLER_FAILED", FAULT],
        ),
        # MISSING_INPUT and BUSY, as far as 0.6.x goes; or DC_BUS_OVER_VOLTAGE with a trajectory done.
        ("0.5", {"Motor_Error_Flag": 1, "Axis_Error": 0x40}, [UNREAD]),
        ("0.5", {"Encoder_Error_Flag": 1, "Axis_Error": 0x100}, [UNREAD]),
        ("0.5", {"Encoder_Error_Flag": 1, "Motor_Error_Flag": 1, "Axis_Error": 0x140}, [UNREAD]),
        ("0.5", {"Axis_Error": 0x80000}, ["Fault left 0x5000000080000 UNKNOWN_POSITION", FAULT]),
        (
            "0.5",
            {
                "Encoder_Error_Flag": 1,
                "Motor_Error_Flag": 1,
                "Controller_Error_Flag": 1,
                "Axis_Error": 0x340,
                "Trajectory_Done_Flag": 1,
            },
            [
                "Fault left 0x5000000000040 MOTOR_FAILED",
                "Fault left 0x5000000000100 ENCODER_FAILED",
                "Fault left 0x5000000000200 CONTROLLER_FAILED",
                FAULT,
            ],
        ),
        ("0.6", {}, [UNREAD]),
        ("0.6", {"Axis_State": 8}, ["State left initialising: CLOSED_LOOP_CONTROL"]),
        ("0.6", {"Axis_State": 8, "Procedure_Result": 1}, [ARMED]),
        ("0.6", {"Procedure_Result": 1}, [UNREAD]),
        ("0.6", {"Procedure_Result": 2}, [READY + ", CANCELLED"]),
        (
            "0.6",
            {"Procedure_Result": 3, "Axis_Error": 0x200},
            ["Fault left 0x200 DC_BUS_UNDER_VOLTAGE", FAULT + ", DISARMED"],
        ),
        ("0.6", {"Trajectory_Done_Flag": 1}, [READY]),
        ("0.6", {"Trajectory_Done_Flag": 1, "Axis_Error": 0x100}, [UNREAD]),
        ("0.6", {"Axis_Error": 0x2000000}, ["Fault left 0x2000000 ESTOP_REQUESTED", FAULT]),
    ],
)
def test_vectors_of_heartbeats_whose_form_shows_the_line(
    line: str, signals: dict[str, Any], reported: list[str]
) -> None:
    """Read where only one line can have sent them; that is never enough to command."""
    talk = Talk([device(poll_ms=0)], line)
    talk.report("Heartbeat", **({"Axis_State": 1} | signals))
    suffix = ", identifying its firmware"
    talk.reports("\n".join(f"0 < {text}{suffix if text.startswith('State') else ': *'}" for text in reported))
    talk.report("Get_Encoder_Estimates")
    talk.run(1, Velocity("left", 1.0))
    assert all(":" not in line.text for line in talk.lines if line.way == ">")


@pytest.mark.parametrize(
    ("data", "mode"),
    [
        ("0000000001020001", "initialising"),  # a result of 2, and a controller's error
        ("0000000001000201", "initialising"),
        ("0000000401000001", "initialising"),  # SPINOUT_DETECTED, and a controller's error
        ("0000000201000001", "initialising"),
        ("0000000201000000", "fault"),  # ESTOP_REQUESTED
        ("0000000001010100", "ready"),  # an encoder's flag without the axis' bit: a trajectory is done
    ],
)
def test_vectors_of_heartbeats_that_no_line_would_send(data: str, mode: str) -> None:
    talk = Talk([device(poll_ms=0)])
    talk.handle(CanFrame(0x61, bytes.fromhex(data)))
    assert talk.lines[-1].text == f"State left {mode}: IDLE, identifying its firmware"


# -- extended identifiers ---------------------------------------------------------------------------------


@pytest.mark.parametrize("node", [0, 0x30004, 0xFFFFFF])
def test_vectors_of_an_axis_with_extended_identifiers(node: int) -> None:
    talk = Talk([device("axis", node, firmware="0.5", is_extended=True, poll_ms=0)], "0.5")
    talk.up05(node, extended=True)
    talk.run(200)
    talk.reports("""
        0 < State axis initialising: IDLE, identifying its firmware
        0 < axis position 0, velocity 0
        1 < axis voltage 24
    """)
    talk.report("Heartbeat", 4, Axis_State=8)
    talk.report("Heartbeat", 4, extended=True, Axis_State=8)
    talk.reports("", foreign=2)
    talk.run(20, Velocity("axis", 1.0))
    talk.ask(ClearFault("axis"))
    talk.beat(node=node, extended=True)
    talk.run(10, Idle("axis"))
    talk.reports(f"""
        0 < State axis ready: IDLE
        0 > x{node}:Set_Controller_Mode 2 1 | x{node}:Set_Input_Vel 0 0 | x{node}:Set_Axis_State 8
        10 > x{node}:Set_Input_Vel 0 0
        20 > x{node}:Clear_Errors
        20 < Done ClearFault axis: and every axis of its board
        20 > x{node}:Set_Axis_State 1
    """)


def test_vectors_of_one_node_id_in_both_formats() -> None:
    """They are two nodes, and do not hear each other's frames."""
    talk = Talk(
        [
            device("standard", firmware="0.5", poll_ms=0),
            device("extended", firmware="0.5", poll_ms=0, is_extended=True),
        ],
        "0.5",
    )
    for _ in range(2):
        for extended in (False, True):
            talk.report("Heartbeat", extended=extended, Axis_State=1)
            talk.report("Get_Encoder_Estimates", extended=extended, Pos_Estimate=0.5 * extended)
        talk.run(100)
        talk.report("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    # Only the standard one has answered, twice as asked.
    talk.stage()
    talk.report("Heartbeat", Axis_State=1)
    talk.report("Heartbeat", extended=True, Axis_State=1)
    talk.run(10, Velocity("standard", 0.0), Velocity("extended", 0.0))
    talk.reports("""
        0 < State standard ready: IDLE
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
    """)
