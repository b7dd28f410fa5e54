"""Sensors that show nothing, and sources that contradict each other: noticed, named, acted on in time.

A brain drives through the kinematic office; from a moment on, or from the start, one thing is wrong. The
office's true pose is the judge.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from brain.belief import BrainState
from brain.brain import Brain, BrainSettings
from brain.perception.motion_check import MotionCheck
from brain.perception.mount import Mount
from brain.perception.perception import Perception, PerceptionSettings
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, seconds
from tests.brain.helpers import BODY, MOUNTS, TICK, TIMEOUTS, Office, Trip
from tests.brain.perception.office import box, scan_at

ACROSS = msg.Goal(-1.0, 3.0)
Fault = Callable[["Faulty", Event], Event]
Scale = tuple[float, float]
"""From what a wheel is commanded to its true motion, and from that to what it reports."""
EXACT, REVERSED, HALF = (1.0, 1.0), (-1.0, -1.0), (2.0, 0.5)
OTHER = {"left": "right", "right": "left"}


class Faulty(Office):
    """An office in which something is wrong: in the scales from the start, else once `fault` is set."""

    def __init__(self, mount: Mount = MOUNTS["lidar"], swapped: bool = False, **scales: Scale) -> None:
        super().__init__()
        self.fault: Fault | None = None
        self.mount = mount
        """The lidar's true one."""
        self.swapped = swapped
        """Left is right, for commands and feedback."""
        self.scales = {"left": EXACT, "right": EXACT} | scales
        self.kept: dict[type[Event], Event] = {}

    def step(self, commands: Sequence[Command]) -> list[Event]:
        """One tick, through what is wrong."""
        wanted: list[Command] = []
        for command in commands:
            motor = OTHER[command.motor] if self.swapped else command.motor
            velocity = command.velocity if isinstance(command, msg.Velocity) else 0.0
            wanted.append(msg.Velocity(motor, velocity * self.scales[motor][0]))
        return [self._through(event) for event in super().step(wanted)]

    def _through(self, event: Event) -> Event:
        if isinstance(event, msg.Feedback):
            motor = OTHER[event.motor] if self.swapped else event.motor
            event = replace(
                event, motor=motor, position=(event.position or 0.0) * self.scales[event.motor][1]
            )
        return event if self.fault is None else self.fault(self, event)

    def scan(self) -> msg.LaserScan:
        walls = np.array([wall for each in self.boxes for wall in box(*each)])
        return scan_at(walls, self.pose, self.mount, self.now, self._rng.normal(0.0, self.noise.range, 360))


def scans(change: Callable[[tuple[float, ...]], tuple[float, ...]]) -> Fault:
    def fault(_: Faulty, event: Event) -> Event:
        return replace(event, ranges=change(event.ranges)) if isinstance(event, msg.LaserScan) else event

    return fault


def rates(change: Callable[[float], float]) -> Fault:
    def fault(_: Faulty, event: Event) -> Event:
        if not isinstance(event, msg.Imu):
            return event
        return replace(event, angular_velocity=(0.0, 0.0, change(event.angular_velocity[2])))

    return fault


def frozen(kind: type[msg.Imu] | type[msg.LaserScan]) -> Fault:
    def fault(office: Faulty, event: Event) -> Event:
        if not isinstance(event, kind):
            return event
        return replace(office.kept.setdefault(kind, event), t=event.t)

    return fault


def jumped(office: Faulty, event: Event) -> Event:
    if isinstance(event, msg.Feedback) and event.motor == "left":
        return replace(event, position=(event.position or 0.0) + 3.0)
    return event


def remounted(mount: Mount) -> Fault:
    def fault(office: Faulty, event: Event) -> Event:
        office.mount = mount
        return event

    return fault


def slipping(office: Faulty, event: Event) -> Event:
    office.noise.slip = 1.0
    return event


@pytest.fixture(scope="module")
def under_way() -> Trip:
    """On its way across the room; to be copied."""
    trip = Trip(Faulty())
    trip.tick([ACROSS])
    trip.run(3.0)
    assert trip.brain.belief().state is BrainState.RUNNING
    assert trip.office.speed > 0.1
    return trip


