"""Conversations of vectors: what devices complain of, what they are asked then, when it is told again."""

from __future__ import annotations

from protocols.words import ClearFault, Estop, Hold, Idle, Torque, Velocity
from tests.protocols.odrive_can.conversation import Talk, device, standing, standing05


def test_vectors_of_an_axis_of_0_5_whose_parts_complain() -> None:
    talk = standing05()
    talk.beat(8)
    talk.run(100, Velocity("axis3", 0.0))
    talk.beat(1, 0x40, Motor_Error_Flag=1)
    talk.answer("Get_Motor_Error", Motor_Error=0x1001)
    talk.run(150, Velocity("axis3", 0.0))
    talk.beat(1, 0x340, Motor_Error_Flag=1, Encoder_Error_Flag=1, Controller_Error_Flag=1)
    talk.answer("Get_Controller_Error", Controller_Error=1)
    talk.run(700, Velocity("axis3", 0.0))
    talk.tell("Get_Encoder_Error", Encoder_Error=4)
    talk.tell("Get_Encoder_Error", Encoder_Error=6)
    talk.beat(1, 0x80)
    talk.answer("Get_Sensorless_Error", Sensorless_Error=1)
    talk.run(200, Velocity("axis3", 0.0))
    talk.beat(1, 0x40, Motor_Error_Flag=1)
    talk.run(200)
    talk.ask(ClearFault("axis3"))
    talk.run(650)
    talk.beat()
    talk.run(100)
    talk.ask(Estop("axis3"))
    talk.beat(1, 0x1000)
    talk.run(100)
    talk.beat(1, 0x4000)
    talk.run(100)
    talk.is_as_told("""
        0 < State axis3 initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?0x0 | 3?Get_Bus_Voltage_Current
        1 < Feedback voltage=24
        100 > 3?0x0 | 3?Get_Bus_Voltage_Current
        101 > 3?Get_Encoder_Estimates
        200 < State axis3 ready IDLE
        300 < State axis3 armed CLOSED_LOOP_CONTROL
        300 > 3:Set_Input_Vel 0 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0
        320…380/20 > 3:Set_Input_Vel 0 0
        400 < Fault axis3 1407374883553344 MOTOR_FAILED the motor has an error of its own read the motor's
            error
        400 < State axis3 fault IDLE
        400 > 3?Get_Motor_Error
        401 < Fault axis3 281474976710657 motor PHASE_RESISTANCE_OUT_OF_RANGE phase resistance is not
            plausible check the phase wires and the calibration current, then calibrate again
        401 < Fault axis3 281474976714752 motor CURRENT_LIMIT_VIOLATION motor current above current_lim plus
            its margin check gains and phase wires; raise current_lim_margin
        600 < Fault axis3 1407374883553536 ENCODER_FAILED the encoder has an error of its own read the
            encoder's error
        600 < Fault axis3 1407374883553792 CONTROLLER_FAILED the controller has an error of its own read the
            controller's error
        600 > 3?Get_Encoder_Error | 3?Get_Controller_Error
        601 < Fault axis3 844424930131969 controller OVERSPEED the shaft turned faster than vel_limit ×
            vel_limit_tolerance check for a load that drives the motor; raise vel_limit; lower vel_gain if
            it overshot
        700 > 3?Get_Encoder_Error
        800 > 3?Get_Encoder_Error
        900 > 3?Get_Encoder_Error
        1000 > 3?Get_Encoder_Error
        1250 < Fault axis3 562949953421316 encoder NO_RESPONSE the encoder does not answer check the
            encoder's cable, supply and settings
        1250 < Fault axis3 562949953421314 encoder CPR_POLEPAIRS_MISMATCH pole pairs or encoder resolution
            are set wrongly correct them, calibrate again
        1300 < Fault axis3 1407374883553408 SENSORLESS_ESTIMATOR_FAILED the estimator has an error of its
            own read the sensorless error
        1300 > 3?Get_Sensorless_Error
        1301 < Fault axis3 1125899906842625 sensorless UNSTABLE_GAIN the estimator's observer gain is too
            high lower it
        1500 < Fault axis3 1407374883553344 MOTOR_FAILED the motor has an error of its own read the motor's
            error
        1500 > 3?Get_Motor_Error
        1501 < Fault axis3 281474976710657 motor PHASE_RESISTANCE_OUT_OF_RANGE phase resistance is not
            plausible check the phase wires and the calibration current, then calibrate again
        1501 < Fault axis3 281474976714752 motor CURRENT_LIMIT_VIOLATION motor current above current_lim
            plus its margin check gains and phase wires; raise current_lim_margin
        1650 > 3:Clear_Errors
        1770 > 3:Clear_Errors
        1890 > 3:Clear_Errors
        2010 > 3:Clear_Errors
        2130 > 3:Clear_Errors
        2250 < Refused ClearFault axis3 still in fault: MOTOR_FAILED
        2300 < State axis3 ready IDLE
        2400 > 3:0x02
        2400 < Fault axis3 1407374883557376 MIN_ENDSTOP_PRESSED the lower end stop was reached move the axis
            back by hand, then clear
        2400 < State axis3 fault IDLE
        2500 < Fault axis3 1407374883569664 ESTOP_REQUESTED an emergency stop was sent over the bus make
            sure it is safe, then clear
        2500 < Done Estop axis3 it stays in fault until cleared
        heard 294, bad 0, foreign 0
        """)


