"""Conversations of vectors: parameters that are read and written."""

from __future__ import annotations

import math
from typing import Any

from protocols.odrive_can.dialect import READABLE05, READABLE06
from protocols.odrive_can.requests import WRITABLE
from protocols.words import (
    ReadParameter,
    WriteParameter,
)
from tests.protocols.odrive_can.conversation import (
    MESSAGES,
    standing,
    standing05,
)


def test_vectors_of_parameters_that_are_read() -> None:
    talk = standing()
    values: dict[str, dict[str, Any]] = {}
    for at, name in enumerate(READABLE06, 1):
        told = next(m for m, row in MESSAGES["0.6"].items() if name in {s.name for s in row.signals})
        values.setdefault(told, {})[name] = at % 2 if name == "Trajectory_Done_Flag" else at
    values["Get_Version"] |= {"Fw_Version_Major": 0, "Fw_Version_Minor": 6}
    for told, signals in values.items():
        talk.answer(told, **signals)
    for name in READABLE06:
        talk.ask(ReadParameter("left", name))
        talk.run(20)
    talk.beat()
    talk.answer("Get_Temperature", FET_Temperature=math.nan, Motor_Temperature=20.0)
    talk.ask(ReadParameter("left", "FET_Temperature"), ReadParameter("left", "Motor_Temperature"))
    talk.run(20)
    talk.ask(ReadParameter("left", "nothing"), ReadParameter("nobody", "Iq_Measured"))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        210 > 3?Get_Encoder_Estimates
        210 < Feedback position=6.28319 velocity=12.5664
        210 < Parameter left Pos_Estimate 1
        210 < Done ReadParameter left
        210 < Feedback position=0 velocity=0
        230 > 3?Get_Encoder_Estimates
        230 < Feedback position=6.28319 velocity=12.5664
        230 < Parameter left Vel_Estimate 2
        230 < Done ReadParameter left
        230 < Feedback position=0 velocity=0
        250 > 3?Get_Iq
        250 < Feedback current=4
        250 < Parameter left Iq_Setpoint 3
        250 < Done ReadParameter left
        270 > 3?Get_Iq
        270 < Parameter left Iq_Measured 4
        270 < Done ReadParameter left
        290 > 3?Get_Bus_Voltage_Current
        290 < Feedback voltage=5
        290 < Parameter left Bus_Voltage 5
        290 < Done ReadParameter left
        310 > 3?Get_Bus_Voltage_Current
        310 < Parameter left Bus_Current 6
        310 < Done ReadParameter left
        330 > 3?Get_Version
        330 < Parameter left Protocol_Version 7
        330 < Done ReadParameter left
        350 > 3?Get_Version
        350 < Parameter left Hw_Version_Major 8
        350 < Done ReadParameter left
        370 > 3?Get_Version
        370 < Parameter left Hw_Version_Minor 9
        370 < Done ReadParameter left
        390 > 3?Get_Version
        390 < Parameter left Hw_Version_Variant 10
        390 < Done ReadParameter left
        410 > 3?Get_Version
        410 < Parameter left Fw_Version_Major 0
        410 < Done ReadParameter left
        430 > 3?Get_Version
        430 < Parameter left Fw_Version_Minor 6
        430 < Done ReadParameter left
        450 > 3?Get_Version
        450 < Parameter left Fw_Version_Revision 13
        450 < Done ReadParameter left
        470 > 3?Get_Version
        470 < Parameter left Fw_Version_Unreleased 14
        470 < Done ReadParameter left
        490 > 3?Heartbeat
        490 < Fault left 2 SYSTEM_LEVEL a fault of the firmware, or memory corrupted reboot it; if it comes
            back, update its firmware
        490 < Fault left 4 TIMING_ERROR the firmware missed a deadline of its control loop reboot it; lower
            its cyclic message rates
        490 < Fault left 8 MISSING_ESTIMATE no valid position or velocity: encoder not calibrated, not
            connected or disturbed check the encoder's cable and magnet, then calibrate
        490 < State left initialising HARMONIC_CALIBRATION_COMMUTATION, procedure result 17, asking for its
            firmware
        490 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        491 > 3?Get_Encoder_Estimates
        492 < Feedback position=6.28319 velocity=12.5664
        500 < State left ready IDLE
        500 < Parameter left Axis_Error 0
        500 < Done ReadParameter left
        500 < Feedback position=0 velocity=0
        510 > 3?Heartbeat
        510 < Fault left 2 SYSTEM_LEVEL a fault of the firmware, or memory corrupted reboot it; if it comes
            back, update its firmware
        510 < Fault left 4 TIMING_ERROR the firmware missed a deadline of its control loop reboot it; lower
            its cyclic message rates
        510 < Fault left 8 MISSING_ESTIMATE no valid position or velocity: encoder not calibrated, not
            connected or disturbed check the encoder's cable and magnet, then calibrate
        510 < State left initialising HARMONIC_CALIBRATION_COMMUTATION, procedure result 17, asking for its
            firmware
        530 < Refused ReadParameter left its firmware is not known, or not what the robot file says
        550 < Refused ReadParameter left its firmware is not known, or not what the robot file says
        570 < Refused ReadParameter left its firmware is not known, or not what the robot file says
        590 < Refused ReadParameter left its firmware is not known, or not what the robot file says
        590 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        591 > 3?Get_Encoder_Estimates
        592 < Feedback position=6.28319 velocity=12.5664
        600 < State left ready IDLE
        600 < Parameter left Axis_State 1
        600 < Done ReadParameter left
        600 < Feedback position=0 velocity=0
        610 > 3?Get_Temperature
        610 < Feedback temperature=22
        610 < Parameter left FET_Temperature 21
        610 < Done ReadParameter left
        630 > 3?Get_Temperature
        630 < Parameter left Motor_Temperature 22
        630 < Done ReadParameter left
        650 > 3?Get_Torques
        650 < Feedback torque=24
        650 < Parameter left Torque_Target 23
        650 < Done ReadParameter left
        670 > 3?Get_Torques
        670 < Parameter left Torque_Estimate 24
        670 < Done ReadParameter left
        690 > 3?Get_Powers
        690 < Parameter left Electrical_Power 25
        690 < Done ReadParameter left
        710 > 3?Get_Powers
        710 < Parameter left Mechanical_Power 26
        710 < Done ReadParameter left
        730 > 2 × 3?Get_Temperature
        730 < Feedback temperature=20
        730 < Refused ReadParameter left the device has no sensor for it
        730 < Parameter left Motor_Temperature 20
        730 < Done ReadParameter left
        750 < Refused ReadParameter left CANSimple does not tell 'nothing'; it tells Pos_Estimate,
            Vel_Estimate, Iq_Setpoint, Iq_Measured, Bus_Voltage, Bus_Current, Protocol_Version,
            Hw_Version_Major, Hw_Version_Minor, Hw_Version_Variant, Fw_Version_Major, Fw_Version_Minor,
            Fw_Version_Revision, Fw_Version_Unreleased, Axis_Error, Axis_State, Procedure_Result,
            Trajectory_Done_Flag, Active_Errors, Disarm_Reason, FET_Temperature, Motor_Temperature,
            Torque_Target, Torque_Estimate, Electrical_Power, Mechanical_Power
        750 < Refused ReadParameter nobody odrive_can cannot do this, or knows no such motor
        heard 114, bad 0, foreign 0
        """)


def test_vectors_of_parameters_that_are_read_of_0_5() -> None:
    talk = standing05()
    values: dict[str, dict[str, Any]] = {}
    for at, name in enumerate(READABLE05, 1):
        told = next(m for m, row in MESSAGES["0.5"].items() if name in {s.name for s in row.signals})
        values.setdefault(told, {})[name] = 0 if told == "Heartbeat" else at
    for told, signals in values.items():
        talk.answer(told, **signals)
    for name in READABLE05:
        talk.ask(ReadParameter("axis3", name))
        talk.run(100)
    talk.ask(ReadParameter("axis3", "nothing"))
    talk.is_as_told("""
        0 < State axis3 initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1 < Feedback voltage=24
        100 > 3?0x0 | 3?Get_Bus_Voltage_Current
        101 > 3?Get_Encoder_Estimates
        200 < State axis3 ready IDLE
        300 > 3?Get_Encoder_Estimates
        300 < Feedback position=6.28319 velocity=12.5664
        300 < Parameter axis3 Pos_Estimate 1
        300 < Done ReadParameter axis3
        300 < Feedback position=0 velocity=0
        400 > 3?Get_Encoder_Estimates
        400 < Feedback position=6.28319 velocity=12.5664
        400 < Parameter axis3 Vel_Estimate 2
        400 < Done ReadParameter axis3
        400 < Feedback position=0 velocity=0
        500 > 3?Get_Iq
        500 < Feedback current=4
        500 < Parameter axis3 Iq_Setpoint 3
        500 < Done ReadParameter axis3
        600 > 3?Get_Iq
        600 < Parameter axis3 Iq_Measured 4
        600 < Done ReadParameter axis3
        700 > 3?Get_Bus_Voltage_Current
        700 < Feedback voltage=5
        700 < Parameter axis3 Bus_Voltage 5
        700 < Done ReadParameter axis3
        800 > 3?Get_Bus_Voltage_Current
        800 < Parameter axis3 Bus_Current 6
        800 < Done ReadParameter axis3
        900 < Parameter axis3 Axis_Error 0
        900 < Done ReadParameter axis3
        1000 < Parameter axis3 Axis_State 1
        1000 < Done ReadParameter axis3
        1100 < Parameter axis3 Motor_Error_Flag 0
        1100 < Done ReadParameter axis3
        1200 < Parameter axis3 Encoder_Error_Flag 0
        1200 < Done ReadParameter axis3
        1300 < Parameter axis3 Controller_Error_Flag 0
        1300 < Done ReadParameter axis3
        1400 < Parameter axis3 Trajectory_Done_Flag 0
        1400 < Done ReadParameter axis3
        1500 > 3?Get_Motor_Error
        1500 < Fault axis3 281474976710657 motor PHASE_RESISTANCE_OUT_OF_RANGE phase resistance is not
            plausible check the phase wires and the calibration current, then calibrate again
        1500 < Fault axis3 281474976710660 error bit 0x4 not known to this driver look it up for this
            firmware
        1500 < Fault axis3 281474976710664 motor DRV_FAULT the gate driver reported a fault: short circuit,
            over-current or over-temperature unplug the motor, look for shorts between phases, reboot
        1500 < Parameter axis3 Motor_Error 13
        1500 < Done ReadParameter axis3
        1600 > 3?Get_Encoder_Error
        1600 < Fault axis3 562949953421314 encoder CPR_POLEPAIRS_MISMATCH pole pairs or encoder resolution
            are set wrongly correct them, calibrate again
        1600 < Fault axis3 562949953421316 encoder NO_RESPONSE the encoder does not answer check the
            encoder's cable, supply and settings
        1600 < Fault axis3 562949953421320 encoder UNSUPPORTED_ENCODER_MODE encoder.config.mode does not
            allow this correct it
        1600 < Parameter axis3 Encoder_Error 14
        1600 < Done ReadParameter axis3
        1700 > 3?Get_Controller_Error
        1700 < Fault axis3 844424930131969 controller OVERSPEED the shaft turned faster than vel_limit ×
            vel_limit_tolerance check for a load that drives the motor; raise vel_limit; lower vel_gain if
            it overshot
        1700 < Fault axis3 844424930131970 controller INVALID_INPUT_MODE input_mode is none that there is
            set a valid one
        1700 < Fault axis3 844424930131972 controller UNSTABLE_GAIN input_filter_bandwidth is too high lower
            it
        1700 < Fault axis3 844424930131976 controller INVALID_MIRROR_AXIS axis_to_mirror is no axis of the
            board correct it
        1700 < Parameter axis3 Controller_Error 15
        1700 < Done ReadParameter axis3
        1800 > 3?Get_Sensorless_Error
        1800 < Fault axis3 1125899906842640 error bit 0x10 not known to this driver look it up for this
            firmware
        1800 < Parameter axis3 Sensorless_Error 16
        1800 < Done ReadParameter axis3
        1900 > 3?Get_Encoder_Count
        1900 < Parameter axis3 Shadow_Count 17
        1900 < Done ReadParameter axis3
        2000 > 3?Get_Encoder_Count
        2000 < Parameter axis3 Count_in_CPR 18
        2000 < Done ReadParameter axis3
        2100 > 3?Get_Sensorless_Estimates
        2100 < Parameter axis3 Sensorless_Pos_Estimate 19
        2100 < Done ReadParameter axis3
        2200 > 3?Get_Sensorless_Estimates
        2200 < Parameter axis3 Sensorless_Vel_Estimate 20
        2200 < Done ReadParameter axis3
        2300 < Refused ReadParameter axis3 CANSimple does not tell 'nothing'; it tells Pos_Estimate,
            Vel_Estimate, Iq_Setpoint, Iq_Measured, Bus_Voltage, Bus_Current, Axis_Error, Axis_State,
            Motor_Error_Flag, Encoder_Error_Flag, Controller_Error_Flag, Trajectory_Done_Flag, Motor_Error,
            Encoder_Error, Controller_Error, Sensorless_Error, Shadow_Count, Count_in_CPR,
            Sensorless_Pos_Estimate, Sensorless_Vel_Estimate
        heard 269, bad 0, foreign 0
        """)


def test_vectors_of_parameters_that_are_written() -> None:
    talk = standing()
    for _, names in WRITABLE:
        for at, name in enumerate(names, 1):
            talk.ask(WriteParameter("left", name, at / 8))
            talk.run(130)
    talk.ask(WriteParameter("left", "Vel_Gain", 3.0))
    talk.ask(WriteParameter("left", "Pos_Gain", -1.0))
    talk.ask(WriteParameter("left", "Pos_Gain", math.nan))
    talk.ask(WriteParameter("left", "Pos_Gain", 0.0))
    talk.ask(WriteParameter("left", "nothing", 1.0))
    talk.ask(WriteParameter("left", "save_configuration", 2.0))
    talk.run(110)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        210 < Refused WriteParameter left SetLimits sets Velocity_Limit and Current_Limit together, and the
            device does not tell them over CAN: write Current_Limit too; Velocity_Limit is kept for it
        340 > 3:Set_Limits 0.125 0.25
        400 < Done WriteParameter left sent; the device does not confirm it
        470 > 3:Set_Traj_Vel_Limit 0.125
        500 < Done WriteParameter left sent; the device does not confirm it
        600 < Refused WriteParameter left SetTrajAccelLimits sets Traj_Accel_Limit and Traj_Decel_Limit
            together, and the device does not tell them over CAN: write Traj_Decel_Limit too;
            Traj_Accel_Limit is kept for it
        730 > 3:Set_Traj_Accel_Limits 0.125 0.25
        800 < Done WriteParameter left sent; the device does not confirm it
        860 > 3:Set_Traj_Inertia 0.125
        900 < Done WriteParameter left sent; the device does not confirm it
        990 > 3:Set_Pos_Gain 0.125
        1000 < Done WriteParameter left sent; the device does not confirm it
        1120 < Refused WriteParameter left SetVelGains sets Vel_Gain and Vel_Integrator_Gain together, and
            the device does not tell them over CAN: write Vel_Integrator_Gain too; Vel_Gain is kept for it
        1250 > 3:Set_Vel_Gains 0.125 0.25
        1300 < Done WriteParameter left sent; the device does not confirm it
        1380 > 3:Set_Vel_Gains 3 0.25
        1380 < Refused WriteParameter left -1.0 is not a finite number of at least 0
        1380 < Refused WriteParameter left nan is not a finite number of at least 0
        1380 > 3:Set_Pos_Gain 0
        1380 < Refused WriteParameter left CANSimple cannot set 'nothing'; it can set Velocity_Limit,
            Current_Limit, Traj_Vel_Limit, Traj_Accel_Limit, Traj_Decel_Limit, Traj_Inertia, Pos_Gain,
            Vel_Gain, Vel_Integrator_Gain, save_configuration
        1380 < Refused WriteParameter left save_configuration takes 1
        1400 < Done WriteParameter left sent; the device does not confirm it (× 2)
        heard 165, bad 0, foreign 0
        """)
