"""Judges in an environment of their own, real ROS 2 and Cyclone DDS: processes that print lines of JSON."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any, NoReturn

import pytest

HERE = Path(__file__).parent / "judges"
PYTHON = Path(__file__).parents[3] / "out" / "ros_judges" / "bin" / "python"
INSTALL = "NOT RUN: real ROS 2: bash tests/gateway/ros/judges/install (x86-64)"


def python() -> Path:
    """Return the judges' Python; skip, or fail where it is required, if there is none."""
    if not PYTHON.exists():
        required = "ros" in re.split(r"[,\s]+", os.environ.get("MOTOR_GATEWAY_REQUIRE", ""))
        (pytest.fail if required else pytest.skip)(INSTALL)
    return PYTHON


def domain() -> int:
    """Return a domain that no other process of these tests is in, on this machine alone."""
    return 30 + os.getpid() % 60


class Judge:
    """One judge, or another script in its environment, while it runs."""

    def __init__(self, folder: Path, script: str, number: int, *arguments: str) -> None:
        self._out = folder / f"{Path(script).name}.out"
        env = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "LD_", "COV"))}
        env |= {
            "ROS_DOMAIN_ID": str(number),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder),
        }
        with self._out.open("wb") as file:
            self._process = subprocess.Popen(
                [python(), HERE / f"{script}.py", *arguments],
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env=env,
            )

    def begun(self) -> bool:
        """Whether it has printed anything: it takes seconds to be imported."""
        return self._out.stat().st_size > 0

    def done(self) -> bool:
        return self._process.poll() is not None

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def end(self) -> dict[str, Any]:
        """Return what it has printed, by kind; fail if it has failed."""
        self.kill()
        text = self._out.read_text()
        lines = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
        if self._process.returncode != 0:
            self._failed(text)
        return {one["kind"]: one for one in lines}

    def _failed(self, text: str) -> NoReturn:
        pytest.fail(f"the judge has ended with {self._process.returncode}:\n{text[-3000:]}")
