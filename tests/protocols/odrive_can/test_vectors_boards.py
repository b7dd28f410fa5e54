"""Conversations of vectors: requests to axes of 0.5.x, and what reaches a whole board.

What vouches: the devices' bytes are cantools' with the DBC 0.5.6; what is expected is derived by hand
from the README ("Two firmware lines") and the docstrings of `requests`. See `talk`.
"""

from __future__ import annotations

from protocols import messages as msg
from tests.protocols.odrive_can.conversation import SERIAL
from tests.protocols.odrive_can.talk import standing05


def test_vectors_of_what_0_5_cannot_do_over_can() -> None:
    talk = standing05()
    talk.ask(msg.SetId("can0", SERIAL, 5), msg.WriteParameter("axis3", "save_configuration", 1.0))
    talk.reports("""
        0 < Refused SetId can0: firmware 0.5.x reports no serial numbers over CAN*
        0 < Refused WriteParameter axis3: firmware 0.5.x cannot do this over CAN*
    """)


def test_vectors_of_clearing_and_zeroing_an_axis_of_0_5() -> None:
    talk = standing05(4)
    talk.beat(1, 0x800)
    talk.run(100)
    talk.ask(msg.ClearFault("axis4"))
    talk.run(10)
    talk.beat()
    talk.ask(msg.Zero("axis3"))
    talk.run(10)
    # A clearing reaches the whole board, and says so.
    talk.reports("""
        0 < Fault axis3 0x5000000000800 WATCHDOG_TIMER_EXPIRED: *
        0 < State axis3 fault: IDLE
        100 > 4:Clear_Errors
        100 < Done ClearFault axis4: and every axis of its board
        110 > 3:Set_Linear_Count 0
        110 < State axis3 ready: IDLE
        110 < Done Zero axis3:*
    """)


def test_vectors_of_a_restart_beside_an_axis_that_another_host_drives() -> None:
    talk = standing05(4)
    talk.beat(8, node=4)
    talk.run(50)
    talk.ask(msg.Reboot("axis3"), msg.Reboot("axis4"))
    talk.beat(node=4)
    talk.run(50)
    talk.reports("""
        0 < State axis4 armed: CLOSED_LOOP_CONTROL
        50 < Refused Reboot axis3: *axis4, which is armed*
        50 < Refused Reboot axis4: it is armed*
        50 < State axis4 ready: IDLE
    """)
    talk.ask(msg.Reboot("axis3"))
    talk.mute(3)
    talk.mute(4)
    talk.run(500)
    talk.up05(3)
    talk.up05(4)
    talk.run(300)
    # 0.5.x restarts without a word: its silence shows it. Done when it can be asked for something again.
    talk.reports("""
        0 > 3:Reboot
        240 < State axis3 offline: no frames received
        240 < State axis4 offline: no frames received
        500 < State axis3 initialising: IDLE, identifying its firmware
        500 < State axis4 initialising: IDLE, identifying its firmware
        600-800 < State axis3 ready: IDLE
        600-800 < Done Reboot axis3: it has restarted, and every axis of its board
        600-800 < State axis4 ready: IDLE
    """)


def test_vectors_of_a_restart_beside_an_axis_that_we_drive() -> None:
    talk = standing05(4)
    talk.run(20, msg.Velocity("axis4", 0.0))
    talk.ask(msg.Reboot("axis3"))
    talk.reports("""
        0 > 4:Set_Controller_Mode 2 1 | 4:Set_Input_Vel 0 0 | 4:Set_Axis_State 8
        10 > 4:Set_Input_Vel 0 0
        20 < Refused Reboot axis3: *axis4, which is armed*
    """)
    talk.run(200, msg.Idle("axis4"))
    talk.ask(msg.Reboot("axis3"))
    # Heartbeats at 80 and 180 say that it is idle.
    talk.reports("""
        0…150/50 > 4:Set_Axis_State 1
        200 > 3:Reboot
    """)


def test_vectors_of_an_estop_and_a_parameter_of_0_5() -> None:
    talk = standing05()
    talk.ask(msg.Estop("axis3"), msg.ReadParameter("axis3", "Axis_State"))
    talk.beat(1, 0x1000)
    talk.run(100)
    talk.beat(1, 0x5000)
    talk.run(100)
    # Estop is not in the DBC of 0.5.x. A heartbeat cannot be asked for there, and comes by itself.
    talk.reports("""
        0 > 3:0x02
        0 < Fault axis3 0x5000000001000 MIN_ENDSTOP_PRESSED: *
        0 < State axis3 fault: IDLE
        0 < Parameter axis3 Axis_State 1
        100 < Fault axis3 0x5000000004000 ESTOP_REQUESTED: *
        100 < Done Estop axis3: it stays in fault until cleared
    """)
    assert "3?Heartbeat" not in talk.requests
