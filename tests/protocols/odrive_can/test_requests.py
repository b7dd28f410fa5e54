"""Requests: every one ends in Done or Refused in bounded virtual time, and says why."""

from __future__ import annotations

import math

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import SECOND, Event, Request
from protocols.odrive_can.codec import BROADCAST, WRITABLE, encode, radians
from protocols.odrive_can.dialect import READABLE06
from protocols.odrive_can.faults import Error
from protocols.odrive_can.messages import (
    Address,
    ClearErrors,
    EnterDfuMode,
    GetTemperature,
    Heartbeat,
    Message,
    Reboot,
    SetAbsolutePosition,
    SetLimits,
    SetPosGain,
    SetVelGains,
)
from protocols.odrive_can.options import Settings
from protocols.odrive_can.requests import SAVE
from tests.protocols.helpers import of
from tests.protocols.odrive_can.helpers import device, ready

SERIAL = 0x385F_3473_3301
ALL: tuple[Request, ...] = (
    msg.ClearFault("left"),
    msg.Estop("left"),
    msg.Scan("can0"),
    msg.SetId("can0", SERIAL, 9),
    msg.Zero("left"),
    msg.ReadParameter("left", "Bus_Voltage"),
    msg.WriteParameter("left", "Pos_Gain", 10.0),
    msg.Reboot("left"),
)


def ends(events: list[Event]) -> list[msg.Done | msg.Refused]:
    return [event for event in events if isinstance(event, msg.Done | msg.Refused)]


@pytest.mark.parametrize("request_", ALL, ids=lambda r: type(r).__name__)
def test_every_request_is_carried_out(request_: Request) -> None:
    bench = ready()
    events = bench.ask(request_, 3000)
    (end,) = ends(events)
    assert isinstance(end, msg.Done)
    assert end.request == type(request_).__name__
    assert end.name in ("left", "can0")


@pytest.mark.parametrize("request_", ALL, ids=lambda r: type(r).__name__)
def test_every_request_ends_although_the_device_is_silent(request_: Request) -> None:
    bench = ready()
    bench.from_device = lambda frame: False
    events = bench.ask(request_, 9000)
    (end,) = ends(events)
    # A scan that finds nothing is carried out all the same.
    assert isinstance(end, msg.Done if isinstance(request_, msg.Scan) else msg.Refused)
    start = bench.now
    bench.run(1000)
    assert all(frame.remote for t, frame in bench.sent if t >= start)


def test_a_lost_frame_is_said_again() -> None:
    for request_ in ALL:
        bench = ready()
        lost: list[CanFrame] = []

        def lossy(frame: CanFrame, lost: list[CanFrame] = lost) -> bool:
            lost.append(frame)
            return len(lost) > 2

        bench.to_device = lossy
        (end,) = ends(bench.ask(request_, 7000))
        assert isinstance(end, msg.Done), request_


def test_what_the_device_or_its_language_cannot_do_is_refused_at_once() -> None:
    bench = ready()
    for request_ in (msg.Home("left"), msg.Set("brain.x", 1.0), msg.ClearFault("nobody"), msg.Zero("nobody")):
        (end,) = ends(bench.ask(request_))
        assert isinstance(end, msg.Refused)
        assert end.reason
    assert bench.said() == []


def test_clearing_what_does_not_go_away_is_refused_and_told_again() -> None:
    bench = ready(device(settings=Settings(bus_voltage=9.0)))
    assert [fault.name for fault in of(msg.Fault, bench.events)] == ["DC_BUS_UNDER_VOLTAGE"]
    events = bench.ask(msg.ClearFault("left"), 900)
    (end,) = ends(events)
    assert isinstance(end, msg.Refused)
    assert "DC_BUS_UNDER_VOLTAGE" in end.reason
    assert [fault.name for fault in of(msg.Fault, events)] == ["DC_BUS_UNDER_VOLTAGE"]


def test_a_stale_heartbeat_does_not_tell_a_cleared_fault_again() -> None:
    bench = ready()
    bench.twin.receive(bench.now, CanFrame(0x22))
    bench.run(150)
    stale = encode(1, Heartbeat(Error.ESTOP_REQUESTED, 1, 3, 0))
    bench.ask(msg.ClearFault("left"))
    assert of(msg.Fault, list(bench.driver.receive(bench.now, stale))) == []
    assert len(of(msg.Done, bench.run(300))) == 1


