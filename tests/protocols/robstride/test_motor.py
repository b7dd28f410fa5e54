"""The limits of a motor's loops, saving, its address; and the CyberGear, which has no watchdog that works."""

from __future__ import annotations

from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Mode
from protocols.plugin import Device
from protocols.robstride import plugin
from protocols.robstride.options import Options, Settings
from tests.protocols.helpers import CanBench, bench_of, of


def bench(settings: Settings | None = None, **options: Any) -> CanBench[Any, Any]:
    return bench_of(plugin, Device("left", 1, Options(**options), settings or Settings()))


# -- CyberGear -------------------------------------------------------------------------------------------


def test_a_cybergear_runs_with_its_default_options_and_is_said_to_have_no_watchdog() -> None:
    rig = bench(model="cybergear")
    rig.run(500, msg.Torque("left", 0.5))
    assert rig.twins[0].mode is Mode.ARMED
    assert not of(msg.Refused, rig.events)
    watchdog = plugin.spec(rig.devices[0]).watchdog
    assert (watchdog.timeout, watchdog.enabled) == (None, False)
    assert watchdog.note == (
        "a cybergear has no watchdog that works: nothing stops it, without a host its last command goes on"
    )
    rig.to_device = lambda frame: False
    rig.run(2000)
    assert rig.twins[0].mode is Mode.ARMED


def test_a_cybergear_takes_no_timeout() -> None:
    twin = plugin.twin(Device("left", 1, Options(model="cybergear"), Settings(timeout_ms=100.0)), 0)
    twin.step(0, [])
    twin.receive(1, CanFrame(0x1200FD01, bytes.fromhex("0c200000d0070000"), extended=True))
    twin.receive(1, CanFrame(0x1100FD01, bytes.fromhex("0c20000000000000"), extended=True))
    _, frames = twin.step(MILLISECOND, [])
    assert [f"{each.id:08X}" for each in frames if isinstance(each, CanFrame)][-1] == "110101FD"  # failed


# -- ids and saving --------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 1, 8])
def test_who_it_is_can_be_asked_with_any_length(size: int) -> None:
    twin = plugin.twin(Device("left", 1, Options(), Settings()), 0)
    twin.step(0, [])
    twin.receive(1, CanFrame(0x0000FD01, bytes(size), extended=True))
    (answer,) = twin.step(MILLISECOND, [])[1]
    assert isinstance(answer, CanFrame)
    assert (answer.id, len(answer.data)) == (0x000001FE, 8)


def test_it_answers_from_its_new_address() -> None:
    device = Device("left", 1, Options(), Settings())
    twin = plugin.twin(device, 0)
    twin.step(0, [])
    frame = CanFrame(0x0705FD01, bytes(8), extended=True)
    assert plugin.decoder([device]).decode(0, frame) == [msg.SetAddress("left", 5)]
    twin.receive(1, frame)
    (answer,) = twin.step(MILLISECOND, [])[1]
    assert isinstance(answer, CanFrame)
    assert answer.id == 0x000005FE


def test_it_is_asked_once_to_save_and_a_status_says_that_it_did() -> None:
    rig = bench()
    rig.run(100)
    assert of(msg.Done, rig.ask(msg.WriteParameter("left", "save_parameters", 1.0), 190))
    assert len([frame for _, frame in rig.sent if plugin.messages(frame) == ("save",)]) == 1


# -- limits of its loops ---------------------------------------------------------------------------------


def torque(settings: Settings, **options: Any) -> float:
    """Return the torque against a stop, at 10 rad/s in mode speed."""
    rig = bench(settings, mode="speed", **options)
    rig.run(100)
    rig.shaft.locked = True
    rig.run(4000, msg.Velocity("left", 10.0))
    return float(rig.twins[0].torque)


def test_its_limits_hold_against_a_stop() -> None:
    assert torque(Settings()) == pytest.approx(17.0)
    assert torque(Settings(limit_cur=0.5)) == pytest.approx(0.5 * 17.0 / 23.0)
    assert torque(Settings(limit_torque=2.0)) == pytest.approx(2.0)
    assert torque(Settings(spd_kp=0.6, spd_ki=0.0)) == pytest.approx(0.3, abs=0.01)


def test_a_limit_of_current_is_of_speed_and_position_alone() -> None:
    rig = bench(Settings(limit_cur=0.5))
    rig.shaft.locked = True
    rig.run(300, msg.Torque("left", 3.0))
    assert rig.twins[0].torque == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize(("acceleration", "least", "most"), [(5.0, 4.0, 5.5), (200.0, 19.0, 20.5)])
def test_its_acceleration_holds(acceleration: float, least: float, most: float) -> None:
    rig = bench(mode="speed", max_acceleration=acceleration)  # as delivered it is 20
    rig.run(100)
    rig.run(1050, msg.Velocity("left", 20.0))
    assert least < rig.shaft.velocity < most


def test_a_planned_position_has_limits_of_its_own() -> None:
    """run_mode 1 (PP), which is not commanded here."""
    rig = bench(Settings(vel_max=2.0, acc_set=4.0, limit_spd=30.0))
    rig.run(50)
    for data in ("0570000001000000", "1670000000004040"):  # loc_ref 3.0
        rig.twins[0].receive(rig.now, CanFrame(0x1200FD01, bytes.fromhex(data), extended=True))
    rig.twins[0].receive(rig.now, CanFrame(0x0300FD01, bytes(8), extended=True))
    fastest, after = 0.0, 0.0
    for at in range(3000):
        rig.twins[0].feed(rig.now)
        rig.run(1)
        fastest, after = max(fastest, rig.shaft.velocity), rig.shaft.velocity if at == 250 else after
    assert rig.shaft.position == pytest.approx(3.0, abs=0.02)
    assert fastest < 2.3
    assert after < 1.3
