"""Calibration: a drive in the kinematic office, whose wheels and lidar are not as the robot file says."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import pytest

from brain.belief import Pose
from gateway.bench import verdict
from gateway.bench.calibrate import Calibration, calibrate
from gateway.bench.drive import Leg, PatternDrive, legs
from gateway.bench.driven import of_events
from gateway.bench.geometry import corrected
from gateway.bench.wheel_path import Factors
from gateway.config import load_robot, parse_robot
from gateway.core.robot import Robot
from gateway.errors import ConfigError, UserError
from gateway.runtime.session import open_session
from protocols.messages import MILLISECOND, Event, Imu, LaserScan, Velocity
from tests.brain.helpers import BODY, MOUNTS
from tests.brain.test_contradictions import Faulty
from tests.gateway.runtime.test_drive_doctor import mirrored

ROBOT = load_robot("diffbot")
TRUE = replace(MOUNTS["lidar"], yaw=0.07, x=0.10, y=0.03)

ROOM = (
    (-3.1, -2.6, 3.1, -2.5),
    (-3.1, 2.2, 3.1, 2.3),
    (-2.7, -2.6, -2.6, 2.3),
    (2.9, -2.6, 3.0, 2.3),
    (1.6, 1.3, 2.1, 1.7),
    (-1.9, -1.7, -1.6, -1.2),
)


def driven(office: Faulty, rounds: int = 2) -> Calibration:
    """Drive the legs in an office, and calibrate by what was reported."""
    office.boxes, office.pose = list(ROOM), Pose(0.0, 0.0, 0.0)
    made = PatternDrive(BODY, legs(BODY, 0.6, rounds))
    commands: list[Velocity] = []
    while True:
        made.observe(office.step(commands))
        wanted = made.commands(office.now)
        if wanted is None:
            assert not made.ended
            return calibrate(of_events(ROBOT, lambda: made.events))
        commands = [one for one in wanted if isinstance(one, Velocity)]


def scaled(factor: float) -> tuple[float, float]:
    """Return the scales of a wheel whose true radius is so many times the stated one."""
    return factor, 1.0 / factor


def test_wheels_and_a_lidar_that_are_a_little_off_are_found() -> None:
    made = driven(Faulty(TRUE, left=scaled(1.04), right=scaled(1.04)))
    found = {one.name: one for one in verdict.figures(made)}
    true = {
        "wheel_radius": (0.05 * 1.04, 0.005 * 0.05),
        "wheel_separation": (0.22, 0.01 * 0.22),
        "lidar yaw": (TRUE.yaw, math.radians(0.5)),
        "lidar x": (TRUE.x, 0.005),
        "lidar y": (TRUE.y, 0.005),
    }
    for name, (value, within) in true.items():
        one = found[name]
        assert abs(one.value - value) < within, one
        assert abs(one.value - value) < 4.0 * one.sigma + 1e-4, one
    assert found["wheel_radius"].differs
    assert not found["wheel_separation"].differs
    assert verdict.named(made) == []
    text = "\n".join(verdict.lines(made))
    assert "[brain.differential]\nwheel_radius = 0.05" in text
    at = re.search(r"\[sensors\.lidar\]\nmount = \{ x = (0\.\d+)", text)
    assert at is not None
    assert abs(float(at[1]) - 0.1) < 0.003
    assert "z = 0.1200" in text  # as stated: no drive shows it
    assert "wheel_separation" not in text


NAMED: dict[str, tuple[Callable[[], Faulty], str]] = {
    "radius": (
        lambda: Faulty(left=scaled(0.5), right=scaled(0.5)),
        "wheel_radius is about 2 times too large",
    ),
    "mirrored": (lambda: _with(mirrored), "lidar is mirrored"),
    "90°": (lambda: Faulty(replace(MOUNTS["lidar"], yaw=math.pi / 2.0)), "lidar is turned by +90°"),
    "swapped": (lambda: Faulty(swapped=True), "left and right are swapped"),
}


def _with(fault: Callable[..., object]) -> Faulty:
    office = Faulty()
    office.fault = fault  # type: ignore[assignment]
    return office


@pytest.mark.sample(1)
@pytest.mark.parametrize(("office", "said"), NAMED.values(), ids=list(NAMED))
def test_what_is_grossly_wrong_is_named(office: Callable[[], Faulty], said: str) -> None:
    assert any(said in one for one in verdict.named(driven(office(), 1)))


def test_a_drive_that_shows_nothing_is_said_to_show_nothing() -> None:
    office = Faulty()
    events = [event for _ in range(300) for event in office.step(())]
    with pytest.raises(UserError, match="show 0 motions: at least 12 are needed"):
        calibrate(of_events(ROBOT, lambda: events))
    with pytest.raises(UserError, match="no scans of a lidar"):
        calibrate(of_events(ROBOT, lambda: [one for one in events if not isinstance(one, LaserScan)]))
    with pytest.raises(UserError, match="no angles of left, right"):
        calibrate(of_events(ROBOT, tuple))


def test_something_near_ends_the_drive() -> None:
    office, made = Faulty(), PatternDrive(BODY, [Leg(0.3, 0.0, 60.0)])
    for _ in range(6000):
        made.observe(
            office.step([one for one in made.commands(office.now) or () if isinstance(one, Velocity)])
        )
        if made.ended:
            break
    assert "sees something 0.3" in made.ended
    assert office.touched == 0


def test_without_scans_it_does_not_drive_on() -> None:
    office, made, ticks = Faulty(), PatternDrive(BODY, [Leg(0.0, 0.3, 60.0)]), 0
    while not made.ended and ticks < 600:
        ticks += 1
        office.silent = {"lidar"} if ticks > 200 else set()
        wanted = made.commands(office.now) or ()
        made.observe(office.step([one for one in wanted if isinstance(one, Velocity)]))
    assert made.ended == "no scan has come for 1 s: it would drive blindly"
    assert 290 <= ticks <= 320


@pytest.mark.parametrize(
    ("robot", "keys"),
    [
        ("diffbot", {"wheel_radius": 0.0525, "wheel_separation": 0.2310}),
        ("skid_steer", {"wheel_radius": 0.084, "effective_separation": 0.651}),
        ("tracked", {"wheel_radius": None, "effective_separation": None}),
        ("ackermann", {"wheel_radius": None, "wheelbase": None, "wheel_separation": None}),
        ("mecanum", {"wheel_radius": None, "wheelbase": None, "wheel_separation": None}),
    ],
)
def test_the_numbers_of_any_body_make_up_for_factors(robot: str, keys: dict[str, float | None]) -> None:
    body = load_robot(robot).brain.base
    assert body is not None
    found = corrected(body, Factors(1.05, 1.0))
    assert set(found) == set(keys)
    for key, value in keys.items():
        assert value is None or found[key] == pytest.approx(value, rel=1e-3)
    assert found["wheel_radius"] == pytest.approx(1.05 * getattr(body, "wheel_radius"), rel=1e-6)  # noqa: B009


# -- late stamps, and the scale of a gyro ----------------------------------------------------------------

LATE, SCALE = 40 * MILLISECOND, 1.05


def stated(late: str = "", scale: str = "") -> Robot:
    """Return diffbot with what its file states of lidar and gyro."""
    text = ROBOT.text.replace("[sensors.lidar]\n", f"[sensors.lidar]\n{late}")
    return parse_robot(text.replace("[sensors.imu]\n", f"[sensors.imu]\n{scale}"))


def test_a_sensor_has_the_errors_that_its_file_states_and_the_brain_sees_none_of_them() -> None:
    """Readings on the wire are late and scaled; after the step they are those of one without errors."""
    scans, rates, wires = list[list[int]](), list[list[float]](), list[list[object]]()
    for robot in (ROBOT, stated("late_ms = 40\n", "gyro_scale = 1.05\n")):
        with open_session(robot, simulated=True, seed=3) as session:
            ticks = list(session.run(1.5))
        events = [event for tick in ticks for event in tick.outputs.events]
        scans.append([one.t for one in events if isinstance(one, LaserScan)])
        rates.append([one.angular_velocity[2] for one in events if isinstance(one, Imu)])
        wires.append([one.frame for tick in ticks for one in tick.inputs.packets if one.bus == "sensors"])
    assert wires[0] != wires[1]
    assert len(scans[1]) > 10
    assert all(abs(a - b) <= 5 * MILLISECOND for a, b in zip(*scans, strict=False))
    assert len(rates[1]) > 100
    assert all(b == pytest.approx(a, rel=1e-5, abs=1e-6) for a, b in zip(*rates, strict=False))


def test_the_keys_of_late_stamps_and_a_scale_are_bounded_and_of_a_gyro() -> None:
    for late, scale, why in (
        ("late_ms = -1\n", "", "late_ms"),
        ("late_ms = 501\n", "", "late_ms"),
        ("", "gyro_scale = 0.0\n", "gyro_scale"),
        ("", "gyro_scale = 2.1\n", "gyro_scale"),
    ):
        with pytest.raises(ConfigError, match=why):
            stated(late, scale)
    lidar = load_robot("diffbot_rplidar").text.replace(
        "[sensors.rplidar]\n", "[sensors.rplidar]\ngyro_scale = 1.1\n"
    )
    with pytest.raises(ConfigError, match="'rplidar' measures no rate of turn here"):
        parse_robot(lidar)


def test_what_a_drive_shows_of_stamps_and_scale_is_put_into_the_file_and_then_nothing_is_left() -> None:
    def erring(_: Faulty, event: Event) -> Event:
        if isinstance(event, LaserScan):
            return replace(event, t=event.t + LATE)
        if isinstance(event, Imu):
            x, y, z = (SCALE * rate for rate in event.angular_velocity)
            return replace(event, angular_velocity=(x, y, z))
        return event

    text = "\n".join(verdict.lines(driven(_with(erring))))
    late, scale = re.search(r"late_ms = ([0-9.]+)", text), re.search(r"gyro_scale = ([0-9.]+)", text)
    assert late is not None
    assert scale is not None
    assert float(late[1]) == pytest.approx(LATE / MILLISECOND, abs=8.0)
    assert float(scale[1]) == pytest.approx(SCALE, rel=0.005)
    robot = stated(f"{late[0]}\n", f"{scale[0]}\n")
    read = robot.sensors["imu"].corrected(Imu("imu", 5, (0.0, 0.0, SCALE), (0.0, 0.0, 9.81)))
    assert isinstance(read, Imu)
    assert read.angular_velocity[2] == pytest.approx(1.0, rel=0.005)
    assert abs(robot.sensors["lidar"].late - LATE) < 8 * MILLISECOND