def test_estop_disarms_and_stays_until_cleared() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 50.0))
    events = bench.ask(msg.Estop("left"), 150)
    assert len(of(msg.Done, events)) == 1
    assert [fault.name for fault in of(msg.Fault, events)] == ["ESTOP_REQUESTED"]
    assert not bench.twin.axis.armed
    bench.run(300, msg.Velocity("left", 50.0))
    assert not bench.twin.axis.armed


def test_zero_calls_the_present_position_zero_but_not_while_armed() -> None:
    bench = ready()
    bench.shaft.position = radians(7.25)
    bench.run(50)
    assert len(of(msg.Done, bench.ask(msg.Zero("left"), 100))) == 1
    assert bench.driver.axes[1].position == pytest.approx(0.0, abs=1e-4)
    bench.run(400, msg.Velocity("left", 20.0))
    (end,) = ends(bench.ask(msg.Zero("left")))
    assert isinstance(end, msg.Refused)
    assert SetAbsolutePosition(0.0) not in bench.said()[-3:]


def test_reboot_and_save_are_refused_while_armed() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 20.0))
    for request_ in (msg.Reboot("left"), msg.WriteParameter("left", SAVE, 1.0)):
        (end,) = ends(bench.ask(request_))
        assert isinstance(end, msg.Refused)
        assert "armed" in end.reason
    assert Reboot(0) not in bench.said()


def test_a_device_that_does_not_come_back_from_a_reboot() -> None:
    bench = ready()
    bench.twin.receive(bench.now, encode(1, EnterDfuMode()))
    (end,) = ends(bench.ask(msg.Reboot("left"), 9000))
    assert isinstance(end, msg.Refused)


# -- parameters ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("parameter", list(READABLE06))
def test_every_readable_parameter_is_read(parameter: str) -> None:
    bench = ready()
    events = bench.ask(msg.ReadParameter("left", parameter), 100)
    (reported,) = of(msg.Parameter, events)
    assert reported.parameter == parameter
    assert math.isfinite(reported.value)
    assert isinstance(ends(events)[0], msg.Done)
    expected = {"Fw_Version_Minor": 6, "Bus_Voltage": 24.0, "Axis_State": 1, "FET_Temperature": 25.0}
    if parameter in expected:
        assert reported.value == pytest.approx(expected[parameter], rel=1e-3)


def test_a_sensor_that_is_not_fitted_is_refused() -> None:
    bench = ready()
    bench.ask(msg.ReadParameter("left", "Motor_Temperature"))
    reply = encode(1, GetTemperature(40.0, None))
    (end,) = ends(list(bench.driver.receive(bench.now, reply)))
    assert isinstance(end, msg.Refused)


def test_unknown_parameters_are_refused_with_what_there_is() -> None:
    bench = ready()
    read, written = (
        ends(bench.ask(request_))[0]
        for request_ in (msg.ReadParameter("left", "warp"), msg.WriteParameter("left", "warp", 1.0))
    )
    assert isinstance(read, msg.Refused)
    assert isinstance(written, msg.Refused)
    assert "Bus_Voltage" in read.reason
    assert "Vel_Integrator_Gain" in written.reason


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
def test_a_parameter_takes_no_nonsense(value: float) -> None:
    bench = ready()
    (end,) = ends(bench.ask(msg.WriteParameter("left", "Pos_Gain", value), 300))
    assert isinstance(end, msg.Refused)
    assert bench.said() == []


def test_single_parameters_are_sent_and_pairs_wait_for_their_partner() -> None:
    bench = ready()
    assert isinstance(ends(bench.ask(msg.WriteParameter("left", "Pos_Gain", 12.0), 200))[0], msg.Done)
    assert bench.said()[-1] == SetPosGain(12.0)
    assert bench.twin.servo.gains.pos_gain == 12.0
    for message, pair in WRITABLE.items():
        if len(pair) < 2:
            continue
        before = len(bench.said())
        first = ends(bench.ask(msg.WriteParameter("left", pair[0], 5.0), 200))[0]
        assert isinstance(first, msg.Refused)
        assert pair[1] in first.reason
        assert len(bench.said()) == before
        second = ends(bench.ask(msg.WriteParameter("left", pair[1], 7.0), 200))[0]
        assert isinstance(second, msg.Done)
        assert bench.said()[-1] == message(5.0, 7.0)
        assert isinstance(ends(bench.ask(msg.WriteParameter("left", pair[0], 6.0), 200))[0], msg.Done)
        assert bench.said()[-1] == message(6.0, 7.0)
    assert SetLimits(6.0, 7.0) in bench.said()
    assert SetVelGains(6.0, 7.0) in bench.said()
    assert bench.twin.servo.gains.current_soft_max == 7.0


