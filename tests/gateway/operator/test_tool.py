"""The operator's command that brings an arm's tip to a place."""

from __future__ import annotations

import math

import pytest

from gateway.config import load_robot
from gateway.operator.commands import RejectedLine, parse
from protocols.messages import Mission, MoveTool

ARM, BASE = load_robot("arm"), load_robot("diffbot")


@pytest.mark.parametrize(
    ("line", "step"),
    [
        ("tool 0.3 0 0.2", MoveTool(0.3, 0.0, 0.2)),
        ("tool 0.3 0 0.2 0 180 90", MoveTool(0.3, 0.0, 0.2, (0.0, math.pi, math.pi / 2))),
    ],
)
def test_a_place_is_a_mission_of_one_step(line: str, step: MoveTool) -> None:
    assert parse(line, ARM) == Mission("bring the tool to (0.3, 0, 0.2)", (step,))


def test_what_is_no_place_and_who_has_no_arm_is_told_so() -> None:
    for line, robot, text in (("tool 1 2", ARM, "three numbers"), ("tool 1 2 3", BASE, "there is no arm")):
        found = parse(line, robot)
        assert isinstance(found, RejectedLine)
        assert text in str(found)
