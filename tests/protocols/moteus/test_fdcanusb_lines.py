"""Lines that moteus 1.1.1 exchanged with an fdcanusb, with checksums: the frames in them are ours."""

from __future__ import annotations

import json
from importlib.resources import files
from math import tau

import pytest

from gateway.buses.adapters.fdcanusb import OK, EmulatedAdapter, decode_received, split_checksum
from protocols.frames import CanFrame
from protocols.messages import Feedback
from protocols.moteus import plugin
from protocols.plugin import Device

LINES = {
    entry["name"]: bytes.fromhex(entry["data"])
    for entry in json.loads((files("gateway.fixtures") / "vectors/fdcanusb.json").read_text("utf-8"))
}


def test_what_the_package_sends_is_a_frame_to_a_device() -> None:
    frames, answer = EmulatedAdapter(1_000_000, 5_000_000).feed(LINES["fdcanusb_line#3"])
    assert [(f.id, f.extended, f.fd, f.brs) for f in frames] == [(0x8005, True, True, True)]
    assert plugin.messages(frames[0]) == ("position 020 021", "read")
    assert split_checksum(answer.rstrip()) == (OK.encode(), True)


def test_what_the_package_takes_is_a_frame_of_a_device() -> None:
    line, right = split_checksum(LINES["fdcanusb_line#2"].rstrip(b"\n"))
    assert right
    frame = decode_received(line.decode())
    assert frame is not None
    driver = plugin.driver([Device("m", 5, plugin.options(), plugin.settings())])
    assert driver.receive(0, frame) == []  # 22 bytes, as the package took them: no CAN FD frame has so many
    whole = CanFrame(frame.id, frame.data + b"\x50" * 2, fd=True, brs=True)  # as a moteus sends it
    (reported,) = (event for event in driver.receive(0, whole) if isinstance(event, Feedback))
    assert reported.position == pytest.approx(-0.125 * tau)
    assert reported.voltage == 24.5
