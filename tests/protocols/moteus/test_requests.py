"""Requests: each ends in Done or Refused, and nothing is sent to a running device that drops or moves it."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.messages import Event, Request
from protocols.moteus.codec import (
    F32,
    INT16,
    REPLY,
    WRITE_ERROR,
    Error,
    Values,
    encode,
    make_frame,
)
from protocols.moteus.messages import DISCOVER
from protocols.moteus.options import Settings, serial_of
from protocols.moteus.registers import Register
from protocols.moteus.twin import MoteusTwin
from tests.protocols.helpers import of
from tests.protocols.moteus.helpers import Bench, device, free_shaft, ready, rev

UUID = "0123456789abcdeffedcba9876543210"


def with_stranger(address: int = 9, settings: Settings | None = None) -> Bench:
    """Two devices on the bus, of which the driver knows one."""
    bench = ready()
    other = device("stranger", address, settings)
    bench.devices = [*bench.devices, other]
    bench.twins.append(MoteusTwin(other, 5))
    bench.shafts.append(free_shaft())
    bench.run(10)
    return bench


# -- scan ------------------------------------------------------------------------------------------


def test_a_scan_finds_known_and_unknown_devices_by_one_query() -> None:
    bench = with_stranger()
    since = bench.now
    reported = bench.ask(msg.Scan("can0"), 1000)
    found = {f.address: f for f in of(msg.Found, reported)}
    assert set(found) == {1, 9}
    assert found[1].detail.startswith("left, model 030404, firmware 1.3.4; UUID ")
    assert found[9].detail.startswith("UUID ")
    assert [found[a].serial for a in (1, 9)] == [serial_of(twin.uuid) for twin in bench.twins]
    assert not any(f.duplicate_address for f in found.values())
    assert of(msg.Done, reported)[0].detail == "2 devices"
    queries = [f for t, f in bench.sent if t >= since and f.id == 0x807F]
    assert {f.data.rstrip(b"\x50") for f in queries} == {DISCOVER}
    assert all(f.data.startswith(DISCOVER) for f in queries)


# -- ids -------------------------------------------------------------------------------------------


def test_an_id_is_given_by_serial_number_and_confirmed_by_the_device() -> None:
    bench = with_stranger()
    serial = serial_of(bench.twins[1].uuid)
    reported = bench.ask(msg.SetId("can0", serial, 12), 300)
    assert [d.request for d in of(msg.Done, reported)] == ["SetId"]
    assert "conf_write" in of(msg.Done, reported)[0].detail
    assert [twin.state.address for twin in bench.twins] == [1, 12]


# -- zero ------------------------------------------------------------------------------------------


def test_zero_is_confirmed_by_the_position() -> None:
    bench = ready()
    bench.shaft.position = rev(2.3)  # replies on their way still hold 0
    reported = bench.ask(msg.Zero("left"), 100)
    assert [d.request for d in of(msg.Done, reported)] == ["Zero"]
    assert bench.twin.servo.position == pytest.approx(0.0, abs=1e-3)
    bench.run(500, msg.Hold("left"))
    assert bench.shaft.position == pytest.approx(rev(2.3), abs=0.01)


# -- parameters ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("voltage", 24.0),
        ("0x00d", 24.0),
        ("temperature", 25.0),
        ("firmware_version", float(0x010304)),
        ("mode", 0.0),
        ("uuid_mask_capable", 1.0),
    ],
)
def test_registers_are_read_by_name_and_number(name: str, value: float) -> None:
    bench = ready()
    reported = bench.ask(msg.ReadParameter("left", name), 50)
    assert [p.value for p in of(msg.Parameter, reported)] == [pytest.approx(value, abs=0.1)]
    assert of(msg.Done, reported) == []  # the parameter is the answer


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (msg.ReadParameter("left", "0x7ff"), "no such register"),
        (msg.ReadParameter("left", "control_position"), "not given"),
        (msg.WriteParameter("left", "voltage", 3.0), "read only"),
        (msg.WriteParameter("left", "0x7ff", 3.0), "no such register"),
    ],
    ids=str,
)
def test_what_the_device_cannot_do_is_refused_with_the_reason(request_: Request, reason: str) -> None:
    bench = ready()
    reported = of(msg.Refused, bench.ask(request_, 100))
    assert len(reported) == 1
    assert reason in reported[0].reason


def test_an_output_is_set_and_the_configuration_saved() -> None:
    bench = ready()
    assert len(of(msg.Done, bench.ask(msg.WriteParameter("left", "set_output_exact", 1.5), 50))) == 1
    assert bench.twin.servo.position == pytest.approx(1.5, abs=1e-3)
    assert len(of(msg.Done, bench.ask(msg.WriteParameter("left", "conf_write", 1.0), 50))) == 1
    assert "console: conf write" in bench.sent_messages()


# Which reply is the one to a write: a frame of its register alone. The others may have been on their way.

ORDINARY = encode(Values(REPLY, Register.MODE, INT16, (0, 0, 0, 0))) + encode(
    Values(REPLY, Register.MOTOR_TEMPERATURE, INT16, (250, 1, 0, 240, 250, 0))
)
"""A reply of the ordinary cycle: home state 0, fault 0."""
GPIO = 0x05C
"""A register that can be written and read (AUX1 GPIO command)."""


def reads(register: int, value: float) -> bytes:
    """The reply of a device to a query for one register."""
    return encode(Values(REPLY, register, F32, (value,)))


def answered(bench: Bench, *data: bytes) -> list[list[Event]]:
    """The events of each frame of the device; the device itself is not queried."""
    node = bench.node
    return [list(bench.driver.receive(bench.now, make_frame(node.reply_id, each))) for each in data]


def writing(name: str, value: float) -> Bench:
    """A write that was sent to a device which does not reply by itself."""
    bench = ready()
    bench.to_device = lambda _: False
    assert of(msg.Refused, bench.ask(msg.WriteParameter("left", name, value))) == []
    return bench


def test_a_reply_that_was_on_its_way_does_not_end_a_write() -> None:
    """It holds the register, and its value is from before; the device then refuses the write."""
    bench = writing("home_state", 2.0)
    reported = answered(bench, ORDINARY, ORDINARY, encode(Error(WRITE_ERROR, Register.HOME_STATE, 2)))
    assert [of(msg.Done, each) + of(msg.Refused, each) for each in reported[:2]] == [[], []]
    assert of(msg.Refused, reported[2])[0].reason == "the device does not accept it (read only)"


def test_a_reply_that_was_on_its_way_does_not_end_a_write_to_the_twin() -> None:
    bench = ready(device(settings=Settings(reply_delay_us=15_000)))
    reported = bench.ask(msg.WriteParameter("left", "position", 0.0), 60)
    assert of(msg.Done, reported) == []
    assert [r.reason for r in of(msg.Refused, reported)] == ["the device does not accept it (read only)"]


def test_a_write_is_done_when_the_device_holds_what_was_written() -> None:
    bench = writing(hex(GPIO), 5.0)
    reported = answered(bench, ORDINARY, reads(GPIO, 4.0), reads(GPIO, 5.0), reads(GPIO, 5.0))
    assert [of(msg.Done, each) for each in reported] == [
        [],
        [],
        [msg.Done(bench.now, "WriteParameter", "left")],
        [],
    ]


def test_a_write_after_which_the_device_holds_something_else_is_refused_with_both_values() -> None:
    bench = writing(hex(GPIO), 5.0)
    assert of(msg.Done, answered(bench, reads(GPIO, 7.0))[0]) == []
    bench.to_device = lambda frame: frame.data[:3] != b"\x0d\x5c\x00"
    reported = bench.run(700)
    assert of(msg.Done, reported) == []
    assert [r.reason for r in of(msg.Refused, reported)] == ["the device holds 7 there, not 5"]


@pytest.mark.parametrize("value", [0.1, 1e-7, -123456.789, 3e38])
def test_what_a_binary32_makes_of_a_number_is_what_was_written(value: float) -> None:
    bench = writing(hex(GPIO), value)
    assert len(of(msg.Done, answered(bench, reads(GPIO, value))[0])) == 1


def test_the_configuration_is_saved_whatever_id_the_device_reports() -> None:
    bench = writing("conf_write", 1.0)
    reported = answered(bench, ORDINARY, reads(Register.MULTIPLEX_ID, 5.0))
    assert [len(of(msg.Done, each)) for each in reported] == [0, 1]


# -- a device that does not answer -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "within"),
    [
        (msg.ClearFault("left"), 600),
        (msg.Zero("left"), 600),
        (msg.ReadParameter("left", "voltage"), 600),
        (msg.WriteParameter("left", "set_output_exact", 0.0), 600),
        (msg.SetId("can0", 5, 6), 1500),
    ],
    ids=str,
)
def test_every_request_ends(request_: Request, within: int) -> None:
    bench = ready()
    bench.to_device = lambda _: False
    reported = of(msg.Refused, bench.ask(request_, within + 10))
    assert [r.request for r in reported] == [type(request_).__name__]
    assert list(bench.driver._queue) == []
