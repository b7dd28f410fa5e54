"""Conversations of vectors: requests that are carried out, refused, asked too often, and never answered."""

from __future__ import annotations

from protocols.wire import BusState
from protocols.words import (
    ClearFault,
    Estop,
    Home,
    Idle,
    ReadParameter,
    Reboot,
    Release,
    Scan,
    Set,
    SetId,
    Velocity,
    WriteParameter,
    Zero,
)
from tests.protocols.odrive_can.conversation import (
    DISCOVERED,
    SERIAL,
    Talk,
    device,
    standing,
    standing05,
)


def test_vectors_of_a_zero_an_estop_and_a_clearing() -> None:
    talk = standing()
    talk.place(0.05)
    talk.ask(Zero("left"))
    talk.run(250)
    talk.place(-0.04)
    talk.run(20)
    talk.ask(Zero("left"))
    talk.place(2.0)
    talk.run(650)
    talk.ask(Estop("left"))
    talk.beat(1, 0x100)
    talk.run(150)
    talk.beat(1, 0x2000100)
    talk.run(150)
    talk.ask(ClearFault("left"))
    talk.run(250)
    talk.beat(1, 0)
    talk.run(100)
    talk.beat(1, 0x2000000)
    talk.run(100)
    talk.ask(ClearFault("left"))
    talk.run(700)
    talk.ask(Home("left"), Release(), Set("gains.left", 1.0))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        210 > 3:Set_Absolute_Position 0
        210 < Feedback position=0.314159 velocity=0
        330 > 3:Set_Absolute_Position 0
        450 > 3:Set_Absolute_Position 0
        460 < Feedback position=-0.251327 velocity=0
        460 < Done Zero left
        480 > 3:Set_Absolute_Position 0
        480 < Feedback position=12.5664 velocity=0
        600 > 3:Set_Absolute_Position 0
        720 > 3:Set_Absolute_Position 0
        840 > 3:Set_Absolute_Position 0
        960 > 3:Set_Absolute_Position 0
        1080 < Refused Zero left its position did not become zero: is it turning?
        1130 > 3:Estop
        1200 < Fault left 256 DC_BUS_OVER_VOLTAGE braking fed energy back into a supply that cannot take it
            fit or configure a brake resistor, brake more gently
        1200 < State left fault IDLE
        1250 > 3:Estop
        1300 < Fault left 33554432 ESTOP_REQUESTED an emergency stop was sent over the bus make sure it is
            safe, then clear
        1300 < Done Estop left it stays in fault until cleared
        1430 > 3:Clear_Errors 0
        1550 > 3:Clear_Errors 0
        1670 > 3:Clear_Errors 0
        1700 < State left ready IDLE
        1700 < Done ClearFault left
        1800 < Fault left 33554432 ESTOP_REQUESTED an emergency stop was sent over the bus make sure it is
            safe, then clear
        1800 < State left fault IDLE
        1880 > 3:Clear_Errors 0
        2000 > 3:Clear_Errors 0
        2120 > 3:Clear_Errors 0
        2240 > 3:Clear_Errors 0
        2360 > 3:Clear_Errors 0
        2480 < Refused ClearFault left still in fault: ESTOP_REQUESTED
        2500 < Fault left 33554432 ESTOP_REQUESTED an emergency stop was sent over the bus make sure it is
            safe, then clear
        2580 < Refused Home left odrive_can has no Home
        2580 < Refused Release  odrive_can cannot do this, or knows no such motor
        2580 < Refused Set  odrive_can cannot do this, or knows no such motor
        heard 285, bad 0, foreign 0
        """)


def test_vectors_of_a_restart_seen_and_of_one_that_is_not() -> None:
    talk = standing()
    talk.ask(Reboot("left"))
    talk.run(2100)
    talk.mute()
    talk.run(900)
    talk.up()
    talk.beat(1, 1)
    talk.run(200)
    talk.beat(1, 0)
    talk.run(200)
    talk.ask(WriteParameter("left", "save_configuration", 1.0))
    talk.cycle(0, "Heartbeat")
    talk.run(399)
    talk.beat()
    talk.run(200)
    talk.cycle(0, "Heartbeat")
    talk.run(400)
    talk.beat()
    talk.run(20)
    talk.ask(Reboot("left"))
    talk.run(8100)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        210 > 3:Reboot 0
        2210 > 3:Reboot 0
        2320…2540/10 > 3?Get_Encoder_Estimates
        2550 < State left offline nothing heard
        2550 > 3?Get_Version | 3?Heartbeat
        2640 > 3?Get_Encoder_Estimates
        2650 > 3?Get_Version | 3?Heartbeat
        2740 > 3?Get_Encoder_Estimates
        2750 > 3?Get_Version | 3?Heartbeat
        2840 > 3?Get_Encoder_Estimates
        2850 > 3?Get_Version | 3?Heartbeat
        2940 > 3?Get_Encoder_Estimates
        2950 > 3?Get_Version | 3?Heartbeat
        3040 > 3?Get_Encoder_Estimates
        3050 > 3?Get_Version | 3?Heartbeat
        3140 > 3?Get_Encoder_Estimates
        3150 > 3?Get_Version | 3?Heartbeat
        3240 > 3?Get_Encoder_Estimates
        3250 > 3?Get_Version | 3?Heartbeat
        3300 < State left initialising IDLE, asking for its firmware
        3300 < Done Reboot left it has restarted
        3350 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        3351 > 3?Get_Encoder_Estimates
        3400 < State left initialising IDLE
        3500 < State left ready IDLE
        3610 > 3:Reboot 1
        3850 > 3?Heartbeat
        3950 > 3?Heartbeat
        4050 > 3?Heartbeat
        4100 < Done WriteParameter left it has restarted
        4450 > 3?Heartbeat
        4550 > 3?Heartbeat
        4629 > 3:Reboot 0
        4650 > 3?Heartbeat
        5000 > 63?Address
        6629 > 3:Reboot 0
        8629 > 3:Reboot 0
        10000 > 63?Address
        10629 > 3:Reboot 0
        12629 < Refused Reboot left it showed no sign of a restart
        heard 1297, bad 0, foreign 0
        """)


