"""Scenarios: every one that ships holds, and fails when the defect that it is for is put back; bad files."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from brain.perception.motion_check import MotionCheck
from brain.perception.perception import Perception
from brain.planning.path_watch import PathWatch
from brain.planning.stop_zone import StopZone
from gateway.cli.main import main
from gateway.config import resources
from gateway.core.arming import Arming
from gateway.core.following import Following
from gateway.core.robot import Motor, Robot
from gateway.errors import ConfigError
from gateway.runtime.scenario import run_scenario, verdicts
from gateway.runtime.scenario_file import load_scenario, parse_scenario
from gateway.runtime.session import open_session
from protocols.messages import MILLISECOND, SECOND

SHIPPED = sorted(resources.shipped("scenarios").glob("*.toml"))
Change = Callable[[Robot], Robot]


def joints(**settings: Any) -> Change:
    """Give every joint other settings."""

    def change(robot: Robot) -> Robot:
        motors = {
            name: replace(one, joint=replace(one.joint, **settings)) for name, one in robot.motors.items()
        }
        return replace(robot, motors=motors)

    return change


def weak(robot: Robot) -> Robot:
    def changed(one: Motor) -> Motor:
        settings: Any = one.device.settings
        return replace(one, device=replace(one.device, settings=replace(settings, current_soft_max=0.5)))

    return replace(robot, motors={name: changed(one) for name, one in robot.motors.items()})


def impatient(robot: Robot) -> Robot:
    health = replace(robot.brain.health, give_up=300 * MILLISECOND)
    return replace(robot, brain=replace(robot.brain, health=health))


def same(robot: Robot) -> Robot:
    return robot


LATE = joints(feedback_timeout=2 * SECOND)
Broken = tuple[tuple[type, str, object], ...]
DISARMED: Broken = ((Arming, "on_state", lambda *_, **__: False),)
TURNS: Broken = tuple((MotionCheck, name, lambda *_: "") for name in ("_compare_turns", "_difference"))
FOLLOWING: Broken = ((Following, "judge", lambda *_: None),)
ROUND: Broken = (
    (StopZone, "allowed", lambda _, previous, desired, wanted, dt: desired),
    (PathWatch, "begin_check", lambda *_: ""),
    (PathWatch, "check", lambda *_: ""),
)
BEAMS: Broken = ((Perception, "_set_absent", lambda *_: None),)

# fmt: off
PUT_BACK: dict[str, tuple[Change, Broken, str]] = {
    # scenario: the robot with the defect, what of the program is put out of action, and what must not hold
    "brown_out": (LATE, DISARMED, "must.tell.restart"),
    "bus_gone": (LATE, (), "must.tell.left"),
    "cable_out": (LATE, (), "must.tell.silence"),
    "encoder_stuck": (same, FOLLOWING, "must.tell.stuck"),
    "imu_saturates": (same, TURNS, "must.tell.disagreement"),
    "lidar_blocked": (same, BEAMS, "must.tell.cover"),
    "lidar_returns": (impatient, (), "must.reach.goal"),
    "load_step": (weak, (), "must.turn.under_load"),
    "motor_blocked": (same, FOLLOWING, "must.tell.blocked"),
    "wall_appears": (same, ROUND, "never.touches"),
}
# fmt: on


@pytest.mark.sample(3)
@pytest.mark.parametrize("path", SHIPPED, ids=[path.stem for path in SHIPPED])
def test_a_scenario_that_ships_goes_as_it_must(path: Path) -> None:
    result = run_scenario(load_scenario(path))
    assert result.passed, result.details


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", PUT_BACK)
def test_it_fails_when_the_defect_is_put_back(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    change, broken, fails = PUT_BACK[name]
    for owner, attribute, instead in broken:
        monkeypatch.setattr(owner, attribute, instead)
    result = run_scenario(load_scenario(name, change))
    assert fails in [one.name for one in result.verdicts if not one.holds]


def test_every_scenario_that_ships_has_its_defect() -> None:
    assert {path.stem for path in SHIPPED} == PUT_BACK.keys()
    assert len(SHIPPED) >= 10


# -- the file -------------------------------------------------------------------------------------------

BENCH = """name = "x"
robot = "bench"
seconds = 2.0
asks.go = { at = 0.5, line = "velocity left 4" }
faults.cable = { at = 1.0, cause = "device silent", on = "left" }
must.tell.it = { after = "cable", within = 0.3, on = "left", text = "silent" }
"""
DIFFBOT = """name = "x"
robot = "diffbot"
seconds = 2.0
asks.go = { at = 0.5, line = "goal 1 0" }
walls.late = { at = 1.0, start = [1, -1], end = [1, 1] }
never.touches = 0
"""
TOLD = ', on = "left", text = "silent"'
TURN = 'must.turn.t = { within = 1.0, on = "", velocity = 1, tolerance = 1 }\n# '
WALL = "walls.w = { at = 1, start = [0, 0], end = [1, 0] }\nasks.go"
# fmt: off
WRONG = [
    # the text, what is written instead of what, and what is told
    (BENCH, "seconds = 2.0", "seconds = 0", r"x\.toml:3: seconds: found 0, expected a finite number"),
    (BENCH, "seconds = 2.0", 'second = 2.0', r"seconds: missing; .*\n.*no key 'second'"),
    (BENCH, '"bench"', '"bunch"', r"x\.toml:2: robot: 'bunch' is neither a \.toml file .*'bench'"),
    (BENCH, "velocity left 4", "velocity lift 4", r"asks\.go\.line: found 'velocity lift 4': .*'lift'"),
    (BENCH, "velocity left 4", "status", r"asks\.go\.line: found 'status': it asks nothing"),
    (BENCH, "device silent", "device silly", r"faults\.cable\.cause: .*did you mean 'device silent'"),
    (BENCH, "device silent", "lidar silent", r"faults\.cable\.on: .*'left'"),
    (BENCH, "at = 1.0", "at = 2.0", r"faults\.cable\.at: 2 s is after the end, at 2 s"),
    (BENCH, "asks.go", "asks.cable", r"cable: something else that happens has this name"),
    (BENCH, 'after = "cable"', 'after = "cabel"', r"must\.tell\.it\.after: .*did you mean 'cable'"),
    (BENCH, "within = 0.3", "within = 1.3", r"must\.tell\.it\.within: this is after the end, at 2 s"),
    (BENCH, 'on = "left", text', 'on = "lefd", text', r"must\.tell\.it\.on: .*did you mean 'left'"),
    (BENCH, "must.tell.it = ", "must.stand.it = ", r"must\.stand\.it\.text: no key 'text'"),
    (BENCH, "must.tell.it = ", "# ", r"nothing must hold: expected a table \[must\.…\] or \[never\]"),
    (BENCH, "must.tell.it = ", "must.reach.g = { within = 1.0 }\n# ", r"must\.reach\.g: 'bench' has no base"),
    (BENCH, "must.tell.it = ", "never.faster = 1.0\n# ", r"never\.faster: 'bench' has no base"),
    (BENCH, "must.tell.it = ", TURN, r"must\.turn\.t\.on: "),
    (BENCH, "asks.go", WALL, r"walls: 'bench' is in no place"),
    (DIFFBOT, "end = [1, 1]", "end = [1, -1]", r"walls\.late\.end: end must be farther from start"),
    (DIFFBOT, "walls.late", "walls.south", r"walls\.south: the world 'office' has a wall of this name"),
    (DIFFBOT, "seconds = 2.0", 'seconds = 2.0\nworld = "offise"', r"world: 'offise' is neither .*'office'"),
    (DIFFBOT, "never.touches = 0", "never.touches = -1", r"never\.touches: found -1, expected an integer"),
]
# fmt: on


@pytest.mark.parametrize(("text", "before", "after", "told"), WRONG)
def test_a_wrong_file_is_told_with_key_and_line(text: str, before: str, after: str, told: str) -> None:
    assert before in text
    parse_scenario(text, Path("x.toml"))
    with pytest.raises(ConfigError) as raised:
        parse_scenario(text.replace(before, after, 1), Path("x.toml"))
    assert re.search(told, str(raised.value)), str(raised.value)


def test_all_mistakes_are_told_at_once() -> None:
    text = BENCH.replace("seconds = 2.0", 'seconds = "2"').replace("device silent", "fire")
    with pytest.raises(ConfigError) as raised:
        parse_scenario(text, Path("x.toml"))
    assert [(one.line, one.key) for one in raised.value.mistakes] == [
        (3, "seconds"),
        (5, "faults.cable.cause"),
    ]


def test_a_run_that_ends_before_its_time_has_failed() -> None:
    scenario = parse_scenario(
        BENCH.replace("must.tell.it", "must.stand.it").replace(TOLD, ""), Path("x.toml")
    )
    with open_session(scenario.robot, simulated=True) as session:
        session.watch(lambda tick, _: session.leave("a signal") if tick.number == 200 else None)
        found = verdicts(scenario, session)
    assert [one.name for one in found] == ["must.stand.it", "seconds"]
    assert not found[1].holds
    assert re.search(r"it ended after \d\.\d\d of 2 s: a signal", found[1].text)


# -- the command, and pytest --------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two scenarios, of which one fails."""
    (tmp_path / "good.toml").write_text(BENCH)
    (tmp_path / "bad.toml").write_text(BENCH.replace("within = 0.3", "within = 0.01"))
    return tmp_path