def test_vectors_of_an_axis_of_0_5_that_is_armed_and_let_go() -> None:
    talk = standing05(4)
    talk.run(110, Velocity("axis3", 1.0), Torque("axis4", 1.0))
    talk.beat(8)
    talk.beat(8, node=4)
    talk.run(120, Velocity("axis3", 1.0), Torque("axis4", 1.0))
    talk.beat(1, node=4)
    talk.run(120, Velocity("axis3", 1.0), Torque("axis4", 1.0))
    talk.run(120, Idle("axis3"), Idle("axis4"))
    talk.beat(1)
    talk.run(300, Idle("axis3"), Idle("axis4"))
    talk.is_as_told("""
        0 < State axis3 initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 < State axis4 initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?0x0 | 3?Get_Bus_Voltage_Current | 4?0x0 | 4?Get_Bus_Voltage_Current
        1 < Feedback voltage=24 (× 2)
        100 > 3?0x0 | 3?Get_Bus_Voltage_Current | 4?0x0 | 4?Get_Bus_Voltage_Current
        101 > 3?Get_Encoder_Estimates | 4?Get_Encoder_Estimates
        200 < State axis3 ready IDLE
        200 < State axis4 ready IDLE
        300 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8 | 4:Set_Controller_Mode 1
            1 | 4:Set_Input_Torque 0 | 4:Set_Axis_State 8
        320…480/20 > 3:Set_Input_Vel 0 0 | 4:Set_Input_Torque 0
        500 < State axis3 armed CLOSED_LOOP_CONTROL
        500 < State axis4 armed CLOSED_LOOP_CONTROL
        500…580/20 > 3:Set_Input_Vel 0.159155 0 | 4:Set_Input_Torque 1
        600 < State axis4 ready IDLE, left closed loop by itself
        600 > 3:Set_Input_Vel 0.159155 0 | 4:Set_Controller_Mode 1 1 | 4:Set_Input_Torque 0 |
            4:Set_Axis_State 8
        620…640/20 > 3:Set_Input_Vel 0.159155 0 | 4:Set_Input_Torque 0
        660 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
        700 < State axis4 ready IDLE
        720 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
        780 > 3:Set_Axis_State 1 | 4:Set_Axis_State 1
        800 < State axis3 ready IDLE
        840 > 3:Set_Axis_State 1
        heard 240, bad 0, foreign 0
        """)


