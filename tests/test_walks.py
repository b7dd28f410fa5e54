"""Three walks through the rooms, traced while they happen: ARCHITECTURE.md has the same rooms.

A room is a package: `gateway.core`, `brain.perception`, `protocols.odrive_can`; files that lie directly in
`brain` or `protocols` are in the rooms `brain` and `protocols`. The CAN bus is python-can's virtual one,
opened as any interface is; what the simulated devices put on it is put there outside the trace.
"""

from __future__ import annotations

import re
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import FrameType

import can
import pytest

import gateway as gw
from gateway.buses import Bus, open_bus
from gateway.buses.python_can import message_of
from gateway.buses.virtual import TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.operator import Operator
from gateway.runtime import loop
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import Instruction, Nanos

ROOT = Path(__file__).parents[1]
PERIOD: Nanos = 5_000_000
VALUES = {"protocols.messages", "protocols.frames", "protocols.message_codec"}
"""Modules of values, which every room may use."""


def room_of(module: str) -> str:
    """The room of a module, "" if it is none of ours."""
    folder = "/".join(module.split("."))
    top = module.split(".")[0]
    if top not in ("gateway", "brain", "protocols") or module in VALUES:
        return ""
    package = module if (ROOT / folder).is_dir() else module.rpartition(".")[0]
    return ".".join(package.split(".")[:2])


def traced(walk: Callable[[], object]) -> tuple[list[str], list[str]]:
    """The rooms and the modules whose functions are called in a walk, in the order of the first call."""
    modules: dict[str, None] = {}

    def enter(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call":
            modules.setdefault(frame.f_globals.get("__name__", ""), None)

    sys.setprofile(enter)
    try:
        walk()
    finally:
        sys.setprofile(None)
    ours = [module for module in modules if room_of(module)]
    return list(dict.fromkeys(map(room_of, ours))), ours


def written(title: str) -> list[str]:
    """The rooms of a walk as ARCHITECTURE.md has them."""
    text = (ROOT / "ARCHITECTURE.md").read_text().replace("\n  ", " ")
    (line,) = re.findall(rf"^\* \*\*{title}\*\* \(.*$", text, re.MULTILINE)
    rooms = list(dict.fromkeys(re.findall(r"`((?:gateway|brain|protocols)[a-z_.0-9]*)`", line)))
    assert f"({len(rooms)} rooms)" in line
    return rooms


class Sensors:
    """A serial line whose bytes the test hands over."""

    name = "sensors"

    def __init__(self) -> None:
        self.packets: list[Packet] = []

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        packets, self.packets = self.packets, []
        return (), packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        pass

    def close(self) -> None:
        pass


class Drive:
    """A diffbot on a virtual CAN bus, stepped by the live loop, with its devices at the far end."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        robot = gw.load_robot("diffbot")
        self.clock, self.sensors = SimulatedClock(), Sensors()
        self.world: TwinWorld = open_world(robot, 1)
        settings = gw.with_interfaces(robot, {"can0": "virtual:walks"}).buses["can0"]
        buses: dict[str, Bus] = {"can0": open_bus(settings, self.clock), "sensors": self.sensors}
        self.far_end = can.Bus(interface="virtual", channel="walks")
        self.operator = stack.enter_context(Operator(robot, folder))
        stack.callback(buses["can0"].close)
        stack.callback(self.far_end.shutdown)
        self.instructions: list[Instruction] = []
        self.gateway = gw.Gateway(robot)
        self.ticks = loop.live(self.gateway, buses, self.clock, poll=self._poll)
        stack.callback(self.ticks.close)

    def _poll(self) -> list[Instruction]:
        taken, self.instructions = self.instructions, []
        return taken

    def exchange(self, *, only: str = "") -> None:
        """Carry frames between the far end and the devices; `only`: hand over those of one bus."""
        now = self.clock.now()
        while (message := self.far_end.recv(0)) is not None:
            frame = CanFrame(message.arbitration_id, bytes(message.data), remote=message.is_remote_frame)
            self.world.buses["can0"].write(now, [frame])
        for name in ("can0", "sensors"):
            packets = self.world.buses[name].read(now + PERIOD)[1]
            if name == "sensors" and only != "can0":
                self.sensors.packets += packets
            for packet in packets if name == "can0" else ():
                assert isinstance(packet.frame, CanFrame)
                self.far_end.send(message_of(packet.frame))

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            next(self.ticks)
            self.exchange()


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Drive]:
    with ExitStack() as stack:
        yield Drive(stack, tmp_path)


def test_a_can_frame_to_the_belief(drive: Drive) -> None:
    drive.run(201)  # the next tick has a measurement
    next(drive.ticks)
    drive.exchange(only="can0")
    rooms, modules = traced(lambda: next(drive.ticks))
    inward = rooms[: 1 + max(rooms.index(room) for room in ("brain.perception", "brain.bodies"))]
    print(f"{len(inward)} rooms: {inward}\n{len(modules)} modules in the whole tick: {modules}")
    assert inward == written("A CAN frame to the belief")
    assert len(inward) <= 9


def test_a_goal_to_a_frame(drive: Drive) -> None:
    drive.run(200)
    rooms: list[str] = []

    def poll() -> None:
        drive.instructions += drive.operator.poll(lambda: "")

    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(drive.operator.path))
        client.sendall(b"goal 1 0\n")
        while not drive.instructions:
            found, _ = traced(poll)
            rooms += [room for room in found if room not in rooms]
    assert drive.instructions == [gw.Goal(1.0, 0.0)]
    for _ in range(20):
        found, _ = traced(lambda: next(drive.ticks))
        rooms += [room for room in found if room not in rooms]
        drive.exchange()
    print(f"{len(rooms)} rooms: {rooms}")
    assert sorted(rooms) == sorted(written("A goal to a frame"))  # the text has the order of the value itself
    assert len(rooms) <= 14


def test_a_key_of_the_robot_file_to_its_object() -> None:
    """The motor's `gear`: what runs between the text and the settings of its joint."""
    robot = gw.load_robot("bench")
    _, modules = traced(lambda: gw.parse_robot(robot.text))
    walk = [module for module in modules if module.startswith("gateway.") and "validate" not in module]
    print(f"{len(walk)} modules: {walk}")
    assert list(dict.fromkeys(map(room_of, walk))) == written("A key of the robot file to its object")
