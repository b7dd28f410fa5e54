"""Conversations of vectors: a device of 0.6.x comes up, is read, armed, steered, stopped and let go.

What vouches: the devices' bytes are cantools' with the DBC 0.6.10; what is expected is derived by hand
from the README ("What it does", "Units") and the docstrings of `options` and `host_axis`. See `talk`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from protocols.frames import BusState, CanFrame
from protocols.messages import Hold, Idle, Impedance, Position, Stop, Torque, Velocity
from tests.protocols.odrive_can.conversation import device, frame
from tests.protocols.odrive_can.talk import ROUND, Talk, standing


def test_vectors_of_a_device_that_comes_up_is_read_and_falls_silent() -> None:
    talk = Talk([device(offline_ms=300)])
    talk.run(260)
    talk.reports("")  # nobody there, and not for offline_ms yet
    talk.up()
    talk.answer("Get_Iq", Iq_Setpoint=1.0, Iq_Measured=2.0)
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.answer("Get_Temperature", FET_Temperature=40.0, Motor_Temperature=50.0)
    talk.answer("Get_Torques", Torque_Target=0.75, Torque_Estimate=0.5)
    talk.run(320)
    # Asked for its version every 100 ms, and for its supply, as both lines tell it; then the next heartbeat
    # counts, and each of the others is polled once in poll_ms.
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        0 < left position 0, velocity 0
        0-100 < left voltage 24
        100 < State left ready: IDLE
        101-301 < left current 2
        101-301 < left temperature 50
        101-301 < left torque 0.5
    """)
    talk.report("Get_Temperature", FET_Temperature=41.0, Motor_Temperature=math.nan)
    talk.report("Get_Temperature", FET_Temperature=math.nan, Motor_Temperature=math.nan)
    talk.report("Get_Powers", Electrical_Power=3.0)
    talk.reports("0 < left temperature 41")  # NaN: no sensor
    talk.mute()
    talk.run(400)
    talk.reports("290-300 < State left offline: no frames received")
    talk.up()
    talk.run(210)
    # Silent, so it may have been replaced: asked anew.
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        100-200 < State left ready: IDLE
    """)


def test_vectors_of_one_that_never_comes_up() -> None:
    talk = Talk([device()])
    talk.run(400, Velocity("left", 1.0))
    talk.run(200, Idle("left"))
    talk.reports("250 < State left offline: no frames received")


def test_vectors_of_arming_steering_and_letting_go() -> None:
    talk = standing()
    talk.place(0.5)
    talk.run(100, Velocity("left", ROUND))
    # Mode 2 (velocity), input 1 (passthrough); a set-point that does not move it; state 8.
    talk.reports("""
        0 < left position 3.14159, velocity 0
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        10…90 > 3:Set_Input_Vel 0 0
    """)
    talk.beat(8, Procedure_Result=1)
    talk.run(40, Velocity("left", ROUND, 0.25))
    talk.reports("""
        0 < State left armed: CLOSED_LOOP_CONTROL
        0…30 > 3:Set_Input_Vel 1 0.25
    """)
    talk.place(0.75, 1.0)
    talk.run(40, Position("left", 2 * ROUND, ROUND, -0.5))
    # No stale input is obeyed when the mode changes, and entering position control may replace the input.
    talk.reports("""
        0 < left position 4.71239, velocity 6.28319
        0 > 3:Set_Input_Pos 2 1 -0.5 | 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 2 1 -0.5
        10…30 > 3:Set_Input_Pos 2 1 -0.5
    """)
    talk.run(20, Hold("left"))
    talk.place(1.0)
    talk.run(20, Hold("left"))
    # Where it was measured when the word was first said.
    talk.reports("""
        0…10 > 3:Set_Input_Pos 0.75 0 0
        20 < left position 6.28319, velocity 0
        20…30 > 3:Set_Input_Pos 0.75 0 0
    """)
    talk.run(20, Torque("left", 0.125))
    talk.run(20, Hold("left"))
    talk.reports("""
        0 > 3:Set_Input_Torque 0.125 | 3:Set_Controller_Mode 1 1 | 3:Set_Input_Torque 0.125
        10 > 3:Set_Input_Torque 0.125
        20 > 3:Set_Input_Pos 1 0 0 | 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 1 0 0
        30 > 3:Set_Input_Pos 1 0 0
    """)
    talk.run(60, Idle("left"))
    talk.reports("0…50/50 > 3:Set_Axis_State 1")
    talk.beat(1)
    talk.run(300, Idle("left"))
    # Last said at 50, 10 ms ago; until two heartbeats say that it is disarmed: the second comes at 100.
    talk.reports("""
        0 < State left ready: IDLE
        40…90/50 > 3:Set_Axis_State 1
    """)


def test_vectors_of_commands_that_must_not_be_sent() -> None:
    talk = standing()
    talk.beat(8)
    talk.run(20, Velocity("left", ROUND))
    talk.stage()
    talk.run(20, Impedance("left", 0.0, 0.0, 0.0, 1.0, 1.0))
    talk.run(20, Velocity("left", math.inf))
    talk.run(20, Velocity("left", 7000.0))  # 1114 turns/s
    talk.run(20, Velocity("nobody", 1.0))
    talk.run(20, Position("left", 0.0, -206.0))  # 32.8 turns/s, and int16 ends at 32.767
    talk.run(20, Velocity("left", ROUND))
    # Each is told once, however often it is said; mode 2 is still the device's.
    talk.reports("""
        0 < Refused Impedance left: *no impedance control
        20 < Refused Velocity left: velocity is inf
        40 < Refused Velocity left: velocity 7000 *
        60 < Refused Velocity nobody: no such motor on this bus
        80 < Refused Position left: velocity -206 *
        100…110 > 3:Set_Input_Vel 1 0
    """)
    talk.run(10, Velocity("left", math.inf))
    talk.reports("0 < Refused Velocity left: velocity is inf")  # it was good in between


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (Velocity("left", 1000 * ROUND), "Set_Input_Vel 1000 0"),
        (Velocity("left", -1000.1 * ROUND), ""),
        (Velocity("left", 0.0, -1000.0), "Set_Input_Vel 0 -1000"),
        (Velocity("left", 0.0, 1000.1), ""),
        (Torque("left", -1000.0), "Set_Input_Torque -1000"),
        (Torque("left", 1000.1), ""),
        (Position("left", -1e6 * ROUND), "Set_Input_Pos -1e+06 0 0"),
        (Position("left", 1.001e6 * ROUND), ""),
        (Position("left", 0.0, 32.767 * ROUND, -32.767), "Set_Input_Pos 0 32.767 -32.767"),
        (Position("left", 0.0, 0.0, 32.768), ""),
        (Position("left", 0.0, 0.0006 * ROUND, -0.0006), "Set_Input_Pos 0 0.001 -0.001"),  # thousandths
    ],
)
def test_vectors_of_commands_at_the_limits_of_their_fields(
    command: Velocity | Torque | Position, said: str
) -> None:
    talk = standing()
    talk.beat(8)
    talk.run(20, command)
    talk.run(10, Idle("left"))
    name = type(command).__name__
    if not said:
        talk.reports(f"""
            0 < State left armed: CLOSED_LOOP_CONTROL
            0 < Refused {name} left: *lies outside*
        """)
        return
    mode = {"Torque": 1, "Velocity": 2, "Position": 3}[name]
    talk.reports(f"""
        0 < State left armed: CLOSED_LOOP_CONTROL
        0 > 3:{said} | 3:Set_Controller_Mode {mode} 1 | 3:{said}
        10 > 3:{said}
        20 > 3:Set_Axis_State 1
    """)


def test_vectors_of_a_device_that_runs_already() -> None:
    """Taken over without dropping its load: no state is asked for, and Hold means where it is."""
    talk = standing()
    talk.beat(8)
    talk.place(0.5)
    talk.run(100, Idle("left"))
    talk.reports("""
        0 < State left armed: CLOSED_LOOP_CONTROL
        0 < left position 3.14159, velocity 0
    """)
    talk.run(100, Hold("left"))
    talk.reports("""
        0 > 3:Set_Input_Pos 0.5 0 0 | 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0.5 0 0
        10…90 > 3:Set_Input_Pos 0.5 0 0
    """)


def test_vectors_of_one_whose_version_comes_before_its_first_heartbeat() -> None:
    talk = Talk([device(poll_ms=0)])
    talk.version()
    talk.place(0.5)
    talk.run(50, Hold("left"))
    talk.beat(8)
    talk.run(50, Hold("left"))
    # From its first heartbeat on it is known, and driven.
    talk.reports("""
        0 < left position 3.14159, velocity 0
        50 < State left armed: CLOSED_LOOP_CONTROL
        50 > 3:Set_Input_Pos 0.5 0 0 | 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0.5 0 0
        60…90 > 3:Set_Input_Pos 0.5 0 0
    """)


def test_vectors_of_a_stop_of_a_device_that_another_host_has_armed() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)])
    talk.up(state=8)
    talk.up(4)
    talk.run(200)
    talk.stage()
    talk.run(100, Idle("left"), Idle("right"))
    talk.reports("")  # not ours
    talk.ask(Stop())
    talk.run(20, Idle("left"), Idle("right"))
    talk.reports("0 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1")
    talk.bus(BusState.FULL)
    talk.run(60, Idle("left"), Idle("right"))
    # What the bus dropped is said again at once.
    talk.reports("0…50/50 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1")
    talk.beat()
    talk.run(220, Idle("left"), Idle("right"))
    # Last said 10 ms ago. Left is heard to be idle at 0 and 100, right (since FULL) at 20 and 120.
    talk.reports("""
        0 < State left ready: IDLE
        40…90/50 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
    """)


def test_vectors_of_frames_that_are_not_for_us() -> None:
    talk = standing()
    estimates = frame("Get_Encoder_Estimates", Pos_Estimate=1.0)
    talk.handle(
        replace(estimates, id=0x89),  # node 4
        replace(estimates, extended=True),
        replace(estimates, fd=True),
        CanFrame(estimates.id, remote=True),
        CanFrame(estimates.id),  # a request, too
        CanFrame(0x68, bytes(8)),  # no message
        CanFrame(0x7E6, bytes.fromhex("04303373345f38")),  # a node id that another host assigns
        b"serial",
    )
    for name in ("Set_Axis_State", "Set_Controller_Mode", "Set_Input_Pos", "Set_Input_Vel", "Estop"):
        talk.handle(frame(name))  # of another host
    talk.run(50)
    talk.reports("", foreign=13)


@pytest.mark.parametrize(
    "raw",
    [
        CanFrame(0x69, bytes(7)),
        CanFrame(0x61, bytes(6)),
        frame("Get_Encoder_Estimates", Pos_Estimate=math.nan),
        frame("Get_Encoder_Estimates", Vel_Estimate=math.inf),
        frame("Get_Iq", Iq_Measured=-math.inf),
        frame("Get_Torques", Torque_Estimate=math.nan),
    ],
)
def test_vectors_of_frames_that_are_bad(raw: CanFrame) -> None:
    """They change nothing, and do not count as a sign of life."""
    talk = standing()
    talk.handle(raw)
    talk.reports("", bad=1)
    talk.mute()
    talk.run(100)
    talk.handle(raw)
    talk.run(200)
    talk.reports("240 < State left offline: no frames received", bad=1)


def test_vectors_of_states_that_are_neither_idle_nor_closed_loop() -> None:
    talk = standing()
    talk.beat(9, Procedure_Result=1)
    talk.run(100)
    talk.beat(40, Procedure_Result=40)
    talk.run(100)
    talk.beat(1, Procedure_Result=1)
    talk.run(100)
    talk.reports("""
        0 < State left initialising: LOCKIN_SPIN
        100 < State left initialising: axis state 40, procedure result 40
        200 < State left ready: IDLE
    """)
