"""Requests: each ends in Done or Refused, and nothing is said to a running device that drops or moves it."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.messages import MILLISECOND, Event, Request
from protocols.moteus.codec import (
    F32,
    INT16,
    READ_ERROR,
    REPLY,
    WRITE_ERROR,
    Error,
    Values,
    encode,
    make_frame,
)
from protocols.moteus.messages import DISCOVER
from protocols.moteus.options import Options, Settings, serial_of
from protocols.moteus.registers import Register
from protocols.moteus.reply import decode
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


def test_a_scan_finds_known_and_unknown_devices_by_one_question() -> None:
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
    asked = [f for t, f in bench.sent if t >= since and f.id == 0x807F]
    assert {f.data.rstrip(b"\x50") for f in asked} == {DISCOVER}
    assert all(f.data.startswith(DISCOVER) for f in asked)


def test_a_device_without_a_uuid_is_found_too() -> None:
    bench = with_stranger()
    bench.twins[1].receive = lambda t, frame: None  # type: ignore[method-assign]
    bench.ask(msg.Scan("can0"))
    bench.run(5)
    old = bytes.fromhex("31d0020131d1020131d2020131d3020131d8020150505050")[:24]

    reported = list(bench.driver.receive(bench.now, make_frame(0x900, old)))
    assert [(f.address, f.serial, f.detail) for f in of(msg.Found, reported)] == [
        (9, None, "it has no UUID: older firmware")
    ]


def test_two_devices_with_one_id_are_both_found() -> None:
    bench = with_stranger(1)
    found = of(msg.Found, bench.ask(msg.Scan("can0"), 1000))
    assert len({f.serial for f in found}) == 2
    assert any(f.duplicate_address for f in found)


def test_the_answer_to_another_host_s_question_is_not_found() -> None:
    bench = with_stranger()
    bench.ask(msg.Scan("can0"))
    asked = [
        f
        for _, f in bench.received
        if (reported := decode(f.data)) and Register.MODEL_NUMBER in reported.values
    ]
    assert asked
    assert of(msg.Found, bench.driver.receive(bench.now, make_frame(0x900, asked[0].data))) == []


# -- ids -------------------------------------------------------------------------------------------


def test_an_id_is_given_by_serial_number_and_confirmed_by_the_device() -> None:
    bench = with_stranger()
    serial = serial_of(bench.twins[1].uuid)
    reported = bench.ask(msg.SetId("can0", serial, 12), 300)
    assert [d.request for d in of(msg.Done, reported)] == ["SetId"]
    assert "conf_write" in of(msg.Done, reported)[0].detail
    assert [twin.state.address for twin in bench.twins] == [1, 12]


@pytest.mark.parametrize(
    ("serial", "address", "reason"),
    [(5, 0, "not an id"), (5, 127, "not an id"), (0, 5, "no serial"), (1 << 64, 5, "no serial")],
)
def test_ids_that_cannot_be_are_refused(serial: int, address: int, reason: str) -> None:
    bench = ready()
    assert reason in of(msg.Refused, bench.ask(msg.SetId("can0", serial, address)))[0].reason


def test_an_id_is_not_given_away_nor_taken_from_what_runs() -> None:
    bench = ready(device("left", 1), device("right", 2))
    mine = serial_of(bench.twin.uuid)
    assert "is held by" in of(msg.Refused, bench.ask(msg.SetId("can0", mine, 2)))[0].reason
    bench.run(50, msg.Hold("left"), msg.Idle("right"))
    assert "armed" in of(msg.Refused, bench.ask(msg.SetId("can0", mine, 5)))[0].reason
    reported = bench.ask(msg.SetId("can0", 77, 5), 1600)
    assert "no device with serial number 000000000000004D" in of(msg.Refused, reported)[0].reason


# -- zero ------------------------------------------------------------------------------------------


def test_zero_is_confirmed_by_the_position() -> None:
    bench = ready()
    bench.shaft.position = rev(2.3)  # answers on their way still say 0
    reported = bench.ask(msg.Zero("left"), 100)
    assert [d.request for d in of(msg.Done, reported)] == ["Zero"]
    assert bench.twin.servo.position == pytest.approx(0.0, abs=1e-3)
    bench.run(500, msg.Hold("left"))
    assert bench.shaft.position == pytest.approx(rev(2.3), abs=0.01)


def test_zero_is_refused_while_armed() -> None:
    bench = ready()
    bench.run(50, msg.Hold("left"))
    assert "send Idle first" in of(msg.Refused, bench.ask(msg.Zero("left")))[0].reason


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
        (msg.ReadParameter("left", "no such"), "no register 'no such'"),
        (msg.ReadParameter("left", "0x7ff"), "no such register"),
        (msg.ReadParameter("left", "control_position"), "not given"),
        (msg.WriteParameter("left", "no such", 1.0), "no register"),
        (msg.WriteParameter("left", "mode", 10.0), "commands are for"),
        (msg.WriteParameter("left", "0x020", 1.0), "commands are for"),
        (msg.WriteParameter("left", "command_within_lower_bound", 1.0), "commands are for"),
        (msg.WriteParameter("left", "clock_trim", 1.0), "no register"),
        (msg.WriteParameter("left", "0x071", 1.0), "communication"),
        (msg.WriteParameter("left", "multiplex_id", 3.0), "SetId"),
        (msg.WriteParameter("left", "uuid_mask1", 3.0), "mask"),
        (msg.WriteParameter("left", "voltage", 3.0), "read only"),
        (msg.WriteParameter("left", "0x7ff", 3.0), "no such register"),
        (msg.WriteParameter("left", "set_output_exact", float("nan")), "finite"),
        (msg.WriteParameter("left", "set_output_exact", 1e39), "finite"),
        (msg.WriteParameter("left", "conf_write", 2.0), "takes 1"),
        (msg.Home("left"), "no Home"),
        (msg.Reboot("left"), "no Reboot"),
        (msg.Estop("left"), "no Estop"),
        (msg.Zero("nobody"), "knows no such motor"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused_with_the_reason(request_: Request, reason: str) -> None:
    bench = ready()
    reported = of(msg.Refused, bench.ask(request_, 100))
    assert len(reported) == 1
    assert reason in reported[0].reason


def test_an_output_is_set_and_the_configuration_saved() -> None:
    bench = ready()
    assert len(of(msg.Done, bench.ask(msg.WriteParameter("left", "set_output_exact", 1.5), 50))) == 1
    assert bench.twin.servo.position == pytest.approx(1.5, abs=1e-3)
    assert len(of(msg.Done, bench.ask(msg.WriteParameter("left", "conf_write", 1.0), 50))) == 1
    assert "console: conf write" in bench.said()


# Which answer is the one to a write: a frame of its register alone. The others may have been under way.

ORDINARY = encode(Values(REPLY, Register.MODE, INT16, (0, 0, 0, 0))) + encode(
    Values(REPLY, Register.MOTOR_TEMPERATURE, INT16, (250, 1, 0, 240, 250, 0))
)
"""An answer as the ordinary cycle has them: home state 0, fault 0."""
GPIO = 0x05C
"""A register that can be written and read (AUX1 GPIO command)."""


def reads(register: int, value: float) -> bytes:
    """What a device answers that was asked for one register."""
    return encode(Values(REPLY, register, F32, (value,)))


def answered(bench: Bench, *data: bytes) -> list[list[Event]]:
    """What is told of each of the device's frames; the device itself is not asked."""
    node = bench.node
    return [list(bench.driver.receive(bench.now, make_frame(node.reply_id, each))) for each in data]


