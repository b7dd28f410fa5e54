"""Conversations of vectors: how a device is armed, and how it refuses.

What vouches: the devices' bytes and the names of results are cantools' with the DBCs 0.6.10 and 0.5.6;
what else is expected is derived by hand from the README ("What it does": arming, verdicts) and the
docstrings of `options` and `host_axis`. See `talk`.
"""

from __future__ import annotations

import pytest

from protocols.messages import ClearFault, Hold, Idle, Position, Torque, Velocity
from tests.protocols.odrive_can.conversation import names_of
from tests.protocols.odrive_can.talk import ROUND, running, standing, standing05


def test_vectors_of_a_position_to_a_device_that_stands_elsewhere() -> None:
    """Armed where it is, and led to where it shall be only when it is in closed loop."""
    talk = standing()
    talk.place(-0.25)
    talk.run(50, Position("left", ROUND))
    talk.beat(8)
    talk.run(20, Position("left", ROUND))
    talk.reports("""
        0 < left position -1.5708, velocity 0
        0 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos -0.25 0 0 | 3:Set_Axis_State 8
        10…40 > 3:Set_Input_Pos -0.25 0 0
        50 < State left armed: CLOSED_LOOP_CONTROL
        50…60 > 3:Set_Input_Pos 1 0 0
    """)


def test_vectors_of_another_mode_while_it_arms() -> None:
    talk = standing()
    talk.run(20, Velocity("left", ROUND))
    talk.run(20, Torque("left", 1.0))
    talk.beat(8)
    talk.run(20, Torque("left", 1.0))
    talk.reports("""
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        10 > 3:Set_Input_Vel 0 0
        20 > 3:Set_Controller_Mode 1 1 | 3:Set_Input_Torque 0
        30 > 3:Set_Input_Torque 0
        40 < State left armed: CLOSED_LOOP_CONTROL
        40…50 > 3:Set_Input_Torque 1
    """)


def test_vectors_of_two_axes_of_0_5_that_are_armed_and_let_go() -> None:
    talk = standing05(4)
    words = (Velocity("axis3", ROUND), Torque("axis4", 1.0))
    talk.run(50, *words)
    talk.beat(8)
    talk.beat(8, node=4)
    talk.run(50, *words)
    talk.reports("""
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
            | 4:Set_Controller_Mode 1 1 | 4:Set_Input_Torque 0 | 4:Set_Axis_State 8
        10…40 > 3:Set_Input_Vel 0 0 | 4:Set_Input_Torque 0
        50 < State axis3 armed: CLOSED_LOOP_CONTROL
        50 < State axis4 armed: CLOSED_LOOP_CONTROL
        50…90 > 3:Set_Input_Vel 1 0 | 4:Set_Input_Torque 1
    """)
    talk.beat(1, node=4)
    talk.run(200, *words)
    # It tells no reason, so none is asked for; only a fresh sequence arms it, arm_retry_ms after the last.
    talk.reports("""
        0 < State axis4 ready: IDLE, left closed loop by itself
        0 > 3:Set_Input_Vel 1 0 | 4:Set_Controller_Mode 1 1 | 4:Set_Input_Torque 0
        10…90 > 3:Set_Input_Vel 1 0 | 4:Set_Input_Torque 0
        100 < State axis4 ready: IDLE
        100…140 > 3:Set_Input_Vel 1 0 | 4:Set_Input_Torque 0
        150 > 3:Set_Input_Vel 1 0 | 4:Set_Input_Torque 0 | 4:Set_Axis_State 8
        160…190 > 3:Set_Input_Vel 1 0 | 4:Set_Input_Torque 0
    """)
    talk.run(100, Idle("axis3"), Idle("axis4"))
    talk.beat(1)
    talk.run(200, Idle("axis3"), Idle("axis4"))
    # Axis 4 is heard to be idle at 100 and 200, axis 3 too.
    talk.reports("""
        0…50/50 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
        100 < State axis3 ready: IDLE
        100…150/50 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
    """)


def test_vectors_of_one_that_is_let_go_and_wanted_again_at_once() -> None:
    """Its last heartbeat is from before Idle; that it obeyed Idle is no fall."""
    talk = running()
    talk.run(10, Idle("left"))
    talk.run(40, Velocity("left", ROUND))
    talk.beat(1)
    talk.run(20, Velocity("left", ROUND))
    talk.reports("""
        0 > 3:Set_Axis_State 1
        10 > 3:Set_Input_Vel 1 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 1 0
        20…40 > 3:Set_Input_Vel 1 0
        50 < State left ready: IDLE
        50 > 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        60 > 3:Set_Input_Vel 0 0
    """)


def test_vectors_of_a_device_that_refuses_to_arm() -> None:
    talk = standing(arm_retry_ms=200)
    talk.run(50, Hold("left"))
    talk.beat(1, Procedure_Result=14)
    talk.run(400, Hold("left"))
    # The first heartbeat after the request may be from before it.
    talk.reports("""
        0 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        10…40 > 3:Set_Input_Pos 0 0 0
        50 < State left ready: IDLE, NOT_CALIBRATED
        50…140 > 3:Set_Input_Pos 0 0 0
        150 < Fault left 0x10000000e NOT_CALIBRATED: motor or encoder is not calibrated
    """)
    talk.run(300, Idle("left"))
    talk.reports("0…150/50 > 3:Set_Axis_State 1")  # heartbeats at 0 (before), 100 and 200
    talk.run(60, Hold("left"))
    # Idle came in between: it is tried again.
    talk.reports("""
        0 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        10…50 > 3:Set_Input_Pos 0 0 0
    """)


