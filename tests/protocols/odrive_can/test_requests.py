"""Requests, in both firmware lines: every one ends in Done or Refused in bounded virtual time."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Event, Request
from protocols.odrive_can import plugin
from protocols.odrive_can.codec import BROADCAST, encode
from protocols.odrive_can.faults import Error
from protocols.odrive_can.messages import Heartbeat
from protocols.odrive_can.options import Options
from protocols.odrive_can.requests import SAVE
from tests.protocols.helpers import of
from tests.protocols.odrive_can.helpers import V05, device, ready

SERIAL = 0x385F_3473_3301
BOTH: tuple[Request, ...] = (
    msg.ClearFault("left"),
    msg.Estop("left"),
    msg.Scan("can0"),
    msg.Zero("left"),
    msg.ReadParameter("left", "Bus_Voltage"),
    msg.WriteParameter("left", "Pos_Gain", 10.0),
    msg.Reboot("left"),
)
V06 = Options()
CASES = [(options, request) for options in (V05, V06) for request in BOTH]
CASES += [(V06, msg.SetId("can0", SERIAL, 9))]
each_request = pytest.mark.parametrize(
    ("options", "request_"), CASES, ids=lambda x: x.firmware if isinstance(x, Options) else type(x).__name__
)


def answers(events: list[Event]) -> list[msg.Done | msg.Refused]:
    return [event for event in events if isinstance(event, msg.Done | msg.Refused)]


@pytest.mark.parametrize("options", [V05, V06], ids=["0.5", "0.6"])
def test_these_are_the_requests_of_the_spec(options: Options) -> None:
    assert plugin.spec(device(options=options)).requests == {type(r) for o, r in CASES if o == options}


@each_request
def test_every_request_is_carried_out(options: Options, request_: Request) -> None:
    bench = ready(device(options=options))
    (done,) = answers(bench.ask(request_, 3000))
    assert isinstance(done, msg.Done), done
    assert done.request == type(request_).__name__
    assert done.name in ("left", "can0")


@each_request
def test_every_request_ends_although_the_device_is_silent(options: Options, request_: Request) -> None:
    bench = ready(device(options=options))
    bench.from_device = lambda frame: False
    (answer,) = answers(bench.ask(request_, 9000))
    # A scan that finds nothing is carried out all the same.
    assert isinstance(answer, msg.Done if isinstance(request_, msg.Scan) else msg.Refused)
    start = bench.now
    bench.run(1000)
    assert all(frame.remote for t, frame in bench.sent if t >= start)


@each_request
def test_a_lost_frame_is_sent_again(options: Options, request_: Request) -> None:
    bench = ready(device(options=options))
    lost: list[CanFrame] = []

    def lossy(frame: CanFrame) -> bool:
        lost.append(frame)
        return len(lost) > 2

    bench.to_device = lossy
    (done,) = answers(bench.ask(request_, 7000))
    assert isinstance(done, msg.Done)


def test_a_stale_heartbeat_does_not_report_a_cleared_fault_again() -> None:
    bench = ready()
    bench.twin.receive(bench.now, CanFrame(0x22))
    bench.run(150)
    stale = encode(1, Heartbeat(Error.ESTOP_REQUESTED, 1, 3, 0))
    bench.ask(msg.ClearFault("left"))
    assert of(msg.Fault, list(bench.driver.receive(bench.now, stale))) == []
    assert len(of(msg.Done, bench.run(300))) == 1


def test_saving_keeps_what_was_written_through_a_reboot() -> None:
    bench = ready()
    bench.ask(msg.WriteParameter("left", "Pos_Gain", 12.0), 200)
    assert isinstance(answers(bench.ask(msg.WriteParameter("left", SAVE, 1.0), 2000))[0], msg.Done)
    assert bench.twin.servo.gains.pos_gain == 12.0
    bench.ask(msg.WriteParameter("left", "Pos_Gain", 13.0), 200)
    bench.ask(msg.Reboot("left"), 2000)
    assert bench.twin.servo.gains.pos_gain == 12.0


def test_a_scan_finds_all_devices_with_remote_frames_only() -> None:
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


def test_set_id_assigns_a_node_id_by_serial_number() -> None:
    bench = ready(device("left", 1), device("right", 2))
    (done,) = answers(bench.ask(msg.SetId("can0", SERIAL, 9), 1000))
    assert isinstance(done, msg.Done)
    assert [twin.axis.node for twin in bench.twins] == [9, 2]
