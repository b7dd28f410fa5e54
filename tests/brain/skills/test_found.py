"""Skills of other distributions: found, read, checked, done, recorded, replayed; what a failing one does."""

from __future__ import annotations

import copy
from dataclasses import replace
from math import radians
from pathlib import Path

import pytest

import gateway as gw
from brain import doors
from brain.belief import Pose
from brain.bodies.limbs import Abilities
from brain.planning.missions import MissionPhase, Missions, why_not
from brain.skills import found
from brain.skills.skill import Done, Failed, Intent, Observed
from gateway.operator.commands import RejectedLine, help_text, parse
from protocols.message_codec import pack, unpack
from protocols.messages import MILLISECOND, STEPS, Mission, Perform, Plain, Repeat, Try, Wait
from tests.brain.helpers import BODY
from tests.distributions import ROOT, Site

EXAMPLE = ROOT / "examples" / "wiggle_and_steady"
WIGGLE = Perform("wiggle", (("angle", radians(20.0)), ("times", 2)))
FILE = "[[steps]]\nwiggle = 20\ntimes = 2\n[[steps]]\nwait = 0.5\n"
ABLE = Abilities(BODY, {}, ("lift",))
SKILL = """
from dataclasses import dataclass
from brain import reading
from brain.bodies.plane import Twist
from brain.skills.skill import *
from protocols.messages import Goal, Position, Velocity

@dataclass(frozen=True)
class Step:
    much: float = 1.0

class Doing:
    def __init__(self, step):
        self.step = step
    def advance(self, seen):
        return {result}
    def halt(self):
        pass

skill = Skill(name="odd", step=Step, own=reading.number, make=lambda given: Step(given["odd"]),
              text=lambda step: {text}, perform=Doing, wrong={wrong})
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    return Site(tmp_path / "site", monkeypatch)


def odd(site: Site, result: str = "Done()", text: str = "'odd'", wrong: str = "lambda *_: ''") -> None:
    source = SKILL.format(result=result, text=text, wrong=wrong)
    site.install("acme-skills", "odd = acme_odd:skill", source, group=found.GROUP)


def test_a_distribution_that_cannot_be_read_is_named_where_a_skill_is_missing(site: Site) -> None:
    site.install("acme-brakes", "brakes = acme_brakes:skill", group=found.GROUP)
    next(site.path.glob("acme_brakes*/entry_points.txt")).write_bytes(b"\xff\xfe")
    with pytest.raises(doors.NotFound, match="the entry points of acme-brakes cannot be read"):
        found.load("brakes")


def test_ours_are_all_there_and_each_does_a_step_of_its_own() -> None:
    assert set(found.ours()) == set(STEPS.values()) - {Repeat, Try, Perform}
    assert found.names() == ["goto", "drive", "turn_deg", "follow", "wait", "dock", "joints", "tool"]


# -- one that is sound ---------------------------------------------------------------------------


def test_a_file_and_a_line_name_it_as_they_name_ours(site: Site) -> None:
    site.project(EXAMPLE)
    diffbot = gw.load_robot("diffbot")
    mission = gw.parse_mission(FILE)
    assert mission.steps == (WIGGLE, Wait(0.5))
    assert unpack(pack(mission)) == mission
    once = replace(WIGGLE, values=(("angle", radians(20.0)), ("times", 1)))
    assert parse("wiggle 20deg", diffbot) == Mission("wiggle by 20°", (once,))
    assert "wiggle ANGLE" in help_text()
    assert parse("wiggle", diffbot) == RejectedLine("one angle is needed; expected: wiggle ANGLE")
    assert found.wrong(replace(WIGGLE, values=(("angle", 9.0),)), ABLE) == "up to 171°, and up to 100 times"
    assert found.wrong(WIGGLE, Abilities(None, {}, ())) == "wiggle: there is no base to drive"
    with pytest.raises(gw.ConfigError, match="step 1: times: found -1, expected a whole number, at least 0"):
        gw.parse_mission(FILE.replace("times = 2", "times = -1"))
    with pytest.raises(gw.ConfigError, match="no key 'tmies': there is wiggle, times, on_failure; did you"):
        gw.parse_mission(FILE.replace("times", "tmies"))


def test_it_is_done_recorded_and_replayed_to_the_byte(site: Site, tmp_path: Path) -> None:
    site.project(EXAMPLE)
    path = tmp_path / "wiggle.mcap"
    notes, yaws = list[str](), list[float]()
    with gw.open_session("diffbot", simulated=True, record=path) as session:
        for tick in session.run(seconds=20.0):
            notes += [note.text for note in tick.outputs.notes]
            yaws.append(session.pose.yaw if session.pose else 0.0)
            if tick.number == 300:
                session.submit(gw.parse_mission(FILE, "wiggle.toml"))
            if "mission wiggle: done" in notes:
                break
    assert "mission wiggle: step 1 of 2: wiggle by 20°" in notes
    assert "mission wiggle: step 1 of 2: done: 2 times" in notes
    assert max(yaws) == pytest.approx(radians(20.0), abs=0.05)
    assert min(yaws) == pytest.approx(radians(-20.0), abs=0.05)
    recording = gw.read_recording(path)
    assert recording.facts["plugin wiggle-and-steady"] == "1.0"
    assert gw.replay_recording(recording).ok


def test_a_replay_without_it_or_with_another_version_says_so(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.project(EXAMPLE)
    path = tmp_path / "wiggle.mcap"
    with gw.open_session("diffbot", simulated=True, record=path) as session:
        for tick in session.run(seconds=4.0):
            if tick.number == 300:
                session.submit(gw.parse_mission(FILE, "wiggle.toml"))
    (site.path / "wiggle_and_steady").unlink()
    (site.path / "wiggle_and_steady").mkdir()
    changed = (EXAMPLE / "wiggle_and_steady" / "wiggle.py").read_text().replace("* self.step.angle", "* -0.5")
    (site.path / "wiggle_and_steady" / "wiggle.py").write_text(changed)
    site.project(EXAMPLE, "1.1")
    said = gw.replay_recording(gw.read_recording(path)).text()
    assert "plugin wiggle-and-steady: '1.0' recorded, '1.1' now" in said
    monkeypatch.undo()
    said = gw.replay_recording(gw.read_recording(path)).text()
    assert "plugin wiggle-and-steady: '1.0' recorded, nothing now" in said
    assert "Mission refused: step 1: no skill 'wiggle': there is dock, drive" in said


def test_a_pause_and_a_copy_go_on_where_it_was(site: Site) -> None:
    site.project(EXAMPLE)
    missions, seen = Missions(), Observed(0, BODY, Pose(0.0, 0.0, 0.0))
    assert not missions.request(Mission("m", (WIGGLE,)), ABLE, "")
    assert missions.advance(seen).twist is not None
    missions.halt("a pause")
    assert not missions.resume()
    other = copy.deepcopy(missions)
    later = replace(seen, now=20 * MILLISECOND)
    assert missions.advance(later) == other.advance(later)
    view = missions.view()
    assert view is not None
    assert view.text == "wiggle by 20°"


# -- failing ones --------------------------------------------------------------------------------


TAKEN = """
from dataclasses import replace
from brain.skills import wait

