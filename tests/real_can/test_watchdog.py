"""A loop on vcan0 that is killed, or hangs: the watchdog process disarms its motors, which have none."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.gateway.rig import BENCH
from tests.gateway.two_signals import settled
from tests.real_can.programs import Program

ROBOT = "stall_timeout_ms = 2000\n" + BENCH.replace("rate_hz = 200", "rate_hz = 50").replace(
    "limits = {", "feedback_timeout_ms = 2000\ncommand_timeout_ms = 2000\nlimits = {"
)
"""Less work to emulate; a machine that does other things for a while makes no fault."""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_loop_that_dies_or_hangs_leaves_no_motor_armed(
    number: signal.Signals, vcan0: str, tmp_path: Path
) -> None:
    robot = tmp_path / "rig.toml"
    robot.write_text(ROBOT)
    bus = ("--bus", f"can0=socketcan:{vcan0}", "-v")
    with Program(tmp_path, "twin", str(robot), *bus) as twin:
        twin.until("to run the robot:\n")
        with Program(tmp_path, "run", str(robot), *bus) as run:
            run.until("left: ready", "left, right: the watchdog process at once")
            run.ask("rig", "velocity left 5")
            mark = twin.until("left: armed")
            assert run.pid is not None
            os.kill(run.pid, number)
            twin.until("left: ready", after=mark)
            settled(twin, mark)
