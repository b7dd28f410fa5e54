"""Conversations of vectors: a device comes up, is read, armed, steered, let go, and falls."""

from __future__ import annotations

import math

from protocols.wire import BusState
from protocols.words import ClearFault, Hold, Idle, Impedance, Position, Stop, Torque, Velocity
from tests.protocols.odrive_can.conversation import Talk, device

ROUND = math.tau
"""rad of a turn"""


def test_vectors_of_a_device_that_comes_up_is_read_and_falls_silent() -> None:
    talk = Talk([device(offline_ms=300)], every=0)
    talk.run(260)
    talk.up()
    talk.answer("Get_Iq", Iq_Setpoint=1.0, Iq_Measured=2.0)
    talk.answer("Get_Bus_Voltage_Current", Bus_Voltage=24.0)
    talk.answer("Get_Temperature", FET_Temperature=40.0, Motor_Temperature=50.0)
    talk.answer("Get_Torques", Torque_Estimate=0.5)
    talk.run(540)
    talk.tell("Get_Temperature", FET_Temperature=41.0, Motor_Temperature=math.nan)
    talk.tell("Get_Temperature", FET_Temperature=math.nan, Motor_Temperature=math.nan)
    talk.tell("Get_Powers", Electrical_Power=3.0)
    talk.cycle(0, "Heartbeat")
    talk.cycle(0, "Get_Encoder_Estimates")
    talk.answer("Heartbeat", Axis_State=1)
    talk.answer("Get_Encoder_Estimates", Pos_Estimate=0.25)
    talk.run(400)
    talk.mute()
    talk.run(450)
    talk.up()
    talk.run(150)
    talk.is_as_told("""
        0 > 3?Get_Version | 3?Get_Encoder_Estimates | 63?Address
        100…200/100 > 3?Get_Version | 3?Get_Encoder_Estimates
        250 > 3?Heartbeat
        260 < Feedback position=0 velocity=0
        300 < State left initialising IDLE, asking for its firmware
        300 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        301 < Feedback voltage=24
        301 > 3?Get_Encoder_Estimates
        400 < State left ready IDLE
        800 < Feedback temperature=41
        810 > 3?Get_Encoder_Estimates | 3?Get_Iq | 3?Get_Bus_Voltage_Current
        811 < Feedback position=1.5708 velocity=0
        811 < Feedback current=2
        820…840/10 > 3?Get_Encoder_Estimates
        850 > 3?Get_Encoder_Estimates | 3?Get_Temperature
        851 < Feedback temperature=50
        860…890/10 > 3?Get_Encoder_Estimates
        900 > 3?Get_Encoder_Estimates | 3?Get_Torques
        901 < Feedback torque=0.5
        910…940/10 > 3?Get_Encoder_Estimates
        950 > 3?Get_Encoder_Estimates | 3?Heartbeat
        960…1010/10 > 3?Get_Encoder_Estimates
        1020 > 3?Get_Encoder_Estimates | 3?Get_Iq | 3?Get_Bus_Voltage_Current
        1030…1050/10 > 3?Get_Encoder_Estimates
        1060 > 3?Get_Encoder_Estimates | 3?Get_Temperature
        1070…1100/10 > 3?Get_Encoder_Estimates
        1110 > 3?Get_Encoder_Estimates | 3?Get_Torques
        1120…1200/10 > 3?Get_Encoder_Estimates
        1201 > 3?Heartbeat
        1210…1220/10 > 3?Get_Encoder_Estimates
        1230 > 3?Get_Encoder_Estimates | 3?Get_Iq | 3?Get_Bus_Voltage_Current
        1240…1260/10 > 3?Get_Encoder_Estimates
        1270 > 3?Get_Encoder_Estimates | 3?Get_Temperature
        1280…1300/10 > 3?Get_Encoder_Estimates
        1301 > 3?Heartbeat
        1310 > 3?Get_Encoder_Estimates
        1320 > 3?Get_Encoder_Estimates | 3?Get_Torques
        1330…1400/10 > 3?Get_Encoder_Estimates
        1401 > 3?Heartbeat
        1410…1420/10 > 3?Get_Encoder_Estimates
        1430 > 3?Get_Encoder_Estimates | 3?Get_Iq | 3?Get_Bus_Voltage_Current
        1440…1460/10 > 3?Get_Encoder_Estimates
        1470 > 3?Get_Encoder_Estimates | 3?Get_Temperature
        1480…1490/10 > 3?Get_Encoder_Estimates
        1491 < State left offline nothing heard
        1491 > 3?Get_Version
        1501 > 3?Heartbeat
        1590 > 3?Get_Encoder_Estimates
        1591 > 3?Get_Version
        1601 > 3?Heartbeat
        1650 < Feedback position=0 velocity=0
        1690 > 3?Get_Encoder_Estimates
        1691 > 3?Get_Version
        1700 < State left ready IDLE
        heard 129, bad 0, foreign 0
        """)


