"""One motor of two on a real CAN, the other simulated: `gateway run --real` on `vcan0`."""

from __future__ import annotations

import re
from pathlib import Path

from tests.real_can.programs import Program


def test_a_real_motor_on_vcan0_beside_a_simulated_one(vcan0: str, tmp_path: Path) -> None:
    bus = ("--bus", f"can0=socketcan:{vcan0}")
    with (
        Program(tmp_path, "twin", "bench", *bus, "-v") as devices,
        Program(tmp_path, "run", "bench", "--real", "left", *bus, "-v") as robot,
    ):
        robot.until("left: ready")
        robot.until("right: ready")
        robot.ask("bench", "velocity left 3")
        robot.ask("bench", "velocity right 3")
        robot.until("left: armed")
        robot.until("right: armed")
        devices.until("left: armed")
        robot.end()
        devices.end()
        assert "right: armed" not in devices.text  # the twin of our process was
    assert re.search(r"^left +command to report +[\d.]+ ms", robot.text, re.MULTILINE), robot.text