def test_vectors_of_arming_again_after_a_clearing() -> None:
    talk = standing(arm_retry_ms=100)
    talk.beat(1, Procedure_Result=14)
    talk.run(290, Hold("left"))
    talk.ask(ClearFault("left"))
    talk.run(300, Hold("left"))
    talk.beat(1, Procedure_Result=3)
    talk.run(100, Idle("left"))
    talk.run(220, Hold("left"))
    talk.beat(1, Procedure_Result=13)
    talk.run(20, Idle("left"))
    talk.run(280, Idle("left"))
    talk.beat(1, Procedure_Result=99)
    talk.run(700, Torque("left", 0.0))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        220 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        240…300/20 > 3:Set_Input_Pos 0 0 0
        300 < State left ready IDLE, NOT_CALIBRATED
        320 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        340…380/20 > 3:Set_Input_Pos 0 0 0
        400 < Fault left 4294967310 NOT_CALIBRATED motor or encoder is not calibrated calibrate with the
            vendor's tool, shaft free, and save
        500 > 3:Clear_Errors 0
        500 < Done ClearFault left
        500 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        520…580/20 > 3:Set_Input_Pos 0 0 0
        600 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        620…680/20 > 3:Set_Input_Pos 0 0 0
        700 < Fault left 4294967310 NOT_CALIBRATED motor or encoder is not calibrated calibrate with the
            vendor's tool, shaft free, and save
        800 < State left ready IDLE, DISARMED
        800 > 3:Set_Axis_State 1
        860 > 3:Set_Axis_State 1
        900 > 3:Set_Controller_Mode 3 1 | 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        920…980/20 > 3:Set_Input_Pos 0 0 0
        1000 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        1020…1080/20 > 3:Set_Input_Pos 0 0 0
        1100 > 3:Set_Input_Pos 0 0 0 | 3:Set_Axis_State 8
        1120 > 3:Set_Axis_State 1
        1180 > 3:Set_Axis_State 1
        1200 < State left ready IDLE, INVALID_STATE
        1240 > 3:Set_Axis_State 1
        1420 > 3:Set_Controller_Mode 1 1 | 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1440…1500/20 > 3:Set_Input_Torque 0
        1500 < State left ready IDLE, procedure result 99
        1520 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1540…1600/20 > 3:Set_Input_Torque 0
        1620 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1640…1700/20 > 3:Set_Input_Torque 0
        1720 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1740…1800/20 > 3:Set_Input_Torque 0
        1820 > 3:Set_Input_Torque 0 | 3:Set_Axis_State 8
        1840…1880/20 > 3:Set_Input_Torque 0
        1900 < Fault left 17179869184 did not arm in 5 tries it stayed in IDLE with procedure result 99 look
            at it with the vendor's tool, then clear
        heard 235, bad 0, foreign 0
        """)


def test_vectors_of_a_result_that_is_no_verdict_on_an_arming() -> None:
    talk = standing()
    talk.run(20, Velocity("left", 0.0))
    talk.beat(8)
    talk.run(100, Velocity("left", 0.0))
    talk.beat(1, Procedure_Result=12)
    talk.run(350)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        220 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        240…320/20 > 3:Set_Input_Vel 0 0
        300 < State left armed CLOSED_LOOP_CONTROL
        400 < State left ready IDLE, HOMING_WITHOUT_ENDSTOP, left closed loop by itself
        400 > 3?Get_Error
        500 < State left ready IDLE, HOMING_WITHOUT_ENDSTOP
        500 > 3?Get_Error
        600 > 3?Get_Error
        heard 76, bad 0, foreign 0
        """)


