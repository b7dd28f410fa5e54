"""Conversations of vectors with a host that calls the driver only when it is due."""

from __future__ import annotations

from protocols.messages import ClearFault, Estop, Hold, Idle, ReadParameter, Reboot, Scan, Velocity
from tests.protocols.cia402.conversation import lazy, up
from tests.protocols.cia402.firmware import Drive


def test_vectors_of_coming_up_and_going_offline_when_due() -> None:
    talk = lazy()
    talk.chapter(
        300,
        expected="""
        < State initialising SWITCH ON DISABLED*
        40..60 < State ready SWITCH ON DISABLED
        asks 6041 6061 6064 606C 6077 6078 6079
        measures position=1.5708 velocity=0 torque=0 current=0 voltage=48
        """,
    )
    talk.drive.put(0x6064, 0)
    talk.chapter(25, expected="measures position=0")
    talk.chapter(1000, expected="reads 1018:04")
    talk.drive.dead = True
    talk.chapter(700, expected="480..505 < State offline no frames received")
    talk.drive.dead = False
    talk.chapter(
        300, expected="< State initialising *\n< State initialising *\n< State ready SWITCH ON DISABLED"
    )


def test_vectors_of_a_drive_that_does_not_disarm_when_due() -> None:
    talk = up(lazy(feedback="sdo", mapping="keep", watchdog_ms=0))
    talk.chapter(300, Velocity("m", 1.0))
    assert talk.drive.state == "OPERATION ENABLED"
    talk.drive.deaf = True
    talk.chapter(
        700,
        Idle("m"),
        expected="""
        write 6040 = 0006 /50 until 440..460
        500..505 write 6040 = 0000 /50
        """,
    )


def test_vectors_of_a_drive_that_does_not_arm_when_due() -> None:
    drive = Drive()
    drive.deaf = True
    talk = up(lazy(drive, state_timeout_ms=200, feedback="sdo", mapping="keep", watchdog_ms=0))
    talk.chapter(
        300,
        Hold("m"),
        expected="""
        nmt OPERATIONAL 2
        write 607A = 4096 …
        write 6060 = 8
        write 6040 = 0006
        200..230 < Fault 10001 operation not enabled
        """,
    )


def test_vectors_of_requests_when_due() -> None:
    talk = up(lazy())
    talk.chapter(20, ReadParameter("m", "6502"), expected="< Parameter 6502 941")
    talk.chapter(900, Scan("can0"))
    (done,) = [run for run in talk.runs() if run.text.startswith("< Done Scan")]
    assert 400 <= done.times[0] <= 600
    talk.drive.trip(0x2310)
    talk.drive.resets = 2
    talk.chapter(50)
    talk.chapter(700, ClearFault("m"))
    (done,) = [run for run in talk.runs() if run.text.startswith("< Done ClearFault")]
    assert 500 <= done.times[0] <= 530, "the second reset"
    reported = "0 < Fault 10004 *\n0 < State fault *\nwrite 6040 = 0002\n< Done Estop m *"
    talk.chapter(200, Estop("m"), expected=reported)  # it gives no torque
    talk.drive.dead = True
    talk.chapter(2500, ReadParameter("m", "6502"))
    (refused,) = [run for run in talk.runs() if run.text.startswith("< Refused ReadParameter")]
    assert refused.times[0] <= 2005


def test_vectors_of_a_reboot_that_is_not_seen_when_due() -> None:
    talk = up(lazy())
    talk.drive.starts = 99
    talk.chapter(
        8100,
        Reboot("m"),
        expected="""
        0 nmt RESET 2 /2000 until 6000..8000
        8000..8001 < Refused Reboot m no boot-up message after the reset
        """,
    )
