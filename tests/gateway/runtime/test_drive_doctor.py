"""The usual troubles above the wires, each provoked, and what the doctor says; two causes at once as well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import pytest

from brain.belief import Belief
from brain.brain import BrainSettings
from gateway.config import load_robot
from gateway.core.robot import Robot
from gateway.runtime.doctor import Finding
from gateway.runtime.drive_doctor import DriveDoctor, from_file
from gateway.runtime.status import NOTHING, finding_lines
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event
from tests.brain.helpers import MOUNTS, TIMEOUTS, Trip
from tests.brain.test_contradictions import HALF, REVERSED, Fault, Faulty, scans, slipping, yawed
from tests.gateway.runtime.doctor_page import holds

ACROSS, AHEAD = msg.Goal(-1.0, 3.0), msg.Goal(1.5, 0.0)
ROBOT = load_robot("diffbot")
CALIBRATE = "gateway calibrate base diffbot"


def mirrored(_: Faulty, event: Event) -> Event:
    if not isinstance(event, msg.LaserScan):
        return event
    last = event.angle_min + event.angle_increment * (len(event.ranges) - 1)
    return replace(event, ranges=event.ranges[::-1], angle_min=-last)


def clock_jumped(office: Faulty, event: Event) -> Event:
    ahead = isinstance(event, msg.Imu) and office.now > 3 * SECOND
    return replace(event, t=event.t - 40 * SECOND) if ahead else event


def upside_down(_: Faulty, event: Event) -> Event:
    if not isinstance(event, msg.Imu):
        return event
    x, y, z = event.angular_velocity
    return replace(event, angular_velocity=(x, -y, -z), linear_acceleration=(0.0, 0.0, -9.81))


def both(*faults: Fault) -> Fault:
    def fault(office: Faulty, event: Event) -> Event:
        for one in faults:
            event = one(office, event)
        return event

    return fault


@dataclass
class Blocked(Faulty):
    """Wheels that turn nothing, whatever they are commanded."""

    def __init__(self) -> None:
        super().__init__()

    def step(self, commands: Sequence[Command]) -> list[Event]:
        return super().step([msg.Idle(one.motor) for one in commands])


class Late(Faulty):
    """Scans that come late, and are stamped when they come."""

    def __init__(self, span: int) -> None:
        super().__init__()
        self.span, self.waiting = span, list[msg.LaserScan]()

    def step(self, commands: Sequence[Command]) -> list[Event]:
        found = super().step(commands)
        self.waiting += [one for one in found if isinstance(one, msg.LaserScan)]
        ripe = [one for one in self.waiting if one.t + self.span <= self.now]
        self.waiting = [one for one in self.waiting if one not in ripe]
        return [one for one in found if not isinstance(one, msg.LaserScan)] + [
            replace(one, t=one.t + self.span) for one in ripe
        ]


class Spinning(Faulty):
    """It turns on the spot, and what wheels and gyro say of that is as it should be."""

    def step(self, commands: Sequence[Command]) -> list[Event]:
        return super().step([msg.Velocity("left", -3.0), msg.Velocity("right", 3.0)] if commands else ())


@dataclass
class Case:
    """One trouble: what is wrong, what is asked for, and what must be said of what."""

    office: Callable[[], Faulty]
    task: msg.Goal | msg.Drive
    said: tuple[tuple[str, str, str], ...]
    """Of what, part of what was seen, part of what to type"""
    span: float = 8.0
    held: bool = False
    """The task is repeated, as a stick is held"""
    settings: BrainSettings | None = None
    timeouts: dict[str, int] = field(default_factory=lambda: dict(TIMEOUTS))


def faulty(fault: Fault) -> Callable[[], Faulty]:
    def make() -> Faulty:
        office = Faulty()
        office.fault = fault
        return office

    return make


LARGE = 0.5, 2.0
FORWARD, TURN = msg.Drive(0.3, 0.0), msg.Drive(0.0, 0.8)
CASES: dict[str, Case] = {
    "wheels twice too large": Case(
        lambda: Faulty(left=LARGE, right=LARGE),
        FORWARD,
        (("wheels", "times too large", CALIBRATE),),
        held=True,
    ),
    "wheels half as large": Case(
        lambda: Faulty(left=HALF, right=HALF),
        FORWARD,
        (("wheels", "times too small", CALIBRATE),),
        held=True,
    ),
    "left wheel reversed": Case(
        lambda: Faulty(left=REVERSED),
        FORWARD,
        (("wheels", "the left wheel rolls backward", "gateway jog left"),),
        held=True,
    ),
    "wheels swapped": Case(
        lambda: Faulty(swapped=True), ACROSS, (("wheels", "left and right are swapped", "gateway jog"),)
    ),
    "lidar turned by 90°": Case(
        lambda: Faulty(mount=yawed(90.0)), FORWARD, (("lidar", "turned by +90°", CALIBRATE),), held=True
    ),
    "lidar mirrored": Case(faulty(mirrored), ACROSS, (("lidar", "mirrored", CALIBRATE),)),
    "scans late": Case(lambda: Late(150 * MILLISECOND), ACROSS, (("lidar", "ms late", CALIBRATE),), 12.0),
    "imu upside down": Case(faulty(upside_down), ACROSS, (("imu", "upside down", "roll = 3.1416"),)),
    "clock of the imu jumped": Case(
        faulty(clock_jumped), FORWARD, (("imu", "stamps are +40.0 s off", "gateway inspect"),)
    ),
    "no returns": Case(
        faulty(scans(lambda ranges: (0.0,) * len(ranges))), AHEAD, (("lidar", "no map: ", "gateway watch"),)
    ),
    "blocked wheels": Case(
        Blocked, AHEAD, (("wheels", "the wheels do not turn", "gateway tune diffbot left"),)
    ),
    "goal inside an obstacle": Case(
        Faulty, msg.Goal(-2.05, 0.0), (("planning", "inside an obstacle", "gateway ask diffbot drop"),), 25.0
    ),
    "goal behind walls": Case(
        Faulty, msg.Goal(20.0, 20.0), (("planning", "no path", "gateway ask diffbot view"),), 60.0
    ),
    "wheels in the air": Case(
        faulty(slipping), FORWARD, (("perception", "has moved by", "gateway ask diffbot status"),), held=True
    ),
    "spinning": Case(Spinning, AHEAD, (("wheels", "is not nearer", CALIBRATE),), 16.0),
    "swapped, and the imu's clock jumped": Case(
        lambda: _with(Faulty(swapped=True), clock_jumped),
        ACROSS,
        (("wheels", "swapped", "gateway jog"), ("imu", "stamps are", "gateway inspect")),
    ),
    "lidar at 90°, and the imu upside down": Case(
        lambda: _with(Faulty(mount=yawed(90.0)), upside_down),
        FORWARD,
        (("lidar", "turned by +90°", CALIBRATE), ("imu", "upside down", "roll = 3.1416")),
        held=True,
    ),
}


def _with(office: Faulty, fault: Fault) -> Faulty:
    office.fault = fault
    return office


def examined(case: Case, robot: Robot = ROBOT) -> tuple[list[Finding], float]:
    """Drive with the trouble; return what the doctor has found, and how many seconds after the beginning of
    the task all that must be said was."""
    trip, doctor = Trip(case.office(), case.settings, case.timeouts), DriveDoctor(robot, MOUNTS)
    events: list[Event] = []
    when: float | None = None
    step = trip.office.step

    def kept(commands: Sequence[Command]) -> list[Event]:
        events[:] = step(commands)
        return list(events)

    trip.office.step = kept  # type: ignore[method-assign]
    for number in range(round(case.span * 100)):
        tasks: tuple[msg.Goal | msg.Drive, ...] = (
            (case.task,) if number == 50 or (case.held and number > 50) else ()
        )
        belief: Belief = trip.tick(tasks)
        doctor.look(trip.office.now, events, tasks, belief)
        if number % 50 == 0 and number > 50 and when is None and is_said(case, doctor.findings()):
            when = number / 100.0 - 0.5
    return doctor.findings(), when or case.span


def is_said(case: Case, findings: Sequence[Finding]) -> bool:
    """Return whether all that must be said of a case was."""
    return all(
        any(one.about == about and seen in one.seen and todo in one.todo for one in findings)
        for about, seen, todo in case.said
    )


@pytest.mark.sample(6)
@pytest.mark.parametrize("trouble", CASES)
def test_each_trouble_is_named_with_what_to_type_as_the_page_has_it(trouble: str) -> None:
    found, when = examined(CASES[trouble])
    holds(trouble, CASES[trouble].said, found, when)
    assert all(one.matters for one in found)


def test_of_a_good_drive_nothing_is_said() -> None:
    assert examined(Case(Faulty, ACROSS, (), 20.0))[0] == []


def test_limits_that_are_too_small_are_found_in_the_file() -> None:
    base, left = ROBOT.brain.base, ROBOT.motors["left"]
    assert base is not None
    assert from_file(ROBOT) == []
    slow = replace(left, joint=replace(left.joint, limits=replace(left.joint.limits, velocity=0.5)))
    weak = replace(base, max_linear_acceleration=0.01)
    robot = replace(ROBOT, motors={**ROBOT.motors, "left": slow}, brain=replace(ROBOT.brain, body=weak))
    said = [(one.about, one.seen) for one in from_file(robot)]
    assert said == [
        ("brain.differential", "max_linear_acceleration = 0.01 m/s²: too small to move"),
        ("left", "its velocity limit, 0.5 rad/s, lets the base drive 0.025 of 0.6 m/s"),
    ]


def test_a_running_robot_says_what_it_has_seen() -> None:
    lines = finding_lines(
        [Finding(True, "wheels", "they slip", "it is lost", "gateway check x")], explain=True
    )
    assert lines == [
        "!! wheels: they slip",
        "     why it matters: it is lost",
        "     what to do: gateway check x",
        "1 findings, 1 of them grave",
    ]
    assert finding_lines([], explain=True) == [NOTHING]
