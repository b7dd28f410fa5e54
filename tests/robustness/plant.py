"""A kinematic base with its sensors among walls, boxes and people: commands in, events out.

Rules. Simulated time. Exact arcs and exact beams, to which `Figures` adds lag, slip, noise and bias; no
contact physics: what the outline touches is counted, with the base's speed. Deterministic by seed. Walls and
boxes are the world files' own, so that MuJoCo can run the same ones.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import arc
from gateway.sim import SceneFile, load_world
from gateway.sim.mjcf import Polygon, outlines
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, seconds

STEP: Nanos = 5 * MILLISECOND
"""Time between two poses; beams see the poses between them."""
TICK: Nanos = 10 * MILLISECOND
OWN = 0.05
"""m/s, from which on a contact is by own motion"""
HALF_LENGTH, HALF_WIDTH = 0.2, 0.12
"""m, half the outline of the base with its wheels"""
STRETCHES = 20
"""Stretches of constant slip per correlation length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Errors of base and sensors; by default those of the world files."""

    lag: float = 0.03
    """s, time constant of the wheels' speed"""
    give: float = 0.002
    """s, time constant by which the base's turn follows its wheels: tyres give way"""
    slip: float = 0.01
    """Standard deviation, as a share of the rolled distance"""
    slip_length: float = 0.3
    """m, its correlation length"""
    radius_errors: tuple[float, float] = (0.028, 0.022)
    """Of the left and the right wheel, as shares"""
    separation_error: float = 0.0
    counts: int = 131_072
    """Of an encoder, per turn of its wheel"""
    jitter: float = 2e-5
    """s, by which the wheels' stamps are off"""
    gyro_noise: float = 0.003
    gyro_bias: float = 0.004
    gyro_walk: float = 0.0001
    gyro_lie: float = 0.0
    """rad/s, added while the base moves"""
    beams: int = 360
    scan_hz: float = 10.0
    range: float = 10.0
    range_noise: float = 0.01
    dropout: float = 0.002
    sweep: bool = True
    """Whether the beams are spread over the scan's period"""
    stated: bool = True
    """Whether the scan tells its duration; otherwise it is stamped at the middle of it"""
    mount_yaw: float = 0.0
    """rad, of the true mounting minus the one stated"""
    lidar: bool = True
    imu: bool = True


@dataclass(frozen=True, slots=True)
class Scene:
    """What stands around, where the base starts, and where it should go, relative to that."""

    solids: dict[str, Polygon]
    start: Pose
    tour: tuple[tuple[float, float], ...]


@cache
def scene(world: str) -> Scene:
    """Return the scene of a shipped world file."""
    file = load_world(world)
    assert isinstance(file, SceneFile)
    names = [*file.walls, *file.boxes]
    start = Pose(file.start.x, file.start.y, file.start.yaw)
    return Scene(dict(zip(names, outlines(file), strict=True)), start, file.tour)


def rectangle(x: float, y: float, yaw: float, length: float, width: float) -> Polygon:
    """Return the corners of a rectangle about a point, its length along yaw."""
    c, s = math.cos(yaw) / 2.0, math.sin(yaw) / 2.0
    signs = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
    along = [(a * length, b * width) for a, b in signs]
    return tuple((x + c * a - s * b, y + s * a + c * b) for a, b in along)


@dataclass(slots=True)
class Person:
    """A disc that walks straight on."""

    x: float
    y: float
    vx: float
    vy: float
    radius: float = 0.2
    left: float = math.inf
    """s until it is gone"""


@dataclass(slots=True)
class _Wheel:
    """Angle, speed and slip of one wheel: a Gauss-Markov process over the distance rolled."""

    slip: float
    angle: float = 0.0
    rate: float = 0.0
    rolled: float = 0.0


