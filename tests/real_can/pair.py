"""The robots of these tests on a bus: `gateway run` and `gateway twin`, two processes.

The shipped ones as they are; and, where a bus has a bit rate, a rover, which is less work to emulate."""

from __future__ import annotations

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
def connected(folder: Path, robot: Path, ends: tuple[str, str], *arguments: str) -> Iterator[Pair]:
    """`run` on our interface, `twin` on theirs; the sensors over a pty. `arguments` go to `gateway run`."""
    ours, theirs = ends
    with Program(folder, "twin", str(robot), "--bus", f"can0=socketcan:{theirs}", "-v") as twin:
        twin.until("to run the robot:\n")
        sensors = twin.find(r"sensors=(serial:\S+)")
        buses = ("--bus", f"can0=socketcan:{ours}", "--bus", f"sensors={sensors}")
        with Program(folder, "run", str(robot), *buses, "-v", *arguments) as run:
            yield run, twin


@contextmanager
def rover(folder: Path, bitrate: int, ends: tuple[str, str], *arguments: str) -> Iterator[Pair]:
    """The rover on a bus of that bit rate; 0 is a virtual one."""
    robot = folder / ROVER.name
    text = ROVER.read_text().replace(f"bitrate = {BITRATE:_}", f"bitrate = {bitrate or BITRATE}")
    for beside in ("room.toml", "rover_plant.toml"):
        text = text.replace(f'"{beside}"', f'"{ROVER.with_name(beside)}"')
    robot.write_text(text)
    with connected(folder, robot, ends, *arguments) as pair:
        yield pair
