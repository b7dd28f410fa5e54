"""Two signals at random distances to a robot on vcan0: the devices report that every motor is disarmed.

A sample; for more, from the project's folder:
python -m tests.real_can run env TWO_SIGNALS=60 .venv/bin/python -m pytest -s -m real_can (this file)"""

from __future__ import annotations

import os
from pathlib import Path

from tests.gateway.two_signals import ROBOT, one_run, summary
from tests.real_can.programs import Program

RUNS = int(os.environ.get("TWO_SIGNALS", "1"))


def test_after_two_signals_every_motor_is_disarmed(vcan0: str, tmp_path: Path) -> None:
    robot = tmp_path / "rig.toml"
    robot.write_text(ROBOT.replace("rate_hz = 200", "rate_hz = 50"))  # less work to emulate
    bus = ("--bus", f"can0=socketcan:{vcan0}", "-v")
    with Program(tmp_path, "twin", str(robot), *bus) as twin:
        twin.until("to run the robot:\n")
        outcomes = [
            one_run(lambda: Program(tmp_path, "run", str(robot), *bus), twin, 12, number)
            for number in range(RUNS)
        ]
    print(summary(outcomes))
    assert any(one.armed for one in outcomes)
