"""The load of a robot's buses: counted, the highest rate that fits, and what is refused."""

from __future__ import annotations

import re
from collections import Counter
from contextlib import closing
from dataclasses import replace

import pytest

from gateway.config import load_robot, parse_robot
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.runtime.schedule import (
    WINDOW,
    BusSchedule,
    count_buses,
    highest_rate,
    lowest_rate,
    not_armed,
    refuse_overload,
    table,
)
from gateway.runtime.session import open_session
from protocols.frames import CanFrame, IdMask, any_matches
from protocols.messages import SECOND, Nanos
from tests.real_can.springs import ROBOTS, springs


def on_slow_bus(rate: float, bitrate: int = 125_000, robot: str | Robot = "bench") -> Robot:
    """Two motors on a bus with little room; no sensors."""
    robot = on_a_bench(load_robot(robot) if isinstance(robot, str) else robot)
    buses = {name: replace(bus, bitrate=bitrate) for name, bus in robot.buses.items()}
    return replace(robot, buses=buses, period=round(1e9 / rate))


def on_a_bench(robot: Robot) -> Robot:
    """A robot without its sensors, whose wheels turn in the air."""
    buses = {name: bus for name, bus in robot.buses.items() if bus.bitrate}
    return replace(robot, buses=buses, sensors={}, world="bench", plant=None)


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
    rate = highest_rate(robot)
    below, above = can0(on_slow_bus(rate)), can0(on_slow_bus(1.1 * rate))
    assert below.fits
    assert below.load > 0.85
    assert not above.fits


def test_a_robot_that_its_bus_does_not_carry_is_refused_with_a_rate_that_fits() -> None:
    with pytest.raises(UserError) as caught:
        refuse_overload(on_slow_bus(1000.0))
    assert "does not fit its buses at 1000 steps per second" in str(caught.value)
    assert can0(on_slow_bus(proposed_rate(caught.value))).fits


def proposed_rate(error: BaseException) -> float:
    return float(str(error).partition("lower the rate (rate_hz = ")[2].partition(",")[0])


