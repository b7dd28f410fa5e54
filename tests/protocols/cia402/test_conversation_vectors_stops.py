"""Conversations of vectors: emergency stops, and quick stops of another host."""

from __future__ import annotations

import pytest

from protocols.messages import ClearFault, Estop, Hold, Idle, Stop
from tests.protocols.cia402.conversation import ARMED, Talk, armed, up
from tests.protocols.cia402.firmware import Drive


def test_vectors_of_an_emergency_stop_and_its_end() -> None:
    talk = armed(Talk())
    talk.chapter(
        100,
        Estop("m"),
        Hold("m"),
        expected="""
        0 < Fault 10004 quick stop
        < State fault OPERATION ENABLED, cyclic synchronous position
        rpdo1 6040=0002 6060=8 607A=4096 …
        < State fault QUICK STOP ACTIVE
        < Done Estop m *
        20..50 < State fault SWITCH ON DISABLED
        sync /10, beat ?
        """,
    )
    talk.chapter(100, Hold("m"), expected="sync /10, beat ?")
    talk.chapter(
        150,
        ClearFault("m"),
        Hold("m"),
        expected=f"""
        < State ready SWITCH ON DISABLED
        < Done ClearFault m
        {ARMED}
        sync /10, beat ?
        """,
    )


def test_vectors_of_an_emergency_stop_that_holds_is_left_without_dropping_the_load() -> None:
    drive = Drive()
    drive.put(0x605A, 6)
    talk = armed(Talk(drive))
    talk.chapter(100, Estop("m"), Hold("m"))
    assert drive.state == "QUICK STOP ACTIVE"
    drive.put(0x6064, 4000)
    talk.chapter(30, Hold("m"), expected="sync /10, beat ?")
    talk.chapter(
        150,
        ClearFault("m"),
        Hold("m"),
        expected="""
        < State ready QUICK STOP ACTIVE
        < Done ClearFault m
        rpdo1 6040=0002 6060=8 607A=4000 …
        rpdo1 6040=000F 6060=8 607A=4000 /10
        < State armed OPERATION ENABLED, cyclic synchronous position
        sync /10, beat ?
        """,
    )


def test_vectors_of_an_emergency_stop_by_sdo_repeated_until_it_is_obeyed() -> None:
    talk = armed(Talk(feedback="sdo", mapping="keep", watchdog_ms=0))
    talk.drive.deaf = True
    talk.chapter(
        200,
        Estop("m"),
        Hold("m"),
        expected="""
        0 < Fault 10004 quick stop
        0 < State fault *
        write 6040 = 0002 /50
        """,
    )
    talk.drive.deaf = False
    talk.chapter(
        100,
        Hold("m"),
        expected="""
        write 6040 = 0002
        < State fault QUICK STOP ACTIVE
        < Done Estop m *
        < State fault SWITCH ON DISABLED
        """,
    )


@pytest.mark.parametrize("holds", [True, False])
def test_vectors_of_a_quick_stop_of_another_host(holds: bool) -> None:
    drive = Drive()
    drive.put(0x605A, 6 if holds else 2)
    drive.stand("QUICK STOP ACTIVE", 8)
    drive.since = 10**9  # it still slows down
    talk = Talk(drive, watchdog_ms=0)
    talk.chapter(100, Idle("m"), expected="< State initialising *\n< State ready QUICK STOP ACTIVE")
    before = len(talk.frames)
    talk.chapter(200, Hold("m"))
    words = [w.data[0] for _, w in talk.frames[before:] if w.id == 0x202]
    order = list(dict.fromkeys(words))
    assert order == ([0x02, 0x0F] if holds else [0x00, 0x06, 0x07, 0x0F])
    assert drive.state == "OPERATION ENABLED"


def test_vectors_of_a_stop_reaches_a_drive_in_a_quick_stop_too() -> None:
    drive = Drive()
    drive.put(0x605A, 6)
    drive.stand("QUICK STOP ACTIVE", 8)
    talk = up(Talk(drive))
    talk.chapter(
        700,
        Stop(),
        Idle("m"),  # 06 does not lead out of a quick stop, 00 does
        expected="""
        0..10 write 6040 = 0006 /50 until 450..500
        500..510 write 6040 = 0000 …
        < State ready SWITCH ON DISABLED
        """,
    )


def test_vectors_of_an_emergency_stop_of_a_drive_that_another_host_runs() -> None:
    drive = Drive()
    drive.stand("OPERATION ENABLED", 9)
    talk = up(Talk(drive))
    talk.chapter(
        100,
        Estop("m"),
        expected="""
        0 < Fault 10004 quick stop
        0 < State fault OPERATION ENABLED*
        write 6040 = 0002
        < State fault QUICK STOP ACTIVE
        < Done Estop m *
        < State fault SWITCH ON DISABLED
        """,
    )
    talk.chapter(100, Hold("m"), expected="")
    talk.chapter(100, ClearFault("m"), expected="< State ready SWITCH ON DISABLED\n< Done ClearFault m")
