"""Conversations of vectors: requests that are carried out, refused, asked too often, and never answered.

What vouches: the devices' bytes are cantools' with the DBCs 0.6.10 and 0.5.6; what is expected is derived
by hand from the README ("Two firmware lines", "What it does": who is refused what, and after which
silence) and the docstrings of `requests`. how often an unanswered frame is sent again is our own choice.
See `talk`.
"""

from __future__ import annotations

from protocols import messages as msg
from protocols.frames import BusState
from tests.protocols.odrive_can.conversation import DISCOVERED, SERIAL, device
from tests.protocols.odrive_can.talk import Talk, standing


def test_vectors_of_a_zero() -> None:
    talk = standing()
    talk.place(0.06)
    talk.ask(msg.Zero("left"))
    talk.run(150)
    talk.place(-0.04)
    talk.run(20)
    talk.reports("""
        0 > 3:Set_Absolute_Position 0
        0 < left position 0.376991, velocity 0
        100-150 > 3:Set_Absolute_Position 0
        150 < left position -0.251327, velocity 0
        150 < Done Zero left:*
    """)


def test_vectors_of_a_zero_of_a_shaft_that_is_elsewhere() -> None:
    talk = standing()
    talk.place(2.0)
    talk.ask(msg.Zero("left"))
    talk.run(650)
    talk.reports("""
        0 > 3:Set_Absolute_Position 0
        0 < left position 12.5664, velocity 0
        100-150…480-599/100-150 > 3:Set_Absolute_Position 0
        600 < Refused Zero left: its position did not become zero: *
    """)


def test_vectors_of_an_estop_and_a_clearing() -> None:
    talk = standing()
    talk.ask(msg.Estop("left"))
    talk.beat(1, 0x100)
    talk.run(100)
    talk.beat(1, 0x2000100, Procedure_Result=3)
    talk.run(100)
    # Another fault is no answer.
    talk.reports("""
        0 > 3:Estop
        0 < Fault left 0x100 DC_BUS_OVER_VOLTAGE: *
        0 < State left fault: IDLE
        100 < Fault left 0x2000000 ESTOP_REQUESTED: *
        100 < State left fault: IDLE, DISARMED
        100 < Done Estop left: it stays in fault until cleared
    """)
    talk.ask(msg.ClearFault("left"))
    talk.run(150)
    talk.beat()
    talk.run(100)
    talk.reports("""
        0…120/100-150 > 3:Clear_Errors 0
        150 < State left ready: IDLE
        150 < Done ClearFault left:*
    """)
    talk.beat(1, 0x2000000)
    talk.run(100)
    talk.reports("""
        0 < Fault left 0x2000000 ESTOP_REQUESTED: *
        0 < State left fault: IDLE
    """)
    talk.ask(msg.ClearFault("left"))
    talk.run(710)
    # What stays is told again, with all its words.
    talk.reports("""
        0…480-599/100-150 > 3:Clear_Errors 0
        600 < Refused ClearFault left: still in fault: ESTOP_REQUESTED
        600-700 < Fault left 0x2000000 ESTOP_REQUESTED: *
    """)


def test_vectors_of_requests_that_are_not_supported() -> None:
    talk = standing()
    talk.ask(msg.Home("left"), msg.Release(), msg.Set("gains.left", 1.0), msg.Zero("nobody"))
    talk.reports("""
        0 < Refused Home left: *
        0 < Refused Release : *
        0 < Refused Set : *
        0 < Refused Zero nobody: *no such motor
    """)


def test_vectors_of_a_restart_that_is_seen() -> None:
    talk = standing()
    talk.ask(msg.Reboot("left"))
    talk.run(2100)
    talk.mute()
    talk.run(900)
    talk.up()
    talk.beat(1, 1)
    talk.run(300)
    # INITIALIZING: restarted, and not up yet.
    talk.reports("""
        0…2000/2000 > 3:Reboot 0
        2340-2350 < State left offline: no frames received
        3000 < State left initialising: IDLE, identifying its firmware
        3100-3200 < State left initialising: IDLE
    """)
    talk.beat(1, 0)
    talk.run(200)
    talk.reports("""
        0 < State left ready: IDLE
        0 < Done Reboot left: it has restarted
    """)


def test_vectors_of_a_saving_and_the_pause_that_shows_it() -> None:
    talk = standing()
    talk.ask(msg.WriteParameter("left", "save_configuration", 1.0))
    talk.cycle(0, "Heartbeat")
    talk.run(390)
    talk.beat()
    talk.run(100)
    talk.cycle(0, "Heartbeat")
    talk.run(310)
    talk.beat()
    talk.run(50)
    # 390 ms may be two heartbeats lost and a late one; 410 are a pause.
    talk.reports("""
        0 > 3:Reboot 1
        800 < Done WriteParameter left: it has restarted
    """)


