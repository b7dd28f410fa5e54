"""The load of a robot's buses: counted, the highest rate that fits, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from gateway.config import load_robot, parse_robot
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.runtime.schedule import BusSchedule, count_buses, highest_rate, refuse_overload


def on_slow_bus(rate: float, bitrate: int = 125_000, robot: str | Robot = "bench") -> Robot:
    """Two motors on a bus with little room."""
    robot = load_robot(robot) if isinstance(robot, str) else robot
    buses = {name: replace(bus, bitrate=bus.bitrate and bitrate) for name, bus in robot.buses.items()}
    return replace(robot, buses=buses, period=round(1e9 / rate))


def can0(robot: Robot) -> BusSchedule:
    return count_buses(robot)[0]


def test_set_points_grow_with_the_rate_and_cyclic_reports_do_not() -> None:
    slow, fast = can0(on_slow_bus(100.0)), can0(on_slow_bus(200.0))
    set_points = {name for name, count in slow.frames.items() if (count, fast.frames[name]) == (100, 200)}
    reports = {name for name, count in slow.frames.items() if abs(count - fast.frames[name]) <= 1}
    assert set_points == {"02C", "04C"}
    assert reports >= {"021", "029", "041", "049"}
    assert slow.load < fast.load < 2.0 * slow.load


def test_the_highest_rate_that_fits_runs_without_a_missed_report_and_a_tenth_more_does_not_fit() -> None:
    robot = on_slow_bus(100.0)
    rate = highest_rate(robot, [can0(robot)])
    below, above = can0(on_slow_bus(rate)), can0(on_slow_bus(1.1 * rate))
    assert below.fits
    assert below.load > 0.85
    assert not above.fits


def test_a_robot_that_its_bus_does_not_carry_is_refused_with_a_rate_that_fits() -> None:
    with pytest.raises(UserError) as caught:
        refuse_overload(on_slow_bus(1000.0))
    text = str(caught.value)
    assert "does not fit its buses at 1000 steps per second" in text
    rate = float(text.partition("rate_hz = ")[2].partition(",")[0])
    assert can0(on_slow_bus(rate)).fits


def test_a_bus_too_slow_for_the_reports_alone_has_no_rate() -> None:
    with pytest.raises(UserError, match="no rate_hz fits"):
        refuse_overload(on_slow_bus(100.0, 10_000))


def test_a_robot_that_asks_for_feedback_too_often_is_told_how_often_fits() -> None:
    with pytest.raises(UserError) as caught:
        refuse_overload(on_slow_bus(200.0, robot="diffbot_vesc"))
    period = int(str(caught.value).partition("feedback_ms = ")[2].partition(" ")[0])
    vesc = load_robot("diffbot_vesc")
    text, count = re.subn(r"feedback_ms = \d+", f"feedback_ms = {period}", vesc.text)
    assert count
    assert can0(on_slow_bus(200.0, robot=parse_robot(text))).fits
