"""A number of the settings, changed while running."""

from __future__ import annotations

import re
from math import inf, nan

import pytest

from brain.bodies.body import Base
from brain.bodies.joints import Joints
from brain.brain import Brain, BrainSettings
from brain.control.pursuit import PursuitSettings
from brain.health import HealthSettings
from brain.perception.filter_settings import FilterSettings
from brain.perception.map import MapSettings
from brain.perception.match import MatchSettings
from brain.perception.mount import Mount
from brain.perception.perception import PerceptionSettings
from brain.planning.costmap import PlannerSettings
from brain.settings import changed, keys
from protocols.messages import MILLISECOND, Goal, Nanos
from tests.brain.helpers import BODY, MOUNTS, TIMEOUTS, Office, Trip

SETTINGS = BrainSettings(BODY)


def test_every_key_takes_its_own_value_or_is_fixed_at_the_start() -> None:
    known = dict(keys(SETTINGS))
    assert len(known) > 40
    for key, value in known.items():
        after, why = changed(SETTINGS, key, value, SETTINGS)
        assert after == SETTINGS, key
        assert why == "" or "fixed at the start" in why, key


def test_a_change_changes_that_and_nothing_else() -> None:
    after, why = changed(SETTINGS, "pursuit.lookahead_time", 0.6, SETTINGS)
    assert why == ""
    assert after.pursuit.lookahead_time == 0.6
    assert changed(after, "pursuit.lookahead_time", SETTINGS.pursuit.lookahead_time, SETTINGS) == (
        SETTINGS,
        "",
    )


def test_a_limit_is_lowered_and_raised_again_up_to_the_robot_file() -> None:
    slow, why = changed(SETTINGS, "differential.max_linear", 0.2, SETTINGS)
    assert isinstance(slow.body, Base)
    assert (slow.body.max_linear, why) == (0.2, "")
    assert changed(slow, "differential.max_linear", 0.6, SETTINGS) == (SETTINGS, "")


def test_times_are_in_milliseconds_as_in_the_robot_file() -> None:
    after, why = changed(SETTINGS, "planner.patience_ms", 1500.0, SETTINGS)
    assert (after.planner.patience, why) == (1500 * MILLISECOND, "")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("pursuit.lookahed_time", 1.0, "did you mean 'pursuit.lookahead_time'"),
        ("nothing like it", 1.0, "there are differential.radius"),
        ("pursuit", 1.0, "there is no setting 'pursuit'"),
        ("pursuit.lookahead_time", -1.0, "lookahead_time must be from 0.01 to 10 s, not -1"),
        ("pursuit.lookahead_min", 3.0, "lookahead_max must not be less than lookahead_min, 3"),
        ("pursuit.lookahead_time", nan, "must be a finite number, not nan"),
        ("health.slow", inf, "must be a finite number"),
        ("health.stand_age", 0.45, "stand_age must not be less than slow_age"),
        ("health.stand_age", 1.1, "stand_age must be from 0.01 to 1, not 1.1"),
        ("planner.expansions_per_step", 10.5, "must be an integer, not 10.5"),
        ("planner.unknown_is_free", 2.0, "must be 0 or 1, not 2"),
        ("planner.margin", 10.0, "margin must be from 0 to 1 m, not 10"),
        ("planner.patience_ms", 1e308, "planner.patience_ms is out of every bound: 1e+308"),
        ("planner.patience_ms", 0.0, "patience must be from 10 to 600000 ms, not 0"),
        ("differential.max_linear", 0.0, "max_linear must be from 0.001 to 20 m/s, not 0"),
        ("planner.margin", 0.04, "must be at least 0.05, the value in the robot file, not 0.04"),
        ("planner.drive_timeout_ms", 600.0, "must be at most 500, the value in the robot file, not 600"),
        ("differential.max_linear_acceleration", 0.4, "is fixed at the start"),
        ("differential.max_linear", 0.7, "must be at most 0.6, the value in the robot file, not 0.7"),
        ("differential.wheel_radius", 0.06, "is fixed at the start: change it in the robot file"),
        ("perception.gyro_sigma", 0.1, "is fixed at the start"),
    ],
)
def test_an_invalid_change_gives_the_reason_and_changes_nothing(key: str, value: float, message: str) -> None:
    after, why = changed(SETTINGS, key, value, SETTINGS)
    assert message in why
    assert after is SETTINGS