def test_the_command_runs_a_folder_and_writes_junit_and_recordings(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit, records = folder / "junit.xml", folder / "records"
    records.mkdir()
    arguments = ["scenario", str(folder), "--junit", str(junit), "--record", str(records)]
    assert main(arguments) == 1
    shown = capsys.readouterr().out
    assert "good.toml: x: ok\n1 of 2 scenarios went as they must\n" in shown
    assert re.search(
        r"bad\.toml: x: FAILED, 1 of 1\n  must\.tell\.it: 'silent' of left: told after 0\.\d\d s", shown
    )
    suite = ET.parse(junit).getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    failed = [one.get("name") for one in suite if one.find("failure") is not None]
    assert failed == [str(folder / "bad.toml")]
    assert main(["replay", str(records / "good.mcap")]) == 0
    assert main(["scenario", str(folder / "nothing.toml")]) == 2
    assert main(["scenario", str(records)]) == 2
    assert "no scenario file (.toml) in this folder" in capsys.readouterr().err


TEST = """
import pytest

@pytest.mark.scenarios("good.toml")
def test_scenario(scenario):
    assert scenario.run().passed

@pytest.mark.robot("bench", seed=3)
def test_session(session):
    ticks = sum(1 for _ in session.run(0.5))
    assert ticks > 90 and session.robot.name == "bench"

def test_without_a_mark(session):
    pass
"""


def test_pytest_runs_a_folder_and_tests_have_scenarios_and_sessions(folder: Path) -> None:
    (folder / "test_own.py").write_text(TEST)
    loaded = [
        "-p",
        "no:motor_gateway",
        "-p",
        "gateway.testing",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(folder),
    ]
    command = [sys.executable, "-m", "pytest", "-v", *loaded, "--scenario", str(folder), "test_own.py"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert re.search(r"1 failed, 3 passed, 1 error", done.stdout), done.stdout
    assert re.search(r"bad\.toml: x: FAILED, 1 of 1\n  must\.tell\.it: 'silent' of left: told", done.stdout)
    assert "needs @pytest.mark.robot(ROBOT)" in done.stdout
