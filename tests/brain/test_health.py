"""The levels: full speed, slow, standing, lost; and back."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from brain.health import Health, HealthLevel, HealthSettings, SourceHealth
from brain.perception.consistency import Trust, Verdict
from brain.perception.motion_check import Contradiction
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Fix, Imu, LaserScan, Mode, Nanos, State

SETTINGS = HealthSettings()
MS = MILLISECOND
TIMEOUTS = {"left": 100 * MS, "right": 80 * MS, "lidar": 700 * MS, "imu": 155 * MS, "gps": 2000 * MS}


def feedback(t: Nanos, motor: str = "left") -> Feedback:
    return Feedback(motor, t, 1.0, 0.0)


def scan(t: Nanos) -> LaserScan:
    return LaserScan("lidar", t, 0.0, 1.0, 0.1, 10.0, (1.0, 1.0))


def all_at(t: Nanos) -> dict[str, Event]:
    """A measurement of every source, by name."""
    return {
        "left": feedback(t),
        "right": feedback(t, "right"),
        "imu": Imu("imu", t, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)),
        "lidar": scan(t),
        "gps": Fix("gps", t, 48.0, 11.0),
    }


def healthy(settings: HealthSettings = SETTINGS, helpful: Sequence[str] = ()) -> Health:
    health = Health(["left", "right"], ["lidar", "imu", "gps"], TIMEOUTS, settings, helpful)
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
    ("name", "measurement", "slow", "stand"),
    [
        ("left", "feedback", "50", "90"),
        ("right", "feedback", "40", "72"),
        ("imu", "reading", "77.5", "139.5"),
        ("lidar", "scan", "350", "630"),
        ("gps", "fix", "1000", "1800"),
    ],
)
def test_each_source_goes_slow_and_then_stands_by_shares_of_its_own_timeout(
    name: str, measurement: str, slow: str, stand: str
) -> None:
    """The reason gives the limit that was passed, in ms."""
    for age, level, reported in (
        (float(slow) * MS, HealthLevel.OK, ""),
        (float(slow) * MS + 1, HealthLevel.SLOW, slow),
        (float(stand) * MS, HealthLevel.SLOW, slow),
        (float(stand) * MS + 1, HealthLevel.HALT, stand),
    ):
        health = healthy()
        now = round(age)
        health.observe([event for source, event in all_at(now).items() if source != name])
        result = health.assess(now, {})
        assert result.level is level, age
        assert result.reason == (reported and f"{name}: no {measurement} for more than {reported} ms")


def test_the_shares_are_settings() -> None:
    health = healthy(HealthSettings(slow_age=0.1, stand_age=1.0))
    for age, level in (
        (70, HealthLevel.OK),
        (71, HealthLevel.SLOW),
        (700, HealthLevel.SLOW),
        (701, HealthLevel.HALT),
    ):
        assert health.source(age * MS, "lidar").level is level, age


def test_a_better_level_takes_effect_only_after_a_while() -> None:
    health = healthy()
    late = 351 * MS

    def level(now: Nanos) -> HealthLevel:
        health.observe([event for source, event in all_at(now).items() if source != "lidar"])
        return health.assess(now, {}).level

    assert level(late) is HealthLevel.SLOW
    health.observe([scan(late)])
    levels = [level(late + i * 10 * MILLISECOND) for i in range(36)]
    assert levels[:30] == [HealthLevel.SLOW] * 30
    assert levels[30:] == [HealthLevel.OK] * 6


def test_what_can_be_driven_with_is_slow_for_as_long_as_it_lasts_and_drops_nothing() -> None:
    """Longer than any trouble may last: a mounting, a verdict, a helpful sensor that falls silent."""
    mounted = Contradiction("lidar: mounted +5.0° off", confirmed=False, flawed="lidar")
    unsure = Verdict(Trust.TOO_SURE, "too sure")
    for reason, found, verdict, silent in (
        (mounted.reason, [mounted], Verdict(), ""),
        ("too sure", [], unsure, ""),
        ("imu: no reading for more than 139.5 ms", [], Verdict(), "imu"),
    ):
        health = healthy(helpful=["imu"])
        for now in range(50 * MS, 30 * SECOND, 50 * MS):
            health.observe([event for name, event in all_at(now).items() if name != silent])
            result = health.assess(now, {}, found, verdict)
            assert now < 200 * MS or result == SourceHealth(HealthLevel.SLOW, reason)
        for later in (0, SETTINGS.recover):
            health.observe(list(all_at(now + later).values()))
            result = health.assess(now + later, {})
        assert result.level is HealthLevel.OK


def test_a_helpful_sensor_is_awaited_for_a_while_and_then_done_without() -> None:
    health = Health(["left"], ["lidar", "imu"], TIMEOUTS, SETTINGS, helpful=["imu"])
    for now, missing in ((0, ", a reading of imu"), (3 * SECOND - 1, ", a reading of imu"), (3 * SECOND, "")):
        health.observe([feedback(now)])
        health.assess(now, {})
        assert health.missing() == f"a reading of lidar{missing}"
    health.observe([scan(now)])
    now += SETTINGS.recover
    health.observe([feedback(now), scan(now)])
    assert health.assess(now, {}) == SourceHealth(HealthLevel.SLOW, "imu has never reported")


def test_an_estimate_that_is_lost_stands_and_then_drops_the_tasks() -> None:
    health, lost = healthy(), Verdict(Trust.LOST, "lost: lidar")
    levels = []
    for now in range(0, SETTINGS.give_up + 1, 100 * MS):
        health.observe(list(all_at(now).values()))
        levels.append(health.assess(now, {}, (), lost).level)
    assert levels == [HealthLevel.HALT] * (len(levels) - 1) + [HealthLevel.LOST]


def test_what_stays_bad_is_lost_and_what_comes_back_is_well_again() -> None:
    health = healthy()
    now = SECOND
    assert health.assess(now, {}).level is HealthLevel.HALT
    assert health.assess(now + SETTINGS.give_up - 1, {}).level is HealthLevel.HALT
    assert health.assess(now + SETTINGS.give_up, {}).level is HealthLevel.LOST
    back = now + SETTINGS.give_up
    for _ in range(2):
        back += SETTINGS.recover - MILLISECOND
        health.observe(list(all_at(back).values()))
        levels = health.assess(back, {}).level, health.source(back, "lidar").level
        assert levels[1] is HealthLevel.OK
    assert levels[0] is HealthLevel.OK


@pytest.mark.parametrize(
    ("rejected", "level"),
    [(0, HealthLevel.OK), (20, HealthLevel.OK), (40, HealthLevel.SLOW), (90, HealthLevel.HALT)],
)
def test_rejected_measurements_count(rejected: int, level: HealthLevel) -> None:
    health = healthy()
    health.assess(0, {"imu": 7})
    for i in range(1, 101):
        now = i * 10 * MILLISECOND
        health.observe(list(all_at(now).values()))
    result = health.assess(SECOND, {"imu": 7 + rejected})
    assert result.level is level
    assert level is HealthLevel.OK or result.reason == f"imu: {rejected} % of its measurements are rejected"


def test_a_motor_in_fault_is_lost_at_once_until_it_changes_state() -> None:
    health = healthy()
    health.observe([State("left", 0, Mode.FAULT, "DC_BUS_UNDER_VOLTAGE"), State("other", 0, Mode.FAULT)])
    result = health.assess(0, {})
    assert (result.level, result.reason) == (HealthLevel.LOST, "left is in fault: DC_BUS_UNDER_VOLTAGE")
    health.observe([State("left", 0, Mode.READY)])
    assert health.source(0, "left").level is HealthLevel.OK


def test_a_base_stands_if_one_wheel_is_armed_and_the_other_is_not() -> None:
    health = healthy()
    health.observe([State("left", 0, Mode.READY), State("right", 0, Mode.READY)])

    def level(t: Nanos) -> SourceHealth:
        health.observe(list(all_at(t).values()))
        return health.assess(t, {})

    assert level(2 * SECOND).level is HealthLevel.OK
    health.observe([State("left", 2 * SECOND, Mode.ARMED)])
    assert [level(t * 100 * MS).level for t in range(20, 31)] == [HealthLevel.OK] * 11
    assert level(3100 * MS) == SourceHealth(HealthLevel.HALT, "right is not armed, and another wheel is")
    health.observe([State("right", 3100 * MS, Mode.ARMED)])
    assert level(3200 * MS).level is HealthLevel.SLOW
    assert level(3500 * MS).level is HealthLevel.OK


def test_a_motor_that_initialises_is_missing_at_the_start_even_if_it_measures() -> None:
    """Of two wheels, one would turn alone."""
    health = healthy()
    health.observe(
        [State("right", 0, Mode.INITIALISING, "identifying"), State("other", 0, Mode.INITIALISING)]
    )
    assert health.missing() == "right to initialise: identifying"
    health.observe([State("right", 0, Mode.READY)])
    assert health.missing() == ""
    health.observe([State("right", 1, Mode.INITIALISING, "calibrating")])  # as some do when they are armed
    assert health.source(0, "right").level is HealthLevel.OK


def test_an_old_measurement_that_comes_late_makes_nothing_younger() -> None:
    health = healthy()
    health.observe([scan(500 * MILLISECOND), scan(100 * MILLISECOND)])
    assert health.source(600 * MILLISECOND, "lidar").level is HealthLevel.OK


def test_a_contradiction_is_slow_until_it_is_confirmed_and_lost_when_it_lasts() -> None:
    health = healthy()

    def level(now: Nanos, *contradictions: Contradiction) -> HealthLevel:
        health.observe(list(all_at(now).values()))
        return health.assess(now, {}, contradictions).level

    doubt, certain = Contradiction("a or b", confirmed=False), Contradiction("a or b")
    assert level(0, doubt) is HealthLevel.SLOW
    assert level(10 * MS, doubt, certain) is HealthLevel.HALT
    assert level(10 * MS + SETTINGS.contradicted - 1, certain) is HealthLevel.HALT
    assert level(10 * MS + SETTINGS.contradicted, certain) is HealthLevel.LOST
    over = 20 * MS + SETTINGS.contradicted
    assert level(over) is HealthLevel.LOST  # until all has been well for a while
    assert level(over + SETTINGS.recover) is HealthLevel.OK


def test_degraded_for_too_long_is_lost() -> None:
    health = healthy()
    levels = {}
    for tenth in range(120):
        now = tenth * 100 * MS
        late = now - 360 * MS  # the lidar is slow, and never stands
        events = [event for source, event in all_at(now).items() if source != "lidar"]
        health.observe([*events, scan(late)])
        levels[tenth] = health.assess(now, {})
    assert {levels[tenth].level for tenth in range(4, 104)} == {HealthLevel.SLOW}
    assert levels[104].level is HealthLevel.LOST
    assert levels[104].reason == "degraded for 10 s: lidar: no scan for more than 350 ms"


@pytest.mark.parametrize(("apart", "lost"), [(3, True), (6, False)])
def test_degraded_too_often_is_lost(apart: int, lost: bool) -> None:
    """The fifth time within 20 s."""
    health = healthy()
    levels = []
    for tenth in range(apart * 10 * 5):
        now = tenth * 100 * MS
        health.observe(list(all_at(now).values()))
        doubts = [Contradiction("a or b", confirmed=False)] if tenth % (apart * 10) == 0 else []
        levels.append(health.assess(now, {}, doubts).level)
    assert levels.count(HealthLevel.LOST) == (3 if lost else 0)
    assert levels[-1] is HealthLevel.OK
    assert levels.index(HealthLevel.SLOW) == 0


def test_a_reading_that_shows_nothing_is_slow_at_once_and_then_none() -> None:
    health = healthy()
    empty = {"lidar": "0 of 360 rays have returns"}
    for age, level, reason in (
        (100, HealthLevel.SLOW, "lidar: 0 of 360 rays have returns"),
        (640, HealthLevel.HALT, "lidar: no scan for more than 630 ms (0 of 360 rays have returns)"),
    ):
        health.observe(list(all_at(age * MS).values()), empty)
        assert health.assess(age * MS, {}) == SourceHealth(level, reason)