def test_vectors_of_a_device_that_does_not_care() -> None:
    talk = standing(arm_retry_ms=200)
    talk.beat(1, Procedure_Result=2)
    talk.run(1300, Torque("left", 1.0))
    # CANCELLED may be left from an earlier request: no verdict. Five tries, each with its time, then a fault.
    talk.reports("""
        0 < State left ready: IDLE, CANCELLED
        0 > 3:Set_Controller_Mode 1 1 | 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        10…190 > 3:Set_Input_Torque 0
        200 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        210…390 > 3:Set_Input_Torque 0
        400 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        410…590 > 3:Set_Input_Torque 0
        600 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        610…790 > 3:Set_Input_Torque 0
        800 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        810…990 > 3:Set_Input_Torque 0
        1000 < Fault left 0x400000000 did not arm in 5 attempts: it stayed in IDLE with CANCELLED
    """)
    talk.ask(ClearFault("left"))
    talk.run(100, Torque("left", 1.0))
    talk.reports("""
        0 > 3:Clear_Errors 0
        0 < Done ClearFault left:*
        0 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        10…90 > 3:Set_Input_Torque 0
    """)


def test_vectors_of_a_device_that_obeys_the_last_try() -> None:
    talk = standing(arm_retry_ms=200)
    talk.run(900, Torque("left", 1.0))
    talk.stage()
    talk.run(90, Torque("left", 1.0))
    talk.beat(8)
    talk.run(20, Torque("left", 1.0))
    # The fifth was at -100.
    talk.reports("""
        0…80 > 3:Set_Input_Torque 0
        90 < State left armed: CLOSED_LOOP_CONTROL
        90…100 > 3:Set_Input_Torque 1
    """)


def test_vectors_of_tries_that_are_quicker_than_heartbeats() -> None:
    """Five heartbeats at least: who tries every 50 ms gives it as much time."""
    talk = standing(arm_retry_ms=50)
    talk.run(600, Torque("left", 1.0))
    asked = [line for line in talk.lines if "Set_Axis_State" in line.text]
    assert [line.first for line in asked] == [0, 50, 100, 150, 200]
    assert [line.first for line in talk.lines if line.text.startswith("Fault")] == [500]


LEFT_OVER = {"SUCCESS", "BUSY", "CANCELLED", "DISARMED"}
"""What may be left over from an earlier request is no verdict on this one."""


@pytest.mark.parametrize("result", range(17))
def test_vectors_of_results_that_are_verdicts(result: int) -> None:
    talk = standing(arm_retry_ms=1000)
    talk.run(10, Hold("left"))
    talk.stage()
    talk.beat(1, Procedure_Result=result)
    talk.run(150, Hold("left"))
    name = names_of("0.6", "Heartbeat", "Procedure_Result").get(result, "procedure result 16")
    state = f"0 < State left ready: IDLE, {name}" if result > 1 else ""
    verdict = [
        "0…90 > 3:Set_Input_Pos 0 0 0",
        f"100 < Fault left {(1 << 32) + result:#x} {name}: *",
    ]
    no_verdict = result == 16 or name in LEFT_OVER
    talk.reports("\n".join([state, *(["0…140 > 3:Set_Input_Pos 0 0 0"] if no_verdict else verdict)]))


def test_vectors_of_arming_again_after_a_clearing() -> None:
    talk = standing(arm_retry_ms=100)
    talk.beat(1, Procedure_Result=14)
    talk.run(300, Hold("left"))
    talk.reports("""
        0 < State left ready: IDLE, NOT_CALIBRATED
        0 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        10…90 > 3:Set_Input_Pos 0 0 0
        100 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        110…190 > 3:Set_Input_Pos 0 0 0
        200 < Fault left 0x10000000e NOT_CALIBRATED: *
    """)
    talk.ask(ClearFault("left"))
    talk.run(300, Hold("left"))
    talk.reports("""
        0 > 3:Clear_Errors 0
        0 < Done ClearFault left:*
        0 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        10…90 > 3:Set_Input_Pos 0 0 0
        100 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        110…190 > 3:Set_Input_Pos 0 0 0
        200 < Fault left 0x10000000e NOT_CALIBRATED: *
    """)


def test_vectors_of_a_verdict_on_the_second_arming() -> None:
    """It runs, falls, and would not arm again: the first heartbeat after the request may still be old."""
    talk = standing()
    talk.answer("Get_Error")
    talk.run(20, Hold("left"))
    talk.beat(8)
    talk.run(280, Hold("left"))
    talk.stage()
    talk.beat(1, Procedure_Result=14)
    talk.run(210, Hold("left"))
    talk.reports("""
        0 < State left ready: IDLE, NOT_CALIBRATED, left closed loop by itself
        0 > 3?Get_Error
        10 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        20…90 > 3:Set_Input_Pos 0 0 0
        100 < State left ready: IDLE, NOT_CALIBRATED
        100…190 > 3:Set_Input_Pos 0 0 0
        200 < Fault left 0x10000000e NOT_CALIBRATED: *
    """)


def test_vectors_of_a_result_that_is_no_verdict_since_it_armed() -> None:
    talk = standing()
    talk.run(20, Velocity("left", 0.0))
    talk.beat(8)
    talk.run(100, Velocity("left", 0.0))
    talk.stage()
    talk.beat(1, Procedure_Result=12)
    talk.run(350)
    talk.reports("""
        0 < State left ready: IDLE, HOMING_WITHOUT_ENDSTOP, left closed loop by itself
        0 > 3?Get_Error
        100 < State left ready: IDLE, HOMING_WITHOUT_ENDSTOP
        100…300/100 > 3?Get_Error
    """)