def test_vectors_of_a_restart_that_is_not_seen() -> None:
    talk = standing()
    talk.ask(msg.Reboot("left"))
    talk.run(8100)
    talk.reports("""
        0…6000/2000 > 3:Reboot 0
        8000 < Refused Reboot left: it showed no sign of a restart
    """)


def test_vectors_of_requests_to_a_device_that_runs() -> None:
    talk = standing()
    talk.beat(8)
    talk.run(50)
    talk.reports("0 < State left armed: CLOSED_LOOP_CONTROL")
    talk.ask(msg.Zero("left"), msg.Reboot("left"), msg.WriteParameter("left", "save_configuration", 1.0))
    talk.ask(msg.SetId("can0", SERIAL, 3))
    talk.handle(DISCOVERED)
    talk.ask(msg.SetId("can0", SERIAL, 5))
    talk.reports("""
        0 < Refused Zero left: it is armed*
        0 < Refused Reboot left: it is armed*
        0 < Refused WriteParameter left: it is armed*
        0 < Refused SetId can0: left is armed* (× 2)
    """)
    talk.ask(msg.WriteParameter("left", "Pos_Gain", 1.0))
    talk.run(100)
    talk.reports("""
        0 > 3:Set_Pos_Gain 1
        50 < Done WriteParameter left: sent; the device does not confirm it
    """)


def test_vectors_of_requests_to_a_device_that_arms() -> None:
    talk = standing()
    talk.run(10, msg.Velocity("left", 0.0))
    talk.stage()
    talk.ask(msg.Zero("left"), msg.Reboot("left"), msg.WriteParameter("left", "save_configuration", 1.0))
    talk.reports("""
        0 < Refused Zero left: it is armed*
        0 < Refused Reboot left: it is armed*
        0 < Refused WriteParameter left: it is armed*
    """)


def test_vectors_of_requests_without_a_reply() -> None:
    talk = Talk([device(poll_ms=0)])
    talk.run(10)
    talk.stage()
    talk.ask(
        msg.ReadParameter("left", "Iq_Measured"),
        msg.Reboot("left"),
        msg.ClearFault("left"),
        msg.Estop("left"),
    )
    talk.run(700)
    # An emergency stop does not wait for the firmware to be known; all lines have the same.
    talk.reports("""
        0 < Refused ReadParameter left: its firmware is not known, or not the one in the robot file
        0 < Refused Reboot left: its firmware is not known, or not the one in the robot file
        0…120/100-150 > 3:Estop
        240 < State left offline: no frames received
        240…480-599/100-150 > 3:Estop
        600 < Refused ClearFault left: no reply from the device
        600 < Refused Estop left: no reply from the device
    """)
    talk.beat()
    talk.run(50)
    talk.ask(msg.ClearFault("left"), msg.Estop("left"))
    talk.run(650)
    # Its firmware is not known: clearing has another length in each line, and does not go out.
    talk.reports("""
        0 < State left initialising: IDLE, identifying its firmware
        50…530-649/100-150 > 3:Estop
        650 < Refused ClearFault left: its firmware is not known
        650 < Refused Estop left: the device did not react
    """)


def test_vectors_of_requests_to_one_that_falls_silent() -> None:
    talk = standing()
    talk.mute()
    talk.ask(
        msg.ReadParameter("left", "Electrical_Power"),
        msg.Zero("left"),
        msg.WriteParameter("left", "Pos_Gain", 1.0),
    )
    talk.run(650)
    talk.reports("""
        0…120/100-150 > 3?Get_Powers | 3:Set_Absolute_Position 0 | 3:Set_Pos_Gain 1
        240 < State left offline: no frames received
        240…480-599/100-150 > 3?Get_Powers | 3:Set_Absolute_Position 0 | 3:Set_Pos_Gain 1
        600 < Refused ReadParameter left: no reply from the device
        600 < Refused Zero left: no reply from the device
        600 < Refused WriteParameter left: no reply from the device
    """)


def test_vectors_of_too_many_requests() -> None:
    talk = standing()
    talk.ask(*(msg.ReadParameter("left", "Electrical_Power") for _ in range(31)), msg.Scan("can0"))
    talk.ask(msg.ReadParameter("left", "Iq_Measured"), msg.Scan("can1"), msg.Velocity("left", 0.0))
    talk.bus(BusState.OFF)
    talk.mute()
    talk.run(10)
    talk.reports("""
        0 > 31 × 3?Get_Powers
        0 < Refused ReadParameter left: too many requests are under way
        0 < Refused Scan can1: too many requests are under way
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        0 < Refused ReadParameter left: the bus is off (× 31)
        0 < Refused Scan can0: the bus is off
    """)


def test_vectors_of_a_restart_beside_a_device_of_0_6_that_runs() -> None:
    """It reaches the one device."""
    talk = Talk([device(poll_ms=0), device("right", 4, poll_ms=0)])
    talk.up()
    talk.up(4, state=8)
    talk.run(200)
    talk.stage()
    talk.ask(msg.Reboot("left"))
    talk.reports("0 > 3:Reboot 0")
