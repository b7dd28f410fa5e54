"""Conversations of vectors: the PDOs of set-points and feedback: written, found, or missing.

Flags of a COB-ID: 8… the PDO does not exist, 4… no remote frames. An inhibit time (subindex 3) counts 100 µs,
an event timer (subindex 5) ms.
"""

from __future__ import annotations

import pytest

from protocols.messages import ClearFault, Fault, Hold, Idle, Position, Torque, Velocity
from tests.protocols.cia402.conversation import (
    ARMED,
    ARMED_BY_SDO,
    READS,
    RPDO1,
    RPDO2,
    RPDO3,
    STARTED,
    TPDO1,
    TPDO2,
    TPDO3,
    WRITTEN_FOR_SYNC,
    Talk,
    armed,
    configured,
    up,
)
from tests.protocols.cia402.firmware import Drive

SHORT = (0x60FF0020, 0x60710010)
"""RPDO2 without the torque offset."""


def with_pdos(kind: int, timer: int = 0) -> Drive:
    """Return a drive delivered with PDOs for all commands and feedback."""
    drive = Drive()
    drive.map(0x1400, 0x202, kind, *RPDO1)
    drive.map(0x1401, 0x302, kind, *SHORT)
    drive.map(0x1800, 0x40000182, kind, *TPDO1, timer=timer)
    return drive


def test_vectors_of_feedback_by_an_event_timer() -> None:
    drive = Drive()
    drive.put(0x1017, 0)  # it has no heartbeat
    talk = up(Talk(drive, feedback="event", feedback_ms=20, heartbeat_ms=50, watchdog_ms=400, host_id=99))
    talk.chapter(
        300,
        Hold("m"),
        expected=f"""
        write 1017 = 50
        {configured(0x1400, 0x202, 255, *RPDO1)}
        {configured(0x1401, 0x302, 255, *RPDO2)}
        {configured(0x1402, 0x402, 255, *RPDO3)}
        {configured(0x1800, 0x40000182, 255, *TPDO1, timer=20)}
        {configured(0x1801, 0x40000282, 255, *TPDO2, timer=20)}
        {configured(0x1802, 0x40000382, 255, *TPDO3, timer=200)}
        write 1016:01 = 00630190
        {STARTED}
        {ARMED}
        beat 99 OPERATIONAL /100..110
        """,
    )
    talk.drive.put(0x6064, 0)
    talk.drive.put(0x606C, 16384)
    talk.chapter(
        40,
        Hold("m"),
        expected="""
        still rpdo1 6040=000F 6060=8 607A=4096 /10
        beat ?
        measures position=0 velocity=6.2832
        """,
    )


def test_vectors_of_feedback_that_is_polled() -> None:
    talk = up(Talk(feedback="sdo"))
    before = len(talk.frames)
    talk.chapter(
        1000,
        Idle("m"),
        expected="reads 1018:04\nasks 6041 6061 6064 606C 6077 6078 6079",
    )
    said = [frame.data[1:3] for _, frame in talk.frames[before:]]
    assert {frame.id for _, frame in talk.frames} == {0x602}
    asked = {title: said.count(bytes.fromhex(title)[::-1]) for title in ("6064", "606C", "6041", "6077")}
    # each 10 ms; the state at least a tenth as often
    assert all(95 <= asked[title] <= 101 for title in ("6064", "606C")), asked
    assert all(10 <= asked[title] <= 101 for title in ("6041", "6077")), asked
    assert 530 <= 2 * len(said) <= 600, "about 560 frames a second, answers included"
    talk.chapter(
        200,
        Hold("m"),
        expected=f"""
        {configured(0x1400, 0x202, 255, *RPDO1)}
        {configured(0x1401, 0x302, 255, *RPDO2)}
        {configured(0x1402, 0x402, 255, *RPDO3)}
        write 1016:01 = 007F01F4
        {STARTED}
        {ARMED}
        beat 127 OPERATIONAL …
        """,
    )


def test_vectors_of_a_drive_whose_mapping_is_kept_and_has_none() -> None:
    talk = up(Talk(feedback="sdo", mapping="keep", watchdog_ms=0))
    talk.chapter(
        200,
        Hold("m"),
        expected=f"""
        nmt OPERATIONAL 2
        {ARMED_BY_SDO}
        """,
    )
    talk.chapter(
        150,
        Velocity("m", 1.0, 0.1),  # 16384/τ = 2607.6; 100 ‰
        expected="""
        write 60B2 = 100
        write 60FF = 2608 /20..30
        write 6060 = 9
        < State armed OPERATION ENABLED, cyclic synchronous velocity
        """,
    )
    talk.chapter(
        150,
        Position("m", 0.5, -1.0),  # 0.5·16384/τ = 1303.8
        expected="""
        write 60B1 = -2608
        write 60B2 = 0
        write 607A = 1304 /20..30
        write 6060 = 8
        < State armed OPERATION ENABLED, cyclic synchronous position
        """,
    )
    talk.chapter(
        150,
        Torque("m", -0.25),
        expected="""
        write 60B1 = 0
        write 6071 = -250 /20..30
        write 6060 = 10
        < State armed OPERATION ENABLED, cyclic synchronous torque
        """,
    )
    talk.chapter(
        150,
        Idle("m"),
        expected="""
        0 write 6040 = 0006
        < State ready READY TO SWITCH ON
        """,
    )


