"""Boxes of parts: simulated devices behind the interfaces that a person would name, in simulated time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.buses import Bus
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.cli import scan
from gateway.config import load_robot, parse_robot
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings, Robot
from gateway.core.step import Gateway
from gateway.runtime.session import Session
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Nanos

ROBOTS = Path("fixtures/robots")


def rover_parts() -> Robot:
    """The skid-steer that ships, with four VESCs: its names are its makers', not those of who unpacks it."""
    text = (ROBOTS / "skid_steer.toml").read_text("utf-8").replace('"odrive_can"', '"vesc"')
    options = "pole_pairs = 7, torque_constant = 0.1, min_erpm = 0.0, feedback_ms = 10"
    text = re.sub("options = {.*}", f"options = {{ {options} }}", text)
    text = re.sub("settings = {.*}", "settings = { status_messages = 25 }", text)
    text = text.replace("gear = 8.0", "gear = 4.0").replace("bitrate = 1_000_000", "bitrate = 500_000")
    return parse_robot(re.sub(r"address = ([1-4])(?=[ ,]+(?:\}|sign))", r"address = 1\1", text))


AXES = {
    "shoulder_pan_joint": ("base_link", "shoulder_link", "0 0 0.09", "0 0 1", 1.2, "8006", 40.0),
    "shoulder_lift_joint": ("shoulder_link", "upper_arm_link", "0 0.08 0", "0 1 0", 1.4, "8009", 54.0),
    "elbow_joint": ("upper_arm_link", "forearm_link", "0 -0.06 0.26", "0 1 0", 0.8, "8006", 40.0),
    "wrist_1_joint": ("forearm_link", "wrist_1_link", "0 0 0.24", "0 1 0", 0.4, "4310", 7.0),
    "wrist_2_joint": ("wrist_1_link", "wrist_2_link", "0 0.06 0", "0 0 1", 0.3, "4310", 7.0),
    "wrist_3_joint": ("wrist_2_link", "wrist_3_link", "0 0 0.06", "0 1 0", 0.1, "4310", 7.0),
}
"""Joints of an arm of the shape and with the names of ROS-Industrial's universal_robot (ur_description), but
smaller: parent, child, origin, axis, mass of the child [kg]; model and torque [N·m] of its motor."""
MOUNTED = {"elbow_joint": -1}
"""Motors that are mounted the other way round"""


def arm_urdf() -> str:
    """Links and joints of that arm."""
    lines = ['<robot name="six">', '  <link name="base_link"/>']
    for name, (parent, child, xyz, axis, mass, _, torque) in AXES.items():
        i = f'ixx="{mass / 200}" ixy="0" ixz="0" iyy="{mass / 200}" iyz="0" izz="{mass / 400}"'
        lines += [
            f'  <link name="{child}"><inertial><origin xyz="0 0 0.08"/><mass value="{mass}"/>',
            f"    <inertia {i}/></inertial></link>",
            f'  <joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>',
            f'    <origin xyz="{xyz}"/><axis xyz="{axis}"/>',
            f'    <limit lower="-2.8" upper="2.8" velocity="3.0" effort="{torque}"/></joint>',
        ]
    return "\n".join([*lines, "</robot>", ""])


def arm_parts(folder: Path) -> Robot:
    """Six Damiao motors in it, made by a file of its makers'."""
    (folder / "six.urdf").write_text(arm_urdf())
    (folder / "plant.toml").write_text(
        'kind = "linked"\nname = "six"\nurdf = "six.urdf"\nbase = "fixed"\n[joint]\ndamping = 0.3\n'
        "friction = 0.1\narmature = 0.05\n[joints]\n"
        + "".join(f"{name} = {{}}\n" for name in AXES)
        + "[encoder]\n"
        "counts_per_turn = 16384\n"
    )
    motors = [
        f'[motors.{name}]\naddress = {at}\nsign = {MOUNTED.get(name, 1)}\noptions = {{ model = "{model}" }}'
        for at, (name, (*_, model, _)) in enumerate(AXES.items(), 1)
    ]
    axes = [f"[brain.arm.axes.{name}]" for name in AXES]
    lines = [
        'name = "made"\nworld = "workshop"\nplant = "plant.toml"\nurdf = "six.urdf"',
        '[buses.can]\nkind = "can"\nbitrate = 1_000_000\ninterface = "twin"',
        '[defaults.motors]\nprotocol = "damiao"\nbus = "can"\ngear = 1.0\nlimits = { acceleration = 20.0 }',
        *motors,
        '[brain]\nbody = "arm"\n[brain.arm]\ntip = "wrist_3_link"',
        *axes,
    ]
    (folder / "made.toml").write_text("\n".join(lines))
    return load_robot(folder / "made.toml")


class Port:
    """One end of a simulated bus, under the name that a program has for it."""

    def __init__(self, name: str, bus: Bus, *, errors: bool) -> None:
        self.name, self._bus, self._errors = name, bus, errors

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        states, packets = self._bus.read(now)
        return states, [replace(one, bus=self.name) for one in packets]

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        self._bus.write(now, frames)

    def close(self) -> None:
        """The world goes on."""


class Wrong(Port):
    """The same at a wrong rate: what others send is an error."""

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        _, packets = super().read(now)
        return [BusState.PASSIVE] if packets and self._errors else [], []

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        assert not frames or not self._errors, "a question at a rate at which there were errors"


class Box:
    """A world of parts, and where their buses are plugged in."""

    def __init__(self, parts: Robot, plugged: Mapping[str, str], *, deaf: bool = False) -> None:
        self.world: TwinWorld = open_world(parts, 1)
        self.parts, self.plugged, self.clock = parts, plugged, SimulatedClock()
        self.deaf = deaf
        """Its adapter tells nothing of errors on the bus."""

    def open(self, settings: BusSettings, _: object = None) -> Port:
        """Open an interface, as `gateway.buses.open_bus` does. At a wrong rate nothing passes."""
        bus = self.world.buses[self.plugged[settings.interface]]
        true = self.parts.buses[bus.name]
        port = Port if (settings.bitrate, settings.baudrate) == (true.bitrate, true.baudrate) else Wrong
        return port(settings.name, bus, errors=not self.deaf)

    def plug_in(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Have `gateway scan` find it."""
        monkeypatch.setattr(scan, "open_bus", self.open)
        monkeypatch.setattr(scan, "open_source", self.open)
        monkeypatch.setattr(scan, "WallClock", lambda: self.clock)

    @contextmanager
    def session(self, robot: Robot) -> Iterator[Session]:
        """A session of a robot file on these parts."""
        buses: dict[str, Bus] = {name: self.open(settings) for name, settings in robot.buses.items()}
        session = Session(robot, Gateway(robot), self.clock, buses, self.world)
        try:
            yield session
        finally:
            session.close()
