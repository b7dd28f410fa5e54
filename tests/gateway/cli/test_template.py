"""The template of a plugin, in its place: its codecs match independent bytes, its driver its README."""

from __future__ import annotations

import binascii
import math
import struct

import pytest

from gateway.cli import templates
from gateway.cli.templates import codec, framing, framing_serial
from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Command, Mode, Request
from protocols.plugin import Device, Driver, RxCounters

# -- bytes, made here by struct alone ------------------------------------------------------------------

RUN = struct.pack("<Bxxxf", 1, 2.5)
STATUS = struct.pack("<BBhf", 1, 0, -250, 7.5)


def sealed(body: bytes) -> bytes:
    return body + struct.pack("<H", binascii.crc_hqx(body, 0))


def test_payloads() -> None:
    assert codec.encode_command(codec.Order.RUN, 2.5) == RUN
    assert codec.decode_command(RUN) == (codec.Order.RUN, 2.5)
    status = codec.Status(codec.DeviceMode.RUNNING, 0, -2.5, 7.5)
    assert codec.encode_status(status) == STATUS
    assert codec.decode_status(STATUS) == status
    assert {len(RUN), len(STATUS)} == {codec.SIZE}


def test_frames() -> None:
    assert framing.make_frame(framing.COMMAND, 5, RUN) == CanFrame(0x105, RUN)
    assert framing.make_frame(framing.STATUS, 5, STATUS) == CanFrame(0x205, STATUS)
    assert framing.Reader(framing.STATUS, [5]).read(CanFrame(0x205, STATUS)) == [(5, STATUS)]


def test_messages_on_a_stream() -> None:
    assert framing_serial.make_frame(framing_serial.COMMAND, 5, RUN) == sealed(b"\xa5\x01\x05" + RUN)
    message = sealed(b"\xa5\x02\x05" + STATUS)
    counters = RxCounters()
    reader = framing_serial.Reader(framing_serial.STATUS, [5], counters)
    stream = b"\xa5" + message + b"xy" + message[:-1] + b"\0" + sealed(b"\xa5\x02\x06" + STATUS) + message
    found = [each for at in range(len(stream)) for each in reader.read(stream[at : at + 1])]
    assert found == [(5, STATUS), (5, STATUS)]
    assert (counters.malformed, counters.ignored) == (1, 3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 100.1, -1e30])
def test_a_command_out_of_range_is_malformed(value: float) -> None:
    assert codec.decode_command(struct.pack("<Bxxxf", 1, value)) is None


@pytest.mark.parametrize("payload", [(3, 0, 0, 0.0), (0, 1, 0, 0.0), (2, 0, 0, 0.0), (0, 0, 0, math.nan)])
def test_a_status_that_no_device_sends_is_malformed(payload: tuple[int, int, int, float]) -> None:
    assert codec.decode_status(struct.pack("<BBhf", *payload)) is None


# -- what the driver reports --------------------------------------------------------------------------


def make_driver() -> Driver:
    return templates.plugin.driver([Device("m", 1, templates.plugin.options(), templates.plugin.settings())])


def test_the_events_of_a_status() -> None:
    status = codec.Status(codec.DeviceMode.FAULT, codec.WATCHDOG, 1.0, 2.0)
    frame = framing.make_frame(framing.STATUS, 1, codec.encode_status(status))
    state, fault, feedback = make_driver().receive(0, frame)
    assert state == msg.State("m", 0, Mode.FAULT, "fault")
    assert isinstance(fault, msg.Fault)
    assert (fault.code, fault.name) == (codec.WATCHDOG, "watchdog")
    assert feedback == msg.Feedback("m", 0, 2.0, 1.0)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (msg.Velocity("m", math.nan), "velocity is nan"),
        (msg.Velocity("m", math.inf), "velocity is inf"),
        (msg.Velocity("m", 100.0001), "velocity 100 lies outside -100 … 100"),
        (msg.Velocity("m", 1.0, 0.5), "the device has no torque for Velocity"),
        (msg.Velocity("x", 1.0), "no such device here"),
        (msg.Scan("bus"), "no such device here"),
        (msg.Hold("m"), "the device cannot do that"),
        (msg.Zero("m"), "the device cannot do that"),
    ],
)
def test_what_it_cannot_do_is_refused_and_a_command_once(message: Command | Request, reason: str) -> None:
    driver = make_driver()
    (refused,), frames = driver.send(0, [message])
    assert getattr(refused, "reason", "") == reason
    assert not frames
    if isinstance(message, Command):
        assert driver.send(1, [message]) == ([], [])