@pytest.mark.parametrize(("kind", "options"), [(1, {}), (255, {"feedback": "event"})])
def test_vectors_of_pdos_that_fit_and_stay(kind: int, options: dict[str, str]) -> None:
    talk = Talk(with_pdos(kind, 10 if kind == 255 else 0), **options)
    talk.chapter(
        150,  # of a PDO that exists: identifier, type, its timer if it tells, and what is mapped
        expected=f"""
        < *
        < State ready SWITCH ON DISABLED
        {READS} 1400:01 1400:02 1600 1600:01 1600:02 1600:03 1401:01 1401:02 1601 \
1601:01 1601:02 1402:01 1403:01 1800:01 1800:02 1800:05 1A00 1A00:01 1A00:02 1A00:03 1801:01 1802:01 1803:01
        """,
    )
    synced = "sync /10" if kind == 1 else ""
    talk.chapter(
        200,
        Hold("m"),
        expected=f"""
        write 1016:01 = 007F01F4
        nmt OPERATIONAL 2
        rpdo2 60FF=0 6071=0 …
        {ARMED}
        {synced}
        beat 127 OPERATIONAL …
        """,
    )
    talk.chapter(250, Hold("m"), expected=f"{synced}\nbeat ?\nasks 606C 6077 6078 6079")
    talk.chapter(
        50,
        Position("m", 1.0, 1.0),  # 60B1 stands in no PDO: by SDO
        expected=f"""
        rpdo1 6040=000F 6060=8 607A=2608 /1..10
        write 60B1 = 2608
        {synced}
        beat ?
        """,
    )


def test_vectors_of_pdos_that_wait_for_a_sync_without_a_producer() -> None:
    drive = with_pdos(1)
    talk = Talk(drive, feedback="event")  # SYNC is not said here: neither end of them is of use
    talk.chapter(150)
    talk.chapter(300, Hold("m"))
    assert [drive.get(index, 2) for index in (0x1400, 0x1401, 0x1800, 0x1801)] == [255] * 4
    assert drive.state == "OPERATION ENABLED"


@pytest.mark.parametrize(("kind", "timer"), [(255, 5000), (255, 0), (240, 0), (0, 0)])
def test_vectors_of_pdos_that_report_too_seldom(kind: int, timer: int) -> None:
    talk = up(Talk(with_pdos(kind, timer)), 150)
    talk.chapter(
        250,
        Hold("m"),  # what steers stays as it is
        expected=f"""
        {WRITTEN_FOR_SYNC}
        write 1016:01 = 007F01F4
        nmt OPERATIONAL 2
        rpdo2 60FF=0 6071=0 …
        {ARMED}
        sync /10, beat 127 OPERATIONAL …
        """,
    )


def test_vectors_of_pdos_that_lack_a_set_point() -> None:
    drive = with_pdos(1)
    drive.map(0x1401, 0x302, 1, 0x60FF0020)  # no torque
    talk = up(Talk(drive), 150)
    talk.chapter(
        250,
        Hold("m"),  # RPDO1 and what tells stay as they are
        expected=f"""
        {configured(0x1401, 0x302, 1, *RPDO2)}
        {configured(0x1402, 0x402, 1, *RPDO3)}
        write 1016:01 = 007F01F4
        {STARTED}
        {ARMED}
        sync /10, beat 127 OPERATIONAL …
        """,
    )


@pytest.mark.parametrize(("index", "cob", "entries"), [(0x1400, 0x202, RPDO1), (0x1800, 0x40000182, TPDO1)])
def test_vectors_of_pdos_that_lack_the_controlword_or_the_statusword(
    index: int, cob: int, entries: tuple[int, ...]
) -> None:
    drive = with_pdos(1)
    drive.map(index, cob, 1, *entries[1:])
    armed(Talk(drive))
    assert drive.get(index + 0x200, 1) == entries[0]


def test_vectors_of_pdos_that_lack_a_set_point_of_the_other_family() -> None:
    drive = with_pdos(1)
    drive.put(0x6502, 0x005)  # PP and PV alone
    drive.map(0x1401, 0x80000302, 1)
    talk = armed(Talk(drive))
    assert drive.get(0x6061) == 1
    assert drive.get(0x1601, 1) == 0x60FF0020
    talk.chapter(50, Velocity("m", 1.0))
    assert (drive.get(0x6061), drive.get(0x60FF)) == (3, 2608)


