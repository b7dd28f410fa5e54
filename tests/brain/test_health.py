"""The ladder: full speed, slow, standing, gone; and back."""

from __future__ import annotations

from dataclasses import replace

import pytest

from brain.health import Health, HealthSettings, Level
from protocols.words import MILLISECOND, SECOND, Event, Feedback, Imu, LaserScan, Mode, Nanos, State

SETTINGS = HealthSettings()


def feedback(t: Nanos, motor: str = "left") -> Feedback:
    return Feedback(motor, t, 1.0, 0.0)


def imu(t: Nanos) -> Imu:
    return Imu("imu", t, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))


def scan(t: Nanos) -> LaserScan:
    return LaserScan("lidar", t, 0.0, 1.0, 0.1, 10.0, (1.0, 1.0))


def heard() -> Health:
    health = Health(["left", "right"], ["lidar", "imu"], SETTINGS)
    health.hear([feedback(0), feedback(0, "right"), imu(0), scan(0)])
    return health


def test_what_is_missing_at_the_start_is_named() -> None:
    health = Health(["left", "right"], ["lidar"], SETTINGS)
    assert health.missing() == "feedback of left, feedback of right, a reading of lidar"
    health.hear([feedback(0), Feedback("right", 0, voltage=24.0), scan(0)])
    assert health.missing() == "feedback of right"
    health.hear([feedback(0, "right")])
    assert health.missing() == ""


@pytest.mark.parametrize(
    ("name", "slow", "stop"),
    [
        ("left", SETTINGS.feedback_slow, SETTINGS.feedback_stop),
        ("imu", SETTINGS.imu_slow, SETTINGS.imu_stop),
        ("lidar", SETTINGS.scan_slow, SETTINGS.scan_stop),
    ],
)
def test_each_source_goes_slow_and_then_stands_by_its_age(name: str, slow: Nanos, stop: Nanos) -> None:
    for age, level in (
        (slow, Level.WELL),
        (slow + 1, Level.SLOW),
        (stop, Level.SLOW),
        (stop + 1, Level.STAND),
    ):
        health = heard()
        others: list[Event] = [feedback(age), feedback(age, "right"), imu(age), scan(age)]
        health.hear([e for e in others if getattr(e, "motor", getattr(e, "sensor", "")) != name])
        verdict = health.judge(age, {})
        assert verdict.level is level, age
        assert verdict.reason.startswith(name) or level is Level.WELL


def test_better_is_believed_after_a_while_only() -> None:
    health = heard()
    late = SETTINGS.scan_slow + MILLISECOND

    def judge(now: Nanos) -> Level:
        health.hear([feedback(now), feedback(now, "right"), imu(now)])
        return health.judge(now, {}).level

    assert judge(late) is Level.SLOW
    health.hear([scan(late)])
    levels = [judge(late + i * 10 * MILLISECOND) for i in range(36)]
    assert levels[:30] == [Level.SLOW] * 30
    assert levels[30:] == [Level.WELL] * 6


def test_what_stays_bad_is_gone_and_what_comes_back_is_well_again() -> None:
    health = heard()
    now = SECOND
    assert health.judge(now, {}).level is Level.STAND
    assert health.judge(now + SETTINGS.give_up - 1, {}).level is Level.STAND
    assert health.judge(now + SETTINGS.give_up, {}).level is Level.GONE
    back = now + SETTINGS.give_up
    for _ in range(2):
        back += SETTINGS.recover - MILLISECOND
        health.hear([feedback(back), feedback(back, "right"), imu(back), scan(back)])
        levels = health.judge(back, {}).level, health.source(back, "lidar").level
        assert levels[1] is Level.WELL
    assert levels[0] is Level.WELL


@pytest.mark.parametrize(
    ("refused", "level"), [(0, Level.WELL), (20, Level.WELL), (40, Level.SLOW), (90, Level.STAND)]
)
def test_measurements_that_do_not_fit_count(refused: int, level: Level) -> None:
    """Consistency: it is not enough that a source speaks; what it says must be believable."""
    health = heard()
    health.judge(0, {"imu": 7})
    for i in range(1, 101):
        now = i * 10 * MILLISECOND
        health.hear([feedback(now), feedback(now, "right"), imu(now), scan(now)])
    verdict = health.judge(SECOND, {"imu": 7 + refused})
    assert verdict.level is level
    assert (
        level is Level.WELL
        or verdict.reason == f"imu: {refused} % of its measurements do not fit what is believed"
    )


def test_a_motor_in_fault_is_gone_at_once_until_it_says_otherwise() -> None:
    health = heard()
    health.hear([State("left", 0, Mode.FAULT, "DC_BUS_UNDER_VOLTAGE"), State("other", 0, Mode.FAULT)])
    verdict = health.judge(0, {})
    assert (verdict.level, verdict.reason) == (Level.GONE, "left is in fault: DC_BUS_UNDER_VOLTAGE")
    health.hear([State("left", 0, Mode.READY)])
    assert health.source(0, "left").level is Level.WELL


def test_an_old_measurement_that_comes_late_makes_nothing_younger() -> None:
    health = heard()
    health.hear([scan(500 * MILLISECOND), scan(100 * MILLISECOND)])
    assert health.source(600 * MILLISECOND, "lidar").level is Level.WELL


@pytest.mark.parametrize(
    "change", [{"slow": 0.0}, {"slow": 1.5}, {"scan_stop": MILLISECOND}, {"give_up": 0}, {"window": -1}]
)
def test_no_timeout_can_be_switched_off(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"must|share"):
        replace(SETTINGS, **change)  # type: ignore[arg-type]  # the point of the test