def test_vectors_of_requests_to_a_device_that_runs() -> None:
    talk = standing()
    talk.beat(8)
    talk.run(100)
    for request in (Zero("left"), Reboot("left"), WriteParameter("left", "save_configuration", 1.0)):
        talk.ask(request)
    talk.ask(SetId("can0", SERIAL, 3))
    talk.ask(SetId("can0", SERIAL, 5))
    talk.hear(DISCOVERED)
    talk.ask(SetId("can0", SERIAL, 5))
    talk.ask(WriteParameter("left", "Pos_Gain", 1.0))
    talk.run(110)
    talk.run(50, Velocity("left", 0.0))
    talk.beat(1)
    talk.run(100, Velocity("left", 0.0))
    talk.ask(Zero("left"), ClearFault("left"))
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        300 < State left armed CLOSED_LOOP_CONTROL
        310 < Refused Zero left it is armed, and would jump: say idle first
        310 < Refused Reboot left it is armed, and would drop its load: say idle first
        310 < Refused WriteParameter left it is armed, and would drop its load: say idle first
        310 < Refused SetId can0 left is armed: say idle first
        310 > 63:0x06 05303373345f38 | 63?Address
        310 < Refused SetId can0 left is armed: say idle first
        310 > 3:Set_Pos_Gain 1
        400 < Done WriteParameter left sent; the device does not confirm it
        420 > 3:Set_Input_Vel 0 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0
        440…480/20 > 3:Set_Input_Vel 0 0
        500 < State left ready IDLE
        500 > 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        520…540/20 > 3:Set_Input_Vel 0 0
        550 > 63:0x06 05303373345f38 | 63?Address | 3:Set_Input_Vel 0 0
        560 > 3:Set_Input_Vel 0 0
        570 < Refused Zero left it is armed, and would jump: say idle first
        570 > 3:Clear_Errors 0
        heard 65, bad 0, foreign 0
        """)


def test_vectors_of_requests_that_nobody_answers() -> None:
    talk = Talk([device(poll_ms=0)], every=0)
    talk.run(10)
    talk.ask(ReadParameter("left", "Iq_Measured"), Reboot("left"), ClearFault("left"), Estop("left"))
    talk.run(700)
    talk.up()
    talk.run(210)
    talk.mute()
    talk.ask(ReadParameter("left", "Iq_Measured"), Zero("left"), WriteParameter("left", "Pos_Gain", 1.0))
    talk.run(650)
    talk.beat()
    talk.run(50)
    talk.ask(ClearFault("left"), Estop("left"))
    talk.run(650)
    talk.is_as_told("""
        0 > 3?Get_Version | 3?Get_Encoder_Estimates | 63?Address
        10 < Refused ReadParameter left its firmware is not known, or not what the robot file says
        10 < Refused Reboot left its firmware is not known, or not what the robot file says
        10 > 3:Estop
        100 > 3?Get_Version | 3?Get_Encoder_Estimates
        130 > 3:Estop
        200 > 3?Get_Version | 3?Get_Encoder_Estimates
        250 < State left offline nothing heard
        250 > 3:Estop | 3?Heartbeat
        300 > 3?Get_Version | 3?Get_Encoder_Estimates
        350 > 3?Heartbeat
        370 > 3:Estop
        400 > 3?Get_Version | 3?Get_Encoder_Estimates
        450 > 3?Heartbeat
        490 > 3:Estop
        500 > 3?Get_Version | 3?Get_Encoder_Estimates
        550 > 3?Heartbeat
        600 > 3?Get_Version | 3?Get_Encoder_Estimates
        610 < Refused ClearFault left no answer of the device
        610 < Refused Estop left no answer of the device
        610 > -
        650 > 3?Heartbeat
        700 > 3?Get_Version | 3?Get_Encoder_Estimates
        710 < Feedback position=0 velocity=0
        750 > 3?Heartbeat
        800 < State left initialising IDLE, asking for its firmware
        800 > 3?Get_Version | 3?Get_Bus_Voltage_Current
        801 > 3?Get_Encoder_Estimates
        900 < State left ready IDLE
        920 > 3?Get_Iq | 3:Set_Absolute_Position 0 | 3:Set_Pos_Gain 1
        930…1030/10 > 3?Get_Encoder_Estimates
        1040 > 3?Get_Iq | 3:Set_Absolute_Position 0 | 3:Set_Pos_Gain 1 | 3?Get_Encoder_Estimates
        1050…1140/10 > 3?Get_Encoder_Estimates
        1150 > 3?Get_Encoder_Estimates | 3?Heartbeat
        1160 < State left offline nothing heard
        1160 > 3?Get_Iq | 3:Set_Absolute_Position 0 | 3:Set_Pos_Gain 1 | 3?Get_Version
        1250 > 3?Get_Encoder_Estimates | 3?Heartbeat
        1260 > 3?Get_Version
        1280 > 3?Get_Iq | 3:Set_Absolute_Position 0 | 3:Set_Pos_Gain 1
        1350 > 3?Get_Encoder_Estimates | 3?Heartbeat
        1360 > 3?Get_Version
        1400 > 3?Get_Iq | 3:Set_Absolute_Position 0 | 3:Set_Pos_Gain 1
        1450 > 3?Get_Encoder_Estimates | 3?Heartbeat
        1460 > 3?Get_Version
        1520 < Refused ReadParameter left no answer of the device
        1520 < Refused Zero left no answer of the device
        1520 < Refused WriteParameter left no answer of the device
        1520 > -
        1550 > 3?Get_Encoder_Estimates | 3?Heartbeat
        1560 > 3?Get_Version
        1600 < State left initialising IDLE, asking for its firmware
        1600…1610/10 > 3?Get_Encoder_Estimates
        1620 > 3:Estop | 3?Get_Encoder_Estimates
        1630…1650/10 > 3?Get_Encoder_Estimates
        1660 > 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1670…1730/10 > 3?Get_Encoder_Estimates
        1740 > 3:Estop | 3?Get_Encoder_Estimates
        1750 > 3?Get_Encoder_Estimates
        1760 > 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1770…1850/10 > 3?Get_Encoder_Estimates
        1860 > 3:Estop | 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1870…1950/10 > 3?Get_Encoder_Estimates
        1960 > 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1970 > 3?Get_Encoder_Estimates
        1980 > 3:Estop | 3?Get_Encoder_Estimates
        1990…2050/10 > 3?Get_Encoder_Estimates
        2060 > 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2070…2090/10 > 3?Get_Encoder_Estimates
        2100 > 3:Estop | 3?Get_Encoder_Estimates
        2110…2150/10 > 3?Get_Encoder_Estimates
        2160 > 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2170…2250/10 > 3?Get_Encoder_Estimates
        2220 < Refused ClearFault left its firmware is not known
        2220 < Refused Estop left the device did not react
        2260 > 3?Get_Version | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        heard 31, bad 0, foreign 0
        """)


def test_vectors_of_too_many_requests() -> None:
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)], every=20)
    talk.up()
    talk.run(210)
    talk.ask(*(ReadParameter("left", "Electrical_Power") for _ in range(31)))
    talk.ask(Scan("can0"))
    talk.ask(ReadParameter("left", "Iq_Measured"), Scan("can1"), Idle("left"), Velocity("left", 0.0))
    talk.run(100)
    talk.bus(BusState.OFF)
    talk.run(10)
    talk.is_as_told("""
        0 < State left initialising IDLE, asking for its firmware
        0 < Feedback position=0 velocity=0
        0 > 3?Get_Version | 3?Get_Bus_Voltage_Current | 4?Get_Version | 4?Get_Encoder_Estimates | 63?Address
        1 > 3?Get_Encoder_Estimates
        100 < State left ready IDLE
        100 > 4?Get_Version | 4?Get_Encoder_Estimates
        200 > 4?Get_Version | 4?Get_Encoder_Estimates
        210 > 31 × 3?Get_Powers
        210 > 63?Address
        210 < Refused ReadParameter left too many requests are under way
        210 < Refused Scan can1 too many requests are under way
        210 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        250 < State right offline nothing heard
        250 > 4?Heartbeat
        300 > 4?Get_Version | 4?Get_Encoder_Estimates
        310 < Refused ReadParameter left the bus is off (× 31)
        310 < Refused Scan can0 the bus is off
        310 > 3?Get_Version | 3?Get_Encoder_Estimates | 63?Address
        heard 38, bad 0, foreign 0
        """)


def test_vectors_of_requests_to_the_axes_of_a_board() -> None:
    talk = standing05(4)
    talk.ask(SetId("can0", SERIAL, 5), Scan("can0"))
    talk.ask(WriteParameter("axis3", "save_configuration", 1.0))
    talk.ask(ClearFault("axis4"))
    talk.run(130)
    talk.place(0.01)
    talk.ask(Zero("axis3"))
    talk.run(20)
    talk.beat(8, node=4)
    talk.run(100)
    talk.ask(Reboot("axis3"), Reboot("axis4"))
    talk.beat(1, node=4)
    talk.run(100)
    talk.ask(Reboot("axis3"), Estop("axis4"), ReadParameter("axis3", "Axis_State"))
    talk.run(100)
    talk.beat(1, 0x800, node=4)
    talk.run(100)
    talk.mute()
    talk.run(500)
    talk.beat()
    talk.run(1300)
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
        300 < Refused SetId can0 firmware 0.5.x tells no serial numbers over CAN: set the node id with the
            vendor's tool
        300 < Refused WriteParameter axis3 firmware 0.5.x cannot do this over CAN: use the vendor's tool
        300 > 4:Clear_Errors
        300 < Done ClearFault axis4 and of every axis of its board
        430 > 3:Set_Linear_Count 0
        430 < Feedback position=0.0628319 velocity=0
        430 < Done Zero axis3
        500 < State axis4 armed CLOSED_LOOP_CONTROL
        550 < Refused Reboot axis3 it restarts its whole board, and axis4, which is armed, may be on it: say
            idle first
        550 < Refused Reboot axis4 it is armed, and would drop its load: say idle first
        600 < State axis4 ready IDLE
        650 > 3:Reboot | 4:0x02
        700 < Parameter axis3 Axis_State 1
        700 < Done ReadParameter axis3
        770 > 4:0x02
        800 < Fault axis4 1407374883555328 WATCHDOG_TIMER_EXPIRED no frame came for the axis within
            watchdog_timeout; it runs while the axis is idle too find out why the host fell silent, then
            clear; frames must come faster than the timeout
        800 < State axis4 fault IDLE
        860…880/10 > 3?Get_Encoder_Estimates
        890 > 4:0x02  | 3?Get_Encoder_Estimates
        900…1000/10 > 3?Get_Encoder_Estimates
        1010 > 4:0x02  | 3?Get_Encoder_Estimates
        1020…1080/10 > 3?Get_Encoder_Estimates
        1090 < State axis3 offline nothing heard
        1090 > 3?0x0 | 3?Heartbeat
        1130 > 4:0x02
        1180 > 3?Get_Encoder_Estimates
        1190 > 3?0x0 | 3?Heartbeat
        1250 < Refused Estop axis4 the device did not react
        1280 > 3?Get_Encoder_Estimates
        1290 > 3?0x0 | 3?Heartbeat
        1380 > 3?Get_Encoder_Estimates
        1390 > 3?0x0 | 3?Heartbeat
        1400 < State axis3 initialising IDLE, asking for its firmware
        1400 < Done Reboot axis3 it has restarted
        1400…1480/10 > 3?Get_Encoder_Estimates
        1490 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1500…1580/10 > 3?Get_Encoder_Estimates
        1590 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1600…1680/10 > 3?Get_Encoder_Estimates
        1690 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1700…1780/10 > 3?Get_Encoder_Estimates
        1790 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1800…1880/10 > 3?Get_Encoder_Estimates
        1890 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        1900…1980/10 > 3?Get_Encoder_Estimates
        1990 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2000…2080/10 > 3?Get_Encoder_Estimates
        2090 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2100 < Found odrive_can 3 None heard, but it did not answer discovery: firmware 0.5.x? False
        2100 < Found odrive_can 4 None axis4, firmware 0.5.x False
        2100 < Done Scan can0 2 devices
        2100…2180/10 > 3?Get_Encoder_Estimates
        2190 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2200…2280/10 > 3?Get_Encoder_Estimates
        2290 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2300…2380/10 > 3?Get_Encoder_Estimates
        2390 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2400…2480/10 > 3?Get_Encoder_Estimates
        2490 < Fault axis3 12884901888 firmware unknown it sends heartbeats but does not answer Get_Version,
            nor as 0.5.x would: do our frames arrive? look at cable and bit rate with a bus monitor, and for
            a second host
        2490 < State axis3 fault IDLE
        2490 > 3?0x0 | 3?Get_Encoder_Estimates | 3?Get_Bus_Voltage_Current
        2500…2640/10 > 3?Get_Encoder_Estimates
        heard 403, bad 0, foreign 0
        """)


def test_vectors_of_a_restart_beside_an_axis_that_we_drive() -> None:
    talk = standing05(4)
    talk.run(20, Velocity("axis4", 0.0))
    talk.ask(Reboot("axis3"))
    talk.run(180, Idle("axis4"))
    talk.ask(Reboot("axis3"))
    talk.run(20)
    talk.ask(Reboot("axis3"))
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
        300 > 4:Set_Controller_Mode 2 1 | 4:Set_Input_Vel 0 0 | 4:Set_Axis_State 8
        320 < Refused Reboot axis3 it restarts its whole board, and axis4, which is armed, may be on it: say
            idle first
        320 > 4:Set_Axis_State 1
        380 > 4:Set_Axis_State 1
        440 > 4:Set_Axis_State 1
        500 < Refused Reboot axis3 it restarts its whole board, and axis4, which is armed, may be on it: say
            idle first
        520 > 3:Reboot
        heard 120, bad 0, foreign 0
        """)