def test_a_change_is_obeyed_while_it_drives() -> None:
    trip = Trip(Office())
    trip.tick([Goal(-1.0, 3.0)])
    trip.run(4.0)
    assert trip.brain.set("differential.max_linear", 0.1) == ""
    trip.run(1.0)
    rest = [trip.office.speed for _ in range(100) if trip.tick()]
    assert 0.05 < max(rest) < 0.11


def test_a_body_whose_joints_are_no_motors_is_refused() -> None:
    with pytest.raises(ValueError, match=r"brain\.differential names joints that are no motors: right"):
        Brain(SETTINGS, ["left"], MOUNTS, {name: t for name, t in TIMEOUTS.items() if name != "right"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ldiar": MILLISECOND}, "there is no 'ldiar' to have a timeout"),
        ({"lidar": None, "left": None}, "'left' has no timeout; 'lidar' has no timeout"),
        ({"lidar": None, "ldiar": 1}, "'lidar' has no timeout; there is no 'ldiar' to have a timeout"),
        ({"imu": 0}, "the timeout of 'imu' must be more than 0"),
        ({"left": -1}, "the timeout of 'left' must be more than 0"),
    ],
)
def test_sources_and_timeouts_match_one_to_one(change: dict[str, Nanos | None], message: str) -> None:
    timeouts = {name: t for name, t in {**TIMEOUTS, **change}.items() if t is not None}
    for settings in (SETTINGS, BrainSettings(Joints(motors=("left", "right")))):
        with pytest.raises(ValueError, match=message) as error:
            Brain(settings, ["left", "right"], MOUNTS, timeouts)
        assert str(error.value) == message


def test_a_wheel_that_is_no_motor_is_refused() -> None:
    timeouts = {name: t for name, t in TIMEOUTS.items() if name != "right"}
    with pytest.raises(ValueError, match="joints that are no motors: right"):
        Brain(SETTINGS, ["left"], MOUNTS, timeouts)


def test_a_motor_and_a_sensor_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="'left' is the name of two"):
        Brain(SETTINGS, ["left", "right"], {**MOUNTS, "left": Mount()}, TIMEOUTS)


@pytest.mark.parametrize(
    ("settings", "values", "message"),
    [
        (FilterSettings, {"confidence": 0.9}, "confidence must be one of"),
        (MapSettings, {"farthest": 100.0, "resolution": 0.02}, "tiles: 65536 tiles lie about the robot"),
        (HealthSettings, {"slow_age": 0.95}, "stand_age must not be less than slow_age, 0.95"),
        (HealthSettings, {"rejected_stop": 0.2}, "rejected_stop must not be less than rejected_slow, 0.3"),
        (MatchSettings, {"widest": 0.05}, "widest must not be less than reach, 0.1"),
        (PursuitSettings, {"lookahead_min": 2.0}, "lookahead_max must not be less than lookahead_min, 2"),
        (PursuitSettings, {"turn_until": 1.0}, "turn_until must be less than turn_from"),
        (
            BrainSettings,
            {
                "body": BODY,
                "perception": PerceptionSettings(map=MapSettings(0.01)),
                "planner": PlannerSettings(margin=1.0, comfort=2.0),
            },
            "planner: the footprint's radius, margin and comfort are 3.25 m, 325 cells of the map",
        ),
    ],
)
def test_settings_that_do_not_go_together_are_refused(
    settings: type, values: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        settings(**values)
