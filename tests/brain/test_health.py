"""The ladder: full speed, slow, standing, gone; and back."""

from __future__ import annotations

from dataclasses import replace

import pytest

from brain.health import Health, HealthSettings, Level
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Fix, Imu, LaserScan, Mode, Nanos, State

SETTINGS = HealthSettings()
MS = MILLISECOND
TIMEOUTS = {"left": 100 * MS, "right": 80 * MS, "lidar": 700 * MS, "imu": 155 * MS, "gps": 2000 * MS}


def feedback(t: Nanos, motor: str = "left") -> Feedback:
    return Feedback(motor, t, 1.0, 0.0)


def imu(t: Nanos) -> Imu:
    return Imu("imu", t, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))


def scan(t: Nanos) -> LaserScan:
    return LaserScan("lidar", t, 0.0, 1.0, 0.1, 10.0, (1.0, 1.0))


def fix(t: Nanos) -> Fix:
    return Fix("gps", t, 48.0, 11.0)


def all_at(t: Nanos) -> dict[str, Event]:
    """Something of everyone, by name."""
    return {
        "left": feedback(t),
        "right": feedback(t, "right"),
        "imu": imu(t),
        "lidar": scan(t),
        "gps": fix(t),
    }


def received(settings: HealthSettings = SETTINGS) -> Health:
    health = Health(["left", "right"], ["lidar", "imu", "gps"], TIMEOUTS, settings)
    health.observe(list(all_at(0).values()))
    return health


def test_what_is_missing_at_the_start_is_named() -> None:
    health = Health(["left", "right"], ["lidar"], TIMEOUTS, SETTINGS)
    assert health.missing() == "feedback of left, feedback of right, a reading of lidar"
    health.observe([feedback(0), Feedback("right", 0, voltage=24.0), scan(0)])
    assert health.missing() == "feedback of right"
    health.observe([feedback(0, "right")])
    assert health.missing() == ""


@pytest.mark.parametrize(
    ("name", "word", "slow", "stand"),
    [
        ("left", "feedback", "50", "90"),
        ("right", "feedback", "40", "72"),
        ("imu", "reading", "77.5", "139.5"),
        ("lidar", "scan", "350", "630"),
        ("gps", "fix", "1000", "1800"),
    ],
)
def test_each_source_goes_slow_and_then_stands_by_shares_of_its_own_timeout(
    name: str, word: str, slow: str, stand: str
) -> None:
    """And says the figure that it has passed, in ms."""
    for age, level, reported in (
        (float(slow) * MS, Level.WELL, ""),
        (float(slow) * MS + 1, Level.SLOW, slow),
        (float(stand) * MS, Level.SLOW, slow),
        (float(stand) * MS + 1, Level.STAND, stand),
    ):
        health = received()
        now = round(age)
        health.observe([event for who, event in all_at(now).items() if who != name])
        verdict = health.judge(now, {})
        assert verdict.level is level, age
        assert verdict.reason == (reported and f"{name}: no {word} for more than {reported} ms")


def test_the_shares_are_settings() -> None:
    health = received(HealthSettings(slow_age=0.1, stand_age=1.0))
    for age, level in ((70, Level.WELL), (71, Level.SLOW), (700, Level.SLOW), (701, Level.STAND)):
        assert health.source(age * MS, "lidar").level is level, age


def test_better_is_believed_after_a_while_only() -> None:
    health = received()
    late = 351 * MS

    def judge(now: Nanos) -> Level:
        health.observe([event for who, event in all_at(now).items() if who != "lidar"])
        return health.judge(now, {}).level

    assert judge(late) is Level.SLOW
    health.observe([scan(late)])
    levels = [judge(late + i * 10 * MILLISECOND) for i in range(36)]
    assert levels[:30] == [Level.SLOW] * 30
    assert levels[30:] == [Level.WELL] * 6


def test_what_stays_bad_is_gone_and_what_comes_back_is_well_again() -> None:
    health = received()
    now = SECOND
    assert health.judge(now, {}).level is Level.STAND
    assert health.judge(now + SETTINGS.give_up - 1, {}).level is Level.STAND
    assert health.judge(now + SETTINGS.give_up, {}).level is Level.GONE
    back = now + SETTINGS.give_up
    for _ in range(2):
        back += SETTINGS.recover - MILLISECOND
        health.observe(list(all_at(back).values()))
        levels = health.judge(back, {}).level, health.source(back, "lidar").level
        assert levels[1] is Level.WELL
    assert levels[0] is Level.WELL


@pytest.mark.parametrize(
    ("refused", "level"), [(0, Level.WELL), (20, Level.WELL), (40, Level.SLOW), (90, Level.STAND)]
)
def test_measurements_that_do_not_fit_count(refused: int, level: Level) -> None:
    """Consistency: it is not enough that a source speaks; what it says must be believable."""
    health = received()
    health.judge(0, {"imu": 7})
    for i in range(1, 101):
        now = i * 10 * MILLISECOND
        health.observe(list(all_at(now).values()))
    verdict = health.judge(SECOND, {"imu": 7 + refused})
    assert verdict.level is level
    assert (
        level is Level.WELL
        or verdict.reason == f"imu: {refused} % of its measurements do not fit what is believed"
    )


def test_a_motor_in_fault_is_gone_at_once_until_it_says_otherwise() -> None:
    health = received()
    health.observe([State("left", 0, Mode.FAULT, "DC_BUS_UNDER_VOLTAGE"), State("other", 0, Mode.FAULT)])
    verdict = health.judge(0, {})
    assert (verdict.level, verdict.reason) == (Level.GONE, "left is in fault: DC_BUS_UNDER_VOLTAGE")
    health.observe([State("left", 0, Mode.READY)])
    assert health.source(0, "left").level is Level.WELL


def test_a_motor_that_initialises_is_missing_at_the_start_though_it_is_heard() -> None:
    """Of two wheels, one would turn alone."""
    health = received()
    health.observe(
        [State("right", 0, Mode.INITIALISING, "asking it what it is"), State("other", 0, Mode.INITIALISING)]
    )
    assert health.missing() == "right to initialise: asking it what it is"
    health.observe([State("right", 0, Mode.READY)])
    assert health.missing() == ""
    health.observe([State("right", 1, Mode.INITIALISING, "calibrating")])  # as some do when they are armed
    assert health.source(0, "right").level is Level.WELL


def test_an_old_measurement_that_comes_late_makes_nothing_younger() -> None:
    health = received()
    health.observe([scan(500 * MILLISECOND), scan(100 * MILLISECOND)])
    assert health.source(600 * MILLISECOND, "lidar").level is Level.WELL


@pytest.mark.parametrize(
    "change",
    [
        {"slow": 0.0},
        {"slow": 1.5},
        {"slow_age": 0.0},
        {"slow_age": 0.95},
        {"stand_age": 0.4},
        {"stand_age": 1.01},
        {"give_up": 0},
        {"window": -1},
    ],
)
def test_no_timeout_can_be_switched_off(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"must|share"):
        replace(SETTINGS, **change)  # type: ignore[arg-type]  # the point of the test