def driven(trip: Trip, since: int) -> float:
    track = trip.track[since:]
    return sum(math.dist((a.x, a.y), (b.x, b.y)) for a, b in pairwise(track))


def assert_stopped(trip: Trip, since: int, within: float, distance: float, named: str) -> None:
    """Noticed within a time [s] and distance [m], named; the goal is dropped, and nothing resumes."""
    trip.states.clear()
    standing = trip.run(within, lambda b: named in b.reason and b.reason.endswith("standing"))
    assert named in standing.reason
    belief = trip.run(6.0, lambda b: b.state is BrainState.STOPPED)
    assert belief.state is BrainState.STOPPED
    assert belief.goal is None
    assert any("1 goal dropped" in text and named in text for _, text in trip.notes)
    moved = driven(trip, since)
    assert moved < distance
    trip.run(2.5)
    assert driven(trip, since) < moved + 1e-3
    assert trip.office.touched == 0


def assert_slow(trip: Trip) -> None:
    """It drives on, slowly."""
    trip.run(1.0)
    speeds = [(trip.run(0.1).state, trip.office.speed) for _ in range(20)]
    assert {state for state, _ in speeds} == {BrainState.DEGRADED}
    assert 0.1 < max(speed for _, speed in speeds) < 0.3 * BODY.max_linear + 0.01


NO_RETURNS = "0 of 360 rays have returns"
AS_BEFORE = "every value is as before"


def yawed(degrees: float) -> Mount:
    return replace(MOUNTS["lidar"], yaw=math.radians(degrees))


TURNED = yawed(180.0)


WRONG_ON_THE_WAY: dict[str, tuple[Fault, float, str]] = {
    "zeros": (scans(lambda ranges: (0.0,) * len(ranges)), 0.6, NO_RETURNS),
    "maxima": (scans(lambda ranges: (10.0,) * len(ranges)), 0.6, NO_RETURNS),
    "infinite": (scans(lambda ranges: (math.inf,) * len(ranges)), 0.6, NO_RETURNS),
    "a tenth": (scans(lambda r: tuple(v * (i % 10 == 0) for i, v in enumerate(r))), 0.6, "36 of 360 rays"),
    "mostly maxima": (scans(lambda r: (*r[:72], *(10.0,) * 288)), 0.4, "288 of 360 beams"),
    "too far": (scans(lambda ranges: tuple(length + 0.5 for length in ranges)), 0.4, "lidar"),
    "lidar frozen": (frozen(msg.LaserScan), 0.6, AS_BEFORE),
    "lidar turned by 180°": (remounted(TURNED), 0.4, "lidar: "),
    "lidar turned by 5°": (remounted(yawed(5.0)), 0.4, "lidar: turned"),
    "lidar shifted": (remounted(replace(MOUNTS["lidar"], x=0.62)), 0.4, "wheels or lidar: moved"),
    "bias": (rates(lambda rate: rate + 0.3), 1.0, "imu"),
    "small bias": (rates(lambda rate: rate + 0.1), 4.0, "imu"),
    "wheels spin": (slipping, 1.0, "wheels or lidar: moved"),
    "encoder jumps": (jumped, 0.1, "left: its position jumped"),
}
"""By name: the fault, when the base must begin to stand [s], and part of the reason."""


