"""A brain of another distribution: it drives, is recorded, replayed; what a failing one does to the robot."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path

import pytest

import gateway as gw
from brain.bodies import bare
from brain.brain import brain_of
from brain.other_brain import GROUP, BrainFailed, BrainKind, Chosen, Moment, OtherBrain
from brain.settings import BrainSettings
from gateway.core.faults import BRAIN_FAILED
from gateway.core.tick import Tick
from protocols import messages as msg
from protocols.messages import MILLISECOND, Command, Drive, Event, Feedback, Idle, Imu, Velocity
from tests.distributions import ROOT, Site
from tests.gateway.rig import BENCH, Rig, sent_commands

EXAMPLE = ROOT / "examples" / "wiggle_and_steady"
TABLE = """[brain]
kind = "steady"
body = "differential"

[brain.steady]
left = "left"
right = "right"
gyro = "imu"
wheel_radius = 0.05
track = 0.22
"""
ODD = """
from dataclasses import dataclass
from brain.other_brain import BrainKind
from protocols.messages import *

@dataclass(frozen=True)
class Settings:
    pass

class Odd:
    def __init__(self, settings, motors):
        self.steps = 0
    def step(self, moment):
        self.steps += 1
        return {result} if self.steps > 100 else [Velocity("left", 2.0), Velocity("right", 2.0)]