def test_vectors_of_arming_steering_and_letting_go() -> None:
    talk = Talk([device(poll_ms=0)])
    talk.up()
    talk.place(0.5)
    talk.run(250)
    talk.run(160, Velocity("left", ROUND))
    talk.beat(8, Procedure_Result=1)
    talk.run(40, Velocity("left", ROUND, 0.25))
    talk.place(0.75, 1.0)
    talk.run(40, Position("left", 2 * ROUND, ROUND, -0.5))
    talk.run(20, Hold("left"))
    talk.place(1.0)
    talk.run(20, Hold("left"))
    talk.run(20, Torque("left", 0.125))
    talk.run(20, Hold("left"))
    talk.run(20, Impedance("left", 0.0, 0.0, 0.0, 1.0, 1.0))
    talk.run(20, Velocity("left", math.inf))
    talk.run(20, Velocity("left", 7000.0))
    talk.run(20, Velocity("nobody", 1.0))
    talk.run(20, Velocity("left", ROUND))
    talk.run(70, Idle("left"))
    talk.beat(1)
    talk.run(400, Idle("left"))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=3.14159 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        250 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        260…440/10 > 3:Set_Input_Vel 0 0
        450 < Feedback position=4.71239 velocity=6.28319
        450 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0.75 0 0
        460…520/10 > 3:Set_Input_Pos 0.75 0 0
        500 < State left armed CLOSED_LOOP_CONTROL
        510 < Feedback position=6.28319 velocity=0
        530 > 3:Set_Input_Torque 0.125 | 3:Set_Controller_Mode 1 1 | 3:Set_Input_Torque 0.125
        540 > 3:Set_Input_Torque 0.125
        550 > 3:Set_Input_Pos 1 0 0 | 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 1 0 0
        560 > 3:Set_Input_Pos 1 0 0
        570 < Refused Impedance left the device has no impedance control
        590 < Refused Velocity left velocity is inf
        610 < Refused Velocity left velocity 7000 lies outside -6283.19 … 6283.19
        630 < Refused Velocity nobody no such motor on this bus
        650 > 3:Set_Input_Vel 1 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 1 0
        660 > 3:Set_Input_Vel 1 0
        670 > 3:Set_Axis_State 1
        720 > 3:Set_Axis_State 1
        770 > 3:Set_Axis_State 1
        800 < State left ready IDLE
        820 > 3:Set_Axis_State 1
        870 > 3:Set_Axis_State 1
        heard 127, bad 0, foreign 0
        """)


def test_vectors_of_a_device_that_refuses_to_arm_and_of_one_that_does_not_care() -> None:
    talk = Talk([device(poll_ms=0, arm_retry_ms=200)], every=50)
    talk.up()
    talk.run(250)
    talk.run(50, Hold("left"))
    talk.beat(1, Procedure_Result=14)
    talk.run(500, Hold("left"))
    talk.run(200, Idle("left"))
    talk.beat(1, Procedure_Result=2)
    talk.run(1700, Torque("left", 1.0))
    talk.ask(ClearFault("left"))
    talk.run(300, Torque("left", 1.0))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        250 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        300 < State left ready IDLE, NOT_CALIBRATED
        300…350/50 > 3:Set_Input_Pos 0 0 0
        400 < Fault left 4294967310 NOT_CALIBRATED motor or encoder is not calibrated calibrate with the
            vendor's tool, shaft free, and save
        800…950/50 > 3:Set_Axis_State 1
        1000 < State left ready IDLE, CANCELLED
        1000 > 3:Set_Controller_Mode 1 1 | 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1050…1150/50 > 3:Set_Input_Torque 0
        1200 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1250…1350/50 > 3:Set_Input_Torque 0
        1400 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1450…1550/50 > 3:Set_Input_Torque 0
        1600 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1650…1750/50 > 3:Set_Input_Torque 0
        1800 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1850 > 3:Set_Input_Torque 0
        1900 < Fault left 17179869184 did not arm in 5 tries it stayed in IDLE with CANCELLED look at it
            with the vendor's tool, then clear
        2700 > 3:Clear_Errors 0
        2700 < Done ClearFault left
        2700 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        2750…2850/50 > 3:Set_Input_Torque 0
        2900 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        2950 > 3:Set_Input_Torque 0
        heard 331, bad 0, foreign 0
        """)


