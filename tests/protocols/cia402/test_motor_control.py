"""The twin's motor: every mode of operation, homing, limits, units (README, "The twin")."""

from __future__ import annotations

import math

import pytest

from protocols.cia402 import objects as o
from protocols.cia402.faults import FOLLOWING_ERROR
from protocols.cia402.options import Settings
from protocols.cia402.profile import HomingStatus, Mode, PowerState, Status, homing_of
from tests.protocols.cia402.twin_bench import TwinBench

NEW, IMMEDIATELY, RELATIVE = 0x10, 0x20, 0x40
ACKNOWLEDGED = Status.SETPOINT_ACKNOWLEDGED
REACHED = Status.TARGET_REACHED


# -- cyclic modes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [1, 137, -4096, 40_001])
def test_csp_goes_to_any_increment(target: int) -> None:
    """A whole-unit cast anywhere would show: 137 increments are 0.0084 turns."""
    bench = TwinBench()
    bench.enable(Mode.CSP)
    bench.put(o.TARGET_POSITION, target)
    bench.run(3000)
    assert bench.read(o.POSITION) == pytest.approx(target, abs=3)
    assert bench.increments() == pytest.approx(target, abs=4)
    assert bench.status & Status.FOLLOWS_COMMAND
    assert not bench.status & Status.FOLLOWING_ERROR


def test_csp_obeys_its_offsets() -> None:
    bench = TwinBench()
    bench.locked = True
    bench.enable(Mode.CSP)
    bench.put(o.TORQUE_OFFSET, 250)
    bench.run(50)
    assert bench.torque == pytest.approx(0.25, abs=0.01)
    bench.put(o.TORQUE_OFFSET, 0)
    bench.put(o.VELOCITY_OFFSET, 16_384)
    bench.run(20)
    assert bench.torque == pytest.approx(0.1 * math.tau, rel=0.1)


def test_csp_interpolates_over_the_period_of_60c2() -> None:
    bench = TwinBench(Settings(interpolation_ms=100))
    bench.locked = True
    bench.enable(Mode.CSP)
    bench.put(o.TARGET_POSITION, 1000)
    bench.run(48)
    assert bench.read(o.POSITION_DEMAND) == pytest.approx(500, abs=25)
    bench.run(60)
    assert bench.read(o.POSITION_DEMAND) == 1000


def test_csv_and_its_offsets() -> None:
    bench = TwinBench()
    bench.enable(Mode.CSV)
    bench.put(o.TARGET_VELOCITY, 16_384)
    bench.put(o.VELOCITY_OFFSET, -32_768)
    bench.run(2500)
    assert bench.read(o.VELOCITY) == pytest.approx(-16_384, abs=200)


def test_cst_gives_torque_of_the_shaft_through_the_gear() -> None:
    bench = TwinBench(Settings(gear_motor=10, rated_torque=200))
    bench.locked = True
    bench.enable(Mode.CST)
    bench.put(o.TARGET_TORQUE, 500)
    bench.run(50)
    assert bench.torque == pytest.approx(1.0, rel=1e-3)
    assert bench.read(o.TORQUE) == bench.read(o.CURRENT) == 500
    bench.put(o.TORQUE_OFFSET, -700)
    bench.run(50)
    assert bench.torque == pytest.approx(-0.4, rel=1e-3)


# -- profile modes ---------------------------------------------------------------------------------------


def pp(settings: Settings | None = None) -> TwinBench:
    bench = TwinBench(
        settings
        or Settings(profile_velocity=20_000, profile_acceleration=100_000, profile_deceleration=100_000)
    )
    bench.enable(Mode.PP)
    return bench


def test_pp_handshake_and_target_reached() -> None:
    bench = pp()
    bench.put(o.TARGET_POSITION, 10_000)
    bench.run(50)
    assert abs(bench.increments()) < 2, "a target alone moves nothing"
    bench.control(0x0F | NEW)
    assert bench.status & ACKNOWLEDGED
    assert not bench.status & REACHED
    bench.control(0x0F)
    assert not bench.status & ACKNOWLEDGED
    bench.run(300)
    assert bench.read(o.VELOCITY) == pytest.approx(20_000, rel=0.1), "6081 is kept"
    bench.run(1500)
    assert bench.status & REACHED
    assert bench.read(o.POSITION) == pytest.approx(10_000, abs=50)


def test_pp_finishes_one_set_point_before_the_next() -> None:
    bench = pp()
    highest = 0.0
    for target in (8000, 2000):
        bench.put(o.TARGET_POSITION, target)
        bench.control(0x0F | NEW)
        bench.control(0x0F)
    assert bench.status & ACKNOWLEDGED, "the place for the next one is taken"
    for _ in range(300):
        bench.run(10)
        highest = max(highest, bench.increments())
    assert highest == pytest.approx(8000, abs=200)
    assert bench.read(o.POSITION) == pytest.approx(2000, abs=50)
    assert not bench.status & ACKNOWLEDGED


