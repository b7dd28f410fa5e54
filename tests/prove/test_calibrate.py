"""Calibration in rooms, with robots, that nobody tuned to: seeded, simulated, driven by their twins.

The plant's wheels, track, lidar and gyro differ from the robot file; stamps are late. Radius, track and yaw
must be found within 0.5 %, 1 % and 0.5°, and be off by no more than their standard deviations allow. What a
wheel rolls is measured in the world: under its load a tyre sinks into the floor, by some 0.3 % of its radius.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from brain.bodies.plane import wrap
from gateway.bench import verdict
from gateway.bench.calibrate import calibrate
from gateway.bench.drive import PatternDrive, bare_robot, drive, legs
from gateway.bench.driven import of_events
from gateway.buses.virtual.bus import TwinWorld
from gateway.config import load_robot
from gateway.core.clock import SimulatedClock
from gateway.core.step import Gateway
from gateway.runtime.session import Session
from gateway.sim import PlantFile, World, WorldFile, parse_plant, parse_world
from gateway.sim.plant_files import WheeledFile
from protocols.messages import SECOND, Event, Imu, LaserScan

ROBOT = load_robot("diffbot")
SEEDS = 14


@dataclass(frozen=True)
class Truth:
    """What is not as stated."""

    radius: float
    """m, of a tyre without load"""
    separation: float
    yaw: float
    x: float
    y: float
    scan_late: float
    gyro_late: float
    gyro_scale: float


def room(seed: int) -> WorldFile:
    """Return four walls and four boxes, nothing within 1.6 m of the start."""
    draw = np.random.Generator(np.random.PCG64(seed)).uniform
    west, east, south, north = -draw(1.8, 3.5), draw(1.8, 4.0), -draw(1.8, 3.5), draw(1.8, 3.5)
    corners = [(west, south), (east, south), (east, north), (west, north)]
    text = 'kind = "scene"\nname = "room"\n'
    for number, (a, b) in enumerate(zip(corners, [*corners[1:], corners[0]], strict=True)):
        text += f"[walls.w{number}]\nstart = [{a[0]:.3f}, {a[1]:.3f}]\nend = [{b[0]:.3f}, {b[1]:.3f}]\n"
    for number in range(4):
        angle, far = draw(0.0, 2.0 * math.pi), draw(1.7, 2.3)
        text += f"[boxes.b{number}]\nx = {far * math.cos(angle):.3f}\ny = {far * math.sin(angle):.3f}\n"
        text += f"yaw = {draw(0.0, 3.0):.3f}\nsize = [{draw(0.2, 0.5):.3f}, {draw(0.2, 0.5):.3f}, 0.6]\n"
    return parse_world(text)


def body(seed: int) -> tuple[PlantFile, Truth]:
    """Return a plant whose wheels and track are not as stated, and what is true."""
    draw = np.random.Generator(np.random.PCG64(1000 + seed)).uniform
    larger, separation, bias = draw(0.0, 0.06), 0.22 * draw(0.9, 1.1), draw(-0.02, 0.02)
    text = (Path(__file__).parents[2] / "fixtures/plants/diffbot.toml").read_text()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wheel = (
            f'{side} = {{ motor = "{side}", y = {sign * separation / 2.0:.5f}, radius_error = {larger:.5f} }}'
        )
        text = re.sub(rf"^{side} = .*$", wheel, text, flags=re.MULTILINE)
    text = text.replace("gyro_bias = [0.002, -0.003, 0.004]", f"gyro_bias = [0.0, 0.0, {bias:.5f}]", 1)
    truth = Truth(
        0.05 * (1.0 + larger),
        separation,
        draw(-0.15, 0.15),
        0.12 + draw(-0.04, 0.04),
        draw(-0.04, 0.04),
        draw(0.0, 0.03),
        draw(0.0, 0.02),
        draw(0.97, 1.03),
    )
    return parse_plant(text), truth


def rolled(plant: PlantFile, seed: int) -> tuple[float, float]:
    """Return what its wheels roll for each radian straight ahead, and how far apart they are by what it turns
    on the spot then [m]; nothing creeps meanwhile."""
    assert isinstance(plant, WheeledFile)
    body = replace(plant.body, slip=replace(plant.body.slip, sigma=0.0))
    world = World(room(seed), replace(plant, body=body), ROBOT, seed)

    def run(left: float, right: float) -> tuple[float, float]:
        """Return the way and the turn while the wheels turn at these rad/s for a second."""
        for name, rate in (("left", left), ("right", right)):
            world.follow(name, world.shaft(name)[0], rate)
        for _ in range(300):  # what starts at once slides at first
            world.step({})
        before = world.truth()
        for _ in range(1000):
            world.step({})
        after = world.truth()
        return math.dist((before.x, before.y), (after.x, after.y)), wrap(after.yaw - before.yaw)

    radius = run(6.0, 6.0)[0] / 6.0
    return radius, radius * 12.0 / run(-6.0, 6.0)[1]


def falsified(event: Event, truth: Truth) -> Event:
    """Return what is reported of it."""
    if isinstance(event, LaserScan):
        return replace(event, t=event.t + round(truth.scan_late * SECOND))
    if isinstance(event, Imu):
        x, y, z = (truth.gyro_scale * rate for rate in event.angular_velocity)
        return replace(event, t=event.t + round(truth.gyro_late * SECOND), angular_velocity=(x, y, z))
    return event


@pytest.mark.prove
@pytest.mark.parametrize("seed", range(SEEDS))
def test_a_robot_that_is_not_as_stated(seed: int) -> None:
    plant, truth = body(seed)
    lidar = ROBOT.sensors["lidar"]
    mount = replace(lidar.mount, yaw=truth.yaw, x=truth.x, y=truth.y)
    true = replace(ROBOT, sensors=ROBOT.sensors | {"lidar": replace(lidar, mount=mount)})
    twins = TwinWorld(true, World(room(seed), plant, true, seed), seed)
    robot = bare_robot(ROBOT)
    session = Session(robot, Gateway(robot), SimulatedClock(), dict(twins.buses), twins)
    base = ROBOT.brain.base
    assert base is not None
    made = PatternDrive(base, legs(base, 0.6, 5))
    drive(session, made)
    assert not made.ended
    assert not session.gateway.still_armed()
    events = [falsified(event, truth) for event in made.events]
    calibration = calibrate(of_events(ROBOT, lambda: events))
    found = {one.name: one for one in verdict.figures(calibration)}
    radius, separation = rolled(plant, seed)
    assert abs(separation / truth.separation - 1.0) < 1e-3
    assert 0.99 < radius / truth.radius < 1.0
    within = {
        "wheel_radius": (radius, 0.005 * radius),
        "wheel_separation": (separation, 0.01 * separation),
        "lidar yaw": (truth.yaw, math.radians(0.5)),
        "lidar x": (truth.x, 0.006),
        "lidar y": (truth.y, 0.006),
        "lidar late": (1e3 * truth.scan_late, 8.0),
        "imu scale": (100.0 * truth.gyro_scale, 0.5),
        "imu late": (1e3 * truth.gyro_late, 8.0),
    }
    for name, (value, most) in within.items():
        one = found[name]
        off = abs(one.value - value)
        assert off < most, (one, value)
        assert off < 4.0 * one.sigma, (one, value)
    assert verdict.named(calibration) == []
