"""Two signals at random distances, over a pseudo-terminal: a sample. tests/prove has 200 runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.gateway.two_signals import ROBOT, one_run
from tests.real_can.programs import Program


@contextmanager
def served(folder: Path) -> Iterator[tuple[Callable[[], Program], Program]]:
    """Yield what starts a run, and the simulated devices that all runs share."""
    robot = folder / "rig.toml"
    robot.write_text(ROBOT)
    with Program(folder, "twin", str(robot), "-v") as twin:
        twin.until("--bus can0=slcan:")
        (bus,) = re.findall(r"--bus (can0=slcan:\S+)", twin.text)
        yield lambda: Program(folder, "run", str(robot), "--bus", bus, "-v"), twin


@pytest.mark.timeout(240)
def test_after_two_signals_every_motor_is_disarmed(tmp_path: Path) -> None:
    with served(tmp_path) as (start, twin):
        outcomes = [one_run(start, twin, 11, number) for number in range(3)]
    assert any(one.armed for one in outcomes)
