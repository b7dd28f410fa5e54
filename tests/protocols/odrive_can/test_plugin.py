"""The contract of the plugin: entry point, spec, ids, read-only frames, options and settings."""

from __future__ import annotations

import math
from typing import Any

import pytest

from protocols.odrive_can import WATCHDOG_NOTE, plugin, spec
from protocols.odrive_can.codec import BROADCAST, encode
from protocols.odrive_can.messages import SetAxisState, SetInputPos
from protocols.odrive_can.options import Options, Settings
from protocols.plugin import Device, load
from protocols.wire import CanFrame
from protocols.words import (
    Hold,
    Idle,
    Impedance,
    Position,
    ReadParameter,
    Reboot,
    Scan,
    SetId,
    Torque,
    Velocity,
    WriteParameter,
    Zero,
)
from tests.protocols.odrive_can.helpers import device, ready


def test_the_entry_point_loads_it() -> None:
    assert load("odrive_can") is plugin


def test_nothing_is_sent_outside_the_declared_ids_and_nothing_else_is_expected() -> None:
    bench = ready(device("left", 1), device("right", 2))
    for word in (
        Velocity("left", 5.0),
        Position("left", 0.0),
        Torque("left", 0.0),
        Hold("left"),
        Idle("left"),
    ):
        bench.run(400, word)
    asks = (Scan("can0"), SetId("can0", 5, 9), Zero("left"), ReadParameter("left", "Electrical_Power"))
    for request in (*asks, WriteParameter("left", "Pos_Gain", 20.0), Reboot("left")):
        bench.ask(request, 2000)
    sends = spec(bench.devices[0]).sends | spec(bench.devices[1]).sends
    expects = spec(bench.devices[0]).expects | spec(bench.devices[1]).expects
    assert {frame.id for _, frame in bench.sent} <= sends
    assert {frame.id for _, frame in bench.heard} <= expects
    assert not spec(bench.devices[0]).sends & spec(bench.devices[1]).sends - {0x7E6}


def test_read_only_is_a_remote_frame_for_what_devices_tell() -> None:
    read_only = spec(device(options=Options(firmware="0.6"))).read_only
    assert read_only(CanFrame(0x29, remote=True))
    assert read_only(CanFrame(0x7E6, remote=True))
    assert not read_only(CanFrame(0x27, remote=True))
    assert not read_only(CanFrame(0x29))
    assert not read_only(CanFrame(0x29, remote=True, extended=True))
    assert not read_only(encode(1, SetAxisState(1)))
    assert not read_only(b"\x29")


def test_the_watchdog_is_told_until_it_is_acknowledged_or_enabled() -> None:
    assert spec(device()).watchdog.note == WATCHDOG_NOTE
    assert not spec(device()).watchdog.enabled
    assert spec(device(options=Options(watchdog="acknowledged"))).watchdog.note == ""
    on = spec(device(settings=Settings(enable_watchdog=True, watchdog_timeout=0.5)))
    assert (on.watchdog.enabled, on.watchdog.timeout, on.watchdog.note) == (True, 500_000_000, "")
    assert spec(device()).holds_unattended
    assert not on.holds_unattended


def test_what_it_can_do() -> None:
    contract = spec(device())
    assert contract.commands == {Idle, Hold, Position, Velocity, Torque}
    assert Impedance not in contract.commands
    assert contract.bus == "can"
    assert contract.kind == "motor"
    assert not contract.stop_clears_faults


@pytest.mark.parametrize("address", [-1, BROADCAST, 64])
def test_an_address_that_is_no_node_id_is_refused(address: int) -> None:
    with pytest.raises(ValueError, match="node id"):
        spec(device(address=address))


def test_two_devices_with_one_address_are_refused() -> None:
    with pytest.raises(ValueError, match="twice"):
        plugin.driver([device("left", 1), device("right", 1)])


def test_options_of_another_plugin_are_refused() -> None:
    with pytest.raises(TypeError):
        spec(Device("left", 1, object(), Settings()))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"feedback_ms": 0}, "feedback_ms is 0"),
        ({"poll_ms": -1}, "poll_ms is -1"),
        ({"offline_ms": 10_001}, "offline_ms"),
        ({"arm_retry_ms": 1}, "arm_retry_ms"),
        ({"feedback_ms": 200, "offline_ms": 300}, "at least twice"),
    ],
)
def test_options_are_checked(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Options(**wrong)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"vel_gain": math.nan}, "vel_gain must be finite"),
        ({"torque_constant": 0.0}, "torque_constant must be above 0"),
        ({"encoder_cpr": 0}, "encoder_cpr must be above 0"),
        ({"pos_gain": -1.0}, "pos_gain must not be negative"),
        ({"iq_msg_rate_ms": -5}, "iq_msg_rate_ms must not be negative"),
        ({"serial_number": 1 << 48}, "48 bits"),
        ({"enable_watchdog": True}, "watchdog_timeout must be above 0"),
        ({"vel_limit": 0.0, "bus_voltage": -1.0}, "vel_limit must be above 0; bus_voltage must be above 0"),
    ],
)
def test_settings_are_checked_all_at_once(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Settings(**wrong)


@pytest.mark.parametrize("quantity", ["position", "velocity", "torque"])
def test_words_survive_the_wire_within_the_declared_resolution(quantity: str) -> None:
    ranges = spec(device()).ranges
    bench = ready()
    bench.run(400, Position("left", 0.0))
    allowed = ranges[f"Position.{quantity}"]
    for share in (-1.0, -0.999999, -0.5, -1e-3, -1e-9, 0.0, 1e-9, 1e-3, 0.123456789, 0.5, 0.999999, 1.0):
        value = allowed.high * share
        bench.ask(WriteParameter("nobody", "", 0.0))  # a send outside the tick changes nothing
        _, wires = bench.driver.send(bench.now, [Position("left", **{"position": 0.0, quantity: value})])
        frames = [w for w in wires if isinstance(w, CanFrame) and w.id == 0x2C]
        ears = plugin.ear([device()])
        for message in (encode(1, SetInputPos(0.0, 0.0, 0.0)), encode(1, SetAxisState(8))):
            ears.hear(0, message)
        ears.hear(0, CanFrame(0x2B, bytes.fromhex("0300000001000000")))
        (heard,) = ears.hear(0, frames[-1])
        assert isinstance(heard, Position)
        error = abs(getattr(heard, quantity) - value)
        assert error <= allowed.resolution + allowed.relative * abs(value), value
