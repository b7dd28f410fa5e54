"""Conversations of vectors: devices that fall, restart or are silent while they run, and a bus that fails.

What vouches: the devices' bytes are cantools' with the DBC 0.6.10; what is expected is derived by hand
from the README ("What it does": errors, restarts) and the docstrings of `host_axis` and `driver` (what a bus
loses). See `talk`.
"""

from __future__ import annotations

from protocols.frames import BusState
from protocols.messages import ClearFault, Hold, Idle, Velocity
from tests.protocols.odrive_can.conversation import device
from tests.protocols.odrive_can.talk import ROUND, Talk, running, standing


def test_vectors_of_a_device_that_falls_while_it_runs() -> None:
    talk = running()
    talk.beat(1, Procedure_Result=3)
    talk.run(150, Velocity("left", 0.0))
    # Told, and only a question: arming again might wipe the reason.
    talk.reports("""
        0 < State left ready: IDLE, DISARMED, left closed loop by itself
        0 > 3?Get_Error
        100 < State left ready: IDLE, DISARMED
        100 > 3?Get_Error
    """)
    talk.report("Get_Error", Active_Errors=0, Disarm_Reason=0x200 | 0x1)
    talk.report("Get_Error", Active_Errors=0, Disarm_Reason=0x100)
    talk.run(50, Velocity("left", 0.0))
    # INITIALIZING is no fault; a reason that was not asked for is history. Then a fresh sequence.
    talk.reports("""
        0 < Fault left 0x200 DC_BUS_UNDER_VOLTAGE: it disarmed the axis: *
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        10…40 > 3:Set_Input_Vel 0 0
    """)
    talk.beat(8)
    talk.run(100, Velocity("left", 0.0))
    talk.reports("""
        0 < State left armed: CLOSED_LOOP_CONTROL
        0…90 > 3:Set_Input_Vel 0 0
    """)
    talk.beat(1, 0x2000200, Procedure_Result=3)
    talk.run(600, Velocity("left", 0.0))
    # In fault: not armed, not cleared. An answer that never comes is not waited for for ever.
    talk.reports("""
        0 < Fault left 0x200 DC_BUS_UNDER_VOLTAGE: *
        0 < Fault left 0x2000000 ESTOP_REQUESTED: *
        0 < State left fault: IDLE, DISARMED
        0…400/100 > 3?Get_Error
    """)
    talk.report("Get_Error", Active_Errors=0x2000280, Disarm_Reason=0)
    talk.reports("0 < Fault left 0x80 error bit 0x80: *")
    talk.beat(1, 0x200)
    talk.run(100)
    talk.reports("0 < State left fault: IDLE")
    talk.beat(1, 0x2000200)
    talk.run(100)
    talk.reports("0 < Fault left 0x2000000 ESTOP_REQUESTED: *")  # it was gone, and came again


def test_vectors_of_one_that_falls_and_is_let_go() -> None:
    """As a joint does that heard of a fault: Idle goes out at once, and the reason is asked for as well."""
    talk = running()
    talk.answer("Get_Error", Disarm_Reason=0x1000000)
    talk.beat(1, Procedure_Result=3)
    talk.run(200, Idle("left"))
    # Idle does not wipe the reason: arming would.
    talk.reports("""
        0 < State left ready: IDLE, DISARMED, left closed loop by itself
        0 > 3:Set_Axis_State 1 | 3?Get_Error
        1 < Fault left 0x1000000 WATCHDOG_TIMER_EXPIRED: it disarmed the axis: *
        50 > 3:Set_Axis_State 1
        100 < State left ready: IDLE, DISARMED
        100…150/50 > 3:Set_Axis_State 1
    """)
    talk.run(100, Idle("left"))
    talk.reports("")  # heard to be idle at 100 and 200


