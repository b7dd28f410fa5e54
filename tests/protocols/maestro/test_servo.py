"""A servo on a Maestro: which pulses it gets, what becomes of it without a host, and without a board."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import pytest

from gateway.config import load_robot, parse_robot
from gateway.config.validate import cautions
from gateway.core.joint import Joint
from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.conformance.bench import ALPHA, NAMES, Bench, data_of, make_bench
from protocols.frames import Frame
from protocols.maestro import plugin
from protocols.maestro import table as mt
from protocols.maestro.options import Options, Settings
from protocols.maestro.twin import MaestroTwin
from protocols.messages import MILLISECOND, Mode
from protocols.plugin import Device
from tests.distributions import ROOT
from tests.gateway.rig import Rig

CAR = (ROOT / "fixtures" / "robots" / "car.toml").read_text("utf-8")


def bench(options: Options, addresses: tuple[int, ...] = (3, 7), settings: object = None) -> Bench:
    made = make_bench(plugin, options, addresses, NAMES[: len(addresses)], settings)
    made.steps(60)
    return made


def targets(frames: Any, checked: bool = False) -> list[float]:
    """The pulses [µs] in these frames; 0: none."""
    found = [one for each in frames for one in mt.PACKETS[checked].in_frame(each)[0]]
    return [one.values["value"] / 4 for one in found if one is not None and one.name == "SETTARGET"]


ODD = (0.0, 0.3, -0.3, 0.8, -0.8, 0.8000001, 3.0, -417.0, 1e30, math.inf, -math.inf, math.nan, 5e-324)


@pytest.mark.parametrize(("low", "centre", "high"), [(1100.0, 1500.0, 1900.0), (900.25, 1000.0, 2100.5)])
def test_a_pulse_outside_the_servos_range_is_never_sent(low: float, centre: float, high: float) -> None:
    """Whatever is commanded, in whatever order; a board that makes another host's longer pulse is held within
    the range, too."""
    made = bench(Options(low_us=low, centre_us=centre, high_us=high, travel=1.6))
    longer = mt.PACKETS[False].encode("SETTARGET", 3, value=4 * 2400)
    sent: list[Frame] = []
    for first, then in product(ODD, ODD):
        for command in (msg.Position(ALPHA, first), msg.Hold(ALPHA), msg.Position(ALPHA, then)):
            sent += [frame for step in made.steps(2, [command]) for frame in step.down]
    sent += [frame for step in made.steps(60, [msg.Idle(ALPHA)]) for frame in step.down]
    for twin in made.twins:
        twin.receive(made.now, longer)
    fresh = replace(made, driver=bench(Options(low_us=low, centre_us=centre, high_us=high)).driver)
    fresh.steps(60)
    sent += [frame for step in fresh.steps(60, [msg.Hold(ALPHA)]) for frame in step.down]
    pulses = targets(sent)
    assert len(pulses) > 300
    assert {0.0, centre} <= set(pulses)
    assert all(pulse == 0.0 or low <= pulse <= high for pulse in pulses), sorted(set(pulses))
    assert targets([longer]) == [2400.0]


def test_a_position_beyond_the_range_is_refused_in_words() -> None:
    made = bench(Options(travel=1.6))
    events = [one for step in made.steps(3, [msg.Position(ALPHA, 0.9)]) for one in step.events]
    assert [one.reason for one in events if isinstance(one, msg.Refused)] == [
        "position 0.9 lies outside -0.8 … 0.8"
    ]


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ({"low_us": 1600.0}, "centre_us must not be less than low_us, 1600"),
        ({"high_us": 1400.0}, "high_us must not be less than centre_us, 1500"),
        ({"low_us": 1490.0, "high_us": 1510.0}, "high_us must be at least 50 µs above low_us, 1490"),
        ({"low_us": 200.0}, "low_us must be from 400 to 2600 µs, not 200"),
        ({"timeout_ms": 105}, "timeout_ms is 105: it has steps of 10"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], wrong: str) -> None:
    with pytest.raises(Invalid, match=wrong):
        Options(**options)


@pytest.mark.parametrize("address", [24, 99, 12_824, 13_000, -1])
def test_an_address_that_is_no_channel(address: int) -> None:
    with pytest.raises(Invalid, match="a channel, 0 to 23"):
        plugin.spec(Device("servo", address, Options(), Settings()))


def test_limits_beyond_the_servos_range_are_warned_of() -> None:
    robot = parse_robot(CAR.replace("position = [-0.5, 0.5]", "position = [-0.6, 0.5]"))
    text = (
        "steering: its limits of position are [-0.5, 0.6] rad at the device's shaft, but the device can be"
        " commanded from -0.55 to 0.55 only; commands beyond that are refused"
    )
    assert text in cautions(robot)
    assert not any("limits of position are" in one for one in cautions(load_robot("car")))


def test_channels_of_several_boards_on_one_line() -> None:
    made = bench(Options(crc=True), (1203, 1303))
    steps = made.steps(300, [msg.Position(ALPHA, 0.3)])
    assert made.modes == {ALPHA: Mode.ARMED, NAMES[1]: Mode.READY}
    assert made.shafts[ALPHA].position == pytest.approx(0.3, abs=0.02)
    assert made.shafts[NAMES[1]].position == 0.0
    sent = [frame for step in steps for frame in step.down if targets([frame], checked=True)]
    assert {data_of(frame)[:4].hex() for frame in sent} == {"aa0c0403"}


def test_the_boards_own_ramp() -> None:
    """Speed and acceleration in its units, rounded: 25 µs/s, 312.5 µs/s²."""
    options = Options(travel=1.0, speed=0.5, acceleration=2.0)
    assert options.set_up == {"SETSPEED": 20, "SETACCELERATION": 6}
    made = bench(options)
    made.steps(60, [msg.Position(ALPHA, 0.0)])
    made.steps(300, [msg.Position(ALPHA, 0.4)])
    assert 0.05 < made.shafts[ALPHA].position < 0.15
    made.steps(1200, [msg.Position(ALPHA, 0.4)])
    assert made.shafts[ALPHA].position == pytest.approx(0.4, abs=0.01)


def test_a_serial_timeout_lets_go_and_says_so() -> None:
    made = bench(Options(timeout_ms=300))
    made.steps(200, [msg.Position(ALPHA, 0.2)])
    assert made.modes[ALPHA] is Mode.ARMED
    twin = made.twins[0]
    assert isinstance(twin, MaestroTwin)
    for at in range(1, 302):  # the host is gone
        twin.step(made.now + at * MILLISECOND, ())
    assert twin.mode is Mode.READY
    made.now += 302 * MILLISECOND
    events = [one for step in made.steps(600) for one in step.events]
    details = [one.detail for one in events if isinstance(one, msg.State) and one.motor == ALPHA]
    assert "open loop: no pulses; serial timeout" in details


@pytest.mark.parametrize("without_signal", ["limp", "holds"])
def test_what_a_servo_does_without_pulses(without_signal: Any) -> None:
    made = bench(Options(), settings=Settings(without_signal=without_signal))
    made.steps(300, [msg.Position(ALPHA, 0.2)])
    made.steps(100, [msg.Idle(ALPHA)])
    made.shafts[ALPHA].load = 0.05
    made.steps(300)
    assert (abs(made.shafts[ALPHA].position - 0.2) < 0.05) is (without_signal == "holds")


# -- the joint ----------------------------------------------------------------------------------------------


def test_a_joint_without_feedback_goes_where_it_is_sent_by_its_own_ramp() -> None:
    """It begins in the middle; each set-point within its limits; nothing is reported as measured."""
    motor = load_robot("car").motors["steering"]
    joint = Joint("steering", motor.joint, motor.spec)
    joint.on_event(msg.State("steering", 0, Mode.READY, "open loop: no pulses"))
    step, now, sent = 5 * MILLISECOND, 0, list[float]()
    for at in range(200):
        now += step
        out = joint.command(now, msg.Position("steering", 0.4), stopped=False)
        assert isinstance(out, msg.Position)
        sent.append(-out.position)  # it is mounted the other way round
        if at == 10:
            joint.on_event(msg.State("steering", now, Mode.ARMED, "open loop: pulses"))
    assert sent[:11] == [pytest.approx(sent[0])] * 11  # until it has pulses
    assert abs(sent[0]) < 2e-3
    speeds = [(b - a) / 5e-3 for a, b in pairwise(sent)]
    assert max(speeds) <= 4.0 + 1e-9
    assert max(b - a for a, b in pairwise(speeds)) <= 2 * 40.0 * 5e-3 + 1e-9  # one step more when it is armed
    assert sent[-1] == pytest.approx(0.4)
    presumed = joint.presumed(now)
    assert presumed is not None
    assert presumed.position == pytest.approx(0.4)
    assert joint.feedback == msg.Feedback("steering", 0)
    assert isinstance(joint.command(now + step, None, stopped=True), msg.Hold)


def test_a_board_that_is_gone_is_a_fault_and_the_car_stands() -> None:
    rig = Rig(CAR)
    rig.run(1.0)
    rig.run(0.6, msg.Drive(0.3, 0.2))
    for _ in range(4):
        rig.run(0.2, msg.Drive(0.3, 0.2))
    assert rig.gateway.joints["steering"].armed
    rig.world.disconnect("steering")
    rig.run(0.5, msg.Drive(0.3, 0.2))
    faults = [fault.name for fault in rig.gateway.joints["steering"].faults.values()]
    assert faults == ["silent: no feedback for more than 250 ms"]
    rig.run(1.0)
    before = rig.world.world.truth()
    rig.run(0.5, msg.Drive(0.3, 0.2))
    after = rig.world.world.truth()
    assert math.dist((before.x, before.y), (after.x, after.y)) < 0.005


def test_the_guard_holds_back_a_pulse_that_jumps() -> None:
    rig = Rig(CAR)
    rig.run(1.0)
    rig.run(0.3, msg.Drive(0.3, 0.0))
    guard, joints = rig.gateway.guard, rig.gateway.joints
    frame = mt.PACKETS[False].encode("SETTARGET", 0, value=4 * 1700)
    passed, blocked = guard.check(rig.clock.now(), "servos", "maestro", [frame], joints, False)
    assert not passed
    assert "position" in blocked[0].text
