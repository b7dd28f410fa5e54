"""`--only PART`: a setting differs at the border of its own part, and at none before."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

import gateway as gw
from brain.other_brain import BrainKind, Chosen, Moment
from gateway.cli.main import main
from gateway.config import parse_robot
from gateway.config.one_setting import with_setting
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay import one_part
from gateway.replay.one_part import PartAlone, differences, run_alone
from protocols.messages import Command

OWN = [
    ("perception", "brain.perception.map.miss", 0.6, "sight.map"),
    ("planning", "brain.planner.comfort", 0.8, "course.path"),
    ("control", "brain.pursuit.lookahead_time", 1.2, "left: velocity"),
    ("driver", "motors.left.gear", 8.1, "left: obeys Velocity.velocity"),
    ("guard", "motors.left.limits.velocity", 3.0, "velocity beyond the limit (3."),
]
"""Part; a setting of it; its value; a value that it changes, in words"""
BEFORE = {"planning": "perception", "control": "planning", "driver": "control", "guard": "control"}
"""Limits are the joint's, too, which the driver's border has in it."""


@pytest.fixture(scope="module")
def goal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A base that sets out for a goal."""
    path = tmp_path_factory.mktemp("parts") / "goal.mcap"
    with gw.open_session("diffbot", simulated=True, record=path) as session:
        session.submit(gw.Goal(0.6, 0.1))
        for _ in session.run(1.2):
            pass
    return path


def alone(path: Path, part: str, key: str, value: float) -> PartAlone:
    recording = read_recording(path)
    return run_alone(
        recording, parse_robot(with_setting(recording.robot_text, key, value), "robot.toml"), part
    )


@pytest.mark.parametrize(("part", "key", "value", "changed"), OWN)
def test_a_setting_differs_at_its_own_border(
    goal: Path, part: str, key: str, value: float, changed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(goal), "--only", part, "--set", f"{key}={value}"]) == 1
    told = capsys.readouterr().out
    assert changed in told
    if part != "guard":
        (differing,) = re.findall(r"^(\d+) of \d+ ticks differ$", told, re.MULTILINE)
        assert int(differing) > 0
        assert "is not the recorded one" not in told


@pytest.mark.parametrize(("part", "key", "value", "_changed"), [one for one in OWN if one[0] in BEFORE])
def test_it_does_not_at_the_border_before(
    goal: Path, part: str, key: str, value: float, _changed: str
) -> None:
    found = alone(goal, BEFORE[part], key, value)
    assert found.same, found.lines()
    assert found.ticks > 200


def test_a_part_that_raises_is_a_sentence(
    goal: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_given: object) -> None:
        raise KeyError("lookahead")

    monkeypatch.setattr(one_part._Beside, "take", broken)
    assert main(["replay", str(goal), "--only", "control", "--set", "brain.pursuit.lookahead_time=1.2"]) == 2
    said = capsys.readouterr().err
    assert "control, with the other settings, raised KeyError 0.000 s after the start: 'lookahead'" in said


def test_how_far_values_are_apart_and_when_is_told() -> None:
    found = PartAlone("control")
    for tick, (one, two) in enumerate([(1.0, 1.0), (2.0, 2.5), (3.0, 5.0), (4.0, 4.25)]):
        found.take(tick * 1_000_000, differences("", {"left": {"v": one}}, {"left": {"v": two}}))
    assert found.lines() == [
        "control alone, on what it was given in 4 recorded ticks",
        "first in tick 1, 0.001 s after the start: left: v",
        "  recorded: 2",
        "  now:      2.5",
        "3 of 4 ticks differ",
        "  left: v: in 3 ticks, by 2 at most, at 0.002 s",
    ]


def test_a_folder_is_judged_by_one_part(goal: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", str(goal.parent), "--only", "control", "--set", "brain.planner.comfort=0.8"]) == 0
    assert "control alone: 1 of 1 recordings give the same" in capsys.readouterr().out


def test_a_recording_that_is_not_given_again_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    path = "fixtures/recordings/format1.mcap"
    assert main(["replay", path, "--only", "control", "--set", "rate_hz=200"]) == 1
    assert "with the recorded settings the replay of the whole is not" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("--only planning", "give --robot ROBOT, or --set KEY=VALUE"),
        ("--set brain.pursuit.lookahead_time=1", "give --only PART"),
        ("--only control --robot bench", "the buses of the recorded robot are can0, sensors"),
        ("--only driver --set motors.left.gear=8 --report x.html", "leave --report away"),
    ],
)
def test_what_cannot_be_run_alone_is_refused(
    goal: Path, given: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(goal), *given.split()]) == 2
    assert text in capsys.readouterr().err


def test_a_brain_of_another_distribution_has_no_parts(goal: Path) -> None:
    recording = read_recording(goal)
    robot = parse_robot(recording.robot_text, "robot.toml")
    other = Chosen(BrainKind(name="turning", settings=object, make=Turning), None, "acme 1.0")
    with pytest.raises(UserError, match="'turning' is of another distribution, and has no control"):
        run_alone(recording, replace(robot, brain=replace(robot.brain, other=other)), "control")


class Turning:
    """A brain that wants nothing."""

    def __init__(self, _settings: object, _motors: object) -> None:
        pass

    def step(self, _moment: Moment) -> list[Command]:
        return []
