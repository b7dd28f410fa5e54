"""A real VESC's telemetry (serial, from firmware of 2018) as frames of the twin and of the table, and what
the driver makes of them. The frames are derived: on CAN they were never sent."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from gateway.rosbag.file import open_bag
from protocols.frames import Frame
from protocols.messages import SECOND, Feedback, Nanos
from protocols.plugin import Device, Driver
from protocols.vesc import plugin
from protocols.vesc.options import Options, Settings
from protocols.vesc.table import TABLE

TELEMETRY = "f110/vesc.bag"
OPTIONS = Options(pole_pairs=2, torque_constant=0.003, max_current=60.0, feedback_ms=1)
MOTOR = Device("motor", 1, OPTIONS, Settings(supply=11.6))


@pytest.fixture(scope="module")
def telemetry(recording: Callable[[str], Path]) -> list[tuple[Nanos, Any]]:
    """What was reported, and when."""
    with open_bag(recording(TELEMETRY)) as (bag, _):
        core = [each for each in bag.connections if each.topic == "/sensors/core"]
        read: list[Any] = [bag.deserialize(raw, at.msgtype) for at, _, raw in bag.messages(core)]
    return [(m.header.stamp.sec * SECOND + m.header.stamp.nanosec, m.state) for m in read]


def decoded(driver: Driver, t: Nanos, frames: Iterable[Frame]) -> dict[str, float]:
    """Return what a driver measures by some frames."""
    events = [event for frame in frames for event in driver.receive(t, frame) if isinstance(event, Feedback)]
    names = ("position", "velocity", "torque", "current", "voltage")
    values = [(name, getattr(event, name)) for event in events for name in names]
    return {name: value for name, value in values if value is not None}


def test_the_twin_reports_what_the_controller_did(telemetry: list[tuple[Nanos, Any]]) -> None:
    """It is given the motion of the shaft, and the current, along which it pushes."""
    twin, driver = plugin.twin(MOTOR, 0), plugin.driver([MOTOR])
    count = 0
    for t, state in telemetry:
        current = -state.current_motor if state.duty_cycle < 0.0 else state.current_motor
        twin.receive(t, TABLE.encode("SET_CURRENT", 1, value=current))
        shaft = Feedback("motor", t, state.displacement * OPTIONS.step, state.speed * OPTIONS.erpm)
        frames = twin.step(t, [shaft])[1]
        count += len(frames)
        if t == telemetry[0][0]:
            continue  # it was switched on
        values = decoded(driver, t, frames)
        assert values["position"] == pytest.approx(state.displacement * OPTIONS.step)
        assert values["velocity"] == pytest.approx(state.speed * OPTIONS.erpm, abs=1.01 * OPTIONS.erpm)
        assert abs(values["current"]) == pytest.approx(abs(current), abs=0.051)
        assert values["current"] * current >= 0.0
    assert count == 3 * len(telemetry) == 6732


def test_its_current_has_the_sign_of_the_power_it_takes(telemetry: list[tuple[Nanos, Any]]) -> None:
    """Driven backwards, the car's motor takes current as it does forwards: our torque points along."""
    driver, along = plugin.driver([MOTOR]), list[bool]()
    for t, state in telemetry:
        if state.speed < -1000.0 and abs(state.current_motor) > 1.0:
            values = {"velocity": state.speed, "current": state.current_motor, "duty": state.duty_cycle}
            report = decoded(driver, t, [TABLE.encode("STATUS_1", 1, **values)])
            along.append(report["torque"] * report["velocity"] > 0.0)
    assert len(along) == 137
    assert sum(along) == 133