def test_pp_changes_immediately_with_bit_5() -> None:
    bench = pp()
    highest = 0.0
    for target in (8000, 1000):
        bench.put(o.TARGET_POSITION, target)
        bench.control(0x0F | NEW | IMMEDIATELY)
        bench.control(0x0F)
    for _ in range(200):
        bench.run(10)
        highest = max(highest, bench.increments())
    assert highest < 4000
    assert bench.read(o.POSITION) == pytest.approx(1000, abs=50)


def test_pp_relative_set_points_add_up() -> None:
    bench = pp()
    bench.put(o.TARGET_POSITION, 1500)
    for _ in range(3):
        bench.control(0x0F | NEW | RELATIVE)
        bench.control(0x0F)
        bench.run(900)
    assert bench.read(o.POSITION) == pytest.approx(4500, abs=50)


def test_pp_forgets_its_set_point_when_it_is_disabled() -> None:
    bench = pp()
    bench.put(o.TARGET_POSITION, 20_000)
    bench.control(0x0F | NEW)
    bench.run(50)
    bench.control(0x00)
    bench.run(400)
    bench.velocity = 0.0
    stalled_for = bench.position
    for control in (0x06, 0x07, 0x0F):
        bench.control(control)
    bench.run(500)
    assert bench.position == pytest.approx(stalled_for, abs=0.01)


def test_pv_ramps_and_shows_standstill() -> None:
    bench = TwinBench(Settings(profile_acceleration=20_000, profile_deceleration=40_000))
    bench.enable(Mode.PV)
    assert bench.status & Status.ZERO_SPEED
    bench.put(o.TARGET_VELOCITY, 20_000)
    bench.run(500)
    assert bench.read(o.VELOCITY_DEMAND) == pytest.approx(10_000, rel=0.05)
    bench.run(2500)
    assert bench.status & REACHED
    assert not bench.status & Status.ZERO_SPEED
    bench.put(o.TARGET_VELOCITY, 0)
    bench.run(250)
    assert bench.read(o.VELOCITY_DEMAND) == pytest.approx(10_000, rel=0.05)


def test_pt_ramps() -> None:
    bench = TwinBench(Settings(torque_slope=1000))
    bench.locked = True
    bench.enable(Mode.PT)
    bench.put(o.TARGET_TORQUE, -400)
    bench.run(200)
    assert bench.read(o.TORQUE_DEMAND) == pytest.approx(-200, abs=10)
    assert not bench.status & REACHED
    bench.run(300)
    assert bench.torque == pytest.approx(-0.4, rel=0.01)
    assert bench.status & REACHED


# -- homing ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "home"), [(33, 0), (34, 16_384), (35, 4096), (37, 4096)])
@pytest.mark.parametrize("offset", [0, 300])
def test_homing(method: int, home: int, offset: int) -> None:
    bench = TwinBench(Settings(homing_method=method, home_offset=offset, homing_speed=20_000))
    bench.position = 4096 / 16384 * math.tau
    bench.run(2)
    bench.enable(Mode.HM)
    assert homing_of(bench.status) is HomingStatus.INTERRUPTED
    bench.control(0x1F)
    if method in (33, 34):
        assert homing_of(bench.status) is HomingStatus.IN_PROGRESS
    bench.run(2500)
    assert homing_of(bench.status) is HomingStatus.DONE
    assert bench.read(o.POSITION) == pytest.approx(bench.increments() - home - offset, abs=2)
    assert abs(bench.velocity) < 0.1
    bench.control(0x0F)
    assert homing_of(bench.status) is HomingStatus.DONE


def test_homing_can_be_interrupted() -> None:
    bench = TwinBench(Settings(homing_method=34, homing_speed=5000))
    bench.position = 0.5
    bench.run(2)
    bench.enable(Mode.HM)
    bench.control(0x1F, steps=100)
    assert homing_of(bench.status) is HomingStatus.IN_PROGRESS
    bench.control(0x0F, steps=300)
    assert homing_of(bench.status) is HomingStatus.INTERRUPTED
    assert abs(bench.velocity) < 0.05


# -- limits ----------------------------------------------------------------------------------------------


def test_a_following_error_trips() -> None:
    bench = TwinBench(Settings(following_window=500, following_time=20))
    bench.locked = True
    bench.enable(Mode.CSP)
    bench.put(o.TARGET_POSITION, 490)
    bench.run(100)
    assert bench.emergencies() == []
    bench.put(o.TARGET_POSITION, 510)
    bench.run(10)
    assert bench.status & Status.FOLLOWING_ERROR
    assert bench.emergencies() == []
    bench.run(20)
    assert bench.state is PowerState.FAULT
    assert bench.emergencies() == [FOLLOWING_ERROR]


