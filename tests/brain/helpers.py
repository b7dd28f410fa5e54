"""A kinematic office and an oracle for paths, shared by the tests of the brain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, hypot, inf, pi, sin

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra as scipy_dijkstra

from brain.belief import Belief, BrainTask, Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import arc
from brain.brain import Brain, BrainSettings
from brain.perception.mount import Mount
from brain.planning.costmap import UNKNOWN
from brain.planning.snapshot import Snapshot
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, seconds
from tests.brain.bodies.kinematics import rolled
from tests.brain.perception.office import box, scan_at


def dijkstra(ground: Snapshot, start: int, goal: int, through_unknown: float = inf) -> float:
    """The optimal cost [m] in the planner's metric, by scipy: an oracle that shares no code with A*."""
    level = ground.level.reshape(ground.height, ground.stride)
    cost = np.where(level >= UNKNOWN, through_unknown, ground.multiplier[level])
    cells, free = np.arange(cost.size).reshape(cost.shape), cost < inf
    tails, heads, weights = [], [], []
    for up, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        low = (slice(0, -1 if up else None), slice(1 if right < 0 else 0, -1 if right > 0 else None))
        high = (slice(up, None), slice(max(right, 0), -1 if right < 0 else None))
        open_ = free[low] & free[high]
        if up and right:
            open_ &= free[low[0], high[1]] & free[high[0], low[1]]
        for a, b in ((low, high), (high, low)):
            tails.append(cells[a][open_])
            heads.append(cells[b][open_])
            weights.append(cost[b][open_] * hypot(up, right))
    entries = (np.concatenate(weights), (np.concatenate(tails), np.concatenate(heads)))
    graph = csr_array(entries, shape=(cost.size, cost.size))
    return float(scipy_dijkstra(graph, indices=start)[goal]) * ground.resolution


# -- a kinematic office ------------------------------------------------------------------------

BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.22,
    radius=0.25,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=0.8,
    max_angular_acceleration=4.0,
)
MOUNTS = {"lidar": Mount(x=0.12, z=0.12), "imu": Mount(z=0.05)}
TIMEOUTS: dict[str, Nanos] = {
    "left": 100 * MILLISECOND,
    "right": 100 * MILLISECOND,
    "lidar": 500 * MILLISECOND,
    "imu": 150 * MILLISECOND,
}
TICK: Nanos = 10 * MILLISECOND

Box = tuple[float, float, float, float]
"""x from, y from, x to, y to [m]"""

ROOMS: tuple[Box, ...] = (
    (-2.1, -2.1, 6.1, -2.0),
    (-2.1, 4.0, 6.1, 4.1),
    (-2.1, -2.1, -2.0, 4.1),
    (6.0, -2.1, 6.1, 4.1),
    (2.0, -2.0, 2.1, 1.5),
    (2.0, 2.5, 2.1, 4.0),
    (0.7, -0.6, 1.1, 0.4),
    (3.6, 0.4, 4.4, 0.8),
)
"""Two rooms, a doorway of 1 m between them, and a box in each."""


@dataclass
class Noise:
    """Errors of body and sensors."""

    gyro: float = 0.005
    """rad/s, each reading"""
    gyro_bias: float = 0.01
    """rad/s"""
    range: float = 0.01
    """m, each beam"""
    slip: float = 0.0
    """Share of the wheels' travel that is lost"""
    encoder: float = 2.0 * pi / 65536.0
    """rad, one count"""


START = Pose(0.0, 0.0, 0.0)


