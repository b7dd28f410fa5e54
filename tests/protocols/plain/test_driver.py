from __future__ import annotations

from dataclasses import replace

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Mode, Request
from protocols.plain import codec, plugin
from tests.protocols.plain.bench import ask, bench, reported

T = 1_000_000_000


def test_a_repeated_refusal_is_reported_once_until_a_command_was_accepted() -> None:
    stage = bench()
    commands = [msg.Velocity("m", velocity) for velocity in (1e9, 1e9, 1.0, 1e9)]
    assert [len(stage.driver.send(T, [command])[0]) for command in commands] == [1, 0, 0, 1]
    assert [len(stage.driver.send(T, [msg.Home("m")])[0]) for _ in range(2)] == [1, 1]


# -- the whole line ------------------------------------------------------------------------------------


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
