"""Conversations of vectors: restarts, offline drives, NMT of another host, a brain that stops commanding."""

from __future__ import annotations

from itertools import pairwise

from protocols.messages import Hold, Idle
from tests.protocols.cia402.conversation import CONFIGURED, Talk, armed, arming, up
from tests.protocols.cia402.firmware import Drive


def test_vectors_of_a_restart_read_anew_and_armed_by_a_fresh_sequence() -> None:
    talk = armed(Talk())
    talk.drive.restart()
    talk.drive.put(0x6064, 5000)
    talk.chapter(
        350,
        Hold("m"),
        expected=f"""
        0 < State initialising restarted
        < State initialising SWITCH ON DISABLED*
        < State ready SWITCH ON DISABLED
        {CONFIGURED}
        nmt OPERATIONAL 2
        {arming(5000)}
        sync ?, beat ?
        """,
    )


def test_vectors_of_a_drive_that_goes_offline_and_comes_back() -> None:
    talk = armed(Talk(offline_ms=300))
    talk.drive.dead = True
    talk.chapter(
        1000,
        Hold("m"),
        expected="""
        280..310 < State offline no frames received
        still rpdo1 6040=000F 6060=8 607A=4096 /10 until 280..310
        sync ?, beat ?
        """,
    )
    talk.chapter(500, Hold("m"), expected="reads 1000")
    talk.drive.dead = False
    talk.chapter(
        400,
        Idle("m"),
        expected="""
        0 write 6040 = 0006 …
        < State initialising READY TO SWITCH ON*
        < State ready READY TO SWITCH ON
        """,
    )


def test_vectors_of_a_drive_that_never_answers() -> None:
    drive = Drive()
    drive.dead = True
    talk = Talk(drive, sdo_timeout_ms=50)
    talk.chapter(400, Hold("m"), expected="reads 1000")
    talk.chapter(700, Hold("m"), expected="95..110 < State offline no frames received\nreads 1000")
    times = [at for at, _ in talk.frames]
    assert {b - a for a, b in pairwise(times)} == {50}


def test_vectors_of_an_nmt_state_that_another_host_changes() -> None:
    talk = armed(Talk())
    for command in (2, 0x80):  # stop; enter pre-operational: both end its PDOs
        talk.drive.nmt(command)
        talk.chapter(
            250,
            Hold("m"),
            expected="""
            0..110 nmt OPERATIONAL 2
            still rpdo1 6040=000F 6060=8 607A=4096 …
            sync /10, beat 127 OPERATIONAL …
            """,
        )


def test_vectors_of_a_start_that_is_not_obeyed() -> None:
    talk = up(Talk(feedback="sdo", watchdog_ms=0))
    talk.drive.starts = 4
    talk.chapter(400, Hold("m"))
    starts = [at for at, frame in talk.frames if frame.id == 0]
    assert [b - a for a, b in pairwise(starts)] == [100, 100, 100]
    assert talk.drive.state == "SWITCH ON DISABLED"


def test_vectors_of_disarming_where_the_position_is_zero() -> None:
    drive = Drive()
    drive.put(0x6064, 0)
    talk = armed(Talk(drive))
    talk.chapter(
        30,
        Idle("m"),
        expected="""
        rpdo1 6040=0006 6060=8 607A=0
        < State ready READY TO SWITCH ON
        write 1016:01 = 00000000
        sync ?, beat ?
        """,
    )


def test_vectors_of_a_drive_that_another_host_disarms_and_that_is_armed_at_its_new_position() -> None:
    talk = armed(Talk())
    talk.drive.stand("SWITCH ON DISABLED", 8)
    talk.drive.put(0x6064, 5000)
    talk.chapter(
        150,
        Hold("m"),
        expected=f"""
        < State ready SWITCH ON DISABLED
        {arming(5000)}
        still rpdo2 60FF=0 6071=0 60B2=0 …
        sync /10, beat ?
        """,
    )


def test_vectors_of_a_brain_that_stops_commanding() -> None:
    talk = armed(Talk())
    talk.chapter(
        300, expected="sync ?"
    )  # neither set-points nor heartbeat: the drive's own watchdog is to trip
    talk.chapter(
        150,
        Hold("m"),
        expected="""
        still rpdo1 6040=000F 6060=8 607A=4096 …
        sync /10, beat 127 OPERATIONAL …
        """,
    )
