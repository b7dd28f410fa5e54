"""A number of the settings, changed while running."""

from __future__ import annotations

from math import inf, nan

import pytest

from brain.bodies.joints import Joints
from brain.brain import Brain, BrainSettings
from brain.perception.mount import Mount
from brain.settings import changed, keys
from protocols.messages import MILLISECOND, Goal, Nanos
from tests.brain.helpers import BODY, MOUNTS, TIMEOUTS, Office, Trip

SETTINGS = BrainSettings("differential", BODY)


def test_every_key_takes_its_own_value_or_says_that_it_counts_from_the_start() -> None:
    known = dict(keys(SETTINGS))
    assert len(known) > 40
    for key, value in known.items():
        after, why = changed(SETTINGS, key, value, SETTINGS)
        assert after == SETTINGS, key
        assert why == "" or "from the start" in why, key


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
    assert (slow.differential and slow.differential.max_linear, why) == (0.2, "")
    assert changed(slow, "differential.max_linear", 0.6, SETTINGS) == (SETTINGS, "")


def test_times_are_in_milliseconds_as_in_the_robot_file() -> None:
    after, why = changed(SETTINGS, "planner.patience_ms", 1500.0, SETTINGS)
    assert (after.planner.patience, why) == (1500 * MILLISECOND, "")


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("pursuit.lookahed_time", 1.0, "did you mean 'pursuit.lookahead_time'"),
        ("nothing like it", 1.0, "there are differential.wheel_radius"),
        ("pursuit", 1.0, "there is no setting 'pursuit'"),
        ("pursuit.lookahead_time", -1.0, "lookahead_time must be more than 0"),
        ("pursuit.lookahead_min", 3.0, "lookahead_max must not be less than lookahead_min, 3.0"),
        ("pursuit.lookahead_time", nan, "must be a finite number, not nan"),
        ("health.slow", inf, "must be a finite number"),
        ("health.slow_age", 0.95, "stand_age must not be less than slow_age"),
        ("health.stand_age", 1.1, "stand_age is a share: at most 1, not 1.1"),
        ("planner.expansions_per_step", 10.5, "must be an integer, not 10.5"),
        ("planner.unknown_is_free", 2.0, "must be 0 or 1, not 2"),
        ("planner.patience_ms", 0.0, "patience must be more than 0"),
        ("differential.max_linear", 0.0, "max_linear must be a number above 0"),
        ("differential.max_linear", 0.7, "must not be more than 0.6, as the robot file has it, but is 0.7"),
        ("differential.wheel_radius", 0.06, "counts from the start on: change it in the robot file"),
        ("perception.gyro_sigma", 0.1, "counts from the start on"),
    ],
)
def test_what_cannot_be_is_a_sentence_and_changes_nothing(key: str, value: float, said: str) -> None:
    after, why = changed(SETTINGS, key, value, SETTINGS)
    assert said in why
    assert after is SETTINGS


def test_a_change_is_obeyed_while_it_drives() -> None:
    trip = Trip(Office())
    trip.tick([Goal(-1.0, 3.0)])
    trip.run(4.0)
    assert trip.brain.set("differential.max_linear", 0.1) == ""
    trip.run(1.0)
    rest = [trip.office.speed for _ in range(100) if trip.tick()]
    assert 0.05 < max(rest) < 0.11


def test_a_body_without_its_table_is_refused() -> None:
    with pytest.raises(ValueError, match=r"needs its table, brain\.differential"):
        Brain(BrainSettings("differential"), ["left", "right"], MOUNTS, TIMEOUTS)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"ldiar": MILLISECOND}, "there is no 'ldiar' to have a timeout"),
        ({"lidar": None, "left": None}, "'left' has no timeout; 'lidar' has no timeout"),
        ({"lidar": None, "ldiar": 1}, "'lidar' has no timeout; there is no 'ldiar' to have a timeout"),
        ({"imu": 0}, "the timeout of 'imu' must be more than 0"),
        ({"left": -1}, "the timeout of 'left' must be more than 0"),
    ],
)
def test_each_source_has_one_timeout_and_no_timeout_is_nobodys(
    change: dict[str, Nanos | None], said: str
) -> None:
    timeouts = {name: t for name, t in {**TIMEOUTS, **change}.items() if t is not None}
    for settings in (SETTINGS, BrainSettings("joints", joints=Joints(("left", "right")))):
        with pytest.raises(ValueError, match=said) as error:
            Brain(settings, ["left", "right"], MOUNTS, timeouts)
        assert str(error.value) == said


def test_a_wheel_that_is_no_motor_is_refused() -> None:
    timeouts = {name: t for name, t in TIMEOUTS.items() if name != "right"}
    with pytest.raises(ValueError, match="wheels that are no motors: right"):
        Brain(SETTINGS, ["left"], MOUNTS, timeouts)


def test_a_motor_and_a_sensor_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="'left' is the name of two"):
        Brain(SETTINGS, ["left", "right"], {**MOUNTS, "left": Mount()}, TIMEOUTS)
