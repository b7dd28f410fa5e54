"""SYNC has one producer a bus: a second one beside the driver is reported once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from protocols.cia402 import plugin
from protocols.cia402.options import Options
from protocols.conformance import CLAUSES, check
from protocols.frames import BusState, CanFrame
from protocols.messages import Event, Fault, Found, Hold, Idle, Mode, Velocity
from protocols.plugin import RxCounters
from tests.protocols.cia402.driver_stage import Stage, device, stage

A = "alpha"
SYNC = CanFrame(0x080)
OWN = Options()
FOREIGN = (Options(sync_ms=0), Options(feedback="event"), Options(feedback="sdo"))
"""With these the driver produces no SYNC."""


def armed(options: Options = OWN) -> Stage:
    """Alpha, commanded."""
    s = stage(options)
    s.until(Mode.READY)
    s.until(Mode.ARMED, Hold(A))
    return s


def received(s: Stage, *frames: CanFrame) -> tuple[list[Event], tuple[int, int, int]]:
    """Return the events of these frames, and their counts: accepted, malformed, ignored."""
    counters = s.driver.counters = RxCounters()
    events = [event for frame in frames for event in s.driver.receive(s.stage.now, frame)]
    return events, (counters.accepted, counters.malformed, counters.ignored)


def own_syncs(s: Stage) -> list[CanFrame]:
    return [frame for frame in s.down if frame.id == SYNC.id]


# -- another producer -----------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", [SYNC, CanFrame(0x080, b"\x07")], ids=["plain", "with a counter"])
def test_another_producer_is_reported_once_with_the_remedy(frame: CanFrame) -> None:
    s = armed()
    events, counters = received(s, frame, SYNC, frame)
    (found,) = events
    assert isinstance(found, Found)
    assert (found.t, found.protocol, found.address, found.serial) == (s.stage.now, "cia402", 0, None)
    assert found.duplicate_address
    assert all(part in found.detail for part in ("SYNC", "0x080", "1005", "sync_ms = 0"))
    assert counters == (3, 0, 0)


@pytest.mark.parametrize("options", FOREIGN, ids=["sync_ms = 0", "event", "sdo"])
def test_a_producer_is_ignored_where_this_host_is_none(options: Options) -> None:
    s = stage(options)
    s.until(Mode.READY)
    s.steps(200, Hold(A))
    assert not own_syncs(s)
    assert received(s, SYNC, SYNC) == ([], (0, 0, 2))


def test_a_producer_is_ignored_until_this_host_is_one_and_after() -> None:
    s = stage()
    s.until(Mode.READY)
    assert received(s, SYNC, SYNC) == ([], (0, 0, 2))
    s.forget()
    while not s.of(Found):
        s.step(Hold(A), stray=[SYNC])
    assert len(own_syncs(s)) in (1, 2)
    for _ in range(200):
        s.step(Hold(A), stray=[SYNC])
    assert len(s.of(Found)) == 1
    s.until(Mode.READY, Idle(A))
    s.steps(700, Idle(A))
    assert received(s, SYNC) == ([], (0, 0, 1))


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
    assert received(armed(), frame) == ([], (0, 0, 1))


@pytest.mark.parametrize("state", [BusState.GONE, BusState.OFF])
def test_it_is_reported_again_after_the_bus_was_gone(state: BusState) -> None:
    s = armed()
    assert len(received(s, SYNC)[0]) == 1
    for passing in (BusState.PASSIVE, BusState.UP, BusState.FULL, BusState.UP):
        s.driver.bus(s.stage.now, passing)
    assert received(s, SYNC) == ([], (1, 0, 0))
    s.driver.bus(s.stage.now, state)
    s.driver.bus(s.stage.now, BusState.BACK)
    s.forget()
    s.steps(1000, Hold(A))
    assert own_syncs(s)
    assert len(received(s, SYNC)[0]) == 1


def test_it_stops_no_motor() -> None:
    s = armed()
    s.steps(500, Velocity(A, 2.0))
    s.forget()
    for at in range(300):
        s.step(Velocity(A, 2.0), stray=[SYNC] if at % 7 == 0 else [])
    assert [type(event) for event in s.events] == [Found]
    assert not s.of(Fault)
    assert s.stage.modes[A] is Mode.ARMED
    assert s.stage.shafts[A].velocity == pytest.approx(2.0, abs=0.05)
    assert len(own_syncs(s)) == 30


@pytest.mark.parametrize(("options", "let_in"), [(OWN, True), *((options, False) for options in FOREIGN)])
def test_a_receive_filter_lets_sync_in_where_it_is_produced(options: Options, *, let_in: bool) -> None:
    receives_also = plugin.spec(device(options=options)).receives_also
    assert any(number == SYNC.id and mask == 0x1FFF_FFFF for number, mask in receives_also) is let_in


def test_the_contract_wants_it_declared() -> None:
    clauses = [clause for clause in CLAUSES if clause.name == "foreign"]
    silent = replace(plugin, spec=lambda device: replace(plugin.spec(device), receives_also=()))
    (result,) = check(silent, clauses=clauses)
    assert result.outcome == "failed"
    assert "SYNC" in result.text
