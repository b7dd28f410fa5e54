"""The host's record of a device: every phase with every trigger, and what reports and commands lead to."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from protocols.messages import MILLISECOND, Fault, Feedback, Mode, State
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.host import Host, Phase, Report, Timing, Trigger

MS = MILLISECOND
TIMING = Timing(offline=100 * MS, release=20 * MS, confirmations=2, arming=1000 * MS)
NOT_ARMED = 9
FAULTS = {7: FaultInfo("hot", "too much torque", "let it cool"), NOT_ARMED: FaultInfo("not armed", "", "")}
# Rows are phases, columns triggers, in the order of their enums.
GRID = """
           command idle      armed disarmed unasked   released fault cleared silent  back lost
free       arming  releasing -     -        releasing -        fault -       offline -    -
arming     -       releasing armed -        -         -        fault -       offline -    -
armed      -       releasing -     arming   -         -        fault -       offline -    arming
releasing  arming  -         -     -        -         free     -     -       -       -    -
fault      -       releasing -     -        releasing -        -     free    offline -    -
offline    -       releasing -     -        -         -        -     -       -       free -
"""
CELLS = [
    (phase, trigger, phase if cell == "-" else Phase[cell.upper()])
    for phase, row in zip(Phase, GRID.splitlines()[2:], strict=True)
    for trigger, cell in zip(Trigger, row.split()[1:], strict=True)
]


def make(*, latch: bool = False) -> Host[None]:
    return Host(Device("m", 1, None, None), None, TIMING, FAULTS, latch=latch)


@pytest.mark.parametrize(("phase", "trigger", "following"), CELLS)
def test_every_phase_with_every_trigger(phase: Phase, trigger: Trigger, following: Phase) -> None:
    host = make()
    host.phase, host.since, host.held = phase, 1, 0.5
    host._fire(5, trigger)
    changed = following is not phase
    assert (host.phase, host.since) == (following, 5 if changed else 1)
    assert (host.held is None) is (changed and following in (Phase.ARMING, Phase.RELEASING))
    assert host.owned is (changed and following is Phase.RELEASING)


def reports(mode: Mode, *faults: int) -> Callable[[Host[None], int], object]:
    return lambda host, t: host.on_report(t, Report(host, 1, mode, faults=faults))


ACTIONS: dict[str, Callable[[Host[None], int], object]] = {
    "ready": reports(Mode.READY),
    "armed": reports(Mode.ARMED),
    "fault": reports(Mode.FAULT, 7),
    "command": lambda host, t: host.on_command(t, hold=False),
    "idle": lambda host, t: host.on_idle(t),
    "stop": lambda host, t: host.own_unasked(),
    "clear": lambda host, t: host.cleared(t),
    "lost": lambda host, t: host.forget(t),
    "trip": lambda host, t: host.trip(t, NOT_ARMED),
    "latch": lambda host, t: None,
    "silence": lambda host, t: host.check_silence(t),
}
SCRIPTS = """
ready free  command arming  armed armed  idle releasing  armed releasing  ready releasing  ready free
ready free  command arming  armed armed  ready arming  armed armed  lost arming  armed armed
armed free  idle free  stop free  idle releasing
armed free  command armed
ready free  command arming  idle releasing  ready releasing  command arming
command arming  idle releasing  ready releasing  ready free  armed releasing  ready releasing
command arming  armed armed  fault fault  command fault  idle releasing  fault releasing  fault free
ready free  fault fault  ready free  command arming
latch free  ready free  fault fault  ready fault  command fault  clear free  command arming
latch free  fault fault  clear fault  ready free
command arming  trip fault  ready fault  clear free
ready free  silence free  silence free  silence offline  command offline  ready free
command arming  silence arming  silence arming  silence arming  silence offline  idle releasing
command arming  armed armed  silence armed  silence armed  silence offline  armed releasing
"""
"""What happens every 40 ms, each with the phase after it."""


@pytest.mark.parametrize("script", SCRIPTS.strip().splitlines())
def test_what_reports_and_commands_lead_to(script: str) -> None:
    host, words = make(latch="latch" in script), script.split()
    for at, (action, phase) in enumerate(zip(words[::2], words[1::2], strict=True)):
        ACTIONS[action](host, at * 40 * MS)
        assert host.phase is Phase[phase.upper()], f"{action} at {at}"


def test_idle_is_due_in_its_period_and_at_once_when_frames_were_lost() -> None:
    host = make()
    host.on_command(0, hold=False)
    host.on_idle(5 * MS)
    assert [t for t in range(60) if host.release_due(t * MS)] == [5, 25, 45]
    assert host.due() == [65 * MS, 0]
    host.resend(61 * MS)
    assert host.release_due(61 * MS)


def test_hold_is_where_the_first_of_the_present_holds_was_given() -> None:
    host, held = make(), []
    for at, (position, hold) in enumerate([(1.0, True), (1.5, True), (2.0, False), (3.0, True)]):
        host.on_report(at, Report(host, 1, Mode.ARMED, feedback=Feedback("m", at, position)))
        host.on_command(at, hold=hold)
        held.append(host.held)
    assert held == [1.0, 1.0, None, 3.0]


def test_a_code_that_is_in_no_table_is_a_fault_with_its_number() -> None:
    host = make()
    (fault,) = host.on_report(0, Report(host, 1, faults=(4711,)))
    assert isinstance(fault, Fault)
    assert (fault.code, fault.name) == (4711, "fault 4711")
    assert all((fault.cause, fault.remedy))


def test_states_and_faults_are_reported_when_they_change() -> None:
    host = make(latch=True)
    script = [(Mode.READY, ()), (Mode.READY, ()), (Mode.FAULT, (7,)), (Mode.FAULT, (7,)), (Mode.READY, ())]
    events = [host.on_report(t, Report(host, 1, mode, "x", codes)) for t, (mode, codes) in enumerate(script)]
    assert events == [
        [State("m", 0, Mode.READY, "x")],
        [],
        [Fault("m", 2, 7, "hot", "too much torque", "let it cool"), State("m", 2, Mode.FAULT, "x")],
        [],
        [State("m", 4, Mode.FAULT, "x, not cleared yet")],
    ]
    assert host.cleared(5) == [State("m", 5, Mode.READY, "x")]
    late = 4 + 100 * MS
    assert host.check_silence(late) == [State("m", late, Mode.OFFLINE, "no message for 100 ms")]
    assert host.check_silence(late + 1) == []
    assert host.on_report(late + 2, Report(host, 1, Mode.READY)) == [State("m", late + 2, Mode.READY)]
