"""Robots of these tests on a wire: `gateway run` and `gateway twin`, two processes.

The shipped ones as they are; and, where a wire has a bit rate, a rover, which is less work to emulate."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.real_can.machine import ROOT
from tests.real_can.programs import Program

SHIPPED = ROOT / "fixtures" / "robots"
ROVER = Path(__file__).with_name("robots") / "rover.toml"
BITRATE = 500_000
"""That of the rover's file."""
Pair = tuple[Program, Program]


@contextmanager
def on_the_wire(folder: Path, robot: Path, ends: tuple[str, str], *words: str) -> Iterator[Pair]:
    """`run` on our end of the wire, `twin` on theirs; the sensors over a pty. `words` go to `gateway run`."""
    ours, theirs = ends
    with Program(folder, "twin", str(robot), "--bus", f"can0=socketcan:{theirs}", "-v") as twin:
        twin.until("to run the robot:\n", "sensors=serial:")
        sensors = re.findall(r"sensors=(serial:\S+)", twin.text)[0]
        buses = ("--bus", f"can0=socketcan:{ours}", "--bus", f"sensors={sensors}")
        with Program(folder, "run", str(robot), *buses, "-v", *words) as run:
            yield run, twin


@contextmanager
def rover(folder: Path, bitrate: int, ends: tuple[str, str], *words: str) -> Iterator[Pair]:
    """The rover on a wire of that bit rate, 0 where it has none."""
    robot = folder / ROVER.name
    robot.write_text(ROVER.read_text().replace(f"bitrate = {BITRATE:_}", f"bitrate = {bitrate or BITRATE}"))
    with on_the_wire(folder, robot, ends, *words) as pair:
        yield pair