def writing(name: str, value: float) -> Bench:
    """A write that was sent to a device which does not answer by itself."""
    bench = ready()
    bench.to_device = lambda _: False
    assert of(msg.Refused, bench.ask(msg.WriteParameter("left", name, value))) == []
    return bench


def test_an_answer_that_was_under_way_does_not_end_a_write() -> None:
    """It holds the register, and its value is from before; the device then refuses the write."""
    bench = writing("home_state", 2.0)
    reported = answered(bench, ORDINARY, ORDINARY, encode(Error(WRITE_ERROR, Register.HOME_STATE, 2)))
    assert [of(msg.Done, each) + of(msg.Refused, each) for each in reported[:2]] == [[], []]
    assert of(msg.Refused, reported[2])[0].reason == "the device does not accept it (read only)"


def test_an_answer_that_was_under_way_does_not_end_a_write_to_the_twin() -> None:
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


def test_a_register_that_cannot_be_read_is_written_when_its_question_is_answered() -> None:
    bench = writing("set_output_exact", 1.5)
    unreadable = encode(Error(READ_ERROR, Register.SET_OUTPUT_EXACT, 1))
    reported = answered(bench, ORDINARY, unreadable)
    assert [len(of(msg.Done, each)) for each in reported] == [0, 1]


def test_the_configuration_is_saved_whatever_id_the_device_tells() -> None:
    bench = writing("conf_write", 1.0)
    reported = answered(bench, ORDINARY, reads(Register.MULTIPLEX_ID, 5.0))
    assert [len(of(msg.Done, each)) for each in reported] == [0, 1]


@pytest.mark.parametrize("name", ["conf_write", "set_output_nearest", "require_reindex"])
def test_what_moves_or_stops_a_running_device_is_not_written(name: str) -> None:
    bench = ready()
    bench.run(50, msg.Hold("left"))
    assert "armed" in of(msg.Refused, bench.ask(msg.WriteParameter("left", name, 1.0)))[0].reason


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


def test_a_zero_that_does_not_become_zero_is_refused() -> None:
    bench = ready()
    bench.shaft.position = rev(3.0)
    bench.run(20)
    bench.to_device = lambda frame: b"\xb1\x02" not in frame.data
    reported = bench.ask(msg.Zero("left"), 700)
    assert "did not become zero" in of(msg.Refused, reported)[0].reason


def test_a_read_that_is_answered_by_other_frames_only_is_refused() -> None:
    bench = ready()
    bench.to_device = lambda frame: frame.data[:1] != b"\x1d"
    reported = bench.ask(msg.ReadParameter("left", "power"), 700)
    assert of(msg.Refused, reported)[0].reason == "no reply to this request"


def test_too_many_requests_are_refused() -> None:
    bench = ready()
    bench.to_device = lambda _: False
    for _ in range(32):
        bench.driver.send(bench.now, [msg.ReadParameter("left", "voltage")])
    reported, _ = bench.driver.send(bench.now, [msg.ReadParameter("left", "voltage")])
    assert "too many" in of(msg.Refused, reported)[0].reason


def test_questions_to_all_go_out_once_for_each_prefix() -> None:
    bench = ready(device("left", 1), device("right", 2, options=Options(can_prefix=3)))
    since = bench.now
    reported = bench.ask(msg.Scan("can0"), 50)
    ids = {f.id for t, f in bench.sent if t >= since and f.id & 0x7F == 0x7F}
    assert ids == {0x807F, 0x3807F}
    assert {f.address for f in of(msg.Found, reported)} == {1, 2}
    assert bench.now - since == 50 * MILLISECOND
