"""The robots of these tests on a wire: `gateway run` and `gateway twin`, two processes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.real_can.programs import Program

ROBOTS = Path(__file__).with_name("robots")
BITRATE = 500_000
"""That of the rover's file."""


@contextmanager
def rover(
    folder: Path, bitrate: int, ends: tuple[str, str], *words: str, name: str = "rover"
) -> Iterator[tuple[Program, Program]]:
    """The robot on our end of the wire and its devices on theirs; the sensors over a pty.

    `bitrate`: of the wire, 0 where it has none. `words` go to `gateway run`. `name`: of the robot's file."""
    ours, theirs = ends
    robot = folder / f"{name}.toml"
    text = (ROBOTS / f"{name}.toml").read_text()
    robot.write_text(text.replace(f"bitrate = {BITRATE:_}", f"bitrate = {bitrate or BITRATE}"))
    with Program(folder, "twin", str(robot), "--bus", f"can0=socketcan:{theirs}", "-v") as twin:
        twin.until("to run the robot:\n", "sensors=serial:")
        sensors = re.findall(r"sensors=(serial:\S+)", twin.text)[0]
        buses = ("--bus", f"can0=socketcan:{ours}", "--bus", f"sensors={sensors}")
        with Program(folder, "run", str(robot), *buses, "-v", *words) as run:
            yield run, twin
