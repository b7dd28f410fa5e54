"""Conversations of vectors: the state of the bus, scans, and several drives on it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from protocols.cia402 import plugin
from protocols.cia402.options import Options, Settings
from protocols.frames import BusState, CanFrame
from protocols.messages import Event, Found, Hold, Home, Idle, ReadParameter, Scan, Velocity
from protocols.plugin import Device
from tests.protocols.cia402.conversation import Talk, armed, up
from tests.protocols.cia402.firmware import Drive


@pytest.mark.parametrize("state", [BusState.GONE, BusState.OFF])
def test_vectors_of_a_bus_that_is_gone_and_back(state: BusState) -> None:
    talk = armed(Talk())
    talk.chapter(1, ReadParameter("m", "6081"), Scan("can0"), Home("m"), Hold("m"))
    talk.bus(state)
    talk.bus(BusState.GONE)  # told again, or more of it: nothing is lost, or told twice
    talk.drive.dead = True
    talk.chapter(
        100,
        Hold("m"),
        expected=f"""
        0 < Refused ReadParameter m the bus is {state}
        0 < Refused Home m the bus is {state}
        0 < Refused Scan can0 the bus is {state}
        """,
    )
    talk.bus(BusState.BACK)
    talk.drive.dead = False
    talk.chapter(350, Hold("m"))
    assert talk.drive.state == "OPERATION ENABLED"
    assert talk.drive.get(0x6060) == 8, "nobody homes any longer"


def test_vectors_of_a_bus_that_is_back_the_drive_is_read_before_anything_is_written() -> None:
    talk = armed(Talk(), Velocity("m", 1.0))
    talk.bus(BusState.BACK)
    talk.drive.put(0x6064, 5000)
    talk.chapter(
        40,
        Velocity("m", 1.0),
        expected="""
        < State initialising *
        < State initialising *
        sync ?, beat ?
        """,
    )
    talk.chapter(
        160,
        Velocity("m", 1.0),  # it runs still, in the mode that is wanted: it is steered again
        expected="""
        < State armed OPERATION ENABLED, cyclic synchronous velocity
        write 1016:01 = 007F01F4
        rpdo1 6040=000F 6060=9 607A=5000 …
        still rpdo2 60FF=2608 6071=0 60B2=0 /10
        sync ?, beat ?
        """,
    )


def test_vectors_of_a_full_queue_what_may_be_lost_is_sent_again() -> None:
    talk = armed(Talk(), Velocity("m", 1.0))
    talk.chapter(30, Velocity("m", 1.0))
    talk.bus(BusState.FULL)
    mark = len(talk.frames)
    talk.chapter(15, Velocity("m", 1.0))
    assert {frame.id for _, frame in talk.frames[mark:]} >= {0x202, 0x302, 0x402}


@pytest.mark.parametrize("state", [BusState.UP, BusState.PASSIVE])
def test_vectors_of_a_bus_that_goes_on(state: BusState) -> None:
    talk = armed(Talk())
    talk.bus(state)
    talk.chapter(50, Hold("m"), expected="still rpdo1 6040=000F 6060=8 607A=4096 /10\nsync /10, beat ?")


# -- looking for devices --------------------------------------------------------------------------------


def _asked(talk: Talk, mark: int) -> list[tuple[int, str]]:
    return [(frame.id - 0x600, frame.data[1:4].hex()) for _, frame in talk.frames[mark:] if frame.id != 0x602]


def _found(events: Sequence[Event]) -> list[tuple[int, int | None, bool, str]]:
    return [(e.address, e.serial, e.duplicate_address, e.detail) for e in events if isinstance(e, Found)]


def test_vectors_of_a_scan_of_an_empty_bus() -> None:
    talk = up(Talk())
    mark = len(talk.frames)
    talk.chapter(900, Scan("can0"))
    assert _asked(talk, mark) == [(node, "001000") for node in range(1, 128) if node != 2], "1000, of each"
    at = {frame.id: at for at, frame in talk.frames[mark:] if frame.id != 0x602}
    assert max(at.values()) - min(at.values()) < 500
    assert _found(talk.events) == [
        (2, 4711, False, "m, twin402, device profile 402, vendor 0x0, product 0x192")
    ]
    done = [run for run in talk.runs() if run.text.startswith("< Done")]
    assert [run.text for run in done] == ["< Done Scan can0 1 devices"]
    assert 400 <= done[0].times[0] <= 600, "half a second"


class Stranger(Drive):
    """A drive that is not in the robot file: it receives all, and answers what is for it."""

    def __init__(self, node: int, serial: int, copies: int = 1) -> None:
        super().__init__(node)
        self.put(0x1018, serial, 4)
        self.put(0x1018, 0x29C, 1)
        self.put(0x1018, 0x1234, 2)
        self.copies = copies


def with_strangers(talk: Talk, strangers: Sequence[Drive], ms: int, *words: Scan) -> None:
    """Run for this time beside them."""
    for at in range(ms):
        mark = len(talk.frames)
        talk.chapter(1, *(words if at == 0 else ()))
        for _, frame in talk.frames[mark:]:
            for stranger in strangers:
                if frame.id == 0x600 + stranger.node:
                    stranger.handle(frame)
        for stranger in strangers:
            talk.drive.extra += stranger.speak(at)


def test_vectors_of_a_scan_that_finds_strangers() -> None:
    one, two, silent, poor = Stranger(5, 77), Stranger(7, 78, copies=2), Stranger(9, 79), Stranger(126, 80)
    silent.dead = True
    poor.lack(0x1018)
    talk = up(Talk())
    mark = len(talk.frames)
    with_strangers(talk, (one, two, silent, poor), 900, Scan("can0"))
    known = "device profile 402, vendor 0x29c, product 0x1234"
    assert _found(talk.events)[1:] == [
        (5, 77, False, known),
        (7, 78, True, known),
        (126, None, False, "device profile 402"),
    ]
    asked = _asked(talk, mark)
    assert [key for node, key in asked if node == 5] == ["001000", "181001", "181002", "181004"]
    talk.handle(CanFrame(0x585, bytes.fromhex("4300100092010200")))  # no host looks any longer
    foreign = talk.driver.counters.ignored
    talk.handle(CanFrame(0x585, bytes.fromhex("4300100092010200")))
    assert talk.driver.counters.ignored == foreign + 1


def test_vectors_of_two_scans_at_once() -> None:
    talk = up(Talk())
    talk.chapter(50, Scan("can0"))
    talk.chapter(1, Scan("can0"))
    assert any(str(run.text) == "< Refused Scan can0 a scan is under way" for run in talk.runs())
    talk.chapter(900)
    talk.chapter(900, Scan("can0"))
    assert [type(event).__name__ for event in talk.events].count("Done") == 2


def test_vectors_of_a_scan_that_reports_a_duplicate_of_its_own_drive() -> None:
    talk = up(Talk())
    talk.drive.copies = 2
    talk.chapter(100)
    talk.drive.copies = 1
    talk.chapter(900, Scan("can0"))
    assert [twice for _, _, twice, _ in _found(talk.events)] == [True, True]
    talk.drive.dead = True
    talk.chapter(600)
    before = len(talk.events)
    talk.chapter(900, Scan("can0"))
    assert _found(talk.events[before:]) == [], "it is gone"


# -- several drives ----------------------------------------------------------------------------------------


def test_vectors_of_two_drives_one_sync_one_heartbeat() -> None:
    left, right = Drive(2), Drive(3)
    right.put(0x6064, -4096)
    talk = up(Talk(left, right))
    talk.chapter(400, Velocity("m", 1.0), Velocity("n", -1.0))
    assert [left.state, right.state] == ["OPERATION ENABLED"] * 2
    talk.chapter(
        300,
        Velocity("m", 1.0),
        Velocity("n", -2.0),
        expected="""
        3: rpdo2 60FF=-5215 6071=0 60B2=0 /10
        still 2: rpdo2 60FF=2608 6071=0 60B2=0 /10
        still 3: rpdo1 6040=000F 6060=9 607A=-4096 …
        sync /10, beat 127 OPERATIONAL /125..130
        measures m.position=1.5708 n.position=-1.5708
        """,
    )
    talk.chapter(
        200,
        Velocity("m", 1.0),  # the other is not commanded: the host's heartbeat stops for both
        expected="""
        still 2: rpdo2 60FF=2608 6071=0 60B2=0 /10
        sync /10
        """,
    )
    talk.chapter(
        100,
        Velocity("m", 1.0),
        Idle("n"),  # once it is let go, the other's is fed again
        expected="""
        3: rpdo2 60FF=0 6071=0 60B2=0
        3: rpdo1 6040=0006 6060=9 607A=-4096
        < State n ready READY TO SWITCH ON
        3: write 1016:01 = 00000000
        sync /10, beat ?
        """,
    )
    talk.chapter(200, Velocity("m", 1.0), expected="sync /10, beat 127 OPERATIONAL /125..130")
    right.trip(0x2310)
    talk.chapter(
        50,
        Velocity("m", 1.0),
        Idle("n"),
        expected="""
        0 < Fault n 2310 continuous over current on the output
        < State n fault FAULT
        still 2: rpdo2 60FF=2608 6071=0 60B2=0 /10
        sync /10, beat ?
        """,
    )


def test_vectors_of_drives_with_different_watchdogs_share_the_faster_heartbeat() -> None:
    left, right = Drive(2), Drive(3)
    devices = [
        Device("m", 2, Options(watchdog_ms=400), Settings()),
        Device("n", 3, Options(watchdog_ms=200), Settings()),
    ]
    talk = Talk(left, right)
    talk.driver = plugin.driver(devices)
    talk.chapter(100)
    talk.chapter(300, Hold("m"), Hold("n"))
    talk.chapter(300, Hold("m"), Hold("n"), expected="sync /10, beat 127 OPERATIONAL /50..60")
    assert [left.get(0x1016, 1), right.get(0x1016, 1)] == [0x7F0190, 0x7F00C8]


def test_vectors_of_a_bus_whose_sync_has_another_producer() -> None:
    talk = up(Talk(sync_ms=0))
    talk.chapter(150, Hold("m"), expected=None)
    assert not [frame for _, frame in talk.frames if frame.id == 0x80]
    sync = CanFrame(0x80)
    for _ in range(30):
        talk.drive.handle(sync)
        talk.handle(sync)
        talk.chapter(10, Hold("m"))
    assert talk.drive.state == "OPERATION ENABLED"
    assert not [event for event in talk.events if isinstance(event, Found)]
