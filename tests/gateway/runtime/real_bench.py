"""Devices of a robot in a process of their own, behind ptys, moved in step with their host.

The host writes a line of JSON for each step: until when, what it has written to each bus so far, where the
shafts are that it simulates, and what happens. The answer is what has been sent on each bus so far, once it
is on its way. So both worlds have one time, whatever the machine does, and nothing is lost or late.

python -m tests.gateway.runtime.real_bench ROBOT BUS,BUS
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from typing import Any

from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.pty import SerialPty
from gateway.buses.virtual.bus import TwinBus, TwinWorld, open_world
from gateway.config import load_robot
from protocols.frames import Frame, Packet
from protocols.messages import Nanos

PATIENCE = 600.0
"""s"""


def amount(frames: Sequence[Frame | Packet]) -> int:
    """Return how much this is: CAN frames, or bytes."""
    plain = [one.frame if isinstance(one, Packet) else one for one in frames]
    return sum(len(one) if isinstance(one, bytes) else 1 for one in plain)


class Port:
    """One bus of twins, and the pty before it."""

    def __init__(self, twins: TwinBus, pty: AdapterPty | SerialPty) -> None:
        self.twins, self.pty = twins, pty
        self.received = self.sent = 0

    @property
    def interface(self) -> str:
        """What the host opens."""
        if isinstance(self.pty, AdapterPty):
            return f"slcan:{self.pty.paths[0]}"
        return f"serial:{self.pty.pty.path}"

    def step(self, t: Nanos, written: int) -> None:
        """Give the twins what the host has written, all of it, and send what they have sent up to then."""
        end = time.monotonic() + PATIENCE
        while True:
            packets = self.pty.read(t)[1]
            self.received += amount(packets)
            self.twins.write(t, [packet.frame for packet in packets])
            if self.received >= written:
                break
            assert time.monotonic() < end, f"{self.twins.name}: {self.received} of {written} received"
        out = [packet.frame for packet in self.twins.read(t)[1]]
        self.pty.write(t, out)
        self.sent += amount(out)


class Coupled(TwinWorld):
    """A world in which one motor's shaft is coupled to another one's."""

    def couple(self, pair: str) -> None:
        """Let the shaft of BRAKE in MOTOR=BRAKE turn as that of MOTOR, which feels both torques."""
        motor, brake = pair.split("=")

        def torques(given: dict[str, float]) -> dict[str, float]:
            self.world.follow(brake, *self.world.shaft(motor))
            return given | {motor: given[motor] + given[brake]}

        self.tamper.torques = torques


def main(name: str, buses: str) -> None:
    robot = load_robot(name)
    world = open_world(robot, 1)
    world.__class__ = Coupled
    ports: dict[str, Port] = {}
    for bus in buses.split(","):
        settings = robot.buses[bus]
        pty = SerialPty(settings) if settings.kind == "serial" else AdapterPty(settings)
        ports[bus] = Port(world.buses[bus], pty)
    print(json.dumps({bus: port.interface for bus, port in ports.items()}), flush=True)
    for line in sys.stdin:
        step: dict[str, Any] = json.loads(line)
        for motor, (position, velocity) in step["shafts"].items():
            world.world.follow(motor, position, velocity)
        for what, device in step["happens"]:
            getattr(world if hasattr(world, what) else world.world, what)(device)
        for bus, port in ports.items():
            port.step(step["t"], step["written"].get(bus, 0))
        print(json.dumps({bus: port.sent for bus, port in ports.items()}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
