"""The template of a plugin, in its place: its messages match independent bytes, its driver its README."""

from __future__ import annotations

import binascii
import math
import struct

import pytest

from gateway.cli import templates
from gateway.cli.templates import line, line_serial
from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Mode
from protocols.plugin import Device, Driver
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.table import Decoded

# Bytes, made here by struct alone.
RUN = struct.pack("<Bxhxxxx", 1, 250)
STATUS = struct.pack("<BBhf", 1, 0, -250, 7.5)
VALUES = {"mode": 1, "fault": 0, "velocity": -2.5, "position": 7.5}


def sealed(body: bytes) -> bytes:
    return body + struct.pack("<H", binascii.crc_hqx(body, 0))


def test_frames() -> None:
    assert line.encode("run", 5, velocity=2.5) == CanFrame(0x105, RUN)
    assert line.encode("status", 5, **VALUES) == CanFrame(0x205, STATUS)
    assert line.Line().read(CanFrame(0x205, STATUS), "from_device") == [Decoded("status", 5, VALUES)]
    assert line.Line().read(CanFrame(0x205, STATUS, fd=True), "from_device") == [Rx.IGNORED]


def test_messages_on_a_stream() -> None:
    assert line_serial.encode("run", 5, velocity=2.5) == sealed(b"\xa5\x01\x05" + RUN)
    message = sealed(b"\xa5\x02\x05" + STATUS)
    stream = b"xy" + message[:-1] + b"\0" + message
    reader = line_serial.Line()
    found = [each for at in range(len(stream)) for each in reader.read(stream[at : at + 1], "from_device")]
    assert found == [Rx.IGNORED, Rx.MALFORMED, Decoded("status", 5, VALUES)]


def make_driver() -> Driver:
    return templates.plugin.driver([Device("m", 1, templates.plugin.options(), templates.plugin.settings())])


def test_the_events_of_a_status() -> None:
    frame = line.encode("status", 1, mode=2, fault=1, velocity=1.0, position=2.0)
    events = {type(event): event for event in make_driver().receive(0, frame)}
    assert events[msg.State] == msg.State("m", 0, Mode.FAULT, "fault")
    assert events[msg.Feedback] == msg.Feedback("m", 0, 2.0, 1.0)
    assert getattr(events[msg.Fault], "name", "") == "watchdog"


@pytest.mark.parametrize("status", [(3, 0, 0, 0.0), (2, 9, 0, 0.0), (0, 0, 0, math.nan)])
def test_a_status_that_no_device_sends_is_malformed(status: tuple[int, int, int, float]) -> None:
    driver = make_driver()
    assert driver.receive(0, CanFrame(0x201, struct.pack("<BBhf", *status))) == []
    assert driver.counters.malformed == 1