def test_saving_keeps_what_was_written_through_a_reboot() -> None:
    bench = ready()
    bench.ask(msg.WriteParameter("left", "Pos_Gain", 12.0), 200)
    assert isinstance(ends(bench.ask(msg.WriteParameter("left", SAVE, 1.0), 2000))[0], msg.Done)
    assert bench.twin.servo.gains.pos_gain == 12.0
    bench.ask(msg.WriteParameter("left", "Pos_Gain", 13.0), 200)
    bench.ask(msg.Reboot("left"), 2000)
    assert bench.twin.servo.gains.pos_gain == 12.0


# -- who is on the bus -----------------------------------------------------------------------------------


def test_a_scan_finds_all_with_remote_frames_only() -> None:
    bench = ready(device("left", 1), device("right", 2), device("new", BROADCAST - 1))
    bench.twins[2].axis.node = BROADCAST
    del bench.driver.axes[BROADCAST - 1]
    start = bench.now
    events = bench.ask(msg.Scan("can0"), 2500)
    found = {(f.address, f.serial) for f in of(msg.Found, events)}
    base = 0x385F_3473_3300
    assert found == {(1, base + 1), (2, base + 2), (BROADCAST, base + BROADCAST - 1)}
    assert [(d.request, d.name, d.detail) for d in of(msg.Done, events)] == [("Scan", "can0", "3 devices")]
    assert all(frame.remote for t, frame in bench.sent if t >= start)
    assert not any(twin.axis.armed for twin in bench.twins)
    assert "firmware 0.6.10" in next(f.detail for f in of(msg.Found, events) if f.address == 1)


def test_a_scan_names_devices_that_only_send_heartbeats() -> None:
    bench = ready()
    bench.ask(msg.Scan("can0"))
    for turn in range(3):
        beat = CanFrame(12 << 5 | 1, bytes.fromhex("0000000001000000"))
        bench.driver.receive(bench.now + turn, beat)
    events = bench.run(2500)
    mute = [f for f in of(msg.Found, events) if f.serial is None]
    assert [(f.address, "did not answer discovery" in f.detail) for f in mute] == [(12, True)]


def test_set_id_gives_a_node_id_by_serial_number() -> None:
    bench = ready(device("left", 1), device("right", 2))
    events = bench.ask(msg.SetId("can0", SERIAL, 9), 1000)
    (end,) = ends(events)
    assert isinstance(end, msg.Done)
    assert [twin.axis.node for twin in bench.twins] == [9, 2]


@pytest.mark.parametrize(
    ("serial", "address", "reason"),
    [
        (SERIAL, 63, "not a node id"),
        (SERIAL, -1, "not a node id"),
        (0, 5, "not a serial number"),
        (1 << 48, 5, "not a serial number"),
        (SERIAL, 2, "is held by"),
    ],
)
def test_set_id_is_refused(serial: int, address: int, reason: str) -> None:
    bench = ready(device("left", 1), device("right", 2))
    (end,) = ends(bench.ask(msg.SetId("can0", serial, address)))
    assert isinstance(end, msg.Refused)
    assert reason in end.reason


def test_set_id_of_an_armed_device_is_refused() -> None:
    bench = ready()
    bench.run(400, msg.Velocity("left", 10.0))
    (end,) = ends(bench.ask(msg.SetId("can0", SERIAL, 9)))
    assert isinstance(end, msg.Refused)
    assert "armed" in end.reason


def test_too_many_requests_are_refused() -> None:
    bench = ready()
    bench.to_device = lambda frame: False
    events = [event for _ in range(40) for event in bench.ask(msg.ClearFault("left"))]
    assert len(of(msg.Refused, events)) == 8
    bench.run(1000, msg.Idle("left"))
    assert bench.now < 2 * SECOND


def test_a_request_does_not_clear_anything_but_clear_fault() -> None:
    for request_ in ALL[1:]:
        bench = ready()
        bench.ask(request_, 2000)
        clears: list[Message] = [m for m in bench.said() if isinstance(m, ClearErrors)]
        assert clears == []


def test_an_address_of_an_assignment_by_another_host_is_not_believed() -> None:
    bench = ready()
    assert bench.driver.receive(bench.now, encode(BROADCAST, Address(1, 0xABC))) == []
    assert 0xABC not in bench.driver._serials.get(1, {})
