"""Two signals at random distances: a sample. tests/prove has 200 runs of each kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.gateway.two_signals import ROBOT, compare, one_run
from tests.real_can.programs import Program


@contextmanager
def served(folder: Path) -> Iterator[tuple[Callable[[], Program], Program]]:
    """Yield what starts a run, and the simulated devices that all runs share."""
    robot = folder / "rig.toml"
    robot.write_text(ROBOT)
    with Program(folder, "twin", str(robot), "-v") as twin:
        bus = twin.find(r"--bus (can0=slcan:\S+)")
        yield lambda: Program(folder, "run", str(robot), "--bus", bus, "-v"), twin


@pytest.mark.timeout(240)
def test_after_two_signals_every_motor_is_disarmed(tmp_path: Path) -> None:
    with served(tmp_path) as (start, twin):
        outcomes = [one_run(start, twin, 11, number) for number in range(2)]
    assert any(one.armed for one in outcomes)


def test_after_two_signals_nothing_turns_faster_than_after_one(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(ROBOT)
    for number in (4, 6):  # while they brake
        compare(str(tmp_path / "rig.toml"), 5, number)
