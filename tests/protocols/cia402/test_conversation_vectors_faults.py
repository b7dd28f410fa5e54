"""Conversations of vectors: faults, how they are reported, and how they end."""

from __future__ import annotations

import pytest

from protocols.messages import ClearFault, Hold, Idle, Velocity
from tests.protocols.cia402.conversation import ARMED, CLEARED, RPDO1, Talk, armed, arming
from tests.protocols.cia402.firmware import Drive


def test_vectors_of_a_fault_reported_by_emcy_and_cleared() -> None:
    talk = armed(Talk())
    talk.drive.trip(0x2310)
    talk.chapter(
        200,
        Hold("m"),  # nothing is said to it till somebody clears it
        expected="""
        0..1 < Fault 2310 continuous over current on the output
        0..20 < State fault FAULT
        still rpdo1 6040=000F 6060=8 607A=4096 …
        sync /10, beat 127 OPERATIONAL …
        """,
    )
    talk.chapter(50, Hold("m"), expected="sync ?, beat ?")
    talk.chapter(
        200,
        ClearFault("m"),
        Hold("m"),
        expected=f"""
        {CLEARED}
        {ARMED}
        sync /10, beat ?
        """,
    )
    talk.drive.trip(0x2310)  # again is another one
    talk.chapter(50, Hold("m"), expected="< Fault 2310 *\n< State fault FAULT\nsync ?, beat ?")


def test_vectors_of_a_fault_without_emcy() -> None:
    talk = armed(Talk())
    talk.drive.trip(0x7305, emcy=False)
    talk.chapter(
        100,
        Hold("m"),  # 603F comes with TPDO2
        expected="""
        < State fault FAULT
        < Fault 7305 incremental sensor 1
        sync /10, beat ?
        """,
    )


def test_vectors_of_a_fault_that_is_polled() -> None:
    talk = armed(Talk(feedback="sdo"), Velocity("m", 1.0))
    talk.drive.trip(0x3220, emcy=False)
    talk.chapter(
        200,
        Velocity("m", 1.0),
        expected="""
        0..40 < State fault FAULT
        0..60 < Fault 3220 DC link under voltage
        beat ?
        reads 603F
        """,
    )
    talk.chapter(
        200,
        ClearFault("m"),
        Velocity("m", 1.0),
        expected=f"""
        {CLEARED}
        rpdo2 60FF=0 6071=0 60B2=0 …
        {arming(4096, 9)}
        rpdo2 60FF=2608 6071=0 60B2=0 …
        beat ?
        """,
    )


def test_vectors_of_a_fault_found_at_the_start() -> None:
    drive = Drive()
    drive.trip(0x8611, emcy=False)
    talk = Talk(drive)
    talk.chapter(
        150,
        Idle("m"),
        expected="""
        < State initialising FAULT*
        < Fault 8611 following error
        < State fault FAULT
        """,
    )
    talk.chapter(100, Hold("m"), expected="")
    talk.chapter(
        100,
        ClearFault("m"),
        Idle("m"),
        expected=f"""
        {CLEARED}
        """,
    )


@pytest.mark.parametrize("stubborn", [2, 99])
def test_vectors_of_a_fault_that_does_not_go(stubborn: int) -> None:
    talk = armed(Talk(feedback="event"))
    talk.drive.trip(0x4310)
    talk.drive.resets = stubborn
    talk.chapter(100, Idle("m"))
    end = """
        500..530 < State ready SWITCH ON DISABLED
        500..530 < Done ClearFault m"""
    if stubborn > 2:
        end = """
        3000..3010 < Fault 4310 excess temperature drive
        3000..3010 < Refused ClearFault m still in fault: error code 0x4310"""
    # the same value is one line, where it was said first: 0000, 0080, and so again half a second later
    talk.chapter(3200, ClearFault("m"), Idle("m"))
    said = [
        (at, w.data[4]) for at, w in talk.frames[-4000:] if w.id == 0x602 and w.data[:3] == b"\x2b\x40\x60"
    ]
    begun = said[0][0]
    times = 2 if stubborn == 2 else 6
    assert [value for _, value in said] == [0x00, 0x80] * times
    assert [round((at - begun) / 250) for at, value in said if value == 0x80] == [2 * n for n in range(times)]
    wanted = [line.split(maxsplit=1) for line in end.strip().splitlines()]
    reported = [run for run in talk.runs() if run.text.startswith("< ")]
    for (window, text), run in zip(wanted, reported, strict=True):
        low, high = map(int, window.split(".."))
        assert run.text == text
        assert low <= run.times[0] <= high, run