@pytest.mark.sample(6)
@pytest.mark.parametrize(("fault", "within", "named"), WRONG_ON_THE_WAY.values(), ids=list(WRONG_ON_THE_WAY))
def test_what_goes_wrong_on_the_way(under_way: Trip, fault: Fault, within: float, named: str) -> None:
    trip = copy.deepcopy(under_way)
    assert isinstance(trip.office, Faulty)
    trip.office.fault = fault
    assert_stopped(trip, len(trip.track), within, 0.5 if within <= 1.0 else 2.0, named)


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("office", "distance", "named"),
    [
        (Faulty(swapped=True), 0.3, "wheels"),
        (Faulty(left=REVERSED), 0.3, "wheels"),
        (Faulty(left=REVERSED, right=REVERSED), 0.3, "wheels"),
        (Faulty(right=HALF), 0.31, "wheels"),
        (Faulty(left=HALF, right=HALF), 0.6, "wheels"),
        (Faulty(mount=TURNED), 0.4, "wheels or lidar: moved"),
        (Faulty(mount=yawed(14.0)), 2.5, "mounted +1"),
    ],
    ids=["swapped", "reversed", "both-reversed", "half", "both-half", "lidar-180", "lidar-14"],
)
def test_what_is_wrong_from_the_start(office: Faulty, distance: float, named: str) -> None:
    trip = Trip(office)
    trip.tick([ACROSS])
    trip.run(0.3)
    assert_stopped(trip, 0, 9.0, distance, named)


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("mount", "named"),
    [(yawed(-2.0), "lidar: mounted -"), (replace(MOUNTS["lidar"], x=0.22), "m ahead")],
    ids=["2°", "0.1 m"],
)
def test_with_a_lidar_mounted_a_little_otherwise_it_drives_on_slowly(mount: Mount, named: str) -> None:
    trip = Trip(Faulty(mount=mount))
    trip.tick([ACROSS])
    assert named in trip.run(9.0, lambda b: "mounted" in b.reason).reason
    assert_slow(trip)
    assert trip.run(40.0, lambda b: b.reached == 1).reached == 1
    assert (
        mount.yaw == 0.0 or math.dist((trip.office.pose.x, trip.office.pose.y), (ACROSS.x, ACROSS.y)) < 0.08
    )


def silent(_: Faulty, event: Event) -> Event:
    return msg.Imu("other", event.t, (0.0,) * 3, (0.0,) * 3) if isinstance(event, msg.Imu) else event


@pytest.mark.parametrize(("fault", "named"), [(frozen(msg.Imu), AS_BEFORE), (silent, "imu: no reading for")])
def test_without_the_gyro_it_drives_on_slowly(under_way: Trip, fault: Fault, named: str) -> None:
    trip = copy.deepcopy(under_way)
    assert isinstance(trip.office, Faulty)
    trip.office.fault = fault
    assert named in trip.run(0.4, lambda b: b.state is BrainState.DEGRADED).reason
    assert_slow(trip)


def test_a_gyro_that_never_reports_is_awaited_for_three_seconds() -> None:
    trip = Trip(Faulty())
    trip.office.silent = {"imu"}
    assert trip.run(2.9).state is BrainState.INITIALISING
    belief = trip.run(0.3)
    assert (belief.state, belief.reason) == (BrainState.DEGRADED, "imu has never reported: slow")


def test_a_reversed_gyro_is_noticed_when_the_base_turns() -> None:
    office = Faulty()
    office.fault = rates(lambda rate: -rate)
    trip = Trip(office)
    trip.tick([ACROSS])
    assert_stopped(trip, 0, 2.0, 0.3, "imu")
    assert abs(office.pose.yaw) < math.radians(40.0)


def test_a_rate_however_large_is_noticed_and_keeps_the_sums_finite() -> None:
    check = MotionCheck(BODY)
    for i in range(100):
        check.on_wheels(i * TICK, (i + 1) * TICK, 0.005, 0.0, 0.0, 0.03)
        check.on_gyro("imu", i * TICK, 1.7e308)
    assert [one.confirmed for one in check.contradictions()] == [True]


def test_without_a_lidar_wheels_and_gyro_are_compared() -> None:
    trip = Trip(Faulty(swapped=True))
    trip.office.silent = {"lidar"}
    timeouts = {name: TIMEOUTS[name] for name in ("left", "right", "imu")}
    trip.brain = Brain(trip.brain.settings, ["left", "right"], {"imu": Mount()}, timeouts)
    for _ in range(200):
        trip.tick([msg.Drive(0.0, 1.0)])
    assert trip.brain.belief().state is BrainState.STOPPED
    assert abs(trip.office.pose.yaw) < 0.5
    assert ("error", f"stopped: {trip.brain.belief().reason}") in trip.notes