class Office:
    """A base between boxes, in simulated time: commands in, events out. Exact arcs, ideal wheels with lag."""

    def __init__(
        self,
        boxes: Sequence[Box] = ROOMS,
        pose: Pose = START,
        noise: Noise | None = None,
        seed: int = 1,
        body: Differential = BODY,
    ) -> None:
        self.boxes, self.pose, self.body, self.noise = list(boxes), pose, body, noise or Noise()
        self.now: Nanos = SECOND
        self.silent: set[str] = set()
        """Motors and sensors without events."""
        self.touched = 0
        """Ticks in which the robot's rectangle of 0.4 × 0.2 m touched a box."""
        self.speed = 0.0
        self._rng = np.random.Generator(np.random.PCG64(seed))
        self._angle = {body.left: 0.0, body.right: 0.0}
        self._rate = {body.left: 0.0, body.right: 0.0}
        self._turn_rate = 0.0

    def step(self, commands: Sequence[Command]) -> list[Event]:
        """One tick: the wheels follow with a lag of 30 ms; on Idle they roll out."""
        dt = seconds(TICK)
        self.now += TICK
        before = dict(self._rate)
        for command in commands:
            wanted = command.velocity if isinstance(command, msg.Velocity) else 0.0
            self._rate[command.motor] += (wanted - self._rate[command.motor]) * dt / 0.03
        turned = {name: (before[name] + rate) / 2.0 * dt for name, rate in self._rate.items()}
        for name, angle in turned.items():
            self._angle[name] += angle
        distance, turn = rolled(self.body, turned[self.body.left], turned[self.body.right])
        distance *= 1.0 - self.noise.slip
        self.pose = arc(self.pose, distance, turn)
        self.speed = distance / dt
        self._turn_rate = rolled(self.body, self._rate[self.body.left], self._rate[self.body.right])[1]
        self.touched += self.touches()
        return self._events()

    def touches(self) -> bool:
        """Whether any point of the robot's outline lies in a box."""
        here = self.pose
        if not any(
            x0 - 0.3 < here.x < x1 + 0.3 and y0 - 0.3 < here.y < y1 + 0.3 for x0, y0, x1, y1 in self.boxes
        ):
            return False
        along, across = np.linspace(-0.2, 0.2, 17), np.linspace(-0.1, 0.1, 9)
        x = np.concatenate([along, along, np.full(9, -0.2), np.full(9, 0.2)])
        y = np.concatenate([np.full(17, -0.1), np.full(17, 0.1), across, across])
        c, s = cos(self.pose.yaw), sin(self.pose.yaw)
        px, py = self.pose.x + c * x - s * y, self.pose.y + s * x + c * y
        return any(
            bool(np.any((px > x0) & (px < x1) & (py > y0) & (py < y1))) for x0, y0, x1, y1 in self.boxes
        )

    def scan(self) -> msg.LaserScan:
        """360 beams from the lidar, exact against the boxes, plus noise."""
        walls = np.array([wall for each in self.boxes for wall in box(*each)])
        noise = self._rng.normal(0.0, self.noise.range, 360)
        return scan_at(walls, self.pose, MOUNTS["lidar"], self.now, noise)

    def _events(self) -> list[Event]:
        events: list[Event] = []
        if self.now % (10 * MILLISECOND) == 0:
            for motor, angle in self._angle.items():
                counts = round(angle / self.noise.encoder) * self.noise.encoder
                events.append(msg.Feedback(motor, self.now, counts, self._rate[motor]))
            rate = self._turn_rate + self.noise.gyro_bias + self._rng.normal(0.0, self.noise.gyro)
            events.append(msg.Imu("imu", self.now, (0.0, 0.0, float(rate)), (0.0, 0.0, 9.81)))
        if self.now % (100 * MILLISECOND) == 0:
            events.append(self.scan())
        return [e for e in events if getattr(e, "motor", getattr(e, "sensor", "")) not in self.silent]


class Trip:
    """A brain in an office, with a log of what it did."""

    def __init__(
        self, office: Office, settings: BrainSettings | None = None, timeouts: dict[str, Nanos] = TIMEOUTS
    ) -> None:
        self.office = office
        self.brain = Brain(
            settings or BrainSettings(office.body),
            [office.body.left, office.body.right],
            MOUNTS,
            timeouts,
        )
        self.commands: Sequence[Command] = ()
        self.notes: list[tuple[str, str]] = []
        self.states: list[str] = []
        """Each state once per change."""
        self.log: list[Sequence[Command]] = []
        self.track: list[Pose] = []

    def tick(self, tasks: Sequence[BrainTask] = (), stopped: str = "") -> Belief:
        """Step the office, then the brain."""
        events = self.office.step(self.commands)
        self.commands = self.brain.step(self.office.now, events, tasks, stopped)
        self.notes += self.brain.take_notes()
        self.log.append(self.commands)
        self.track.append(self.office.pose)
        belief = self.brain.belief()
        if not self.states or self.states[-1] != belief.state:
            self.states.append(belief.state)
        return belief

    def run(self, span: float, until: Callable[[Belief], bool] = lambda _: False) -> Belief:
        """Tick for this many seconds, or until the condition holds."""
        belief = self.brain.belief()
        for _ in range(round(span / seconds(TICK))):
            belief = self.tick()
            if until(belief):
                break
        return belief

    def go(self, *goals: msg.Goal, span: float = 60.0) -> Belief:
        """Send the goals, and run until all are reached or the time is over."""
        count = self.brain.belief().reached + len(goals)
        self.tick(goals)
        return self.run(span, lambda b: b.reached >= count)
