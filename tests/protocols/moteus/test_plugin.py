"""The contract of the plugin: spec, read-only frames, options and settings with their bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from protocols.conformance import check, table
from protocols.messages import Feedback, Impedance
from protocols.moteus import plugin
from protocols.plugin import Device
from tests.protocols.moteus.test_transcripts import notation

OPTIONS, SETTINGS = plugin.options(), plugin.settings()
DEVICE = Device("left", 1, OPTIONS, SETTINGS)


def test_specs_of_equal_devices_are_equal() -> None:
    assert plugin.spec(DEVICE) == plugin.spec(replace(DEVICE))


@pytest.mark.parametrize(
    ("data", "harmless"),
    [
        ("11001f01110f", True),
        ("11001c040114060a", True),
        ("1b80021804d00211d802", True),
        ("1d0d", True),
        ("", True),
        ("50", True),
        ("010000", False),
        ("01000a0f20 0.0f 0.0f 0.0f 0d27 0.1f 11001f01110f", False),
        ('40010f "conf get id.id" 0a', False),
        ("0ad402 00000000 00000000 1804d00211d802", True),
        ("11001f01110f 60", False),
        ("11001f0111", False),
        ("420130", False),
    ],
)
def test_only_queries_are_read_only(data: str, harmless: bool) -> None:
    read_only = plugin.spec(DEVICE).read_only
    assert read_only(notation(f"frame 8001 {data}")) is harmless
    assert read_only(notation(f"frame 807f {data}")) is harmless
    assert not read_only(notation(f"frame 8002 {data}"))


@pytest.mark.parametrize("address", [0, -1, 127, 200])
def test_an_address_that_is_no_id(address: int) -> None:
    with pytest.raises(ValueError, match="it must be 1 to 126"):
        plugin.spec(replace(DEVICE, address=address))


def test_the_watchdog_is_always_on_and_in_the_spec() -> None:
    watchdog = plugin.spec(replace(DEVICE, options=plugin.options(timeout_ms=250))).watchdog
    assert (watchdog.timeout, watchdog.enabled, watchdog.note) == (250_000_000, True, "")


@pytest.mark.parametrize(
    ("values", "name", "value"),
    [
        *((OPTIONS, "host_id", value) for value in (-1, 127)),
        (OPTIONS, "can_prefix", 0x2000),
        *((OPTIONS, "timeout_ms", value) for value in (0, 9, 10_001)),
        (OPTIONS, "feedback_ms", 0),
        (OPTIONS, "details_ms", 0),
        (OPTIONS, "offline_ms", 19),
        *((OPTIONS, "max_torque", value) for value in (math.nan, -1.0)),
        (OPTIONS, "velocity_limit", math.inf),
        (OPTIONS, "acceleration_limit", -0.1),
        *((OPTIONS, name, -1.0) for name in ("kp", "kd")),
        *((OPTIONS, name, math.inf) for name in ("within_min", "within_max")),
        (plugin.options(within_max=1.0), "within_min", 1.0),
        *((SETTINGS, name, value) for name, value in (("uuid", "xyz"), ("firmware", "1.2"))),
        *((SETTINGS, "kp", value) for value in (math.nan, -1.0)),
        *((SETTINGS, name, 0) for name in ("motor_kv", "encoder_cpr", "max_current")),
        *((SETTINGS, name, math.inf) for name in ("ki", "position_max")),
        (SETTINGS, "timeout_mode", 3),
        (SETTINGS, "enable_ms", -1),
    ],
)
def test_options_and_settings_that_cannot_be(values: Any, name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        replace(values, **{name: value})


def test_all_errors_in_options_are_reported_at_once() -> None:
    with pytest.raises(ValueError, match=r"(?s)(?=.*host_id)(?=.*max_torque)(?=.*offline_ms)"):
        plugin.options(host_id=127, max_torque=-1.0, feedback_ms=1000, offline_ms=100)


def test_impedance_is_a_command_where_both_gains_are_known() -> None:
    for kp, kd in ((10.0, 0.4), (10.0, 0.0), (0.0, 0.4)):
        spec = plugin.spec(replace(DEVICE, options=plugin.options(kp=kp, kd=kd)))
        assert (Impedance in spec.commands) == (kp > 0.0 and kd > 0.0)


@pytest.mark.prove
def test_the_contract_is_kept_with_gains_limits_and_bounds() -> None:
    given = {"kp": 10.0, "kd": 0.4, "velocity_limit": 30.0, "within_min": -200.0, "within_max": 300.0}
    results = check(replace(plugin, options=partial(plugin.options, max_torque=1.0, **given)))  # type: ignore[arg-type] # what makes the options
    assert not [result for result in results if result.outcome == "failed"], table(results)


def test_every_fault_has_name_cause_and_remedy_and_no_other_is_provoked() -> None:
    faults = plugin.spec(DEVICE).faults
    assert all(info.name and info.cause and info.remedy for info in faults.values())
    with pytest.raises(ValueError, match="no fault 96"):  # what limits the output is no fault
        plugin.twin(DEVICE, 0).provoke(96)


def test_uuids_come_from_address_and_seed_and_what_is_not_measured_is_not_taken() -> None:
    replies = set()
    for address, seed in ((1, 0), (1, 1), (2, 0), (2, 1), (2, 1)):
        twin = plugin.twin(replace(DEVICE, address=address), seed)
        twin.receive(0, notation(f"frame {0x8000 | address:x} 1d01"))  # before its first step: nothing
        assert twin.step(0, [Feedback("left", 0, math.pi, 0.0)])[1] == []
        twin.step(10**6, [Feedback("left", 10**6, math.nan, math.nan), Feedback("right", 10**6, 1.0, 1.0)])
        twin.receive(10**6, notation(f"frame {0x8000 | address:x} 1d01 1804d002"))
        (reply,) = twin.step(2 * 10**6, [])[1]
        assert "2D010000003F" in str(reply)
        replies.add(str(reply)[-40:])
    assert len(replies) == 4
