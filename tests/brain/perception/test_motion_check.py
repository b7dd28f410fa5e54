"""Lies of wheels, gyro and lidar against a kinematic base in the office; and that ordinary driving is none.

The base follows true poses, not an estimate: what is found here, no map or filter has helped to find.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import pytest

from brain.bodies.differential import Differential
from brain.bodies.plane import wrap
from brain.perception.body_scan import to_body
from brain.perception.motion_check import MotionCheck
from brain.perception.mount import Mount
from brain.perception.track import GAP, SourceTrack
from protocols.messages import MILLISECOND, Feedback, Imu, LaserScan, Velocity, seconds
from tests.brain.bodies.kinematics import speeds
from tests.brain.perception.rolling import shown
from tests.robustness.plant import Base, Figures, scene

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
MOUNT = Mount(x=0.12)
INSTANT = Figures(sweep=False)


@dataclass
class Drive:
    """A base, and what the check holds against its sources."""

    figures: Figures = INSTANT
    true: Mount = MOUNT
    mount: Mount = MOUNT
    """As the check has corrected it"""
    lie: float = 0.0
    """rad/s, of the gyro"""
    seed: int = 1
    found: list[tuple[float, str]] = field(default_factory=list)
    """When [s] and what: confirmed, or to be driven with slowly"""

    def __post_init__(self) -> None:
        mounted = self.true.x, self.true.y, self.true.yaw
        self.base = Base(scene("office"), BODY, mounted, self.figures, self.seed)
        self.check = MotionCheck(BODY)
        self.began = self.base.now
        self.wheels: dict[str, float] = {}
        self.last = self.base.now

    @property
    def time(self) -> float:
        """s, since the beginning"""
        return seconds(self.base.now - self.began)

    def step(self, linear: float, angular: float) -> None:
        """Drive for 10 ms."""
        left, right = speeds(BODY, linear, angular)
        before = dict(self.wheels)
        for event in self.base.step([Velocity("left", left), Velocity("right", right)]):
            if isinstance(event, Imu):
                self.check.on_gyro("imu", event.t, event.angular_velocity[2] + self.lie)
            elif isinstance(event, Feedback):
                self.wheels[event.motor] = event.position or 0.0
            elif isinstance(event, LaserScan):
                scan = to_body(event, self.mount, 12.0)
                yaw = self.check.on_scan("lidar", event.t + event.duration, scan)
                self.mount = replace(self.mount, yaw=self.mount.yaw + yaw)
        if before:
            ends = [[angles[motor] for motor in BODY.joints] for angles in (before, self.wheels)]
            self.check.on_wheels(self.last, self.base.now, *shown(BODY, *ends))
        self.last = self.base.now
        now = [one for one in self.check.contradictions() if one.confirmed or one.flawed]
        self.found += [(self.time, one.reason) for one in now]

    def straight(self, speed: float, span: float) -> None:
        """Accelerate, and drive straight on for a time [s]."""
        for i in range(round(span * 100)):
            self.step(min(speed, 0.01 * i), 0.0)

    def turn(self, rate: float, span: float) -> None:
        """Turn on the spot."""
        for _ in range(round(span * 100)):
            self.step(0.0, rate)

    def tour(self, goals: Sequence[tuple[float, float]]) -> None:
        """Drive from place to place of the world."""
        linear = 0.0
        for x, y in goals:
            while (way := math.dist((x, y), (self.base.pose.x, self.base.pose.y))) > 0.1:
                bearing = math.atan2(y - self.base.pose.y, x - self.base.pose.x)
                aside = wrap(bearing - self.base.pose.yaw)
                wanted = min(0.5, 2.0 * way) * math.cos(aside) if abs(aside) < 0.5 else 0.0
                linear += min(max(wanted - linear, -0.008), 0.008)
                self.step(linear, min(max(3.0 * aside, -1.5), 1.5))


ROUND = [
    (2.6, 1.05),
    (5.2, 0.95),
    (5.4, -1.8),
    (5.2, 0.95),
    (2.6, 1.05),
    (0.0, 0.0),
    (-0.8, -2.0),
    (0.2, 1.8),
]
"""In the office: through the doorway, and back."""
FEW = replace(INSTANT, beams=90, scan_hz=5.0, range_noise=0.03)
ORDINARY = {
    "slip 3 %": replace(INSTANT, slip=0.03),
    "slip 10 %": replace(INSTANT, slip=0.1),
    "radii": replace(INSTANT, radius_errors=(0.05, -0.05)),
    "separation": replace(INSTANT, slip=0.03, separation_error=0.1),
    "narrow": replace(INSTANT, slip=0.03, separation_error=-0.1),
    "few beams": replace(FEW, slip=0.1),
    "bias": replace(INSTANT, gyro_bias=0.05),
    "no gyro": replace(INSTANT, slip=0.1, imu=False),
}


@pytest.mark.sample(1)
@pytest.mark.parametrize("kind", ["radii", "few beams", "no gyro"])
def test_ordinary_driving_is_no_lie(kind: str) -> None:
    """All kinds, with 100 seeds each: `./go prove -k ordinary`."""
    drive = Drive(ORDINARY[kind])
    drive.tour(ROUND[:4])
    assert not drive.found


@pytest.mark.parametrize(
    ("true", "speed", "span", "named"),
    [
        (replace(MOUNT, yaw=math.radians(5.0)), 0.3, 2.0, "lidar: mounted +"),
        (replace(MOUNT, yaw=math.radians(-2.0)), 0.6, 2.0, "lidar: mounted -"),
        (replace(MOUNT, yaw=math.pi), 0.6, 2.0, "wheels or lidar: moved"),
    ],
)
def test_a_lidar_that_looks_aside_is_named_within_two_seconds(
    true: Mount, speed: float, span: float, named: str
) -> None:
    drive = Drive(true=true)
    drive.straight(speed, span)
    assert drive.found
    assert drive.found[0][1].startswith(named)


def test_a_yaw_that_is_off_is_corrected_to_half_a_degree() -> None:
    true = replace(MOUNT, yaw=math.radians(-5.0))
    drive = Drive(true=true)
    drive.straight(0.5, 4.0)
    assert drive.mount.yaw == pytest.approx(true.yaw, abs=math.radians(0.5))
    drive.turn(1.0, 2.0)
    assert drive.found[-1][1].startswith("lidar: mounted -")


@pytest.mark.parametrize(
    ("x", "y", "named"),
    [(0.22, 0.0, "+0.10 (±0.0"), (0.12, -0.1, "-0.10 (±0.0")],
)
def test_a_lidar_that_stands_elsewhere_shows_in_turns(x: float, y: float, named: str) -> None:
    drive = Drive(true=Mount(x=x, y=y))
    drive.turn(1.0, 4.0)
    assert named in drive.found[-1][1]


@pytest.mark.parametrize("lie", [0.1, -0.1])
@pytest.mark.parametrize("known", [0.0, 3.0])
def test_a_gyro_that_lies_a_little_is_named_whenever_that_began(lie: float, known: float) -> None:
    for moving in (0.0, 0.4):
        drive = Drive(lie=lie if known == 0.0 else 0.0)
        drive.turn(0.0, known)
        drive.lie = lie
        for i in range(600):
            drive.step(0.0, moving * math.cos(0.02 * i))
        drive.found = [one for one in drive.found if one[0] > known]
        assert drive.found[0][1].startswith("imu: ")
        assert drive.found[0][0] < known + 6.0


def test_one_scan_stamped_late_or_a_burst_of_them_confirms_nothing() -> None:
    """A host that stalls reads several at once."""
    drive = Drive()
    drive.turn(1.0, 1.0)
    t, ranges = drive.base.now, (3.0,) * 360
    for i in range(5):
        scan = LaserScan("lidar", t + i * MILLISECOND, -math.pi, math.tau / 360, 0.1, 10.0, ranges)
        drive.check.on_scan("lidar", scan.t, to_body(scan, MOUNT))
    assert [one.confirmed for one in drive.check.contradictions()] == [False]


def test_after_a_gap_a_track_begins_anew() -> None:
    """What comes then may be stamped late."""
    track = SourceTrack()
    track.add(0, GAP, 1.0, 0.2, 0.1, 0.0)
    motion = track.between(0, GAP)
    assert motion is not None
    assert motion.turn == pytest.approx(0.1)
    assert math.hypot(motion.x, motion.y) == pytest.approx(math.sin(0.1) / 0.1)
    track.add(GAP, 2 * GAP + 1, 1.0, 0.0, 0.0, 0.0)
    track.add(2 * GAP + 1, 3 * GAP, 0.5, 0.0, 0.0, 0.0)
    assert track.between(GAP, 3 * GAP) is None
    assert track.between(2 * GAP + 1, 3 * GAP) is not None