def cast(
    segments: Floats, people: Sequence[Floats], origins: Floats, angles: Floats, farthest: float
) -> Floats:
    """Return how far beams go, each from its own origin (n × 2): exact intersections.

    `segments`: m × 4 (x0 y0 x1 y1). `people`: of each n × 3, centre at each beam's time and radius."""
    dx, dy = np.cos(angles)[:, None], np.sin(angles)[:, None]
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    wx, wy = segments[:, 0] - origins[:, 0, None], segments[:, 1] - origins[:, 1, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (dx * ey - dy * ex)
        far = (wx * ey - wy * ex) * inverse
        along = (wx * dy - wy * dx) * inverse
        met = (far > 0.0) & (along >= 0.0) & (along <= 1.0)
    nearest: Floats = np.where(met, far, farthest).min(axis=1, initial=farthest)
    for person in people:
        rx, ry = person[:, 0] - origins[:, 0], person[:, 1] - origins[:, 1]
        ahead = rx * dx[:, 0] + ry * dy[:, 0]
        inside = person[:, 2] ** 2 - (rx * rx + ry * ry - ahead * ahead)
        reach = ahead - np.sqrt(np.maximum(inside, 0.0))
        nearest = np.where((inside > 0.0) & (reach > 0.0), np.minimum(nearest, reach), nearest)
    return nearest


@dataclass
class Base:
    """A base in a scene, and what can happen to it."""

    scene: Scene
    body: Differential
    """As the brain is stated"""
    lidar: tuple[float, float, float]
    """x, y, yaw of the lidar's mounting as stated"""
    figures: Figures
    seed: int
    glass: frozenset[str] = frozenset()
    """Solids that give no echo"""
    now: Nanos = SECOND
    speed: float = 0.0
    """m/s, forward"""
    turn_rate: float = 0.0
    touches: list[tuple[str, float]] = field(default_factory=list)
    """What was met that was not touched before, and the speed then"""
    moved: bool = False
    """Lifted and put down elsewhere, at any time"""
    silent: dict[str, Nanos] = field(default_factory=dict)
    """Until when a motor or sensor sends nothing"""

    def __post_init__(self) -> None:
        self.pose = self.scene.start
        """In the world"""
        self.solids = dict(self.scene.solids)
        self.people: dict[str, Person] = {}
        streams = [
            np.random.Generator(np.random.PCG64(s)) for s in np.random.SeedSequence(self.seed).spawn(5)
        ]
        self._slips, self._gyro, self._lidar, self.random, self._stamps = streams
        draws = self._slips.standard_normal(2)
        self._wheels = [_Wheel(self.figures.slip * float(draw)) for draw in draws]
        self._bias = self.figures.gyro_bias
        self._poses: deque[tuple[Nanos, Pose]] = deque([(self.now, self.pose)], maxlen=400)
        self._touching: frozenset[str] = frozenset()
        self._period: Nanos = round(SECOND / self.figures.scan_hz)
        self._arrange()

    # -- what happens to it -----------------------------------------------------------------------------

    def move(self, distance: float, yaw: float, bearing: float | None = None) -> None:
        """Lift the base and put it down elsewhere, by default straight ahead; the wheels do not turn."""
        at = self.pose.yaw if bearing is None else bearing
        x, y = self.pose.x + distance * math.cos(at), self.pose.y + distance * math.sin(at)
        self.pose = Pose(x, y, math.remainder(self.pose.yaw + yaw, 2.0 * math.pi))
        self.moved = True

    def carry(self, distance: float, yaw: float) -> None:
        """Move to a place drawn at this distance, with nothing between, 0.5 m free around: it may move."""
        ring = np.linspace(-math.pi, math.pi, 72)
        for bearing in self.random.permutation(ring):
            x, y = self.pose.x + distance * math.cos(bearing), self.pose.y + distance * math.sin(bearing)
            here, there = np.array([[self.pose.x, self.pose.y]] * 72), np.array([[x, y]] * 72)
            free = cast(self._all, (), there, ring, 9.0).min() > 0.5
            if free and cast(self._all, (), here, np.full(72, bearing), 99.0)[0] > distance:
                self.move(distance, yaw, bearing)
                return
        self.move(0.0, yaw if abs(yaw) > 0.3 else math.pi)

    def put(
        self, name: str, distance: float, width: float, bearing: float = 0.0, depth: float = 0.05
    ) -> None:
        """Put a box with its near face this far from the base's middle, at a bearing, facing the base."""
        at, away = self.pose.yaw + bearing, distance + depth / 2.0
        x, y = self.pose.x + away * math.cos(at), self.pose.y + away * math.sin(at)
        self.add(name, rectangle(x, y, at, depth, width))

    def add(self, name: str, solid: Polygon) -> None:
        """Add a solid in the world's frame, or replace it."""
        self.solids[name] = solid
        self._arrange()

    def shift(self, name: str, dx: float, dy: float) -> None:
        """Move a solid in the world's frame."""
        self.add(name, tuple((x + dx, y + dy) for x, y in self.solids[name]))

    def remove(self, name: str) -> None:
        """Remove a solid."""
        del self.solids[name]
        self._arrange()

    def silence(self, source: str, span: float = math.inf) -> None:
        """Stop the events of a motor or sensor for a time [s]."""
        self.silent[source] = self.now + (round(span * SECOND) if math.isfinite(span) else 2**62)

    def cross(self, ahead: float, side: float, speed: float) -> None:
        """A person sets out this far ahead and to the left, and walks across to the right."""
        c, s = math.cos(self.pose.yaw), math.sin(self.pose.yaw)
        x, y = self.pose.x + c * ahead - s * side, self.pose.y + s * ahead + c * side
        self.people["person"] = Person(x, y, s * speed, -c * speed)

    # -- motion --------------------------------------------------------------------------------------------

    def step(self, commands: Sequence[Command]) -> list[Event]:
        """Advance by one tick of 10 ms under these commands; return what the sensors and motors send."""
        wanted = {each.motor: each.velocity for each in commands if isinstance(each, msg.Velocity)}
        events: list[Event] = []
        for _ in range(TICK // STEP):
            self._advance(wanted.get(self.body.left, 0.0), wanted.get(self.body.right, 0.0))
            events += self._imu() + self._scan()
        for motor, wheel in zip((self.body.left, self.body.right), self._wheels, strict=True):
            count = 2.0 * math.pi / self.figures.counts
            angle = wheel.angle - wheel.rate * self.figures.jitter * float(self._stamps.standard_normal())
            events.append(msg.Feedback(motor, self.now, math.floor(angle / count) * count, wheel.rate))
        self._touch()
        return [event for event in events if self.now >= self.silent.get(_source(event), 0)]

    def _advance(self, left: float, right: float) -> None:
        figures, dt = self.figures, seconds(STEP)
        self.now += STEP
        ways, speeds = [], []
        for wheel, wanted, error in zip(self._wheels, (left, right), figures.radius_errors, strict=True):
            before = wheel.rate
            wheel.rate += (wanted - wheel.rate) * -math.expm1(-dt / figures.lag)
            angle, radius = 0.5 * (before + wheel.rate) * dt, self.body.wheel_radius * (1.0 + error)
            wheel.angle += angle
            ways.append(radius * angle * (1.0 - wheel.slip))
            speeds.append(radius * wheel.rate * (1.0 - wheel.slip))
            wheel.rolled += radius * abs(angle)
            if wheel.rolled >= figures.slip_length / STRETCHES:
                wheel.rolled = 0.0
                kept = math.exp(-1.0 / STRETCHES)
                drawn = math.sqrt(1.0 - kept * kept) * figures.slip * float(self._slips.standard_normal())
                wheel.slip = kept * wheel.slip + drawn
        separation = self.body.wheel_separation * (1.0 + figures.separation_error)
        self.speed, before = sum(speeds) / 2.0, self.turn_rate
        rate = (ways[1] - ways[0]) / separation / dt
        self.turn_rate += (rate - before) / (figures.give / dt + 0.5)  # bilinear: the gyro's angle is exact
        self.pose = arc(self.pose, sum(ways) / 2.0, 0.5 * (before + self.turn_rate) * dt)
        self._poses.append((self.now, self.pose))
        for person in self.people.values():
            person.x += person.vx * dt
            person.y += person.vy * dt
            person.left -= dt
        self.people = {name: person for name, person in self.people.items() if person.left > 0.0}

    def at(self, t: Nanos) -> Pose:
        """Return the true pose at a time within the last 2 s."""
        index = max(1, min(len(self._poses) - 1, len(self._poses) - 1 - (self.now - t) // STEP))
        (before, a), (after, b) = self._poses[index - 1], self._poses[index]
        share = (t - before) / (after - before)
        turn = math.remainder(b.yaw - a.yaw, 2.0 * math.pi)
        return Pose(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), a.yaw + share * turn)

    def _arrange(self) -> None:
        corners = np.array(list(self.solids.values())).reshape(-1, 4, 2)
        self._corners, self._names = corners, list(self.solids)
        self._centres = corners.mean(axis=1)
        self._radii = np.hypot(*(corners - self._centres[:, None]).transpose(2, 0, 1)).max(axis=1)
        self._all = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 4)
        seen = np.array([name not in self.glass for name in self._names], bool)
        self._segments = self._all[np.repeat(seen, 4)]

    def _touch(self) -> None:
        """Note what the outline touches anew: separating axes of rectangles, and the distance to discs."""
        here, names = self.pose, set()
        c, s = math.cos(here.yaw), math.sin(here.yaw)
        axes = np.array([[c, s], [-s, c]])
        half = np.array([HALF_LENGTH, HALF_WIDTH])
        outline = np.array([here.x, here.y]) + (np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half) @ axes
        away = np.hypot(*(self._centres - (here.x, here.y)).T)
        for index in np.flatnonzero(away < self._radii + 0.24):
            corners = self._corners[index]
            sides = np.concatenate([axes, corners[1:3] - corners[0:2]])
            ours, theirs = sides @ outline.T, sides @ corners.T
            if np.all((ours.max(1) > theirs.min(1)) & (theirs.max(1) > ours.min(1))):
                names.add(self._names[index])
        for name, person in self.people.items():
            offset = np.abs(axes @ np.array([person.x - here.x, person.y - here.y]))
            if np.hypot(*np.maximum(offset - half, 0.0)) < person.radius:
                names.add(name)
        self.touches += [(name, self.speed) for name in sorted(names - self._touching)]
        self._touching = frozenset(names)

    # -- sensors -------------------------------------------------------------------------------------------

    def _imu(self) -> list[Event]:
        figures = self.figures
        if not figures.imu:
            return []
        walk, noise = self._gyro.standard_normal(2)
        self._bias += figures.gyro_walk * math.sqrt(seconds(STEP)) * float(walk)
        lie = figures.gyro_lie if abs(self.speed) > 0.01 else 0.0
        rate = self.turn_rate + self._bias + lie + figures.gyro_noise * float(noise)
        return [msg.Imu("imu", self.now, (0.0, 0.0, rate), (0.0, 0.0, 9.81))]

    def _scan(self) -> list[Event]:
        """Return the scan that ends now, if one does."""
        figures, period, beams = self.figures, self._period, self.figures.beams
        if self.now % period or not figures.lidar:
            return []
        increment = 2.0 * math.pi / beams
        first = self.now - (period if figures.sweep else 0)
        duration = (beams - 1) * period // beams if figures.sweep else 0
        times = first + np.arange(beams) * (duration / (beams - 1))
        steps = list(self._poses)[-(period // STEP + 2) :]
        known = np.array([t for t, _ in steps], float)
        x, y = (np.interp(times, known, [getattr(pose, axis) for _, pose in steps]) for axis in ("x", "y"))
        yaw = np.interp(times, known, np.unwrap([pose.yaw for _, pose in steps]))
        mount_x, mount_y, mount_yaw = self.lidar
        origins = np.stack(
            [
                x + np.cos(yaw) * mount_x - np.sin(yaw) * mount_y,
                y + np.sin(yaw) * mount_x + np.cos(yaw) * mount_y,
            ],
            axis=1,
        )
        ago = (times - self.now) / SECOND
        people = [
            np.stack([p.x + p.vx * ago, p.y + p.vy * ago, np.full(beams, p.radius)], axis=1)
            for p in self.people.values()
        ]
        angles = yaw + mount_yaw + figures.mount_yaw - math.pi + increment * np.arange(beams)
        true = cast(self._segments, people, origins, angles, figures.range)
        read = np.round(true + figures.range_noise * self._lidar.standard_normal(beams), 3)
        read = np.where(true >= figures.range, figures.range, np.minimum(read, figures.range))
        read[(read < 0.1) | (self._lidar.random(beams) < figures.dropout)] = 0.0
        t, stated = (first, duration) if figures.stated else (first + duration // 2, 0)
        limits, ranges = (0.1, figures.range), tuple(read.tolist())
        return [msg.LaserScan("lidar", t, -math.pi, increment, *limits, ranges, stated)]


def _source(event: Event) -> str:
    return str(getattr(event, "motor", "") or getattr(event, "sensor", ""))
