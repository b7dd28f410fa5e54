"""slcan-disco 0.1.0, a stranger's driver of slcan adapters, at our emulated one over a pty, in a process of
its own: what it sends reaches the bus, and what the bus has reaches it."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys

import pytest

from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.core.robot import BusSettings
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND

pytest.importorskip("slcan_disco", reason="python-can-slcan-disco is not installed")

CLIENT = """
import json, sys
import can
from slcan_disco import slcanDiscoBus

SENT = json.loads(sys.argv[2])
with slcanDiscoBus(sys.argv[1], bitrate=500_000, sleep_after_open=0) as bus:
    version = serial = None
    while version in (None, (None, None)):  # answers to what it sent before come first
        version = bus.get_version(60.0)
    while serial is None:
        serial = bus.get_serial_number(60.0)
    received = []
    for number, extended, remote, data in SENT:
        data = bytes.fromhex(data)
        bus.send(can.Message(0.0, number, extended, remote, dlc=len(data), data=None if remote else data))
        one = bus.recv(60.0)
        received.append([one.arbitration_id, one.is_extended_id, one.is_remote_frame, bytes(one.data).hex()])
print(json.dumps([version, serial, received]))
"""
FRAMES = (
    CanFrame(0x123, bytes(range(8))),
    CanFrame(0x7FF, b"\xff"),
    CanFrame(0x001),
    CanFrame(0x1ABCDEF0, bytes(range(8, 16)), extended=True),
    CanFrame(0x00000001, b"\x01\x02", extended=True),
    CanFrame(0x222, remote=True),
    CanFrame(0x1FFFFFFF, extended=True, remote=True),
)


def answer_to(frame: CanFrame) -> CanFrame:
    """The same frame with the next lower id, or the highest."""
    most = 0x1FFFFFFF if frame.extended else 0x7FF
    return CanFrame((frame.id - 1) % (most + 1), frame.data, frame.extended, frame.remote)


def plain(frame: CanFrame) -> list[object]:
    return [frame.id, frame.extended, frame.remote, frame.data.hex()]


def test_it_opens_the_adapter_and_exchanges_every_kind_of_frame() -> None:
    bus, now, seen = AdapterPty(BusSettings("can0", "can", "twin", 500_000)), 0, list[CanFrame]()
    command = [sys.executable, "-c", CLIENT, *bus.paths, json.dumps([plain(each) for each in FRAMES])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        while client.poll() is None:
            now += MILLISECOND
            frames = [p.frame for p in bus.read(now)[1] if isinstance(p.frame, CanFrame)]
            seen += frames
            bus.write(now, [answer_to(each) for each in frames])
            if not frames:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    client.wait(0.002)
        text, trouble = client.communicate()
    bus.close()
    assert client.returncode == 0, trouble
    assert seen == [*FRAMES]
    assert json.loads(text) == [[10, 1], "TWIN", [plain(answer_to(each)) for each in FRAMES]]