def test_one_bad_scan_makes_it_slow_and_the_next_good_one_fast_again(under_way: Trip) -> None:
    trip = copy.deepcopy(under_way)
    office = trip.office
    assert isinstance(office, Faulty)
    office.mount = TURNED
    trip.run(0.1)
    office.mount = MOUNTS["lidar"]
    trip.states.clear()
    trip.run(1.0)
    assert trip.states == ["degraded", "running"]
    assert not any("standing" in text for _, text in trip.notes)
    assert trip.run(30.0, lambda b: b.reached == 1).reached == 1


def test_a_lidar_that_is_back_after_a_gap_is_not_compared_with_the_scan_before_it() -> None:
    """Health lets it drive on slowly for most of the lidar's timeout."""
    trip = Trip(Faulty(), timeouts={**TIMEOUTS, "lidar": 6 * SECOND})
    trip.tick([ACROSS])
    trip.run(3.0)
    trip.office.silent = {"lidar"}
    trip.run(2.9)
    trip.office.silent = set()
    assert trip.run(30.0, lambda b: b.reached == 1).reached == 1
    assert not any("agree" in text or "moved" in text for _, text in trip.notes)


def test_a_robot_pushed_aside_at_rest_is_lost_and_then_ready() -> None:
    trip = Trip(Faulty())
    trip.run(1.0)
    trip.office.pose = replace(trip.office.pose, y=0.3)
    assert trip.run(3.0, lambda b: b.state is BrainState.STOPPED).state is BrainState.STOPPED
    assert trip.run(5.0, lambda b: b.state is BrainState.READY).state is BrainState.READY


# -- what shows nothing --------------------------------------------------------------------------


def test_a_lidar_that_shows_nothing_is_missing_at_the_start() -> None:
    office = Faulty()
    office.fault = scans(lambda ranges: (10.0,) * len(ranges))
    belief = Trip(office).run(1.0)
    assert belief.state is BrainState.INITIALISING
    assert belief.reason == f"waiting for a reading of lidar ({NO_RETURNS})"
    assert belief.map is not None
    assert not belief.map.log_odds.any()


def test_where_open_ground_is_expected_it_drives_but_nothing_is_free_space() -> None:
    open_ground = PerceptionSettings(least_returns=0.0)
    office = Faulty()
    office.fault = scans(lambda ranges: (10.0,) * len(ranges))
    trip = Trip(office, BrainSettings(BODY, perception=open_ground))
    assert trip.run(1.0).state is BrainState.READY
    for _ in range(100):
        belief = trip.tick([msg.Drive(0.3, 0.0)])
    assert trip.office.speed > 0.25
    assert belief.map is not None
    assert not belief.map.log_odds.any()


def test_an_imu_may_repeat_itself_for_less_than_a_fifth_of_a_second() -> None:
    """One with a coarse resolution does at rest."""
    perception = Perception(BODY, MOUNTS, PerceptionSettings())

    def absent(t: Nanos, rate: float) -> dict[str, str]:
        perception.observe(t, [msg.Imu("imu", t, (0.0, 0.0, rate), (0.0, 0.0, 9.81))])
        return perception.absent

    for i in range(200):
        assert not absent(i * 5 * MILLISECOND, 0.001 * (i // 40))  # 40 equal ones, over 195 ms
    assert absent(1000 * MILLISECOND, 0.004) == {"imu": f"{AS_BEFORE}: it does not measure"}


# -- stamps from the future ----------------------------------------------------------------------


@pytest.mark.parametrize("source", ["left", "lidar", "imu"])
def test_a_stamp_from_the_future_keeps_no_source_fresh(under_way: Trip, source: str) -> None:
    """Stamps 10 s ahead, then silence; and the estimate goes on."""
    trip = copy.deepcopy(under_way)
    office = trip.office
    assert isinstance(office, Faulty)

    def ahead(_: Faulty, event: Event) -> Event:
        mine = getattr(event, "motor", getattr(event, "sensor", "")) == source
        return replace(event, t=event.t + 10 * SECOND) if mine else event

    office.fault = ahead
    trip.run(0.1)
    office.fault = None
    office.silent = {source}
    assert trip.run(1.0, lambda b: "standing" in b.reason).reason.startswith(f"{source}: no ")
    office.silent = set()
    belief = trip.run(1.0)
    assert belief.estimate is not None
    assert seconds(office.now - belief.estimate.t) < 0.05
