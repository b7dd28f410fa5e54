"""The plugin's spec, options and settings, and what it refuses."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest

from protocols import messages as msg
from protocols.cia402 import plugin
from protocols.cia402.faults import FAULTS, register_of
from protocols.cia402.options import Options
from protocols.cia402.settings import Settings
from protocols.conformance import CLAUSES, check
from protocols.frames import CanFrame, Frame, exact
from protocols.plugin import Device
from tests.protocols.cia402.bus import TwinOnShaft

NODE = 5


def device(address: int = NODE, name: str = "m") -> Device:
    """Return a device with default options."""
    return Device(name, address, Options(), Settings())


READ = ("4000100000000000", "6000000000000000", "7000000000000000", "8000100000000405")
"""Uploads and aborts."""
WRITTEN = ("2B40600006000000", "2108100009000000", "0D78000000000000", "C000000000000000", "40")


def test_uploads_and_aborts_of_a_host_alone_are_read_only() -> None:
    read_only, read = plugin.spec(device()).read_only, [CanFrame(0x605, bytes.fromhex(data)) for data in READ]
    assert all(map(read_only, read))
    others: list[Frame] = [CanFrame(0x605, bytes.fromhex(data)) for data in WRITTEN]
    others += [replace(frame, extended=True) for frame in read] + [replace(frame, id=0x585) for frame in read]
    others += [b"bytes", CanFrame(0, b"\1\5"), CanFrame(0x80), CanFrame(0x77F, b"\5")]
    assert not any(map(read_only, others))


def test_the_spec_follows_options_and_settings() -> None:
    usual = plugin.spec(device())
    assert usual.watchdog.enabled
    assert usual.watchdog.timeout == 500_000_000
    assert not usual.watchdog.note
    assert not usual.holds_unattended
    assert {"Position.velocity", "Velocity.torque"} <= set(usual.ranges)
    profile = plugin.spec(Device("m", NODE, Options(modes="profile"), Settings()))
    assert "Position.velocity" not in profile.ranges
    bare = plugin.spec(Device("m", NODE, Options(watchdog_ms=0), Settings(supported_modes=0x100)))
    assert bare.commands == {msg.Idle, msg.Hold, msg.Velocity}
    assert bare.watchdog.timeout is None
    assert "keeps its last set-point" in bare.watchdog.note
    assert bare.holds_unattended


@pytest.mark.parametrize(
    ("devices", "error"),
    [
        ([device(address=0)], "1 to 127"),
        ([device(address=128)], "1 to 127"),
        ([device(address=127)], "host's own"),
        ([device(), device(name="n")], "is that of"),
        ([device(), Device("n", 6, Options(sync_ms=20), Settings())], r"sync_ms .* 10 for m and 20 for n"),
        ([device(), Device("n", 6, Options(host_id=100), Settings())], r"host_id .* 127 for m and 100 for n"),
        ([device(), Device("n", 6, Options(feedback="event", sync_ms=20), Settings())], ""),
        ([device(), Device("n", 6, Options(watchdog_ms=100), Settings())], ""),
        ([device(address=9), Device("n", 6, Options(host_id=9), Settings())], "host"),
    ],
)
def test_what_cannot_be_on_one_bus_is_refused(devices: list[Device], error: str) -> None:
    with pytest.raises(ValueError, match=error) if error else nullcontext():
        plugin.driver(devices)


FOREIGN = (Options(sync_ms=0), Options(feedback="event"), Options(feedback="sdo"))
"""With these the driver produces no SYNC."""


@pytest.mark.parametrize("options", [Options(), *FOREIGN])
def test_a_receive_filter_lets_sync_in_where_it_is_produced(options: Options) -> None:
    receives_also = plugin.spec(Device("m", NODE, options, Settings())).receives_also
    assert (exact(0x80) in receives_also) is (options not in FOREIGN)


def test_the_contract_wants_it_declared() -> None:
    clauses = [clause for clause in CLAUSES if clause.name == "foreign"]
    silent = replace(plugin, spec=lambda device: replace(plugin.spec(device), receives_also=()))
    (result,) = check(silent, clauses=clauses)
    assert result.outcome == "failed"
    assert "SYNC" in result.text


@pytest.mark.parametrize("code", sorted(FAULTS))
def test_every_fault_can_be_provoked(code: int) -> None:
    drive = TwinOnShaft()
    drive.twin.provoke(code)
    emcy = code.to_bytes(2, "little") + bytes((register_of(code),))
    assert [frame.data[:3] for frame in drive.run(2) if frame.id == 0x82] == [emcy]


def test_an_unknown_fault_cannot_be_provoked() -> None:
    with pytest.raises(ValueError, match="4660"):
        TwinOnShaft().twin.provoke(0x1234)


@pytest.mark.parametrize(("position", "velocity"), [(math.nan, 0.0), (0.0, math.inf)])
def test_a_measurement_that_is_not_finite_is_ignored(position: float, velocity: float) -> None:
    drive = TwinOnShaft()
    drive.shaft.position = 1.0
    drive.run(2)
    drive.twin.step(drive.now, [msg.Feedback("m", drive.now, position, velocity)])
    assert drive.answer(bytes.fromhex("4064600000000000")) == bytes.fromhex("43646000300A0000")  # 2608


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        (lambda: Options(host_id=0), "host_id must be from 1"),
        (lambda: Options(sync_ms=-1), "sync_ms must be from 0"),
        (lambda: Options(offline_ms=150), "offline_ms .150. must be at least twice"),
        (lambda: Options(watchdog_ms=3), "watchdog_ms is 3"),
        (lambda: Options(rated_torque=math.nan), "rated_torque"),
        (lambda: Options(counts_per_turn=-1.0), "counts_per_turn"),
        (lambda: Settings(encoder_increments=0), "encoder_increments must be from 1"),
        (lambda: Settings(max_torque=70_000), "max_torque must be from 0 to 65535, not 70000"),
        (lambda: Settings(homing_method=17), "homing_method is 17"),
        (lambda: Settings(quick_stop_option=4), "quick_stop_option is 4"),
        (lambda: Settings(soft_limit_low=1), "soft_limit_low"),
        (lambda: Settings(velocity_gain=-0.1), "velocity_gain"),
        (lambda: Settings(device_name="größer"), "ASCII"),
    ],
)
def test_wrong_options_are_refused(wrong: Any, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        wrong()


def test_all_mistakes_are_reported_at_once() -> None:
    with pytest.raises(ValueError, match=r"feed_shaft.*max_torque.*halt_option"):
        Settings(max_torque=70_000, feed_shaft=0, halt_option=9)
