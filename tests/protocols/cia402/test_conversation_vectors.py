"""Conversations of vectors: a drive boots, is read, configured, armed, commanded in each mode, and disarmed.

The drive counts 16384 increments a turn (608F), has no gear (6091) and no feed (6092), and 1 N·m (6076):
an increment is τ/16384 rad, a per mille of torque 1 mN·m. It stands at 4096: a quarter turn, 1.5708 rad.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from protocols.messages import ClearFault, Fault, Hold, Idle, Position, Stop, Torque, Velocity
from tests.protocols.cia402.conversation import CONFIGURED, READS, STARTED, Talk, armed, arming, lazy, up
from tests.protocols.cia402.firmware import Drive


def test_vectors_of_a_drive_that_comes_up_and_is_only_polled() -> None:
    talk = Talk()
    talk.chapter(
        100,
        expected=f"""
        < State initialising SWITCH ON DISABLED*
        40..60 < State ready SWITCH ON DISABLED
        {READS} 1400:01 1401:01 1402:01 1403:01 1800:01 1801:01 1802:01 1803:01
        asks 6041 6061 6064 606C 6077 6078 6079
        measures position=1.5708 velocity=0 torque=0 current=0 voltage=48
        """,
    )
    talk.drive.put(0x6064, -8192)  # half a turn back: -π
    talk.drive.put(0x606C, 16384)  # a turn a second: τ
    talk.drive.put(0x6077, -250)  # ‰ of 1 N·m
    talk.drive.put(0x6078, 300)  # ‰ of 5 A (6075)
    talk.drive.put(0x6079, 23_500)  # mV
    talk.chapter(
        250,
        Idle("m"),  # what no host armed is not told to disarm
        expected="""
        asks 6041 6061 6064 606C 6077 6078 6079
        measures position=-3.1416 velocity=6.2832 torque=-0.25 current=1.5 voltage=23.5
        """,
    )


@pytest.mark.parametrize("made", [Talk, lazy])
def test_vectors_of_the_first_command_configure_start_and_arm_where_the_shaft_stands(
    made: Callable[[], Talk],
) -> None:
    talk = up(made())
    talk.chapter(
        300,
        Hold("m"),
        expected=f"""
        {CONFIGURED}
        {STARTED}
        {arming(last="/10")}
        sync /10, beat 127 OPERATIONAL /125..130
        measures position=1.5708 velocity=0 torque=0 current=0 voltage=48
        """,
    )
    assert [talk.drive.get(0x1600), talk.drive.get(0x1A00, 3)] == [3, 0x60640020]
    talk.chapter(
        100,
        Idle("m"),
        expected="""
        0 rpdo1 6040=0006 6060=8 607A=4096
        < State ready READY TO SWITCH ON
        write 1016:01 = 00000000
        sync ?, beat ?
        """,
    )


def test_vectors_of_each_cyclic_mode_and_of_disarming() -> None:
    talk = armed(Talk())
    talk.chapter(
        100,
        # -0.5·16384/τ = -1303.8; 0.25·16384/τ = 651.9; 0.125 N·m = 125 ‰
        Position("m", -0.5, 0.25, 0.125),
        expected="""
        rpdo2 60FF=0 6071=0 60B2=125 …
        rpdo3 60B1=652 …
        rpdo1 6040=000F 6060=8 607A=-1304 /10
        sync /10, beat ?
        """,
    )
    talk.chapter(
        100,
        Velocity("m", -1.5, -0.06),  # -1.5·16384/τ = -3911.4
        expected="""
        rpdo2 60FF=-3911 6071=0 60B2=-60 /10
        rpdo3 60B1=0 …
        rpdo1 6040=000F 6060=9 607A=* …
        < State armed OPERATION ENABLED, cyclic synchronous velocity
        sync /10, beat ?
        """,
    )
    talk.chapter(
        100,
        Torque("m", 0.25),
        expected="""
        rpdo2 60FF=0 6071=250 60B2=0 /10
        rpdo1 6040=000F 6060=10 607A=* …
        < State armed OPERATION ENABLED, cyclic synchronous torque
        still rpdo3 60B1=0 …
        sync /10, beat ?
        """,
    )
    talk.drive.put(0x6064, 5000)  # it has turned meanwhile, and is to stay there
    talk.chapter(10, Torque("m", 0.25))
    talk.chapter(
        100,
        Hold("m"),
        expected="""
        rpdo2 60FF=0 6071=0 60B2=0 …
        rpdo1 6040=000F 6060=8 607A=5000 /10
        < State armed OPERATION ENABLED, cyclic synchronous position
        sync /10, beat ?
        """,
    )
    talk.drive.put(0x6064, 5100)  # pushed away: it holds where it was told to
    talk.chapter(
        100,
        Hold("m"),
        expected="""
        still rpdo1 6040=000F 6060=8 607A=5000 /10
        sync /10, beat ?
        measures position=1.9558 velocity=0 torque=0
        """,
    )
    talk.chapter(  # with each SYNC, every 10 ms, comes a statusword: two must say so
        200,
        Idle("m"),
        expected="""
        0 rpdo1 6040=0006 6060=8 607A=5100
        < State ready READY TO SWITCH ON
        15..27 write 1016:01 = 00000000
        sync /10 until 10..50, beat ?
        """,
    )
    talk.chapter(400, Idle("m"), expected="asks 6041 6061 6064 606C 6077 6078 6079")
    assert talk.drive.state == "READY TO SWITCH ON"


def test_vectors_of_arming_by_the_state_that_is_shown() -> None:
    for state, rest in (
        ("SWITCH ON DISABLED", ["0006", "0007", "000F"]),
        ("READY TO SWITCH ON", ["0007", "000F"]),
        ("SWITCHED ON", ["0007", "000F"]),  # 07 does nothing there, till mode and set-point stand
    ):
        drive = Drive()
        drive.stand(state, 1)  # in another mode till now
        talk = up(Talk(drive))
        before = len(talk.frames)
        talk.chapter(300, Hold("m"))
        said = [frame.data for _, frame in talk.frames[before:] if frame.id == 0x202]
        assert [word for word in rest if bytes.fromhex(word)[::-1] in [data[:2] for data in said]] == rest
        assert {data[:2] for data in said} == {bytes.fromhex(word)[::-1] for word in rest}, state
        assert {data[2:] for data in said} == {b"\x08\x00\x10\x00\x00"}  # CSP, 4096: nothing else, ever
        assert drive.state == "OPERATION ENABLED"


def test_vectors_of_a_mode_that_is_shown_late_no_enable_before_it() -> None:
    drive = Drive()
    talk = up(Talk(drive))
    drive.modes_late = True
    talk.chapter(250, Velocity("m", 1.0))
    talk.chapter(
        150,
        Velocity("m", 1.0),
        expected="""
        still rpdo1 6040=0007 6060=9 607A=4096 /100
        still rpdo2 60FF=0 6071=0 60B2=0 /10
        still rpdo3 60B1=0 /100
        sync /10, beat ?
        """,
    )
    drive.modes_late = False
    talk.chapter(
        150,
        Velocity("m", 1.0),  # 16384/τ = 2607.6
        expected="""
        rpdo1 6040=000F 6060=9 607A=4096 …
        < State armed OPERATION ENABLED, cyclic synchronous velocity
        rpdo2 60FF=2608 6071=0 60B2=0 /10
        sync /10, beat ?
        """,
    )


def test_vectors_of_a_running_drive_that_is_taken_over_and_one_that_is_stopped() -> None:
    drive = Drive()
    drive.map(0x1400, 0x202, 255, 0x60400010, 0x60600008, 0x607A0020)
    drive.map(0x1401, 0x302, 255, 0x60FF0020, 0x60710010)
    drive.map(0x1800, 0x40000182, 255, 0x60410010, 0x60610008, 0x60640020, timer=10)
    drive.stand("OPERATION ENABLED", 8)
    drive.nmt(1)
    talk = Talk(drive, feedback="event")
    talk.chapter(
        200,
        Idle("m"),
        expected="""
        < State initialising OPERATION ENABLED, *
        < State initialising OPERATION ENABLED, cyclic synchronous position, *
        < State armed OPERATION ENABLED, cyclic synchronous position
        """,
    )
    talk.chapter(
        100,
        Hold("m"),  # no NMT, no mapping, no 06 or 07: it goes on in its mode
        expected="""
        write 1016:01 = 007F01F4
        rpdo2 60FF=0 6071=0 …
        rpdo1 6040=000F 6060=8 607A=4096 …
        beat 127 OPERATIONAL …
        """,
    )
    again = Drive()
    again.stand("OPERATION ENABLED", 9)
    talk = up(Talk(again))
    talk.chapter(
        100,
        Stop(),  # an operator's stop reaches what another host has armed
        Idle("m"),
        expected="""
        0..10 write 6040 = 0006 …
        < State ready READY TO SWITCH ON
        """,
    )


def test_vectors_of_a_drive_that_does_not_disarm() -> None:
    talk = armed(Talk())
    talk.drive.deaf = True
    talk.chapter(
        800,
        Idle("m"),
        expected="""
        0 rpdo1 6040=0006 6060=8 607A=4096 /50 until 450..500
        50 write 6040 = 0006 /50 until 450..500
        500 rpdo1 6040=0000 6060=8 607A=4096 /50
        500 write 6040 = 0000 /50
        sync /10, beat ?
        """,
    )
    talk.drive.deaf = False
    talk.chapter(
        200,
        Idle("m"),
        expected="""
        write 6040 = 0000 …
        < State ready SWITCH ON DISABLED
        write 1016:01 = 00000000
        sync ?, beat ?
        """,
    )


def test_vectors_of_a_drive_that_does_not_arm() -> None:
    drive = Drive()
    drive.deaf = True
    talk = up(Talk(drive, state_timeout_ms=150))
    talk.chapter(100, Hold("m"))
    talk.chapter(
        300,
        Hold("m"),
        expected="""
        still rpdo1 6040=0006 6060=8 607A=4096 /10 until 80..160
        80..170 < Fault 10001 operation not enabled
        sync ?, beat ?
        """,
    )
    (fault,) = [event for event in talk.events if isinstance(event, Fault)]
    assert "SWITCH ON DISABLED" in fault.cause
    assert "no mode" in fault.cause
    drive.deaf = False
    talk.chapter(  # it obeys what it was told last; nothing is tried by itself
        200,
        Hold("m"),
        expected="""
        < State ready READY TO SWITCH ON
        sync ?, beat ?
        """,
    )
    talk.chapter(
        200,
        ClearFault("m"),
        Hold("m"),
        expected="""
        < Done ClearFault m
        rpdo1 6040=0007 6060=8 607A=4096 …
        < State ready SWITCHED ON
        rpdo1 6040=000F 6060=8 607A=4096 /10
        < State armed OPERATION ENABLED, cyclic synchronous position
        sync ?, beat ?
        """,
    )


def test_vectors_of_disarming_a_drive_that_receives_no_pdos() -> None:
    talk = armed(Talk())
    talk.drive.nmt(0x80)  # another host sends pre-operational, and its heartbeat tells
    talk.chapter(110)
    talk.chapter(
        100,
        Idle("m"),
        expected="""
        0 write 6040 = 0006
        < State ready READY TO SWITCH ON
        write 1016:01 = 00000000
        sync ?, beat ?
        """,
    )
