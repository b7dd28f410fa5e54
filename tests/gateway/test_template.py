"""The template of a plugin, where it stands: it keeps the contract, and its codecs say what they claim."""

from __future__ import annotations

import binascii
import math
import struct

import pytest

from gateway import template
from gateway.template import codec, codec_serial
from protocols.conformance import check, table
from protocols.plugin import Device, Tally
from protocols.wire import CanFrame, Wire
from protocols.words import MILLISECOND, SECOND, Fault, Feedback, Found, Mode, State, Velocity


@pytest.mark.parametrize("seed", [3])
def test_it_keeps_every_clause_that_needs_no_knowledge_of_the_device(seed: int) -> None:
    results = check(template.plugin, seed)
    assert {result.clause for result in results if result.outcome == "failed"} <= {"vectors"}, table(results)


# -- bytes, made here by struct alone ------------------------------------------------------------------

RUN = struct.pack("<Bxxxf", 1, 2.5)
TOLD = struct.pack("<BBhf", 1, 0, -250, 7.5)


def sealed(body: bytes) -> bytes:
    return body + struct.pack("<H", binascii.crc_hqx(body, 0))


def test_frames() -> None:
    assert codec.command(5, codec.Order.RUN, 2.5) == CanFrame(0x105, RUN)
    status = codec.Status(codec.DeviceMode.RUNNING, 0, -2.5, 7.5)
    assert codec.status(5, status) == CanFrame(0x205, TOLD)
    assert codec.Reader(codec.STATUS, [5]).read(CanFrame(0x205, TOLD)) == [(5, TOLD)]
    assert codec.read_status(TOLD) == status


def test_messages_on_a_stream() -> None:
    assert codec_serial.command(5, codec_serial.Order.RUN, 2.5) == sealed(b"\xa5\x01\x05" + RUN)
    message = sealed(b"\xa5\x02\x05" + TOLD)
    tally = Tally()
    reader = codec_serial.Reader(codec_serial.STATUS, [5], tally)
    stream = b"\xa5" + message + b"xy" + message[:-1] + b"\0" + sealed(b"\xa5\x02\x06" + TOLD) + message
    found = [each for at in range(len(stream)) for each in reader.read(stream[at : at + 1])]
    assert found == [(5, TOLD), (5, TOLD)]
    assert (tally.bad, tally.foreign) == (1, 3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 100.1, -1e30])
def test_what_is_out_of_range_is_no_order(value: float) -> None:
    assert codec.read_command(struct.pack("<Bxxxf", 1, value)) is None


@pytest.mark.parametrize("payload", [(3, 0, 0, 0.0), (0, 1, 0, 0.0), (2, 0, 0, 0.0), (0, 0, 0, math.nan)])
def test_what_no_device_can_have_said_is_no_status(payload: tuple[int, int, int, float]) -> None:
    assert codec.read_status(struct.pack("<BBhf", *payload)) is None


# -- what the driver tells -----------------------------------------------------------------------------


def told(*wires: Wire) -> list[object]:
    driver = template.plugin.driver([Device("m", 1, template.plugin.options(), template.plugin.settings())])
    return [event for at, wire in enumerate(wires) for event in driver.receive(at * 10 * MILLISECOND, wire)]


def test_a_status_in_words() -> None:
    tripped = codec.status(1, codec.Status(codec.DeviceMode.FAULT, codec.WATCHDOG, 1.0, 2.0))
    state, fault, feedback = told(tripped)
    assert state == State("m", 0, Mode.FAULT, "fault")
    assert isinstance(fault, Fault)
    assert (fault.code, fault.name) == (codec.WATCHDOG, "watchdog")
    assert feedback == Feedback("m", 0, 2.0, 1.0)


@pytest.mark.parametrize(("devices", "found"), [(1, 0), (2, 1)])
def test_two_devices_at_one_address_are_noticed_by_how_often_they_speak(devices: int, found: int) -> None:
    wire = codec.status(1, codec.Status(codec.DeviceMode.READY, 0, 0.0, 0.0))
    driver = template.plugin.driver([Device("m", 1, template.plugin.options(), template.plugin.settings())])
    times = range(0, SECOND + 1, codec.STATUS_PERIOD)
    events = [e for t in times for _ in range(devices) for e in driver.receive(t, wire)]
    twice = [event for event in events if isinstance(event, Found) and event.twice]
    assert len(twice) == found


@pytest.mark.parametrize("value", [math.nan, math.inf, 100.0001])
def test_what_must_not_be_said_is_refused_with_a_sentence(value: float) -> None:
    driver = template.plugin.driver([Device("m", 1, template.plugin.options(), template.plugin.settings())])
    (refused,), wires = driver.send(0, [Velocity("m", value)])
    assert "is not in ±100" in getattr(refused, "reason", "")
    assert not wires
