"""The real devices of a run: the simulated world follows their shafts, and their latencies are measured.

Rules. Only what is part of a tick is looked at, so that a recording gives the same figures. Nothing here
reaches the robot but by the world, and by what an operator could ask.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from brain.belief import Belief
from gateway.core.joint import Joint
from gateway.core.robot import TWIN, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from protocols import messages as msg
from protocols.messages import MILLISECOND, Command, Feedback, LaserScan, Measurement, Nanos

if TYPE_CHECKING:
    from gateway.buses.virtual.bus import TwinWorld

KEPT = 20_000
"""Latencies of a device: the newest"""


def real_names(robot: Robot) -> list[str]:
    """Return the devices that are named as real, or else those on real interfaces."""
    return [*robot.real] or [one.name for one in robot.devices() if robot.buses[one.bus].interface != TWIN]


@dataclass(slots=True)
class Latency:
    """Of one device: the newest times, and how many there were."""

    newest: deque[Nanos] = field(default_factory=lambda: deque(maxlen=KEPT))
    count: int = 0
    longest: Nanos = 0

    def add(self, took: Nanos) -> None:
        """Count one."""
        self.newest.append(took)
        self.count += 1
        self.longest = max(self.longest, took)

    def share(self, part: float) -> Nanos:
        """Return what this part of the newest does not exceed."""
        ordered = sorted(self.newest)
        return ordered[min(len(ordered) - 1, int(part * len(ordered)))]


class Latencies:
    """How long real devices take, from ticks.

    Of a motor: from the writing of what commands it to its next report of its motion. Of a sensor: the age of
    a reading (of a scan: of its last beam) at the step that has it."""

    def __init__(self, robot: Robot, names: Collection[str]) -> None:
        self._buses = {one.name: one.bus for one in robot.devices() if one.name in names}
        self.found: dict[str, Latency] = {name: Latency() for name in self._buses}
        self._motors = frozenset(robot.motors)
        self._written: dict[str, Nanos] = {}
        """By motor: when its bus was last written to, since its last report."""

    def take(self, tick: Tick, _belief: Belief | None = None) -> None:
        """Look at a step."""
        for event in tick.outputs.events:
            if isinstance(event, Feedback) and event.motor in self.found and _is_motion(event):
                written = self._written.get(event.motor)
                if written is not None and event.t > written:
                    self.found[event.motor].add(event.t - self._written.pop(event.motor))
            elif isinstance(event, Measurement) and event.sensor in self.found:
                swept = event.duration if isinstance(event, LaserScan) else 0
                self.found[event.sensor].add(max(0, tick.now - event.t - swept))
        busy = {packet.bus for packet in tick.outputs.packets}
        for name in self._motors & self.found.keys():
            if self._buses[name] in busy:
                self._written.setdefault(name, tick.now)

    def lines(self) -> list[str]:
        """Return the latencies as a table, a line for each device."""
        if not self.found:
            return []
        rows = [("real device", "", "median", "99 %", "longest", "count")]
        for name, one in self.found.items():
            what = "command to report" if name in self._motors else "age of a reading"
            times = [one.share(0.5), one.share(0.99), one.longest] if one.count else []
            shown = [f"{each / MILLISECOND:.1f} ms" for each in times] or ["-"] * 3
            rows.append((name, what, shown[0], shown[1], shown[2], str(one.count)))
        widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))]
        return [
            "  ".join(
                cell.ljust(width) if at < 2 else cell.rjust(width)
                for at, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in rows
        ]


def _is_motion(event: Feedback) -> bool:
    return event.position is not None or event.velocity is not None


class FollowingWorld:
    """Lets the simulated world follow the shafts of the motors that are real."""

    def __init__(self, world: TwinWorld, joints: Mapping[str, Joint]) -> None:
        self._world, self._joints = world, {name: joints[name] for name in world.followed}
        self._last: dict[str, Nanos] = {}

    def take(self, tick: Tick, _belief: Belief) -> None:
        """Tell the world what was measured, or of a joint that reports nothing what it does as commanded."""
        for name, joint in self._joints.items():
            moved = joint.presumed(tick.now) if joint.open_loop else joint.feedback
            if moved is not None and moved.t > self._last.get(name, 0):
                self._last[name] = moved.t
                self._world.follow(moved, tick.now - moved.t)


def cannot_load(robot: Robot, twins: TwinWorld | None, motor: str, brake: str) -> str:
    """Return why a motor cannot be loaded by another one; "" if it can."""
    if twins is None:
        return "every device is real: there is no simulated world, whose torque could load a motor"
    followed = [*twins.followed]
    able = robot.brain.abilities(robot.motors).joints
    brakes = [one for one in followed if one in able and msg.Torque in robot.motors[one].spec.commands]
    if motor not in followed:
        there = ", ".join(followed) or "none"
        return f"{motor!r} is not loaded by the simulated world: not a real motor; real (--real): {there}"
    if brake not in brakes or brake == motor:
        others = [one for one in brakes if one != motor]
        what = "expected another real motor, a joint of its own that takes a torque"
        return f"{brake!r} cannot load {motor!r}; {what}: there is {', '.join(others) or 'none'}"
    return ""


class Dynamometer:
    """Commands a real motor the torque that the simulated world puts on the shaft of another one."""

    def __init__(
        self, gateway: Gateway, world: TwinWorld, motor: str, brake: str, ask: Callable[[Command], None]
    ) -> None:
        self._gateway, self._followed, self._brake, self._ask = gateway, world.followed[motor], brake, ask

    def take(self, tick: Tick, _belief: Belief) -> None:
        """Ask for the torque of this moment, as an operator would; the joint limits it."""
        joint = self._gateway.joints[self._brake]
        if joint.is_heard(tick.now) and not joint.faults and not self._gateway.why_stopped():
            most = joint.settings.limits.torque
            self._ask(msg.Torque(self._brake, max(-most, min(most, self._followed.resistance))))
