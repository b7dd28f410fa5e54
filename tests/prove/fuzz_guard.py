"""A driver whose output is anything: random bytes, changed and old frames, frames that nobody asked for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random

from gateway import config
from protocols import messages as msg
from protocols.conformance.bench import DriverWrapper, Messages
from protocols.frames import CanFrame, Frame
from protocols.messages import Event, Nanos
from tests.gateway.rig import Rig

UNASKED = json.loads((Path(__file__).parents[1] / "gateway" / "core" / "unasked.json").read_text("utf-8"))
ROBOTS = (
    "diffbot_cia402",
    "diffbot_moteus",
    "diffbot_damiao",
    "diffbot_vesc",
    "diffbot_cubemars",
    "diffbot_robomaster",
    "diffbot_robstride",
    "diffbot_myactuator",
    "diffbot_zlac8015d",
    "bench",
    "diffbot",
)
"""One for each protocol; the last has serial sensors of plain beside ODrives."""
KEPT = 200
"""Frames of before that are sent again."""
MARGIN = 1.02
"""Of the limits."""


@dataclass
class Hostile(DriverWrapper):
    """Sends what its driver does, and more; what is received reaches the driver as it is."""

    random: Random = field(default_factory=Random)
    count: int = 0
    """Frames beside, in each step."""
    unasked: tuple[Frame, ...] = ()
    ids: list[tuple[int, bool, bool]] = field(default_factory=list)
    """Of frames that the driver has sent: id, whether extended, whether CAN FD."""
    before: list[Frame] = field(default_factory=list)
    made: int = 0

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode, and put others in between."""
        events, frames = self.driver.send(now, messages)
        for frame in frames:
            if isinstance(frame, CanFrame) and (key := (frame.id, frame.extended, frame.fd)) not in self.ids:
                self.ids.append(key)
        self.before = [*self.before, *frames][-KEPT:]
        others = [self._other() for _ in range(self.count)] if self.before else []
        self.made += len(others)
        mixed = [*frames, *others]
        self.random.shuffle(mixed)
        return events, mixed

    def _other(self) -> Frame:
        random = self.random
        old = random.choice(self.before)
        match random.randrange(5):
            case 0:
                return old
            case 1 if self.unasked:
                return random.choice(self.unasked)
            case 2 if isinstance(old, CanFrame):
                return CanFrame(random.randrange(1 << 29), random.randbytes(8), extended=True)
            case 3 if isinstance(old, CanFrame) and self.ids:
                number, extended, fd = random.choice(self.ids)
                return CanFrame(number, random.randbytes(random.randrange(9)), extended, False, fd, fd)
        data = bytearray(old.data if isinstance(old, CanFrame) else old)
        for _ in range(random.randrange(1, 4)):
            if data:
                data[random.randrange(len(data))] = random.randrange(256)
        return replace(old, data=bytes(data)) if isinstance(old, CanFrame) else bytes(data)


def fuzz(name: str, seed: int, frames: int, each: int = 20) -> tuple[int, float]:
    """Return how many frames were made, and the largest share of a limit that a shaft came to."""
    rig = Rig(config.load_robot(name).text)
    hostile: list[Hostile] = []
    for one in rig.gateway._drivers:
        of_robot = tuple(_frame(entry) for entry in UNASKED if entry["robot"] == name)
        hostile.append(Hostile(one.driver, Random(f"{name} {seed}"), 0, of_robot))
        object.__setattr__(one, "driver", hostile[-1])
    rig.gateway._on_blocked = lambda *_: None  # type: ignore[method-assign]  # the guard alone: it drives on
    goal = msg.Velocity("left", 3.0) if name == "bench" else msg.Goal(3.0, 0.0)
    for _ in range(20):
        rig.run(0.05, goal)
    for driver in hostile:
        driver.count = each
    worst = 0.0
    while sum(driver.made for driver in hostile) < frames:
        rig.run(0.02, goal)
        rig.ticks.clear()
        for motor, joint in rig.gateway.joints.items():
            worst = max(worst, abs(rig.velocity(motor)) / joint.settings.limits.velocity)
        if any(joint.faults for joint in rig.gateway.joints.values()):  # it is cleared, and goes on
            rig.run(0.02, *(msg.ClearFault(motor) for motor in rig.gateway.joints), msg.Release())
    return sum(driver.made for driver in hostile), worst


def _frame(entry: dict[str, object]) -> CanFrame:
    data = bytes.fromhex(str(entry["data"]))
    return CanFrame(int(str(entry["id"]), 16), data, bool(entry["extended"]), fd=bool(entry.get("fd", False)))