skill = replace(wait.skill, name="odd")
"""
BROKEN = [
    ("skill = 5", "skill 'odd' of acme-skills is broken: acme_odd:skill is not a brain.skills.skill.Skill"),
    ("1 / 0", "skill 'odd' of acme-skills is broken: ZeroDivisionError: division by zero"),
    ("raise SystemExit(3)", "skill 'odd' of acme-skills is broken: SystemExit: 3"),
    (
        TAKEN,
        "skill 'odd' of acme-skills is broken: its step, Wait, is a skill's of ours; expected one of its own",
    ),
    ("from brain.skills.wait import skill", "skill 'odd' of acme-skills is broken: it calls itself 'wait'"),
]


@pytest.mark.parametrize(("source", "reason"), BROKEN)
def test_one_that_cannot_be_loaded_is_named_with_the_reason(site: Site, source: str, reason: str) -> None:
    site.install("acme-skills", "odd = acme_odd:skill", source, group=found.GROUP)
    with pytest.raises(gw.ConfigError) as raised:
        gw.parse_mission("[[steps]]\nodd = 1\n", "m.toml")
    assert str(raised.value) == f"m.toml:1: step 1: {reason}"
    assert why_not(Mission("m", (Perform("odd"),)), ABLE) == f"step 1: {reason}"
    assert parse("odd 1", gw.load_robot("diffbot")) == RejectedLine(reason)
    assert reason in help_text()
    assert gw.parse_mission("[[steps]]\nwait = 1\n").steps == (Wait(1.0),)


def test_two_with_one_name_are_none_and_our_names_cannot_be_taken(site: Site) -> None:
    odd(site)
    source = (site.path / "acme_odd.py").read_text()
    site.install("acme-more", "odd = acme_more:skill", source, group=found.GROUP)
    site.install("acme-wait", "wait = acme_wait:skill", source, group=found.GROUP)
    with pytest.raises(doors.Broken, match="skill 'odd' is acme-more and acme-skills's: uninstall one"):
        found.load("odd")
    assert found.load("wait").step is Wait


def test_a_distribution_that_cannot_be_read_hides_no_other(site: Site) -> None:
    odd(site)
    site.install("acme-worse", "worse = acme_worse:skill", group=found.GROUP)
    next(site.path.glob("acme_worse*/entry_points.txt")).write_bytes(b"\xff\xfe")
    assert found.load("odd").name == "odd"
    assert found.load("wait").step is Wait


WRONG = [
    ("1 / 0", "skill 'odd' of acme-skills 1.0 has failed: ZeroDivisionError: division by zero"),
    (
        "5",
        "skill 'odd' of acme-skills 1.0 has failed: TypeError: it returned int, not Intent, Done or Failed",
    ),
    (
        "Intent(twist=Twist(float('nan')))",
        "odd wants what it may not: a twist that is not finite: (nan, 0.0, 0.0)",
    ),
    (
        "Intent(goal=Goal(1e9, 0.0))",
        "odd wants what it may not: a goal: its x must be from -1000000",
    ),
    (
        "Intent(goal=Goal(None, 0.0))",
        "odd wants what it may not: a goal: its x is None, and must be a finite",
    ),
    ("Intent(targets=(Velocity('left', 1.0),))", "a target: 'left' is no joint that takes a target"),
    ("Intent(targets=(Position('lift', float('inf')),))", "its position is inf, and must be a finite number"),
    ("Intent(targets=(3,))", "skill 'odd' of acme-skills 1.0 has failed: TypeError"),
    ("Intent(seconds=-1.0)", "odd wants what it may not: its time must be from 0"),
    ("Failed('x' * 999)", "x" * found.MOST_TEXT),
]


@pytest.mark.parametrize(("result", "reason"), WRONG, ids=[row[0] for row in WRONG])
def test_what_a_failing_one_does_fails_its_step_in_words(site: Site, result: str, reason: str) -> None:
    odd(site, result)
    missions = Missions()
    assert not missions.request(Mission("m", (Perform("odd"), Wait(1.0))), ABLE, "")
    assert missions.advance(Observed(0, BODY)) == Intent()
    assert missions.phase is MissionPhase.FAILED
    assert reason in missions.reason


def test_one_that_fails_where_it_is_only_asked_is_refused_or_has_a_name(site: Site) -> None:
    odd(site, text="1 / 0", wrong="lambda *_: {}['x']")
    assert found.text(Perform("odd")) == "do odd"
    assert found.wrong(Perform("odd"), ABLE) == "skill 'odd' of acme-skills 1.0 has failed: KeyError: 'x'"
    assert "TypeError: Step.__init__() got an unexpected keyword" in found.wrong(
        Perform("odd", (("colour", "red"),)), ABLE
    )
    deep: Plain = 1.0
    for _ in range(9):
        deep = (deep,)
    values: list[Plain] = [float("nan"), 10**400, (1,) * 65, deep]
    for value in values:
        assert "its values have what is no finite" in found.wrong(Perform("odd", (("much", value),)), ABLE)


def test_one_that_fails_where_it_is_read_is_a_mistake_in_the_file_and_a_rejected_line(site: Site) -> None:
    source = SKILL.format(result="Done()", text="'odd'", wrong="lambda *_: ''")
    source = source.replace("Step(given['odd'])", "Step(given)").replace('Step(given["odd"])', "Step(given)")
    source = source.replace(
        "perform=Doing", "perform=Doing, words=Words('', '', lambda words, able: words.x)"
    )
    site.install("acme-skills", "odd = acme_odd:skill", source, group=found.GROUP)
    failed = "skill 'odd' of acme-skills 1.0 has failed: "
    with pytest.raises(gw.ConfigError, match=f"step 1: {failed}TypeError: .* has what is no finite number"):
        gw.parse_mission("[[steps]]\nodd = 1\n")
    rejected = parse("odd 1", gw.load_robot("diffbot"))
    assert isinstance(rejected, RejectedLine)
    assert rejected.reason.startswith(f"{failed}AttributeError: 'list' object has no attribute 'x'")


def test_a_result_that_is_sound_passes(site: Site) -> None:
    odd(site, "Done('it is')")
    assert found.perform(Perform("odd"), ABLE).advance(Observed(0)) == Done("it is")
    assert isinstance(found.perform(Perform("none_such"), ABLE).advance(Observed(0)), Failed)
