"""Bases on wheels of every kind against what their geometry says by hand; people and boxes around them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from gateway.config import resources
from gateway.sim import WheeledFile, WorldError, load_plant, parse_plant, parse_world
from gateway.sim.plant_files import Slip
from gateway.sim.rover import Rover
from tests.gateway.world_helpers import PLANT

SPEEDING_UP, STEADY = 800, 1500
"""Steps of 1 ms."""


def ideal(name: str) -> WheeledFile:
    """A shipped plant without wear and creep."""
    plant = load_plant(name)
    assert isinstance(plant, WheeledFile)
    wheels = {key: replace(wheel, radius_error=0.0) for key, wheel in plant.body.wheels.items()}
    return replace(plant, body=replace(plant.body, slip=Slip(), wheels=wheels))


def rover(plant: WheeledFile, world: str = "") -> Rover:
    file = parse_world(f'kind = "scene"\nname = "place"\n{world}')
    assert file.kind == "scene"
    return Rover(file, plant, {}, 1)


def driven(base: Rover, speeds: dict[str, float], steered: dict[str, float]) -> tuple[float, float, float]:
    """Drive at these speeds [rad/s] with these steering angles; return the twist: forward, turn, left."""
    gathered = dict.fromkeys(speeds, 0.0)
    start = base.pose()
    for step in range(SPEEDING_UP + STEADY):
        if step == SPEEDING_UP:
            start = base.pose()
        torques = {}
        for motor, speed in speeds.items():
            error = speed * min(1.0, step / SPEEDING_UP) - base.shaft(motor)[1]
            gathered[motor] += 10.0 * error * 0.001
            torques[motor] = error + gathered[motor]
        for motor, angle in steered.items():
            position, velocity = base.shaft(motor)
            torques[motor] = 30.0 * (angle - position) - 1.0 * velocity
        base.step(torques)
    end, t = base.pose(), STEADY / 1000.0
    turn = math.remainder(end.yaw - start.yaw, 2.0 * math.pi)
    # From the chord to the arc, by its middle's heading.
    length = (
        math.hypot(end.x - start.x, end.y - start.y) * (turn / 2.0) / math.sin(turn / 2.0) if turn else 0.0
    )
    length = length or math.hypot(end.x - start.x, end.y - start.y)
    along = math.atan2(end.y - start.y, end.x - start.x) - start.yaw - turn / 2.0
    return length * math.cos(along) / t, turn / t, length * math.sin(along) / t


def four(fl: float, fr: float, rl: float, rr: float) -> dict[str, float]:
    return {"front_left": fl, "front_right": fr, "rear_left": rl, "rear_right": rr}


def steer(fl: float, fr: float, rl: float, rr: float) -> dict[str, float]:
    return {f"{motor}_steer": angle for motor, angle in four(fl, fr, rl, rr).items()}


def sliding(half: float, *wheels: float) -> float:
    """How many times faster than by rolling the sides' wheels at these x turn, for Coulomb friction: the yaw
    moments of all friction forces, each against its slip, are in balance (by bisection)."""
    low, high = 1.0, 10.0
    while high - low > 1e-6:
        slip = ((low + high) / 2.0 - 1.0) * half
        moment = sum((half * slip - x * x) / math.hypot(slip, x) for x in wheels)
        low, high = (low, (low + high) / 2.0) if moment > 0.0 else ((low + high) / 2.0, high)
    return low


SKID = sliding(0.19, 0.15)
TRACK = sliding(0.17, 0.21, 0.07)
R = 1.0
"""m, of the car's curve: by hand from its wheelbase of 0.3 m and its wheels at ± 0.13 m."""

CASES = {
    # plant, speeds of the wheels [rad/s], steering [rad], twist (m/s forward, rad/s, m/s left), tolerance
    "differential": ("diffbot", {"left": 4.0, "right": 8.0}, {}, (0.3, 0.2 / 0.22, 0.0), 0.01),
    "mecanum ahead": ("mecanum", four(4.0, 4.0, 4.0, 4.0), {}, (0.304, 0.0, 0.0), 0.01),
    "mecanum left": ("mecanum", four(-4.0, 4.0, 4.0, -4.0), {}, (0.0, 0.0, 0.304), 0.01),
    "mecanum turn": ("mecanum", four(-4.0, 4.0, -4.0, 4.0), {}, (0.0, 0.304 / 0.35, 0.0), 0.01),
    "omni turn": ("omni", {"left": 4.0, "rear": 4.0, "right": 4.0}, {}, (0.0, 0.2 / 0.16, 0.0), 0.01),
    "omni left": ("omni", {"left": 2.0, "rear": -4.0, "right": 2.0}, {}, (0.0, 0.0, 0.2), 0.01),
    "swerve left": ("swerve", four(6.0, 6.0, 6.0, 6.0), steer(*[math.pi / 2] * 4), (0.0, 0.0, 0.3), 0.01),
    "swerve turn": (
        "swerve",
        four(-6.0, 6.0, -6.0, 6.0),
        steer(-math.pi / 4, math.pi / 4, math.pi / 4, -math.pi / 4),
        (0.0, 0.3 / math.hypot(0.18, 0.18), 0.0),
        0.01,
    ),
    "car": (
        "ackermann",
        {"rear_left": 5.0 * (R - 0.13), "rear_right": 5.0 * (R + 0.13)},
        {"steer_left": math.atan(0.3 / (R - 0.13)), "steer_right": math.atan(0.3 / (R + 0.13))},
        (0.3 * R, 0.3, 0.0),
        0.01,
    ),
    "skid ahead": ("skid_steer", four(4.0, 4.0, 4.0, 4.0), {}, (0.32, 0.0, 0.0), 0.01),
    "skid turn": ("skid_steer", four(-4.0, 4.0, -4.0, 4.0), {}, (0.0, 0.32 / 0.19 / SKID, 0.0), 0.01),
    "track turn": ("tracked", {"left": -4.0, "right": 4.0}, {}, (0.0, 0.28 / 0.17 / TRACK, 0.0), 0.1),
}