def test_vectors_of_a_device_that_falls_while_it_runs() -> None:
    talk = Talk([device(poll_ms=0)], every=20)
    talk.up()
    talk.beat(8)
    talk.run(220)
    talk.run(100, Velocity("left", 0.0))
    talk.beat(1, Procedure_Result=3)
    talk.run(150, Velocity("left", 0.0))
    talk.tell("Get_Error", Active_Errors=0, Disarm_Reason=0x200 | 0x1)
    talk.tell("Get_Error", Active_Errors=0, Disarm_Reason=0x100)
    talk.run(60, Velocity("left", 0.0))
    talk.beat(8)
    talk.run(100, Velocity("left", 0.0))
    talk.beat(1, 0x2000200, Procedure_Result=3)
    talk.run(620, Velocity("left", 0.0))
    talk.tell("Get_Error", Active_Errors=0x2000280, Disarm_Reason=0)
    talk.beat(1, 0x200)
    talk.run(100)
    talk.beat(1, 0x2000200)
    talk.run(100)
    talk.beat(1, 0x1)
    talk.run(300, Velocity("left", 0.0))
    talk.beat(9, 0, Procedure_Result=40)
    talk.run(300, Velocity("left", 0.0))
    talk.beat(40, 0)
    talk.run(100)
    talk.is_as_told("""
        0 < State left initialising CLOSED_LOOP_CONTROL, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left armed CLOSED_LOOP_CONTROL
        220 > 3:Set_Input_Vel 0 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0
        240…380/20 > 3:Set_Input_Vel 0 0
        400 < State left ready IDLE, DISARMED, left closed loop by itself
        400 > 3?Get_Error
        470 < Fault left 512 DC_BUS_UNDER_VOLTAGE it disarmed the axis: the supply sagged or is off check
            battery, fuse and cables; lower the current limit
        480 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        500 < State left ready IDLE, DISARMED
        500…680/20 > 3:Set_Input_Vel 0 0
        600 < State left armed CLOSED_LOOP_CONTROL
        700 < Fault left 512 DC_BUS_UNDER_VOLTAGE the supply sagged or is off check battery, fuse and
            cables; lower the current limit
        700 < Fault left 33554432 ESTOP_REQUESTED an emergency stop was sent over the bus make sure it is
            safe, then clear
        700 < State left fault IDLE, DISARMED
        700 > 3?Get_Error
        800 > 3?Get_Error
        900 > 3?Get_Error
        1000 > 3?Get_Error
        1100 > 3?Get_Error
        1250 < Fault left 128 error bit 0x80 not known to this driver look it up for this firmware
        1300 < State left fault IDLE
        1400 < Fault left 33554432 ESTOP_REQUESTED an emergency stop was sent over the bus make sure it is
            safe, then clear
        1500 < State left initialising IDLE, asking for its firmware
        1500 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        1501 > 3?Get_Encoder_Estimates
        1600 < State left initialising IDLE
        1800 < State left initialising LOCKIN_SPIN, procedure result 40
        1800 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        1820…2040/20 > 3:Set_Input_Vel 0 0
        2100 < State left initialising axis state 40
        heard 242, bad 0, foreign 0
        """)


