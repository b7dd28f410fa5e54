"""The template of a plugin, where it stands: it keeps the contract, and its codecs say what they claim."""

from __future__ import annotations

import binascii
import math
import struct

import pytest

from gateway.cli import templates
from gateway.cli.templates import codec, framing, framing_serial
from protocols import messages as msg
from protocols.conformance import check, table
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Request
from protocols.plugin import Device, RxCounters


@pytest.mark.parametrize("seed", [3])
def test_it_keeps_every_clause_that_needs_no_knowledge_of_the_device(seed: int) -> None:
    results = check(templates.plugin, seed)
    assert {result.clause for result in results if result.outcome == "failed"} <= {"vectors"}, table(results)


# -- bytes, made here by struct alone ------------------------------------------------------------------

RUN = struct.pack("<Bxxxf", 1, 2.5)
REPORTED = struct.pack("<BBhf", 1, 0, -250, 7.5)


def sealed(body: bytes) -> bytes:
    return body + struct.pack("<H", binascii.crc_hqx(body, 0))


def test_payloads() -> None:
    assert codec.command(codec.Order.RUN, 2.5) == RUN
    assert codec.read_command(RUN) == (codec.Order.RUN, 2.5)
    status = codec.Status(codec.DeviceMode.RUNNING, 0, -2.5, 7.5)
    assert codec.status(status) == REPORTED
    assert codec.read_status(REPORTED) == status
    assert {len(RUN), len(REPORTED)} == {codec.SIZE}


def test_frames() -> None:
    assert framing.message(framing.COMMAND, 5, RUN) == CanFrame(0x105, RUN)
    assert framing.message(framing.STATUS, 5, REPORTED) == CanFrame(0x205, REPORTED)
    assert framing.Reader(framing.STATUS, [5]).read(CanFrame(0x205, REPORTED)) == [(5, REPORTED)]


def test_messages_on_a_stream() -> None:
    assert framing_serial.message(framing_serial.COMMAND, 5, RUN) == sealed(b"\xa5\x01\x05" + RUN)
    message = sealed(b"\xa5\x02\x05" + REPORTED)
    counters = RxCounters()
    reader = framing_serial.Reader(framing_serial.STATUS, [5], counters)
    stream = b"\xa5" + message + b"xy" + message[:-1] + b"\0" + sealed(b"\xa5\x02\x06" + REPORTED) + message
    found = [each for at in range(len(stream)) for each in reader.read(stream[at : at + 1])]
    assert found == [(5, REPORTED), (5, REPORTED)]
    assert (counters.malformed, counters.ignored) == (1, 3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 100.1, -1e30])
def test_what_is_out_of_range_is_no_order(value: float) -> None:
    assert codec.read_command(struct.pack("<Bxxxf", 1, value)) is None


@pytest.mark.parametrize("payload", [(3, 0, 0, 0.0), (0, 1, 0, 0.0), (2, 0, 0, 0.0), (0, 0, 0, math.nan)])
def test_what_no_device_can_have_said_is_no_status(payload: tuple[int, int, int, float]) -> None:
    assert codec.read_status(struct.pack("<BBhf", *payload)) is None


def said(mode: codec.DeviceMode, *rest: float) -> Frame:
    fault, velocity, position = rest
    return framing.message(
        framing.STATUS, 1, codec.status(codec.Status(mode, int(fault), velocity, position))
    )


# -- what the driver tells -----------------------------------------------------------------------------


def reported(*frames: Frame) -> list[object]:
    driver = templates.plugin.driver(
        [Device("m", 1, templates.plugin.options(), templates.plugin.settings())]
    )
    return [
        event for at, frame in enumerate(frames) for event in driver.receive(at * 10 * MILLISECOND, frame)
    ]


def test_a_status_in_words() -> None:
    tripped = said(codec.DeviceMode.FAULT, codec.WATCHDOG, 1.0, 2.0)
    state, fault, feedback = reported(tripped)
    assert state == msg.State("m", 0, Mode.FAULT, "fault")
    assert isinstance(fault, msg.Fault)
    assert (fault.code, fault.name) == (codec.WATCHDOG, "watchdog")
    assert feedback == msg.Feedback("m", 0, 2.0, 1.0)


@pytest.mark.parametrize(("devices", "found"), [(1, 0), (2, 1)])
def test_two_devices_at_one_address_are_noticed_by_how_often_they_speak(devices: int, found: int) -> None:
    frame = said(codec.DeviceMode.READY, 0, 0.0, 0.0)
    driver = templates.plugin.driver(
        [Device("m", 1, templates.plugin.options(), templates.plugin.settings())]
    )
    times = range(0, SECOND + 1, codec.STATUS_PERIOD)
    events = [e for t in times for _ in range(devices) for e in driver.receive(t, frame)]
    twice = [event for event in events if isinstance(event, msg.Found) and event.duplicate_address]
    assert len(twice) == found


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (math.nan, "velocity is nan"),
        (math.inf, "velocity is inf"),
        (100.0001, "velocity 100 lies outside -100 … 100"),
    ],
)
def test_what_must_not_be_said_is_refused_with_a_sentence_and_once(value: float, reason: str) -> None:
    driver = templates.plugin.driver(
        [Device("m", 1, templates.plugin.options(), templates.plugin.settings())]
    )
    (refused,), frames = driver.send(0, [msg.Velocity("m", value)])
    assert getattr(refused, "reason", "") == reason
    assert not frames
    assert driver.send(1, [msg.Velocity("m", value)]) == ([], [])


@pytest.mark.parametrize(
    ("word", "reason"),
    [
        (msg.Velocity("x", 1.0), "no such device here"),
        (msg.Scan("bus"), "no such device here"),
        (msg.Hold("m"), "the device cannot do that"),
        (msg.Zero("m"), "the device cannot do that"),
        (msg.Velocity("m", 1.0, 0.5), "the device has no torque for Velocity"),
    ],
)
def test_what_it_cannot_do_is_refused(word: Command | Request, reason: str) -> None:
    driver = templates.plugin.driver(
        [Device("m", 1, templates.plugin.options(), templates.plugin.settings())]
    )
    (refused,), frames = driver.send(0, [word])
    assert getattr(refused, "reason", "") == reason
    assert not frames
