"""The scene in MuJoCo: motion, slip, contacts, lidar, IMU, determinism, and what it needs."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from brain.perception.mount import Mount
from gateway.config import load_robot, parse_robot
from gateway.sim import SceneFile, World, WorldError, load_plant, load_world
from gateway.sim.files import Wall
from protocols.messages import MILLISECOND, LaserScan
from tests.gateway.world_helpers import BASE, PLANT, ROOM, WALLS, Driver, plant, robot, scene, turned, world

OFFICE, DIFFBOT = load_world("office"), load_plant("diffbot")
BLIND = PLANT[: PLANT.index("[lidars")]


# -- motion ------------------------------------------------------------------------------------------


def test_straight_odometry_is_right_without_slip() -> None:
    driver = Driver(world()).run(3000, 10.0, 10.0)
    truth = driver.world.truth()
    assert truth.x > 1.3
    assert abs(truth.y) < 1e-3
    assert abs(truth.yaw) < 1e-3
    assert driver.off(driver.odometry()) < 0.005 * truth.x


def test_turning_follows_the_kinematics() -> None:
    driver = Driver(world()).run(3000, 6.0, 10.0)
    left, right = driver.encoders[-1]
    wanted = 0.05 * (right - left) / 0.22
    assert wanted > 2.0
    assert turned(driver) == pytest.approx(wanted, rel=0.01)
    assert driver.off(driver.odometry()) < 0.01 * driver.path()


def test_spinning_on_the_spot_does_not_scrub() -> None:
    driver = Driver(world()).run(3000, -6.0, 6.0)
    left, right = driver.encoders[-1]
    assert turned(driver) == pytest.approx(0.05 * (right - left) / 0.22, rel=0.01)
    assert math.hypot(*driver.truths[-1][:2]) < 0.005
    held = {name: driver.gathered[name] for name in ("left", "right")}
    assert abs(held["right"]) < 0.04, f"a cylinder's wheels would need 0.10 N·m: {held}"


def test_backwards_and_to_the_right() -> None:
    back = Driver(world()).run(1500, -8.0, -8.0)
    assert back.world.truth().x < -0.4
    right = Driver(world()).run(1500, 8.0, 4.0)
    assert turned(right) < -0.5


def test_start_pose() -> None:
    file = scene(ROOM + "[start]\nx = 1.0\ny = -2.0\nyaw = 1.5\n")
    here = Driver(world(file))
    assert here.truths[0] == pytest.approx((1.0, -2.0, 1.5), abs=1e-6)
    there = here.run(1000, 8.0, 8.0).world.truth()
    assert math.atan2(there.y + 2.0, there.x - 1.0) == pytest.approx(1.5, abs=0.01)


def test_too_much_torque_spins_the_wheels() -> None:
    spun = world()
    for _ in range(1000):
        spun.step({"left": 2.0, "right": 2.0})
    way, rolled = spun.truth().x, 0.05 * spun.shaft("left")[0]
    assert rolled > 1.5 * way
    # What accelerates it is the friction of its tyres, less than its weight.
    assert 0.5 < way < 0.5 * 9.81


def test_full_speed_against_a_wall_is_a_stall() -> None:
    driver = Driver(world(scene(ROOM + WALLS))).run(6000, 10.0, 10.0, limit=0.4)
    assert abs(driver.world.shaft("left")[1]) < 0.1
    assert driver.gathered["left"] == pytest.approx(0.4)
    assert driver.world.truth().x == pytest.approx(1.8, abs=0.01)


# -- slip --------------------------------------------------------------------------------------------


def _by_gyro(driver: Driver, still: float) -> list[tuple[float, float, float]]:
    """Encoders for the way, the gyro for the turn: bias from the first `still` seconds."""
    imus = driver.imus()
    bias = np.mean([i.angular_velocity[2] for i in imus if i.t < still * 1e9])
    per_step = (
        np.add.reduceat([i.angular_velocity[2] - bias for i in imus], np.arange(0, len(imus), 2)) * 0.005
    )
    return driver.odometry(lambda index, _: float(per_step[index]))


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_office_wheels_distort_odometry_and_a_gyro_corrects_the_heading_but_not_the_scale(seed: int) -> None:
    assert isinstance(OFFICE, SceneFile)
    driver = Driver(world(replace(OFFICE, walls={}, boxes={}), seed, made=DIFFBOT)).run(1000, 0.0, 0.0)
    for left, right in ((8.0, 8.0), (8.0, 9.0), (9.0, 8.0), (8.0, 8.0)):
        driver.run(5000, left, right)
    path = driver.path()
    assert path > 7.0
    raw, by_gyro = driver.off(driver.odometry()), driver.off(_by_gyro(driver, 1.0))
    assert raw > 1.3 * by_gyro > 0.01 * path
    rolled = 0.05 * sum(driver.encoders[-1]) / 2.0
    assert path / rolled == pytest.approx(1.025, abs=0.01)  # the tyres are larger than the robot file has


def test_slip_differs_by_seed_and_is_absent_at_rest() -> None:
    one, other = (Driver(world(OFFICE, seed, made=DIFFBOT)).run(1500, 8.0, 8.0).truths[-1] for seed in (1, 2))
    assert one != other
    still = Driver(world(OFFICE, made=DIFFBOT)).run(2000, 0.0, 0.0)
    assert still.off([still.truths[0]] * len(still.truths)) < 1e-4


# -- contacts ----------------------------------------------------------------------------------------


def test_bumps_are_counted() -> None:
    driver = Driver(world(scene(ROOM + WALLS))).run(3000, 8.0, 8.0)
    assert driver.world.contacts() == 0
    driver.run(3000, 8.0, 8.0, limit=0.4)
    first = driver.world.contacts()
    assert first >= 1
    driver.run(1000, -8.0, -8.0)
    away = driver.world.contacts()
    driver.run(500, -8.0, -8.0)
    assert driver.world.contacts() == away
    driver.run(3000, 8.0, 8.0, limit=0.4)
    assert driver.world.contacts() > away


def test_outlines_are_the_faces() -> None:
    polygons = world(scene(ROOM + WALLS)).outlines()
    assert len(polygons) == 3
    assert min(x for x, _ in polygons[0]) == pytest.approx(2.0)
    assert min(y for _, y in polygons[1]) == pytest.approx(1.5)
    assert max(x for x, _ in polygons[2]) == pytest.approx(-1.0)


# -- lidar -------------------------------------------------------------------------------------------


def _expected(x: float, y: float, angle: float) -> float:
    """m to the walls of WALLS from a point along an angle, 10 where there is nothing."""
    c, s = math.cos(angle), math.sin(angle)
    hits = [10.0]
    if c > 1e-9 and -3.0 <= y + (2.0 - x) / c * s <= 3.0:
        hits.append((2.0 - x) / c)
    if s > 1e-9 and -3.0 <= x + (1.5 - y) / s * c <= 3.0:
        hits.append((1.5 - y) / s)
    if c < -1e-9 and -0.5 <= y + (-1.0 - x) / c * s <= 0.5:
        hits.append((-1.0 - x) / c)
    return min(hits)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_lidar_sees_walls_where_they_are(yaw: float) -> None:
    built = World(scene(ROOM + WALLS), plant(), robot(lidar=f"x = 0.12, y = 0.03, z = 0.12, yaw = {yaw}"), 1)
    scan = Driver(built).run(100, 0.0, 0.0).scans()[0]
    assert len(scan.ranges) == 360
    assert scan.angle_min == -math.pi
    assert scan.angle_increment == pytest.approx(2.0 * math.pi / 360)
    assert all(math.isfinite(range_) for range_ in scan.ranges)
    angles = [scan.angle_min + scan.angle_increment * index for index in range(360)]
    wanted = [_expected(0.12, 0.03, angle + yaw) for angle in angles]
    off = [abs(a - b) for a, b in zip(scan.ranges, wanted, strict=True)]
    # Corners: a beam beside an edge may fall on either side of it.
    assert sum(error > 2e-3 for error in off) <= 4, [i for i, e in enumerate(off) if e > 2e-3]


def test_lidar_upside_down_turns_the_other_way() -> None:
    built = World(scene(ROOM + WALLS), plant(), robot(lidar="z = 0.12, roll = 3.141592653589793"), 1)
    scan = Driver(built).run(100, 0.0, 0.0).scans()[0]
    assert scan.ranges[180 - 90] == pytest.approx(1.5, abs=2e-3), "its right is the robot's left"
    assert scan.ranges[180 + 90] == 10.0


def test_lidar_noise_dropouts_and_limits() -> None:
    text = PLANT.replace("[lidars.lidar]", "[lidars.lidar]\nnoise = 0.01\nresolution = 0.001\ndropout = 0.1")
    driver = Driver(world(scene(ROOM + WALLS), lidar="z = 0.12", made=plant(text))).run(5000, 0.0, 0.0)
    scans = np.array([scan.ranges for scan in driver.scans()])
    assert scans.shape == (50, 360)
    ahead = scans[:, 180]
    read = ahead[ahead > 0.0]
    assert np.mean(scans == 0.0) == pytest.approx(0.1, abs=0.01)
    assert np.mean(read) == pytest.approx(2.0, abs=0.006)
    assert np.std(read) == pytest.approx(0.01, rel=0.4)
    assert np.allclose(np.round(read / 0.001) * 0.001, read)
    nothing = scans[:, 90]
    assert set(nothing.tolist()) == {0.0, 10.0}, "to the south there is nothing, and it is not noisy"


def test_lidar_gives_no_reading_below_its_range() -> None:
    text = PLANT.replace("[lidars.lidar]", "[lidars.lidar]\nrange_min = 1.2")
    scan = (
        Driver(world(scene(ROOM + WALLS), lidar="z = 0.12", made=plant(text))).run(100, 0.0, 0.0).scans()[0]
    )
    assert scan.ranges[0] == 0.0
    assert scan.ranges[180] == pytest.approx(2.0, abs=2e-3)


def test_a_sweep_measures_each_beam_from_where_the_lidar_is_then() -> None:
    driver = Driver(world(scene(ROOM + WALLS), lidar="z = 0.12")).run(1000, 10.0, 10.0, ramp=1)
    scan = driver.scans()[-1]
    assert (scan.t, scan.duration) == (900 * MILLISECOND, 100 * MILLISECOND * 359 // 360)
    poses = np.array(driver.truths)
    times = np.arange(len(poses)) * 10 * MILLISECOND
    off: list[float] = []
    instant: list[float] = []
    for beam in range(135, 225):  # those that see the wall ahead
        angle = scan.angle_min + beam * scan.angle_increment
        taken = scan.t + beam * scan.duration // 359
        for t, errors in ((taken, off), (scan.t, instant)):
            x, y, yaw = (float(np.interp(t, times, poses[:, axis])) for axis in range(3))
            errors.append(abs(scan.ranges[beam] - _expected(x, y, yaw + angle)))
    assert float(np.median(off)) < 1e-3
    assert float(np.median(instant)) > 20e-3


def test_two_lidars_measure_each_by_its_own_figures() -> None:
    made = plant(PLANT + "[lidars.rear]\nbeams = 180\nrate_hz = 20\nsweep = false\n")
    sensors = robot(lidar="z = 0.12").sensors
    rear = replace(sensors["lidar"], mount=Mount(z=0.12, yaw=math.pi))
    two = replace(robot(), sensors={**sensors, "rear": rear})
    scans = Driver(World(scene(ROOM + WALLS), made, two, 1)).run(100, 0.0, 0.0).scans()
    assert [(scan.sensor, len(scan.ranges), scan.t) for scan in scans] == [
        ("rear", 180, 0),
        ("rear", 180, 50 * MILLISECOND),
        ("lidar", 360, 0),
    ]
    assert scans[0].ranges[90] == pytest.approx(1.0, abs=2e-3), "the box behind"
    assert scans[2].ranges[180] == pytest.approx(2.0, abs=2e-3)


def test_readings_come_at_their_rates_and_are_stamped() -> None:
    driver = Driver(world()).run(1000, 0.0, 0.0)
    assert [scan.t for scan in driver.scans()] == [100 * MILLISECOND * i for i in range(10)]
    assert [imu.t for imu in driver.imus()] == [5 * MILLISECOND * i for i in range(200)]
    assert driver.world.now == 1000 * MILLISECOND
    assert driver.world.readings() == ()


# -- IMU ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mount", "gravity"), [("x = 0.0", 9.81), ("z = 0.05, roll = 3.141592653589793", -9.81)]
)
def test_imu_at_rest_measures_gravity(mount: str, gravity: float) -> None:
    last = Driver(world(imu=mount)).run(500, 0.0, 0.0).imus()[-1]
    assert last.linear_acceleration == pytest.approx((0.0, 0.0, gravity), abs=0.01)
    assert last.angular_velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


def test_imu_signs() -> None:
    turn = Driver(world()).run(2000, -4.0, 4.0)
    rate = 4.0 * 2 * 0.05 / 0.22
    assert turn.imus()[-1].angular_velocity[2] == pytest.approx(rate, rel=0.02)
    push = Driver(world()).run(1000, 10.0, 10.0, ramp=1000)
    ahead = np.mean([i.linear_acceleration[0] for i in push.imus()[50:]])
    assert ahead == pytest.approx(0.5, rel=0.1)


def test_imu_mounted_turned_to_the_left() -> None:
    push = Driver(world(imu="x = 0.1, z = 0.05, yaw = 1.5707963267948966")).run(1000, 10.0, 10.0, ramp=1000)
    across = np.mean([i.linear_acceleration for i in push.imus()[50:]], axis=0)
    assert across == pytest.approx([0.0, -0.5, 9.81], abs=0.05)


def test_imu_bias_and_noise_are_those_of_the_world_file() -> None:
    figures = DIFFBOT.imus["imu"]
    imus = Driver(world(OFFICE, made=DIFFBOT)).run(4000, 0.0, 0.0).imus()
    gyro = np.array([i.angular_velocity for i in imus])
    accel = np.array([i.linear_acceleration for i in imus])
    assert gyro.mean(axis=0) == pytest.approx(figures.gyro_bias, abs=6e-4)
    assert gyro.std(axis=0) == pytest.approx(figures.gyro_noise, rel=0.1)
    # Wheels of unequal radius tilt the base by 1.4 mrad, which gravity shows.
    assert accel.mean(axis=0) - [0.0, 0.0, 9.81] == pytest.approx(figures.accel_bias, abs=0.02)
    assert accel.std(axis=0) == pytest.approx(figures.accel_noise, rel=0.1)


# -- determinism -------------------------------------------------------------------------------------


def test_one_sensors_noise_does_not_depend_on_another() -> None:
    alone = {name: sensor for name, sensor in robot().sensors.items() if name == "lidar"}
    few = World(OFFICE, DIFFBOT, replace(robot(), sensors=alone), 1)
    assert (
        Driver(few).run(200, 0.0, 0.0).scans()
        == Driver(world(OFFICE, made=DIFFBOT)).run(200, 0.0, 0.0).scans()
    )


# -- what it needs -----------------------------------------------------------------------------------


def test_torques_must_be_finite() -> None:
    with pytest.raises(ValueError, match="'left' is nan"):
        world().step({"left": math.nan})


def test_without_mujoco_a_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(WorldError, match=r"pip install 'motor-gateway\[sim\]'"):
        world()


def test_mujoco_comes_late_and_no_graphics_at_all() -> None:
    code = (
        "import sys, gateway.buses.virtual.bus\n"
        "from gateway.sim import load_plant, load_world, World\n"
        "from tests.gateway.world_helpers import robot\n"
        "assert 'mujoco' not in sys.modules\n"
        "world = World(load_world('office'), load_plant('diffbot'), robot(), 1)\n"
        "world.step({})\n"
        "assert 'mujoco' in sys.modules\n"
        "print([name for name in ('OpenGL.GL', 'OpenGL.EGL', 'mujoco.egl') if name in sys.modules])\n"
    )
    headless = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "MUJOCO_GL")}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=headless
    )
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_a_motor_that_turns_no_wheel_turns_a_shaft_that_the_base_carries() -> None:
    text = BASE.format(world="").replace("[brain]\n", "[motors.mast]\naddress = 3\n\n[brain]\n")
    free = "[shafts.mast]\ninertia = 0.01\ndamping = 0.0\nfriction = 0.0\n"
    carrying = World(scene(), plant(BLIND + free), parse_robot(text), 1)
    bare = World(scene(), plant(BLIND), parse_robot(BASE.format(world="")), 1)
    for _ in range(500):
        carrying.step({"left": 0.2, "right": 0.2, "mast": 0.1})
        bare.step({"left": 0.2, "right": 0.2})
    assert carrying.shaft("mast") == pytest.approx((1.25, 5.0), rel=3e-3)
    assert carrying.truth() == bare.truth()


def test_all_reasons_why_a_robot_does_not_fit_are_reported_at_once() -> None:
    text = PLANT.replace('motor = "left"', 'motor = "port"').replace("[imus.imu]", "[imus.imo]")
    with pytest.raises(WorldError) as caught:
        world(made=plant(text))
    reported = str(caught.value)
    assert len(caught.value.mistakes) == 3
    for part in ("no motor 'port'", "no motor 'left'", "no sensor 'imu'", "did you mean 'imo'?"):
        assert part in reported


# -- given motions, walls that appear, distances ---------------------------------------------------------


def test_shafts_with_a_given_motion_drive_the_base_whatever_their_torques() -> None:
    made = world()
    for name in ("left", "right"):
        made.follow(name, 0.0, 5.0)
    for _ in range(1000):
        made.step({"left": -2.0, "right": -2.0})
    assert made.shaft("left") == pytest.approx((5.0, 5.0), abs=0.01)
    assert made.truth().x == pytest.approx(0.05 * 5.0, abs=0.03)
    for name in ("left", "right"):
        made.hold(name)
    for _ in range(300):
        made.step({"left": 2.0, "right": 2.0})
    assert made.shaft("left") == pytest.approx((5.0, 0.0), abs=0.01)
    assert math.hypot(*made.twist()) < 0.01
    for name in ("left", "right"):
        made.let_go(name)
    for _ in range(100):
        made.step({"left": 1.0, "right": 1.0})
    assert made.shaft("left")[1] > 1.0


def test_a_wall_that_appears_is_neither_seen_nor_touched_before_and_both_from_then_on() -> None:
    file = OFFICE
    assert isinstance(file, SceneFile)
    late = Wall((0.5, -0.5), (0.5, 0.5), appears=0.7)
    made = World(replace(file, walls=file.walls | {"late": late}), DIFFBOT, load_robot("diffbot"), 1)
    ahead = []
    for name in ("left", "right"):
        made.follow(name, 0.0, 4.0)
    for _ in range(1600):
        made.step({})
        ahead += [(one.t, min(one.ranges[170:190])) for one in made.readings() if isinstance(one, LaserScan)]
    before = [near for t, near in ahead if t < 600 * MILLISECOND]
    after = [near for t, near in ahead if t > 800 * MILLISECOND]
    assert min(before) > 1.5
    assert max(after) < 0.4
    assert made.contacts() >= 1
    assert made.clearance() == pytest.approx(0.0, abs=0.02)


def test_the_clearance_is_the_distance_from_the_outline_to_the_nearest_wall() -> None:
    made = World(OFFICE, DIFFBOT, load_robot("diffbot"), 1)
    assert made.clearance() == pytest.approx(0.9, abs=0.15)  # the desk's side, at y = -1
    assert made.clearance(0.5) == 0.5
