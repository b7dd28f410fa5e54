"""The contract of a plain device, its settings, and the twin at inputs that no host causes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, SECOND
from protocols.plain import plugin
from protocols.plugin import Device, Twin
from tests.protocols.plain.published import notation


def device(kind: str = "motor", **settings: Any) -> Device:
    return Device("m", 1, plugin.options(kind), plugin.settings(**settings))


def test_a_plain_device_is_a_sensor_by_default() -> None:
    spec = plugin.spec(replace(device(), options=plugin.options()))
    assert spec.kind == "sensor"
    assert not spec.commands
    assert spec.requests == frozenset[type[msg.Request]]((msg.Scan, msg.SetId))
    kinds = {name.partition(".")[0] for name in spec.ranges}
    assert kinds == {"Imu", "LaserScan", "Fix", "PoseReading", "Marker", "ShaftReading"}


@pytest.mark.parametrize(("watchdog", "enabled", "holds"), [(100.0, True, False), (0.0, False, True)])
def test_the_watchdog_decides_whether_a_motor_holds_unattended(
    watchdog: float, enabled: bool, holds: bool
) -> None:
    spec = plugin.spec(device(watchdog_ms=watchdog))
    assert (spec.watchdog.enabled, spec.holds_unattended) == (enabled, holds)
    assert spec.watchdog.timeout == (round(watchdog * MILLISECOND) or None)


@pytest.mark.parametrize("address", [0, 256, -1])
def test_an_address_out_of_range_is_an_error_of_configuration(address: int) -> None:
    with pytest.raises(ValueError, match="1 … 255"):
        plugin.spec(replace(device(), address=address))


@pytest.mark.parametrize("wrong", [{"torque_limit": math.nan}, {"supply": -1.0}, {"feedback_ms": 0.0}])
def test_settings_that_cannot_be_are_an_error_of_configuration(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        plugin.settings(**wrong)


@pytest.mark.parametrize(
    ("text", "harmless"),
    [
        ('0 Scan ""', True),
        ('1 ReadParameter "" "supply"', True),
        ('0 Scan "" + 1 ReadParameter "" "supply"', True),
        ('0 Scan "" + 1 Idle ""', False),
        ('1 Idle ""', False),
        ('1 ClearFault ""', False),
        ('0 SetId "" 1 2', False),
        ('[:9] 0 Scan ""', False),
        ('0 Scan "" + [:9] 1 Idle ""', False),
    ],
)
def test_read_only(text: str, harmless: bool) -> None:
    assert plugin.spec(device()).read_only(notation(text)) is harmless
    assert not plugin.spec(device()).read_only(CanFrame(1, remote=True))


@pytest.mark.parametrize(("kind", "code"), [("sensor", 1), ("motor", 0), ("motor", 3)])
def test_what_is_no_fault_is_not_provoked(kind: str, code: int) -> None:
    with pytest.raises(ValueError, match=f"no fault {code}"):
        plugin.twin(device(kind), 0).provoke(code)


def stepped(twin: Twin, now: int, position: float | None, velocity: float | None = 0.0) -> Any:
    return twin.step(now, [msg.Feedback("m", now, position, velocity)])


def test_before_its_first_step_it_obeys_no_command_and_a_wrong_shaft_is_not_measured() -> None:
    twin = plugin.twin(device(), 0)
    twin.receive(SECOND, notation('1 Position "" 1.0 0.0 0.0'))
    assert stepped(twin, SECOND, 0.0)[0] == [msg.Torque("m", 0.0)]
    twin.receive(SECOND, notation('1 Position "" 1.0 0.0 0.0'))
    for position in (0.5, math.nan, None):
        assert stepped(twin, SECOND, position)[0] == [msg.Torque("m", 0.5)]


def test_after_a_pause_it_sends_one_state_and_one_feedback() -> None:
    twin = plugin.twin(device(), 0)
    stepped(twin, SECOND, 0.0)
    stepped(twin, SECOND + MILLISECOND, 0.0)
    assert [len(stepped(twin, 11 * SECOND + n * MILLISECOND, 0.0)[1]) for n in range(3)] == [1, 1, 0]