@pytest.mark.parametrize(
    ("index", "kind", "entries"),
    [
        (0x1400, 1, (*RPDO1, 0x00050008)),  # 5 is a dummy: it takes room
        (0x1400, 1, (*RPDO1, 0x00050004)),  # half a byte of it
        (0x1400, 255, RPDO1),  # at once, not with SYNC
        (0x1800, 1, (*TPDO1, 0x20000108)),  # more is told than is asked for
        (0x1800, 1, (*TPDO1, 0x20000104)),  # half a byte
        (0x1800, 2, TPDO1),  # with every second SYNC
    ],
)
def test_vectors_of_odd_pdos_that_do_well(index: int, kind: int, entries: tuple[int, ...]) -> None:
    drive = with_pdos(1)
    drive.map(index, 0x202 if index == 0x1400 else 0x40000182, kind, *entries)
    if entries[-1] >> 16 == 0x2000:
        drive.own(0x2000, 1)
    talk = up(Talk(drive), 150)
    before = len(talk.frames)
    talk.chapter(300, Hold("m"))
    said = [frame.data for _, frame in talk.frames[before:] if frame.id == 0x602 and frame.data[0] != 0x40]
    assert [data[1:4].hex() for data in said] == ["161001"], "1016:01 alone"
    assert drive.state == "OPERATION ENABLED"
    drive.put(0x6064, -8192)
    dummy = "202#0F00080010000000 /10\n" if len(entries) == 4 and index == 0x1400 else ""
    talk.chapter(100, Hold("m"), expected=f"{dummy}sync /10, beat ?\nmeasures position=-3.1416")


def test_vectors_of_a_drive_without_offsets_and_supply() -> None:
    drive = Drive()
    drive.lack(0x60B1, 0x60B2, 0x6079)
    talk = up(Talk(drive))
    talk.chapter(250, Hold("m"))
    assert [drive.get(0x1601), drive.get(0x1602), drive.get(0x1A02)] == [2, 0, 1]
    talk.chapter(
        50,
        Position("m", 1.0, 0.5),
        expected="""
        0 < Refused Position m it has no object 60B1 *
        sync /10, beat ?
        """,
    )
    talk.chapter(
        50,
        Velocity("m", 1.0, 0.5),
        expected="""
        0 < Refused Velocity m it has no object 60B2 *
        sync /10, beat ?
        """,
    )
    talk.chapter(
        50,
        Position("m", 1.0),
        expected="""
        rpdo1 6040=000F 6060=8 607A=2608 /2..10
        sync /10, beat ?
        """,
    )
    drive = Drive()
    drive.lack(0x60B1, 0x60B2)
    talk = up(Talk(drive, feedback="sdo", mapping="keep", watchdog_ms=0))
    talk.chapter(
        200,
        Hold("m"),
        expected=f"""
        nmt OPERATIONAL 2
        {ARMED_BY_SDO}
        """,
    )


def test_vectors_of_pdos_that_may_not_be_written() -> None:
    drive = Drive()
    for index in (0x1400, 0x1801):
        drive.refuse(index, 0x06010002)
    talk = up(Talk(drive))
    talk.chapter(
        350,
        Hold("m"),
        expected=f"""
        write 1400:01 = 80000202
        {configured(0x1401, 0x302, 1, *RPDO2)}
        {configured(0x1402, 0x402, 1, *RPDO3)}
        {configured(0x1800, 0x40000182, 1, *TPDO1)}
        write 1801:01 = C0000282
        {configured(0x1802, 0x40000382, 10, *TPDO3)}
        write 1016:01 = 007F01F4
        {STARTED}
        {ARMED_BY_SDO}
        sync /10, beat 127 OPERATIONAL …
        """,
    )


def test_vectors_of_a_watchdog_that_may_not_be_written() -> None:
    drive = with_pdos(1)
    drive.refuse(0x1016, 0x06010002)
    talk = up(Talk(drive), 150)
    talk.chapter(
        200,
        Hold("m"),
        expected="""
        write 1016:01 = 007F01F4
        < Fault 10005 not configured
        """,
    )
    (fault,) = [event for event in talk.events if isinstance(event, Fault)]
    assert fault.cause.startswith("1016:01: the object can only be read")
    drive.refused.clear()
    talk.chapter(
        200,
        ClearFault("m"),
        Hold("m"),
        expected=f"""
        < Done ClearFault m
        write 1016:01 = 007F01F4
        nmt OPERATIONAL 2
        rpdo2 60FF=0 6071=0 …
        {ARMED}
        sync /10, beat 127 OPERATIONAL …
        """,
    )
    assert armed(Talk(Drive(5), watchdog_ms=0)).drive.get(0x1016, 1) == 0
