"""Parameters at the twin; which reply is the one to a write."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.messages import Event
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
from protocols.moteus.registers import Register
from tests.protocols.helpers import of
from tests.protocols.moteus.helpers import Bench, ready


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


@pytest.mark.parametrize(("number", "why"), [(2, "read only"), (1, "error 1: no such register?")])
def test_a_reply_that_was_on_its_way_does_not_end_a_write(number: int, why: str) -> None:
    """It holds the register, and its value is from before; the device then refuses the write."""
    bench = writing("home_state", 2.0)
    reported = answered(bench, ORDINARY, ORDINARY, encode(Error(WRITE_ERROR, Register.HOME_STATE, number)))
    assert [of(msg.Done, each) + of(msg.Refused, each) for each in reported[:2]] == [[], []]
    assert of(msg.Refused, reported[2])[0].reason == f"the device does not accept it ({why})"


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