def test_vectors_of_two_devices_on_a_bus_that_fails() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)], every=20)
    talk.up()
    talk.up(4)
    talk.run(240)
    talk.run(40, Velocity("left", 1.0), Hold("right"))
    talk.beat(8)
    talk.beat(8, node=4)
    talk.run(140, Velocity("left", 1.0), Hold("right"))
    talk.bus(BusState.FULL)
    talk.run(60, Velocity("left", 1.0), Hold("right"))
    talk.bus(BusState.PASSIVE)
    talk.run(20, Velocity("left", 1.0), Hold("right"))
    talk.ask(ClearFault("left"))
    talk.bus(BusState.GONE)
    talk.run(40, Velocity("left", 1.0), Hold("right"))
    talk.bus(BusState.BACK)
    talk.run(200, Idle("left"), Hold("right"))
    talk.beat(1)
    talk.run(300, Idle("left"), Velocity("right", 1.0))
    talk.ask(Stop())
    talk.run(60, Idle("left"), Idle("right"))
    talk.bus(BusState.FULL)
    talk.run(60, Idle("left"), Idle("right"))
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
        240 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8 | 4:Set_Controller_Mode 3
            1 | 4:Set_Input_Pos 0 0 0 | 4:Set_Axis_State 8
        260…280/20 > 3:Set_Input_Vel 0 0 | 4:Set_Input_Pos 0 0 0
        300 < State left armed CLOSED_LOOP_CONTROL
        300 < State right armed CLOSED_LOOP_CONTROL
        300…400/20 > 3:Set_Input_Vel 0.159155 0 | 4:Set_Input_Pos 0 0 0
        420 > 3:Set_Input_Vel 0.159155 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0.159155 0 |
            4:Set_Input_Pos 0 0 0 | 4:Set_Controller_Mode 3 1 | 4:Set_Input_Pos 0 0 0
        440…480/20 > 3:Set_Input_Vel 0.159155 0 | 4:Set_Input_Pos 0 0 0
        500 > 3:Clear_Errors 0
        500 < State left initialising CLOSED_LOOP_CONTROL, asking for its firmware
        500 < State right initialising CLOSED_LOOP_CONTROL, asking for its firmware
        500 < Refused ClearFault left the bus is gone
        500 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 4?Get_Version | 4?Get_Bus_Voltage_Current |
            63?Address
        501 > 3?Get_Encoder_Estimates | 4?Get_Encoder_Estimates
        540 > 3:Set_Axis_State 1 | 63?Address
        600 < State left initialising CLOSED_LOOP_CONTROL, asking for its firmware
        600 < State right initialising CLOSED_LOOP_CONTROL, asking for its firmware
        600 > 3:Set_Axis_State 1 | 3?Get_Version | 3?Get_Bus_Voltage_Current | 4?Get_Version |
            4?Get_Bus_Voltage_Current
        601 > 3?Get_Encoder_Estimates | 4?Get_Encoder_Estimates
        660 > 3:Set_Axis_State 1
        700 < State left armed CLOSED_LOOP_CONTROL
        700 < State right armed CLOSED_LOOP_CONTROL
        700 > 4:Set_Input_Pos 0 0 0 | 4:Set_Controller_Mode 3 1 | 4:Set_Input_Pos 0 0 0
        720 > 3:Set_Axis_State 1 | 4:Set_Input_Pos 0 0 0
        740 > 4:Set_Input_Vel 0.159155 0 | 4:Set_Controller_Mode 2 1 | 4:Set_Input_Vel 0.159155 0
        760 > 4:Set_Input_Vel 0.159155 0
        780 > 3:Set_Axis_State 1 | 4:Set_Input_Vel 0.159155 0
        800 < State left ready IDLE
        800…820/20 > 4:Set_Input_Vel 0.159155 0
        840 > 3:Set_Axis_State 1 | 4:Set_Input_Vel 0.159155 0
        860…1020/20 > 4:Set_Input_Vel 0.159155 0
        1040 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
        1100 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
        heard 262, bad 0, foreign 0
        """)