@pytest.mark.parametrize("mode", [Mode.CSP, Mode.PP])
def test_position_limits_hold_the_target(mode: Mode) -> None:
    bench = TwinBench(Settings(soft_limit_low=-1000, soft_limit_high=2000))
    bench.enable(mode)
    bench.put(o.TARGET_POSITION, 9000)
    if mode is Mode.PP:
        bench.control(0x1F)
    bench.run(10)
    assert bench.status & Status.INTERNAL_LIMIT
    bench.run(2000)
    assert bench.read(o.POSITION) == pytest.approx(2000, abs=20)


def test_torque_and_speed_are_limited() -> None:
    bench = TwinBench(Settings(max_torque=300, max_profile_velocity=10_000))
    bench.locked = True
    bench.enable(Mode.CST)
    bench.put(o.TARGET_TORQUE, 900)
    bench.run(50)
    assert bench.torque == pytest.approx(0.3, rel=1e-3)
    assert bench.status & Status.INTERNAL_LIMIT
    bench.locked = False
    bench.put(o.TARGET_TORQUE, 0)
    bench.put(o.MODE, Mode.CSV)
    bench.put(o.TARGET_VELOCITY, 50_000)
    bench.run(2500)
    assert bench.read(o.VELOCITY) == pytest.approx(10_000, rel=0.05)


def test_the_motors_speed_is_limited_behind_its_gear() -> None:
    bench = TwinBench(Settings(max_motor_speed=600, gear_motor=10))
    bench.enable(Mode.CSV)
    bench.put(o.TARGET_VELOCITY, 10**6)
    bench.run(2500)
    assert bench.velocity == pytest.approx(math.tau, rel=0.05)


# -- units -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "reported"),
    [
        (Settings(encoder_increments=4000), 1000),
        (Settings(encoder_increments=4000, gear_motor=5), 5000),
        (Settings(encoder_increments=4000, gear_motor=5, feed=360), 90),
        (Settings(encoder_increments=4000, feed=3600, feed_shaft=2), 450),
    ],
    ids=("encoder", "gear", "feed", "feed per turns"),
)
def test_a_quarter_turn_in_the_drives_units(settings: Settings, reported: int) -> None:
    bench = TwinBench(settings)
    bench.position = math.tau / 4
    bench.run(2)
    assert bench.read(o.POSITION) == reported


def test_the_encoder_counts_whole_increments() -> None:
    bench = TwinBench(Settings(encoder_increments=100, feed=100_000))
    seen = set()
    for step in range(40):
        bench.position = step * math.tau / 1000
        bench.run(1)
        seen.add(bench.read(o.POSITION))
    assert seen == {0, 1000, 2000, 3000, 4000}


def test_units_may_be_written_while_it_runs() -> None:
    bench = TwinBench()
    bench.position = math.tau
    bench.put(o.FEED, 360)
    assert bench.read(o.POSITION) == 360
    bench.put(o.FEED, 0)
    assert bench.read(o.POSITION) == 16_384


@pytest.mark.parametrize(
    ("unit", "acceleration", "factor", "turn"),
    [
        (0xFDB44700, 0xFDC00300, 1, 60_000),  # thousandths of rpm: as it is delivered
        (0x00B44700, 0x00C00300, 1, 60),  # rpm
        (0x00B40300, 0x00B45700, 1, 1),  # turns per second
        (0xFD100300, 0xFD105700, 1, 6283),  # mrad/s
        (0x00410300, 0x00415700, 1, 360),  # degrees per second
        (0x00B50300, 0x00B55700, 1, 4000),  # increments per second
        (0, 0, 10, 40_000),  # position units per second, times 6096
        (0, 0, 0, 60),  # not defined: rpm
    ],
)
def test_a_turn_per_second_in_units_of_velocity(unit: int, acceleration: int, factor: int, turn: int) -> None:
    """Units of CiA 303-2: B4 turn, 10 radian, 41 degree, B5 increment; FD thousandths; 47 minute."""
    settings = Settings(
        encoder_increments=4000,
        velocity_unit=unit,
        acceleration_unit=acceleration,
        velocity_numerator=factor,
        profile_acceleration=turn * 2,
        max_profile_velocity=turn * 20,
    )
    bench = TwinBench(settings, as_it_is=True)
    bench.enable(Mode.PV)
    bench.put(o.TARGET_VELOCITY, turn)
    bench.run(250)
    assert bench.velocity == pytest.approx(math.tau / 2, rel=0.1), "a turn/s² twice"
    bench.run(2500)
    assert bench.velocity == pytest.approx(math.tau, rel=0.01)
    assert bench.read(o.VELOCITY) == pytest.approx(turn, rel=0.02, abs=1)
    bench.put(o.TARGET_VELOCITY, turn * 30)
    bench.run(3000)
    assert bench.read(o.VELOCITY_DEMAND) <= turn * 30
    assert bench.velocity < math.tau * 21
