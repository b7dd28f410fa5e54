"""The contract of the plugin: entry point, spec, ids, read-only frames, options, settings, the samples."""

from __future__ import annotations

import math
from dataclasses import replace
from types import ModuleType
from typing import Any

import moteus
import pytest

from benchmarks.codec import theirs
from benchmarks.samples import moteus as samples
from protocols.messages import Estop, Hold, Idle, Impedance, Position, Reboot, Torque, Velocity
from protocols.moteus import driver, spec
from protocols.moteus.codec import Query, command_id, encode, make_frame
from protocols.moteus.faults import FAULTS, LIMITS, fault_info_of
from protocols.moteus.messages import DISCOVER, IDENTIFY, STOP, Limits, console, masked, position_command
from protocols.moteus.options import Options, Settings, limits_of
from protocols.moteus.registers import Register
from protocols.moteus.reply import FAST, FULL
from protocols.plugin import Device
from tests.protocols.moteus.helpers import device


def test_specs_of_equal_devices_are_equal() -> None:
    assert spec(device()) == spec(device())
    assert spec(device()).commands == {Idle, Hold, Position, Velocity, Torque}
    assert not {Impedance} & spec(device()).commands
    assert not {Estop, Reboot} & spec(device()).requests


@pytest.mark.parametrize(
    "data", [FAST, FULL, DISCOVER, IDENTIFY, encode(Query(Register.VOLTAGE, 3, 1)), b"", b"\x50"]
)
def test_queries_are_read_only(data: bytes) -> None:
    read_only = spec(device()).read_only
    assert read_only(make_frame(command_id(1), data))
    assert read_only(make_frame(command_id(0x7F), data))
    assert not read_only(make_frame(command_id(2), data))
    assert not read_only(data)


@pytest.mark.parametrize(
    "data",
    [
        STOP,
        position_command(0.0, 0.0, 0.0, Limits(0.1)) + FAST,
        console("conf get id.id"),
        masked(bytes(8), DISCOVER),
        FAST + b"\x60",
        FAST[:-1],
        bytes.fromhex("420130"),
    ],
)
def test_all_else_is_not(data: bytes) -> None:
    assert not spec(device()).read_only(make_frame(command_id(1), data))


@pytest.mark.parametrize("address", [0, -1, 127, 200])
def test_an_address_that_is_no_id(address: int) -> None:
    with pytest.raises(ValueError, match="an id is 1 to 126"):
        spec(device(address=address))


def test_a_duplicate_address_is_an_error() -> None:
    with pytest.raises(ValueError, match="duplicate address"):
        driver([device("left", 1), device("right", 1)])
    driver([device("left", 1), device("right", 1, options=Options(can_prefix=1))])


def test_options_of_another_protocol_are_an_error() -> None:
    with pytest.raises(TypeError, match="Options and Settings"):
        spec(Device("left", 1, object(), Settings()))


def test_the_watchdog_is_always_on_and_in_the_spec() -> None:
    watchdog = spec(device(options=Options(timeout_ms=250))).watchdog
    assert (watchdog.timeout, watchdog.enabled, watchdog.note) == (250_000_000, True, "")
    with pytest.raises(ValueError, match="timeout_ms is 0"):
        Options(timeout_ms=0)


@pytest.mark.parametrize(
    ("values", "name", "value"),
    [
        (Options(), "host_id", 127),
        (Options(), "host_id", -1),
        (Options(), "can_prefix", 0x2000),
        (Options(), "timeout_ms", 9),
        (Options(), "timeout_ms", 10_001),
        (Options(), "feedback_ms", 0),
        (Options(), "details_ms", 0),
        (Options(), "offline_ms", 19),
        (Options(), "max_torque", math.nan),
        (Options(), "max_torque", -1.0),
        (Options(), "velocity_limit", math.inf),
        (Options(), "acceleration_limit", -0.1),
        (Settings(), "uuid", "xyz"),
        (Settings(), "firmware", "1.2"),
        (Settings(), "timeout_mode", 3),
        (Settings(), "kp", math.nan),
        (Settings(), "kp", -1.0),
        (Settings(), "ki", math.inf),
        (Settings(), "motor_kv", 0.0),
        (Settings(), "encoder_cpr", 0),
        (Settings(), "enable_ms", -1),
        (Settings(), "position_max", math.inf),
        (Settings(), "max_current", 0.0),
    ],
)
def test_options_and_settings_that_cannot_be(values: Any, name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        replace(values, **{name: value})


def test_all_errors_in_options_are_reported_at_once() -> None:
    with pytest.raises(ValueError, match=r"host_id.*max_torque.*offline_ms"):
        Options(host_id=127, max_torque=-1.0, feedback_ms=1000, offline_ms=100)


def test_limits_are_in_the_device_s_units() -> None:
    limits = limits_of(Options(max_torque=1.5, velocity_limit=math.tau, acceleration_limit=2 * math.tau))
    assert limits == Limits(0.1, 1.5, 1.0, 2.0)
    assert limits_of(Options()) == Limits(0.1)


def test_settings_may_be_nan_where_the_device_s_may() -> None:
    Settings(position_min=math.nan, default_timeout_s=math.nan, fault_position_error=math.nan)


def test_every_fault_has_name_cause_and_remedy() -> None:
    for code in (*FAULTS, 77):
        text = fault_info_of(code)
        assert text.name
        assert text.cause
        assert text.remedy
    assert not set(FAULTS) & set(LIMITS)


@pytest.mark.parametrize("sample", samples.SAMPLES, ids=lambda sample: sample.what)
def test_both_sides_of_a_sample_come_to_the_same(sample: samples.Sample) -> None:
    package: ModuleType = moteus
    theirs(sample, samples.prepared(package))