@pytest.mark.parametrize("name", CASES)
def test_a_base_moves_as_its_wheels_say(name: str) -> None:
    plant, speeds, steering, wanted, tolerance = CASES[name]
    found = driven(rover(ideal(plant)), speeds, steering)
    near = [pytest.approx(one, rel=tolerance, abs=0.004) for one in wanted]
    assert list(found) == near


@pytest.mark.parametrize(
    "name", ["ackermann", "diffbot", "mecanum", "omni", "skid_steer", "swerve", "tracked"]
)
def test_a_base_at_rest_stays_there(name: str) -> None:
    base = rover(ideal(name))
    for _ in range(1000):
        base.step({})
    assert math.hypot(base.pose().x, base.pose().y) < 1e-3
    assert abs(base.pose().yaw) < 1e-3
    assert abs(float(base.data.qpos[2])) < 5e-3, "neither sunk nor lifted"
    assert base.touches == 0


def test_wheels_of_one_motor_turn_together_and_a_wheel_without_motor_rolls() -> None:
    more = 'left_rear = { motor = "left", x = -0.1, y = 0.11 }\nfree = { x = -0.1, y = -0.11 }\n'
    text = PLANT.replace("[body.casters]", f"{more}[body.casters]")
    plant = parse_plant(text)
    assert isinstance(plant, WheeledFile)
    base = rover(plant)
    driven(base, {"left": 6.0, "right": 6.0}, {})
    angles = {name: float(base.data.qpos[base.model.joint(name).qposadr[0]]) for name in plant.body.wheels}
    assert angles["left_rear"] == pytest.approx(angles["left"], abs=0.02)
    assert angles["free"] == pytest.approx(angles["right"], rel=0.05)


# -- people and boxes ------------------------------------------------------------------------------------

ACROSS = """
[people.one]
path = [[1.0, 1.0], [1.0, -1.0]]
speed = 1.0
"""


def test_somebody_is_seen_and_touched_without_force() -> None:
    import numpy as np

    from brain.perception.mount import Mount
    from gateway.sim.scene import Floats

    base = rover(ideal("diffbot"), ACROSS)
    ahead: Floats = np.array([[1.0, 0.0, 0.0]])
    seen = []
    for _ in range(2000):
        base.step({})
        seen.append(float(base.rays(Mount(z=0.5), ahead, 10.0)[0]))
    near = [i for i, found in enumerate(seen) if found < 10.0]
    assert [near[0], near[-1]] == pytest.approx([800, 1200], abs=5)
    assert min(seen) == pytest.approx(0.8, abs=1e-3)
    standing = rover(
        ideal("diffbot"), ACROSS.replace("[1.0, 1.0]", "[0.0, 1.0]").replace("1.0, -1", "0.0, -1")
    )
    for _ in range(2000):
        standing.step({})
    assert standing.touches_by_people == 0, "the robot stands: people walk through it"
    assert math.hypot(standing.pose().x, standing.pose().y) < 1e-3


def test_only_a_moving_robot_touches_people() -> None:
    base = rover(ideal("diffbot"), "[people.one]\npath = [[0.6, 0.0]]\n")
    driven(base, {"left": 6.0, "right": 6.0}, {})
    assert (base.touches_by_people, base.touches) == (1, 0)
    assert base.pose().x > 0.5, "it goes on"
    assert base.people() == [(0.6, 0.0, 0.2)]


def test_a_box_with_a_mass_is_pushed_and_no_wall() -> None:
    base = rover(ideal("diffbot"), "[boxes.crate]\nx = 0.5\ny = 0.0\nsize = [0.2, 0.2, 0.2]\nmass = 0.2\n")
    assert base.box("crate") == pytest.approx((0.5, 0.0, 0.1), abs=5e-3)
    driven(base, {"left": 6.0, "right": 6.0}, {})
    assert base.box("crate")[0] > 0.6
    assert base.touches == 0


def test_one_motor_steers_two_wheels_by_a_linkage() -> None:
    """Their axes meet on the rear axle: the inner wheel turns further, both as of a wheel midway."""
    base = rover(ideal("car"))
    names = "front_left_steer", "front_right_steer"
    places = [int(base.model.joint(name).qposadr[0]) for name in names]
    for _ in range(600):
        angle, velocity = base.shaft("steering")
        base.step({"steering": 2.0 * (0.4 - angle) - 0.1 * velocity})
    angle = base.shaft("steering")[0]
    assert angle == pytest.approx(0.4, abs=0.02)
    left, right = (float(base.data.qpos[place]) for place in places)
    radius = 0.26 / math.tan(angle)
    assert left == pytest.approx(math.atan2(0.26, radius - 0.1), abs=0.01)
    assert right == pytest.approx(math.atan2(0.26, radius + 0.1), abs=0.01)
    assert left > angle > right


@pytest.mark.parametrize(
    ("part", "instead", "wrong"),
    [
        ("x = 0.26\ny = -0.1", "x = 0.2\ny = -0.1", "those that steering steers by a linkage must be on one"),
        ('motor = "drive"', 'motor = "steering"', "a motor that steers one must do nothing else"),
    ],
)
def test_a_linkage_that_cannot_be(part: str, instead: str, wrong: str) -> None:
    text = resources.find("plants", "car").read_text("utf-8")
    assert part in text
    with pytest.raises(WorldError, match=wrong):
        parse_plant(text.replace(part, instead))
