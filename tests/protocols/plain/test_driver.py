from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from protocols import messages as msg
from protocols.conformance.bench import Bench
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Mode, Request
from protocols.plain import codec, plugin
from tests.protocols.plain.bench import ask, bench, reported

T = 1_000_000_000


def received(stage: Bench, *messages: bytes, t: int = T) -> list[Any]:
    return [event for data in messages for event in stage.driver.receive(t, data)]


# -- up ------------------------------------------------------------------------------------------------


def test_each_address_has_its_own_name() -> None:
    stage = bench(motors=["left", "right"])
    messages = [codec.encode(address, msg.Feedback("", 0, float(address))) for address in (2, 1)]
    assert received(stage, *messages) == [msg.Feedback("right", T, 2.0), msg.Feedback("left", T, 1.0)]


# -- down ----------------------------------------------------------------------------------------------


def sent(stage: Bench, *messages: Command | Request) -> list[Any]:
    return list(stage.driver.send(T, messages)[1])


REFUSED: list[tuple[Command | Request, str]] = [
    (msg.Velocity("m", float("nan")), "not in"),
    (msg.ClearFault("lidar"), "no motor 'lidar'"),
    (msg.WriteParameter("m", "velocity_gain", float("inf")), "not finite"),
    (msg.WriteParameter("m", "x" * 20_000, 1.0), "a body of"),
]


@pytest.mark.parametrize(
    ("message", "reason"), REFUSED, ids=[type(message).__name__ for message, _ in REFUSED]
)
def test_refused_at_once_and_nothing_goes_out(message: Command | Request, reason: str) -> None:
    stage = bench(sensors=["lidar"])
    events, frames = stage.driver.send(T, [message])
    (refused,) = events
    assert isinstance(refused, msg.Refused)
    assert refused.request == type(message).__name__
    assert reason in refused.reason
    assert frames == []
    assert sent(stage, msg.Idle("m")) == []  # it is not owned either


def test_a_repeated_refusal_is_reported_once_until_a_command_was_accepted() -> None:
    stage = bench()
    commands = [msg.Velocity("m", velocity) for velocity in (1e9, 1e9, 1.0, 1e9)]
    assert [len(stage.driver.send(T, [command])[0]) for command in commands] == [1, 0, 0, 1]
    assert [len(stage.driver.send(T, [msg.Home("m")])[0]) for _ in range(2)] == [1, 1]


REQUESTS: list[Request] = [
    msg.ClearFault("m"),
    msg.Estop("m"),
    msg.Zero("m"),
    msg.ReadParameter("m", "supply"),
    msg.WriteParameter("m", "supply", 12.0),
    msg.Reboot("m"),
]


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda message: type(message).__name__)
def test_a_request_is_answered_by_the_device_and_then_no_more(request_: Request) -> None:
    stage = bench()
    stage.steps(5)
    steps = ask(stage, request_, steps=400)
    (answer,) = reported(steps, (msg.Done, msg.Refused, msg.Parameter))
    assert isinstance(answer, msg.Parameter if isinstance(request_, msg.ReadParameter) else msg.Done)


# -- the whole line ------------------------------------------------------------------------------------


def test_scan_finds_motors_and_sensors_and_ends() -> None:
    stage = bench(sensors=["lidar"], motors=["left", "right"])
    steps = ask(stage, msg.Scan("line"), steps=250)
    assert [(f.address, f.serial, f.detail) for f in reported(steps, msg.Found)] == [
        (1, 10, "motor"),
        (2, 20, "motor"),
        (101, 1010, "sensor"),
    ]
    assert [(d.request, d.name, d.detail) for d in reported(steps, msg.Done)] == [("Scan", "line", "3 found")]
    assert {state.mode for state in reported(steps, msg.State)} == {Mode.READY}


def test_set_id_moves_the_one_device_with_this_serial_number() -> None:
    stage = bench(motors=["left", "right"])
    stage.steps(5)
    steps = ask(stage, msg.SetId("line", 20, 9), steps=300)
    assert [(f.address, f.serial) for f in reported(steps, msg.Found)] == [(9, 20)]
    assert [(d.request, d.detail) for d in reported(steps, msg.Done)] == [("SetId", "20 is now at 9")]
    assert {f.motor for f in reported(steps[20:], msg.Feedback)} == {"left"}
    assert [(s.motor, s.mode) for s in reported(steps, msg.State) if s.mode == Mode.OFFLINE] == [
        ("right", Mode.OFFLINE)
    ]


@pytest.mark.parametrize(("serial", "address"), [(99, 9), (10, 0), (10, 256)])
def test_set_id_that_no_device_takes_is_refused_in_time(serial: int, address: int) -> None:
    stage = bench()
    steps = ask(stage, msg.SetId("line", serial, address), steps=300)
    (refused,) = reported(steps, msg.Refused)
    assert refused.request == "SetId"
    assert reported(steps, msg.Done) == []


def test_set_id_reaches_a_sensor_too() -> None:
    stage = bench(sensors=["gps"], motors=[])
    steps = ask(stage, msg.SetId("line", 1010, 7))
    assert [f.address for f in reported(steps, msg.Found)] == [7]


# -- the contract --------------------------------------------------------------------------------------


def test_a_plain_device_is_a_sensor_by_default() -> None:
    spec = bench(sensors=["lidar"], motors=[]).specs[0]
    assert spec.kind == "sensor"
    assert not spec.commands
    assert spec.requests == frozenset[type[Request]]((msg.Scan, msg.SetId))
    assert plugin.options().kind == "sensor"
    assert {name.partition(".")[0] for name in spec.ranges} == {"Imu", "LaserScan", "Fix"}


@pytest.mark.parametrize(("watchdog", "enabled", "holds"), [(100.0, True, False), (0.0, False, True)])
def test_the_watchdog_decides_whether_a_motor_holds_unattended(
    watchdog: float, enabled: bool, holds: bool
) -> None:
    spec = bench(watchdog_ms=watchdog).specs[0]
    assert (spec.watchdog.enabled, spec.holds_unattended) == (enabled, holds)
    assert spec.watchdog.timeout == (round(watchdog * MILLISECOND) or None)


def test_an_address_out_of_range_is_an_error_of_configuration() -> None:
    device = bench().devices[0]
    for address in (0, 256, -1):
        with pytest.raises(ValueError, match="1 … 255"):
            plugin.spec(replace(device, address=address))


READ_ONLY: list[tuple[bytes | CanFrame, bool]] = [
    (codec.encode(0, msg.Scan("")), True),
    (codec.encode(1, msg.ReadParameter("", "supply")), True),
    (codec.encode(0, msg.Scan("")) + codec.encode(1, msg.ReadParameter("", "supply")), True),
    (codec.encode(0, msg.Scan("")) + codec.encode(1, msg.Idle("")), False),
    (codec.encode(1, msg.Idle("")), False),
    (codec.encode(1, msg.ClearFault("")), False),
    (codec.encode(0, msg.SetId("", 1, 2)), False),
    (codec.encode(0, msg.Scan("")) + codec.encode(1, msg.Idle(""))[:-1], False),
    (codec.encode(0, msg.Scan(""))[:-1], False),
    (b"x", False),
    (CanFrame(1, remote=True), False),
]


@pytest.mark.parametrize(("frame", "harmless"), READ_ONLY)
def test_read_only(frame: bytes | CanFrame, harmless: bool) -> None:
    assert bench().specs[0].read_only(frame) is harmless