@pytest.mark.parametrize("name", ["diffbot_cia402", "diffbot_zlac8015d"])
def test_drives_that_are_set_up_by_question_and_answer_are_counted_as_the_live_loop_steps(name: str) -> None:
    """Step by step at 50 Hz, their set-up would take four times as long as it does."""
    counted = refuse_overload(replace(on_a_bench(load_robot(name)), period=SECOND // 50))
    assert all(one.fits for one in counted)


@pytest.mark.parametrize("on_wheels", [False, pytest.param(True, marks=pytest.mark.prove)])
def test_motors_that_fall_out_on_a_full_wire_are_refused_with_a_rate_that_is_accepted(
    on_wheels: bool,
) -> None:
    """On its wheels, with its sensors, it stands at 10 Hz: what is commanded is too old before the next."""
    robot = on_slow_bus(500.0, 300_000, "diffbot_robomaster")
    if on_wheels:
        whole = load_robot("diffbot_robomaster")
        robot = replace(whole, buses=whole.buses | robot.buses, period=robot.period)
    with pytest.raises(UserError, match="does not fit") as caught:
        refuse_overload(robot)
    rate = proposed_rate(caught.value)
    assert 300.0 <= rate < 500.0
    refuse_overload(replace(robot, period=round(SECOND / rate)))


@pytest.mark.parametrize("limit", [11.5, 12.5, 37.0, 99.9, 512.3, 900.0])
@pytest.mark.parametrize("rate", [12.0, 60.0, 700.0, 1000.0])
@pytest.mark.parametrize("hidden", [1.0, 0.9])
def test_the_search_ends_just_below_the_limit(
    limit: float, rate: float, hidden: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`hidden`: share of the limit beyond which only the whole window shows that a rate does not fit."""
    tried: list[float] = []

    def count(
        robot: Robot, rate: float | None = None, window: Nanos = WINDOW, *_: object
    ) -> list[BusSchedule]:
        tried.append(rate or SECOND / robot.period)
        return [
            BusSchedule("can0", 1.0 if tried[-1] > (limit if window < WINDOW else hidden * limit) else 0.5)
        ]

    monkeypatch.setattr("gateway.runtime.schedule.count_buses", count)
    robot = replace(load_robot("bench"), period=round(SECOND / rate))
    if rate <= hidden * limit:
        refuse_overload(robot)
        assert highest_rate(robot, rate) >= rate
    else:
        with pytest.raises(UserError) as caught:
            refuse_overload(robot)
        if (lowest := lowest_rate(robot)) > hidden * limit:
            assert "no lower rate_hz fits" in str(caught.value)
        else:
            assert max(lowest, 0.84 * limit - 1.0) <= proposed_rate(caught.value) <= hidden * limit
    assert len(tried) < 25


def test_no_rate_is_tried_at_which_a_command_would_be_too_old_before_the_next() -> None:
    robot = load_robot("bench")
    assert {motor.joint.command_timeout for motor in robot.motors.values()} == {SECOND // 10}
    assert lowest_rate(robot) == 11.0
    parse_robot(re.sub(r"rate_hz = \d+", "rate_hz = 11", robot.text))


def test_motors_that_never_report_are_named_and_the_wire_is_not_blamed() -> None:
    """In its MIT mode this one answers commands alone, and a base awaits feedback before it commands."""
    text = load_robot("diffbot_cubemars").text.replace('mode = "servo"', 'mode = "mit"')
    counted = refuse_overload(on_a_bench(parse_robot(text)))
    assert "left, right" in not_armed(counted)
    assert table(counted).endswith(not_armed(counted))
    assert not any(one.crowded for one in counted)


def test_a_bus_too_slow_for_the_reports_alone_has_no_rate() -> None:
    with pytest.raises(UserError, match="no lower rate_hz fits"):
        refuse_overload(on_slow_bus(100.0, 10_000))


def test_a_robot_that_asks_for_feedback_too_often_is_told_how_often_fits() -> None:
    with pytest.raises(UserError) as caught:
        refuse_overload(on_slow_bus(200.0, robot="diffbot_vesc"))
    period = int(str(caught.value).partition("feedback_ms = ")[2].partition(" ")[0])
    vesc = load_robot("diffbot_vesc")
    text, count = re.subn(r"feedback_ms = \d+", f"feedback_ms = {period}", vesc.text)
    assert count
    assert can0(on_slow_bus(200.0, robot=parse_robot(text))).fits


# -- at the limit ------------------------------------------------------------------------------------


@pytest.mark.prove
def test_just_below_the_limit_no_reply_of_twelve_is_missed_and_just_above_some_are() -> None:
    robot = load_robot(ROBOTS / "twelve_damiao.toml")
    rate = highest_rate(robot)
    for one in count_buses(robot, rate):
        assert len(one.frames) == 12
        assert all(abs(number - rate) <= 1.0 for number in one.frames.values()), (rate, one.frames)
        assert one.load > 0.93
    above = 1.05 * rate
    assert min(min(one.frames.values()) for one in count_buses(robot, above)) < 0.95 * above


@pytest.mark.parametrize(
    ("name", "bitrate"),
    [
        ("diffbot_damiao", 250_000),
        pytest.param("diffbot_moteus", 125_000, marks=pytest.mark.prove),
        pytest.param("diffbot_myactuator", 250_000, marks=pytest.mark.prove),
        pytest.param("diffbot_robstride", 250_000, marks=pytest.mark.prove),
    ],
)
def test_just_below_the_limit_every_command_is_answered(name: str, bitrate: int) -> None:
    """The search for it is short, and shows how far it is."""
    robot, seen = on_slow_bus(50.0, bitrate, name), list[Nanos]()
    rate = highest_rate(robot, simulated=seen.append)
    assert WINDOW < sum(seen) < 12 * WINDOW
    assert max(seen) < WINDOW // 10
    wire, motors = count_buses(robot, rate)[0], robot.motors.values()
    commands, answers = (
        sum(number for ident, number in wire.frames.items() if is_one_of(ident, ids))
        for ids in (
            [one for motor in motors for one in motor.spec.sends],
            [one for motor in motors for one in motor.spec.expects],
        )
    )
    assert commands >= len(motors) * rate
    assert abs(commands - answers) <= len(motors), (rate, wire.frames)
    assert wire.load > 0.9


def is_one_of(ident: str, ids: list[IdMask]) -> bool:
    return any_matches(ids, CanFrame(int(ident, 16), extended=len(ident) > 3))


@pytest.mark.prove
@pytest.mark.parametrize(("name", "rate"), [("twelve_damiao", 670.0), ("twelve_moteus", 319.0)])
def test_twelve_springs_get_nine_tenths_of_their_wire_and_lose_no_answer(name: str, rate: float) -> None:
    """Six on each of two buses of 1 Mbit/s, twelve on one of CAN FD, where a spring's frames are longer than
    those of Hold: `tests/real_can/test_load.py` counts the same on the kernel's."""
    robot = load_robot(ROBOTS / f"{name}.toml")
    with open_session(replace(robot, period=round(SECOND / rate)), simulated=True) as session:
        assert session.twins is not None
        buses, busy = session.twins.buses, dict[str, Nanos]()
        seen, steps = {bus: Counter[str]() for bus in buses}, 0
        with closing(session.run(3.0, poll=lambda: springs(robot, session.clock.now()))) as ticks:
            for tick in ticks:
                if tick.now < SECOND:
                    busy = {bus: one.busy for bus, one in buses.items()}
                    continue
                steps += 1
                for packet in (*tick.inputs.packets, *tick.outputs.packets):
                    seen[packet.bus][str(packet.frame).partition("#")[0]] += 1
                if tick.now >= 3 * SECOND - session.robot.period:
                    break
            for bus, one in buses.items():
                share = (one.busy - busy[bus]) / (steps * session.robot.period)
                print(f"{name} at {rate:g} Hz: {bus} {share:.1%}, {min(seen[bus].values())} of {steps}")
                assert share > 0.9
                assert len(seen[bus]) == 2 * sum(motor.bus == bus for motor in robot.motors.values())
                assert all(abs(number - steps) <= 1 for number in seen[bus].values()), seen[bus]