kind = BrainKind(name="odd", settings=Settings, make=Odd)
"""
ODD_BENCH = BENCH.replace('body = "joints"\n', 'body = "joints"\nkind = "odd"\n')
FAILED = "the brain 'odd' of acme-brains 1.0 has failed"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    return Site(tmp_path / "site", monkeypatch)


def odd(site: Site, result: str) -> None:
    site.install("acme-brains", "odd = acme_odd:kind", ODD.format(result=result), group=GROUP)


def steady_text(table: str = TABLE) -> str:
    text = (ROOT / "fixtures" / "robots" / "diffbot.toml").read_text()
    return text.replace('[brain]\nbody = "differential"\n', table)


# -- one that is sound ---------------------------------------------------------------------------


def test_it_drives_by_hand_and_its_recording_replays_to_the_byte(site: Site, tmp_path: Path) -> None:
    site.project(EXAMPLE)
    path, notes = tmp_path / "steady.mcap", list[str]()
    with gw.open_session(gw.parse_robot(steady_text()), simulated=True, record=path) as session:
        for tick in session.run(seconds=4.0):
            notes += [note.text for note in tick.outputs.notes]
            if tick.number % 20 == 10 and 2.0 < tick.seconds < 3.0:
                session.submit(Drive(0.3, 1.0))
            if tick.number == 700:
                session.submit(gw.Goal(1.0, 0.0))
        assert session.twins is not None
        true = session.twins.world.truth()
    assert true.yaw == pytest.approx(1.2, abs=0.1)  # 1.2 s of a hand's 1 rad/s
    assert "brain" not in "".join(text for text in notes if "failed" in text)
    assert "Goal refused: the brain 'steady' takes Drive" in notes
    recording = gw.read_recording(path)
    assert recording.facts["plugin wiggle-and-steady"] == "1.0"
    assert gw.replay_recording(recording).ok
    assert gw.write_report(recording, tmp_path / "steady.html").ok
    assert "commands by the brain 'steady' of wiggle-and-steady 1.0" in gw.describe(session.robot)


def test_its_settings_are_read_with_their_bounds_and_all_mistakes_at_once(site: Site) -> None:
    site.project(EXAMPLE)
    wrong = TABLE.replace("track = 0.22", "track = 22.0\ngian = 1").replace("wheel_radius = 0.05\n", "")
    with pytest.raises(gw.ConfigError) as raised:
        gw.parse_robot(steady_text(wrong), "r.toml")
    said = [str(mistake).partition(": ")[2] for mistake in raised.value.mistakes]
    assert "brain.steady.wheel_radius: missing; expected a finite number from 0.01 to 1 m" in said
    assert "brain.steady.track: found 22.0, expected a finite number from 0.05 to 5 m" in said
    assert any(text.startswith("brain.steady.gian: no key 'gian'") for text in said)
    with pytest.raises(gw.ConfigError, match=r"brain\.steady: there is no motor lift"):
        gw.parse_robot(steady_text(TABLE.replace('left = "left"', 'left = "lift"')))


NAMES = [
    ('"stedy"', "no brain 'stedy': there is steady; did you mean 'steady'?"),
    ("5", "found 5, expected the name of a brain that is installed"),
    ('"planner"', 'found "planner", expected the name of a brain that is installed'),
]


@pytest.mark.parametrize(("name", "reason"), NAMES)
def test_what_is_no_brain_is_a_mistake_in_the_robot_file(site: Site, name: str, reason: str) -> None:
    site.project(EXAMPLE)
    with pytest.raises(gw.ConfigError) as raised:
        gw.parse_robot(steady_text(TABLE.replace('"steady"', name, 1)))
    assert f"brain.kind: {reason}" in str(raised.value)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("1 / 0", "brain 'odd' of acme-brains is broken: ZeroDivisionError: division by zero"),
        ("kind = 3", "acme_odd:kind is not a brain.other_brain.BrainKind"),
        (ODD.replace("self.steps = 0", "1 / 0").format(result="[]"), "it is broken: ZeroDivisionError"),
        (ODD.replace('name="odd"', 'name="even"').format(result="[]"), "it calls itself 'even'"),
    ],
)
def test_a_broken_one_is_named(site: Site, source: str, reason: str) -> None:
    site.install("acme-brains", "odd = acme_odd:kind", source, group=GROUP)
    with pytest.raises(gw.ConfigError, match=r"brain\.") as raised:
        gw.parse_robot(ODD_BENCH)
    assert reason in str(raised.value)


# -- failing ones --------------------------------------------------------------------------------

WRONG = [
    ("1 / 0", "ZeroDivisionError: division by zero"),
    ("exit(3)", "SystemExit: 3"),
    ("[Velocity('left', float('nan'))]", "its Velocity to left: its velocity is nan, and must be a finite"),
    ("[Velocity('left', '2')]", "its Velocity to left: its velocity is '2', and must be a finite number"),
    ("[Velocity('arm', 1.0)]", "it commands 'arm'; there are left, right"),
    ("[Idle('left'), Idle('left')]", "it gives 'left' two commands"),
    ("['left']", "it returned str, which is no command"),
    ("iter(lambda: Idle('right'), 5)", "it gives 'right' two commands"),
    ("None", "TypeError: 'NoneType' object is not iterable"),
]


@pytest.mark.sample(3)
@pytest.mark.parametrize(("result", "cause"), WRONG, ids=[row[0] for row in WRONG])
def test_a_failing_one_stops_the_robot_with_a_latched_fault_and_the_loop_goes_on(
    site: Site, result: str, cause: str
) -> None:
    odd(site, result)
    rig = Rig(ODD_BENCH)
    ticks = rig.run(2.0)
    notes = [note.text for tick in ticks for note in tick.outputs.notes]
    faults = [text for text in notes if FAILED in text and text.startswith("fault: ")]
    assert len(faults) == 2  # one for each joint, once
    assert cause in faults[0]
    assert moving(ticks) == {"left", "right"}
    assert rig.velocity("left") == rig.velocity("right") == pytest.approx(0.0, abs=0.01)
    assert all(fault.code == BRAIN_FAILED for j in rig.gateway.joints.values() for fault in j.faults.values())
    assert rig.gateway.why_stopped() == f"left: {FAILED}"
    assert all(isinstance(command, Idle) for _, command in sent_commands(rig.robot, rig.run(0.2)))


def moving(ticks: Sequence[Tick]) -> set[str]:
    return {
        event.motor
        for tick in ticks
        for event in tick.outputs.events
        if isinstance(event, Feedback) and abs(event.velocity or 0.0) > 1.0
    }


def test_it_begins_anew_once_its_faults_are_cleared(site: Site) -> None:
    odd(site, "1 / 0")
    rig = Rig(ODD_BENCH)
    rig.run(2.0)
    notes = [note.text for tick in rig.run(1.0, msg.ClearFault("all")) for note in tick.outputs.notes]
    assert any("running" in text for text in notes)
    assert sum(FAILED in text for text in notes if text.startswith("fault: ")) == 2  # 100 steps later


# -- when it is asked ----------------------------------------------------------------------------


class Turning:
    """Turns, faster at every step."""

    def __init__(self, settings: object, motors: Sequence[str]) -> None:
        self.moments: list[Moment] = []

    def step(self, moment: Moment) -> list[Command]:
        self.moments.append(moment)
        return [Velocity("left", float(len(self.moments)))]


CHOSEN = Chosen(BrainKind(name="turning", settings=object, make=Turning, takes=(Velocity,)), None, "acme 1.0")
TIMEOUTS = {"left": 100 * MILLISECOND, "right": 100 * MILLISECOND, "imu": 100 * MILLISECOND}


def brain() -> OtherBrain:
    from brain.perception.mount import Mount

    settings = BrainSettings(bare(["left", "right"]), other=CHOSEN)
    made = brain_of(settings, ["left", "right"], {"imu": Mount()}, TIMEOUTS)
    assert isinstance(made, OtherBrain)
    return made


def heard(now: int, imu: bool = True) -> list[Event]:
    motors: list[Event] = [Feedback(name, now, 1.0, None, torque=0.5) for name in ("left", "right")]
    return [*motors, *[Imu("imu", now, (0.0, 0.0, 0.1), (0.0, 0.0, 9.8))] * imu]


def test_it_is_asked_once_all_have_reported_and_anew_after_a_stop() -> None:
    made, idle = brain(), [Idle("left"), Idle("right")]
    assert made.step(0, heard(0, imu=False), [], "") == idle
    assert made.belief().reason == "waiting for a reading of imu"
    assert made.step(1, heard(1), [Velocity("left", 1.0), Drive(1.0, 0.0)], "")[0] == Velocity("left", 1.0)
    assert next(text for _, text in made.take_notes()) == "Drive refused: the brain 'turning' takes Velocity"
    assert made.step(2, [Feedback("left", 2, velocity=3.0)], [], "")[0] == Velocity("left", 2.0)
    commander = made._commander
    assert isinstance(commander, Turning)
    last = commander.moments[-1]
    assert last.joints["left"] == Feedback("left", 2, 1.0, 3.0, 0.5)
    assert isinstance(last.readings["imu"], Imu)
    assert [len(moment.tasks) for moment in commander.moments] == [1, 0]
    assert made.step(3, heard(3), [Velocity("left", 1.0)], "by hand") == idle
    assert made.belief().reason == "by hand"
    assert made.step(4, heard(4), [], "")[0] == Velocity("left", 1.0)


def test_a_source_that_is_lost_is_a_failure_and_its_settings_stay() -> None:
    made = brain()
    made.step(0, heard(0), [], "")
    late = 95 * MILLISECOND
    with pytest.raises(BrainFailed, match="imu: no reading for more than 90 ms"):
        made.step(late, heard(late, imu=False), [], "")
    assert made.set("gain", 1.0) == "gain is fixed at the start: change it in the robot file"


def test_a_copy_goes_on_as_the_original() -> None:
    made = brain()
    made.step(0, heard(0), [], "")
    other = copy.deepcopy(made)
    for now in (1, 2, 3):
        assert made.step(now, heard(now), [], "") == other.step(now, heard(now), [], "")