def test_vectors_of_a_restart_in_the_midst_of_motion() -> None:
    talk = running()
    talk.beat(1, 1)
    talk.run(200, Velocity("left", ROUND))
    talk.beat(1)
    talk.run(100, Velocity("left", ROUND))
    talk.beat(8)
    talk.run(100, Velocity("left", ROUND))
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        100 < State left initialising: IDLE
        200 < State left ready: IDLE
        200 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        210…290 > 3:Set_Input_Vel 0 0
        300 < State left armed: CLOSED_LOOP_CONTROL
        300…390 > 3:Set_Input_Vel 1 0
    """)


def test_vectors_of_one_that_is_silent_in_the_midst_of_motion() -> None:
    talk = running()
    talk.mute()
    talk.run(300, Velocity("left", ROUND))
    talk.up(state=8)
    talk.run(200, Velocity("left", ROUND))
    # Heard last at -10. What it is is asked anew, every 100 ms; then it is taken over.
    talk.reports("""
        0…230 > 3:Set_Input_Vel 1 0
        240 < State left offline: no frames received
        240 > 3:Set_Input_Vel 1 0
        300 < State left initialising: CLOSED_LOOP_CONTROL, identifying its firmware
        400 < State left armed: CLOSED_LOOP_CONTROL
        400 > 3:Set_Input_Vel 1 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 1 0
        410…490 > 3:Set_Input_Vel 1 0
    """)
    talk.run(50, Idle("left"))
    talk.mute()
    talk.run(300, Idle("left"))
    talk.up()
    talk.run(300, Idle("left"))
    # Idle goes out to what was ours, heard or not, until two heartbeats confirm it: at 350 and 450.
    talk.reports("""
        0…250/50 > 3:Set_Axis_State 1
        290 < State left offline: no frames received
        300 > 3:Set_Axis_State 1
        350 < State left initialising: IDLE, identifying its firmware
        350…400/50 > 3:Set_Axis_State 1
        450 < State left ready: IDLE
    """)


def test_vectors_of_two_devices_on_a_bus_that_fails() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)])
    talk.up()
    talk.up(4)
    talk.run(200)
    talk.stage()
    words = (Velocity("left", ROUND), Hold("right"))
    talk.run(50, *words)
    talk.beat(8)
    talk.beat(8, node=4)
    talk.run(50, *words)
    talk.reports("""
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
            | 4:Set_Controller_Mode 3 1 | 4:Set_Input_Pos 0 0 0 | 4:Set_Axis_State 8
        10…40 > 3:Set_Input_Vel 0 0 | 4:Set_Input_Pos 0 0 0
        50 < State left armed: CLOSED_LOOP_CONTROL
        50 < State right armed: CLOSED_LOOP_CONTROL
        50…90 > 3:Set_Input_Vel 1 0 | 4:Set_Input_Pos 0 0 0
    """)
    talk.bus(BusState.FULL)
    talk.run(30, *words)
    talk.bus(BusState.PASSIVE)
    talk.run(20, *words)
    # Our frames may be lost: the mode is said again. An error-passive controller loses none.
    talk.reports("""
        0 > 3:Set_Input_Vel 1 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 1 0
            | 4:Set_Input_Pos 0 0 0 | 4:Set_Controller_Mode 3 1 | 4:Set_Input_Pos 0 0 0
        10…40 > 3:Set_Input_Vel 1 0 | 4:Set_Input_Pos 0 0 0
    """)
    talk.ask(ClearFault("left"))
    talk.bus(BusState.GONE)
    talk.mute(3)
    talk.mute(4)
    talk.run(40, *words)
    talk.reports("""
        0 > 3:Clear_Errors 0
        0 < Refused ClearFault left: the bus is gone
    """)
    talk.bus(BusState.BACK)
    talk.up(state=8)
    talk.up(4, state=8)
    talk.run(200, Idle("left"), Hold("right"))
    # Asked anew what they are; but Idle goes out at once to what was ours.
    talk.reports("""
        0 < State left initialising: CLOSED_LOOP_CONTROL, identifying its firmware
        0 < State right initialising: CLOSED_LOOP_CONTROL, identifying its firmware
        0…50/50 > 3:Set_Axis_State 1
        100 < State left armed: CLOSED_LOOP_CONTROL
        100 < State right armed: CLOSED_LOOP_CONTROL
        100 > 3:Set_Axis_State 1 | 4:Set_Input_Pos 0 0 0 | 4:Set_Controller_Mode 3 1 | 4:Set_Input_Pos 0 0 0
        110…140 > 4:Set_Input_Pos 0 0 0
        150 > 3:Set_Axis_State 1 | 4:Set_Input_Pos 0 0 0
        160…190 > 4:Set_Input_Pos 0 0 0
    """)


def test_vectors_of_a_bus_that_was_off_while_a_device_arms() -> None:
    talk = standing()
    talk.run(20, Velocity("left", 1.0))
    talk.bus(BusState.OFF)
    talk.run(110, Velocity("left", 1.0))
    # Frames were lost: a fresh sequence, as soon as it is known again.
    talk.reports("""
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        10 > 3:Set_Input_Vel 0 0
        100 < State left ready: IDLE
        100 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        110…120 > 3:Set_Input_Vel 0 0
    """)