@pytest.mark.parametrize(
    ("feedback", "periodic"), [("sync", "sync /10, beat ?"), ("event", "beat ?"), ("sdo", "beat ?")]
)
def test_vectors_of_a_fault_cleared_before_its_statusword_shows_it(feedback: str, periodic: str) -> None:
    talk = armed(Talk(feedback=feedback))
    talk.drive.trip(0x2320)
    talk.chapter(
        150,
        ClearFault("m"),
        Hold("m"),
        expected=f"""
        0..1 < Fault 2320 short circuit or earth leakage on the output
        < State fault FAULT
        {CLEARED}
        {ARMED}
        {periodic}
        """,
    )


def test_vectors_of_a_warning_that_comes_goes_and_comes_again() -> None:
    talk = armed(Talk())
    for _ in range(2):
        talk.drive.say_emcy(0x4210)
        talk.chapter(
            50,
            Hold("m"),
            expected="""
            0 < Fault 4210 excess temperature device
            still rpdo1 6040=000F 6060=8 607A=4096 /10
            sync /10, beat ?
            """,
        )
        talk.drive.say_emcy(0x4210)
        talk.chapter(50, Hold("m"), expected="sync /10, beat ?")
        talk.drive.say_emcy(0)
        talk.chapter(50, Hold("m"), expected="sync /10, beat ?")


def test_vectors_of_a_fault_while_it_is_disarmed() -> None:
    for options in ({}, {"feedback": "sdo"}):
        talk = armed(Talk(**options))
        talk.chapter(1, Idle("m"))
        talk.drive.trip(0x3210)
        talk.chapter(
            150,
            Idle("m"),
            expected="""
            < Fault 3210 DC link over voltage
            < State fault FAULT
            write 1016:01 = 00000000
            sync ?, beat ?
            """,
        )


def test_vectors_of_a_drive_that_is_disarmed_after_a_fault() -> None:
    talk = armed(Talk(), Velocity("m", 1.0))
    talk.drive.trip(0x8611)
    talk.chapter(100, Velocity("m", 1.0))
    talk.drive.put(0x6064, 4200)  # it has run out
    talk.chapter(
        150,
        ClearFault("m"),
        Idle("m"),  # cleared, and let go: 06 stands in its RPDO
        expected="""
        rpdo2 60FF=0 6071=0 60B2=0
        rpdo1 6040=0006 6060=9 607A=*
        write 6040 = 0000
        write 6040 = 0080
        < State ready READY TO SWITCH ON
        < Done ClearFault m
        write 1016:01 = 00000000
        sync ?, beat ?
        """,
    )


def test_vectors_of_a_fault_cleared_before_the_state_is_known() -> None:
    drive = Drive()
    drive.trip(0x8611, emcy=False)
    talk = Talk(drive)
    talk.chapter(
        150,
        ClearFault("m"),
        expected="""
        < State initialising FAULT*
        write 6040 = 0000
        write 6040 = 0080
        < State initialising SWITCH ON DISABLED*
        < Done ClearFault m
        < State ready SWITCH ON DISABLED
        """,
    )


def test_vectors_of_a_fault_whose_code_comes_with_the_statusword() -> None:
    drive = Drive()
    drive.map(0x1400, 0x202, 1, *RPDO1)
    drive.map(0x1401, 0x302, 1, 0x60FF0020, 0x60710010)
    drive.map(0x1800, 0x40000182, 1, 0x60410010, 0x603F0010, 0x60640020)
    talk = armed(Talk(drive))
    drive.trip(0, emcy=False)
    talk.chapter(30, Hold("m"), expected="< State fault FAULT\nsync /10, beat ?")
    drive.put(0x603F, 0x7305)  # a bit later it knows why
    talk.chapter(30, Hold("m"), expected="< Fault 7305 incremental sensor 1\nsync /10, beat ?")


def test_vectors_of_an_emergency_that_no_statusword_confirms_is_cleared_without_a_controlword() -> None:
    talk = armed(Talk())
    talk.drive.say_emcy(0x2310)
    talk.chapter(1, ClearFault("m"), Hold("m"))
    talk.chapter(20, ClearFault("m"), Hold("m"), expected="< Done *\n< Done ClearFault m\nsync ?, beat ?")
    assert talk.drive.state == "OPERATION ENABLED"
