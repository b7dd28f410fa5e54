"""The contract of the plugin: entry point, spec, ids, read-only frames, options and settings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import pytest

from protocols import messages as msg
from protocols.conformance import CLAUSES, check, table, variants
from protocols.conformance.bench import ADDRESSES
from protocols.conformance.case import Case
from protocols.conformance.requests import configuration_is_read_and_written
from protocols.frames import EXTENDED_BIT, CanFrame
from protocols.odrive_can import WATCHDOG_NOTE, errors, plugin, spec
from protocols.odrive_can.options import Options, Settings, line_of
from protocols.odrive_can.table import BROADCAST
from tests.protocols.odrive_can.helpers import IDLE, V05, device, encode


def test_read_only_is_a_remote_frame_of_a_device_s_message() -> None:
    read_only = spec(device(options=Options(firmware="0.6"))).read_only
    assert read_only(CanFrame(0x29, remote=True))
    assert read_only(CanFrame(0x7E6, remote=True))
    assert not read_only(CanFrame(0x27, remote=True))
    assert not read_only(CanFrame(0x29))
    assert not read_only(CanFrame(0x29, remote=True, extended=True))
    assert not read_only(encode(1, IDLE))
    assert not read_only(b"\x29")


def test_the_watchdog_note_is_there_until_it_is_acknowledged_or_enabled() -> None:
    assert spec(device()).watchdog.note == WATCHDOG_NOTE
    assert not spec(device()).watchdog.enabled
    assert spec(device(options=Options(watchdog="acknowledged"))).watchdog.note == ""
    on = spec(device(settings=Settings(enable_watchdog=True, watchdog_timeout=0.5)))
    assert (on.watchdog.enabled, on.watchdog.timeout, on.watchdog.note) == (True, 500_000_000, "")
    assert spec(device()).holds_unattended
    assert not on.holds_unattended


def test_commands_requests_and_kind_of_the_spec() -> None:
    contract = spec(device())
    assert contract.commands == {msg.Idle, msg.Hold, msg.Position, msg.Velocity, msg.Torque}
    both: set[type] = {msg.ClearFault, msg.Estop, msg.Scan, msg.Zero, msg.Home, msg.Reboot}
    both |= {msg.ReadParameter, msg.WriteParameter}
    assert contract.requests == both | {msg.SetId}
    assert spec(device(options=V05)).requests == both | {msg.SetAddress}
    assert (contract.bus, contract.kind, contract.stop_clears_faults) == ("can", "motor", False)


@pytest.mark.parametrize("address", [-1, BROADCAST, 64])
def test_an_address_that_is_no_node_id_is_refused(address: int) -> None:
    with pytest.raises(ValueError, match="must be 0 to 62"):
        spec(device(address=address))


def test_two_devices_with_one_address_are_refused() -> None:
    with pytest.raises(ValueError, match="used by two"):
        plugin.driver([device("left", 1), device("right", 1)])


@pytest.mark.parametrize(
    ("kind", "wrong", "error"),
    [
        (Options, {"offline_ms": 10_001}, "offline_ms"),
        (Options, {"feedback_ms": 200, "offline_ms": 300}, "at least twice"),
        (Options, {"is_extended": True}, "is_extended needs"),
        (Options, {"endpoints": ("axis0.x 5 float",)}, "endpoints_version '' must be like"),
        (
            Options,
            {"endpoints": ("axis0.x 5 double",), "endpoints_version": "0.6.10"},
            "is not a path",
        ),
        (Options, {"endpoints": ("axis0.x5 float",), "endpoints_version": "0.6.10"}, "is not a path"),
        (Options, {"endpoints": ("a.input_vel 5 float",), "endpoints_version": "0.6.10"}, "is for commands"),
        (Settings, {"encoder_cpr": 0}, "encoder_cpr must be from 1 to 16777216, not 0"),
        (Settings, {"serial_number": 1 << 48}, "serial_number must be from 0 to 281474976710655, not"),
        (Settings, {"enable_watchdog": True}, "watchdog_timeout must be above 0"),
        (
            Settings,
            {"vel_limit": 0.0, "bus_voltage": -1.0},
            "vel_limit must be .* not 0; bus_voltage must be .* not -1",
        ),
        (Settings, {"firmware": "0.7.1"}, "firmware '0.7.1' must be like"),
        (Settings, {"firmware": "0.6"}, "firmware '0.6' must be like"),
        (Settings, {"firmware": "0.5.6b"}, "firmware '0.5.6b' must be like"),
        (Settings, {"other_axis": -2}, "other_axis"),
    ],
)
def test_options_and_settings_are_checked(kind: type, wrong: dict[str, Any], error: str) -> None:
    with pytest.raises(ValueError, match=error):
        kind(**wrong)


def test_the_line_is_that_of_the_settings_or_that_of_the_options() -> None:
    assert line_of(device(settings=Settings(firmware="0.5.4"))) == "0.5"
    assert line_of(device(options=Options(firmware="0.5"))) == "0.5"
    assert line_of(device()) == "0.6"


# -- the contract, where the plugin's own defaults do not lead ------------------------------------------


@dataclass(frozen=True, slots=True)
class Extended(Options):
    """An extended axis of 0.5.x, with everything else as by default."""

    firmware: Literal["0.5"] = "0.5"
    is_extended: bool = True
    watchdog: Literal["acknowledged"] = "acknowledged"


@dataclass(frozen=True, slots=True)
class Auto(Options):
    """Nothing is known beforehand."""

    firmware: Literal["auto"] = "auto"
    watchdog: Literal["acknowledged"] = "acknowledged"


@dataclass(frozen=True, slots=True)
class Settings05(Settings):
    """A device of 0.5.x, whatever is expected."""

    firmware: str = "0.5.6"


@pytest.mark.sample(1)
@pytest.mark.parametrize("options", [Extended, Auto], ids=lambda kind: kind.__name__)
def test_the_contract_is_kept_by_devices_of_0_5_too(options: type[Options]) -> None:
    """Those clauses that ids, arming and requests bear on; the whole contract runs over the defaults."""
    wanted = {"commands", "counts", "passive", "declared", "repeatable"}
    clauses = [clause for clause in CLAUSES if clause.name in wanted]
    assert len(clauses) == len(wanted)
    results = check(replace(plugin, options=options, settings=Settings05), clauses=clauses)
    assert {result.outcome for result in results} == {"passed"}, table(results)


def test_the_contract_tries_every_firmware_option() -> None:
    assert {options.firmware for options in variants(plugin)} == {"auto", "0.5", "0.6"}


@pytest.mark.parametrize(("address", "fits"), [(63, True), (0xFFFFFF, True), (0x1000000, False), (-1, False)])
def test_an_extended_address_has_24_bits(address: int, fits: bool) -> None:
    extended = device(address=address, options=Options(firmware="0.5", is_extended=True))
    if fits:
        assert all(EXTENDED_BIT <= number < EXTENDED_BIT + (1 << 29) for number, _ in spec(extended).sends)
    else:
        with pytest.raises(ValueError, match="must be 0 to 16777215"):
            spec(extended)


def test_one_address_may_be_a_standard_and_an_extended_one() -> None:
    both = [device("left", 1), device("right", 1, options=Options(firmware="0.5", is_extended=True))]
    assert plugin.driver(both)


# -- faults -------------------------------------------------------------------------------------------


def test_codes_have_one_meaning_whichever_the_line() -> None:
    assert not errors.DEVICE05.keys() & errors.DEVICE06.keys()


def test_endpoints_are_configuration_and_measurements_are_not() -> None:
    endpoints = (
        "axis0.config.enable_watchdog 11 bool",
        "axis0.controller.config.vel_limit 12 float",
        "axis0.trap_traj.config.vel_limit 13 float",
        "axis0.config.can.node_id 14 uint32",
        "axis0.commutation_mapper.config.offset 15 float",
        "vbus_voltage 16 float",
    )
    options = Options(endpoints=endpoints, endpoints_version="0.6.10")
    case = Case(plugin, options, 0, ADDRESSES)
    configuration_is_read_and_written(case)
    protected = {name: each.protected != "" for name, each in case.spec.configuration.items()}
    assert list(protected.values()) == [False, False, False, True, True]
