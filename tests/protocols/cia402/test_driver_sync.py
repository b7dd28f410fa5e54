"""SYNC has one producer a bus: a second one beside the driver is reported once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from protocols.cia402 import plugin
from protocols.cia402.options import Options, Settings
from protocols.conformance import CLAUSES, check
from protocols.frames import BusState, CanFrame, exact
from protocols.messages import MILLISECOND, Event, Found, Hold, Idle, Velocity
from protocols.plugin import Device, RxCounters
from tests.protocols.cia402.conversation import Talk, armed, up

SYNC = CanFrame(0x080)
FOREIGN = (Options(sync_ms=0), Options(feedback="event"), Options(feedback="sdo"))
"""With these the driver produces no SYNC."""


def received(talk: Talk, *frames: CanFrame) -> tuple[list[Event], tuple[int, int, int]]:
    """Return the events of these frames, and their counts: accepted, malformed, ignored."""
    counters = talk.driver.counters = RxCounters()
    before = len(talk.events)
    talk.handle(*frames)
    return talk.events[before:], (counters.accepted, counters.malformed, counters.ignored)


def own_syncs(talk: Talk) -> int:
    return sum(frame.id == SYNC.id for _, frame in talk.frames)


@pytest.mark.parametrize("frame", [SYNC, CanFrame(0x080, b"\x07")], ids=["plain", "with a counter"])
def test_another_producer_is_reported_once_with_the_remedy(frame: CanFrame) -> None:
    talk = armed(Talk())
    events, counters = received(talk, frame, SYNC, frame)
    (found,) = events
    assert isinstance(found, Found)
    assert (found.t, found.address, found.serial) == (talk.now * MILLISECOND, 0, None)
    assert found.duplicate_address
    assert all(part in found.detail for part in ("SYNC", "0x080", "1005", "sync_ms = 0"))
    assert counters == (3, 0, 0)


@pytest.mark.parametrize("options", [{"sync_ms": 0}, {"feedback": "event"}, {"feedback": "sdo"}], ids=str)
def test_a_producer_is_ignored_where_this_host_is_none(options: dict[str, Any]) -> None:
    talk = up(Talk(**options))
    talk.chapter(200, Hold("m"))
    assert not own_syncs(talk)
    assert received(talk, SYNC, SYNC) == ([], (0, 0, 2))


def test_a_producer_is_ignored_until_this_host_is_one_and_after() -> None:
    talk = up(Talk())
    assert received(talk, SYNC, SYNC) == ([], (0, 0, 2))
    for _ in range(300):
        before = own_syncs(talk)
        talk.chapter(1, Hold("m"))
        reported = [event for event in received(talk, SYNC)[0] if isinstance(event, Found)]
        assert bool(reported) is (own_syncs(talk) == 1 and before == 0), "with its first SYNC, and once"
    talk.chapter(800, Idle("m"))
    assert received(talk, SYNC) == ([], (0, 0, 1))


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x080, b"\1\2"),
        CanFrame(0x080, bytes(8)),
        CanFrame(0x080, remote=True),
        CanFrame(0x080, extended=True),
        CanFrame(0x080, fd=True),
        CanFrame(0x100),
    ],
    ids=str,
)
def test_what_is_no_sync_is_ignored(frame: CanFrame) -> None:
    assert received(armed(Talk()), frame) == ([], (0, 0, 1))


@pytest.mark.parametrize("state", [BusState.GONE, BusState.OFF])
def test_it_is_reported_again_after_the_bus_was_gone(state: BusState) -> None:
    talk = armed(Talk())
    assert len(received(talk, SYNC)[0]) == 1
    for passing in (BusState.PASSIVE, BusState.UP, BusState.FULL, BusState.UP):
        talk.bus(passing)
    assert received(talk, SYNC) == ([], (1, 0, 0))
    talk.bus(state)
    talk.bus(BusState.BACK)
    talk.chapter(1000, Hold("m"))
    assert len(received(talk, SYNC)[0]) == 1


def test_it_stops_no_motor() -> None:
    talk = armed(Talk(), Velocity("m", 2.0))
    talk.handle(SYNC)
    before = own_syncs(talk)
    for _ in range(30):
        talk.handle(SYNC)
        talk.chapter(10, Velocity("m", 2.0), expected="still rpdo2 60FF=5215 6071=0 60B2=0 …\nsync ?, beat ?")
    assert own_syncs(talk) == before + 30
    assert talk.drive.state == "OPERATION ENABLED"


@pytest.mark.parametrize("options", [Options(), *FOREIGN])
def test_a_receive_filter_lets_sync_in_where_it_is_produced(options: Options) -> None:
    receives_also = plugin.spec(Device("m", 5, options, Settings())).receives_also
    assert (exact(SYNC.id) in receives_also) is (options not in FOREIGN)


def test_the_contract_wants_it_declared() -> None:
    clauses = [clause for clause in CLAUSES if clause.name == "foreign"]
    silent = replace(plugin, spec=lambda device: replace(plugin.spec(device), receives_also=()))
    (result,) = check(silent, clauses=clauses)
    assert result.outcome == "failed"
    assert "SYNC" in result.text