def test_vectors_of_a_restart_in_the_midst_of_motion() -> None:
    talk = standing()
    talk.beat(8)
    talk.run(150, Velocity("left", 1.0))
    talk.beat(1, 1)
    talk.run(220, Velocity("left", 1.0))
    talk.beat(1)
    talk.run(120, Velocity("left", 1.0))
    talk.beat(8)
    talk.run(120, Velocity("left", 1.0))
    talk.mute()
    talk.run(300, Velocity("left", 1.0))
    talk.up()
    talk.beat(8)
    talk.run(220, Velocity("left", 1.0))
    talk.run(40, Idle("left"))
    talk.mute()
    talk.run(320, Idle("left"))
    talk.up()
    talk.run(320, Idle("left"))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        220 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        240…280/20 > 3:Set_Input_Vel 0 0
        300 < State left armed CLOSED_LOOP_CONTROL
        300…380/20 > 3:Set_Input_Vel 0.159155 0
        400 < State left initialising IDLE, asking for its firmware
        400 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        401 > 3?Get_Encoder_Estimates
        500 < State left initialising IDLE
        600 < State left ready IDLE
        600 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        620…680/20 > 3:Set_Input_Vel 0 0
        700 < State left armed CLOSED_LOOP_CONTROL
        700…820/20 > 3:Set_Input_Vel 0.159155 0
        830…1040/10 > 3:Set_Input_Vel 0.159155 0 | 3?Get_Encoder_Estimates
        1050 > 3:Set_Input_Vel 0.159155 0 | 3?Get_Encoder_Estimates | 3?Heartbeat
        1060 < State left offline nothing heard
        1060 > 3:Set_Input_Vel 0.159155 0 | 3?Get_Version
        1150 > 3?Get_Encoder_Estimates | 3?Heartbeat
        1160 > 3?Get_Version
        1200 < State left armed CLOSED_LOOP_CONTROL
        1200 > 3:Set_Input_Vel 0.159155 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0.159155 0
        1220…1320/20 > 3:Set_Input_Vel 0.159155 0
        1340 > 3:Set_Axis_State 1
        1390 > 3:Set_Axis_State 1 | 3?Get_Encoder_Estimates
        1400…1430/10 > 3?Get_Encoder_Estimates
        1440 > 3:Set_Axis_State 1 | 3?Get_Encoder_Estimates
        1450…1480/10 > 3?Get_Encoder_Estimates
        1490 > 3:Set_Axis_State 1 | 3?Get_Encoder_Estimates
        1500…1530/10 > 3?Get_Encoder_Estimates
        1540 > 3:Set_Axis_State 1 | 3?Get_Encoder_Estimates
        1550 > 3?Get_Encoder_Estimates | 3?Heartbeat
        1560…1580/10 > 3?Get_Encoder_Estimates
        1590 > 3:Set_Axis_State 1 | 3?Get_Encoder_Estimates
        1600…1610/10 > 3?Get_Encoder_Estimates
        1620 < State left offline nothing heard
        1620 > 3?Get_Version
        1640 > 3:Set_Axis_State 1
        1650 > 3?Heartbeat
        1700 < State left initialising IDLE, asking for its firmware
        1700 > 3:Set_Axis_State 1 | 3?Get_Encoder_Estimates
        1710 > 3?Get_Encoder_Estimates
        1720 > 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1760 > 3:Set_Axis_State 1
        1800 < State left ready IDLE
        heard 159, bad 0, foreign 0
        """)


def test_vectors_of_a_device_that_tells_by_its_clock_and_of_one_that_is_asked_often() -> None:
    talk = Talk([device(feedback_ms=20, poll_ms=50), device("right", 4, feedback_ms=50, poll_ms=40)], every=0)
    talk.up()
    talk.cycle(30, "Get_Bus_Voltage_Current", Bus_Voltage=20.0)
    talk.cycle(0, "Get_Encoder_Estimates")
    talk.answer("Get_Iq", Iq_Measured=1.0)
    talk.up(4)
    talk.cycle(100, "Get_Encoder_Estimates", 4, Pos_Estimate=1.0)
    talk.run(210)
    talk.answer("Get_Encoder_Estimates", Vel_Estimate=1.0)
    talk.run(90)
    talk.cycle(20, "Get_Encoder_Estimates")
    talk.run(110)
    talk.cycle(0, "Heartbeat")
    talk.run(370)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback voltage=20
        0 < State right initialising IDLE, asking for its firmware
        0 < Feedback position=6.28319 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 4?Get_Version | 4?Get_Bus_Voltage_Current |
            63?Address
        1…100/99 > 3?Get_Encoder_Estimates | 4?Get_Encoder_Estimates
        100 < State left ready IDLE
        100 < State right ready IDLE
        120 > 3?Get_Encoder_Estimates | 3?Get_Iq | 4?Get_Iq | 4?Get_Bus_Voltage_Current
        121 < Feedback current=1
        140 > 3?Get_Encoder_Estimates | 3?Get_Temperature | 4?Get_Temperature | 4?Get_Torques
        150 > 3?Get_Torques | 4?Get_Encoder_Estimates
        160 > 3?Get_Encoder_Estimates | 4?Get_Iq | 4?Get_Bus_Voltage_Current
        180 > 3?Get_Encoder_Estimates | 3?Get_Iq | 4?Get_Temperature | 4?Get_Torques
        200 > 3?Get_Encoder_Estimates | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates |
            4?Get_Iq | 4?Get_Bus_Voltage_Current
        220 > 3?Get_Encoder_Estimates | 4?Get_Temperature | 4?Get_Torques
        221 < Feedback position=0 velocity=6.28319
        240 > 3?Get_Encoder_Estimates | 3?Get_Iq | 4?Get_Iq | 4?Get_Bus_Voltage_Current
        250 > 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates
        260 > 3?Get_Encoder_Estimates | 4?Get_Temperature | 4?Get_Torques
        280 > 3?Get_Encoder_Estimates | 4?Get_Iq | 4?Get_Bus_Voltage_Current
        300 < Feedback position=0 velocity=0
        300 > 3?Get_Iq | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Temperature |
            4?Get_Torques
        350 > 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        400 > 3?Get_Iq | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        450 > 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        500 > 3?Get_Iq | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        550 > 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        600 > 3?Get_Iq | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        650 > 3?Heartbeat | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        700 > 3?Get_Iq | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        750 > 3?Heartbeat | 3?Get_Temperature | 3?Get_Torques | 4?Get_Encoder_Estimates | 4?Get_Iq |
            4?Get_Bus_Voltage_Current | 4?Get_Temperature | 4?Get_Torques
        heard 85, bad 0, foreign 0
        """)
