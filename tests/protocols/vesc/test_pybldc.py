"""pybldc 1.1.0, which flashes real VESCs over CAN, on our twin: through python-can's slcan on a pty, in a
process of its own (it is GPL)."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys

from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.core.robot import BusSettings
from protocols.messages import MILLISECOND, Mode, Velocity
from protocols.plugin import Device
from protocols.vesc import plugin
from protocols.vesc.options import Options, Settings
from protocols.vesc.twin import VescTwin

CLIENT = """
import functools, json, logging, sys
import can
from pybldc import PyBldcCan

def asked(client, *data):
    client._send_implementation(list(data), [], 0.0)
    return client._can_listener.packet_queue.get(timeout=60.0)

can.Bus = functools.partial(can.Bus, sleep_after_open=0)
with PyBldcCan(logging.getLogger(), 23, "slcan", sys.argv[1], 500_000) as client:
    answers = {"there": client.ping(60.0), "hardware": client._can_listener.hw_type}
    answers["before"] = asked(client, 50, 0, 0x20, 0, 0)
    client._send_implementation([8, 0, 0, 0x0B, 0xB8], [], 0.0)
    answers["after"] = asked(client, 50, 0, 0x20, 0, 0)
    answers["fault"] = asked(client, 50, 0, 0, 0x80, 0)
print(json.dumps(answers))
"""
"""Pings, asks for the state, commands 3000 ERPM, and asks again."""


def test_it_finds_asks_and_commands_a_controller() -> None:
    bus = AdapterPty(BusSettings("can0", "can", "twin", 500_000))
    twin = plugin.twin(Device("left", 23, Options(), Settings(status_messages=0)), 0)
    assert isinstance(twin, VescTwin)
    command = [sys.executable, "-c", CLIENT, *bus.paths]
    now = 0
    twin.step(now, [])
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        while client.poll() is None:
            packets = bus.read(now)[1]
            for packet in packets:
                now += MILLISECOND
                twin.receive(now, packet.frame)
                bus.write(now, twin.step(now, [])[1])
            if not packets:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    client.wait(0.002)
        text, trouble = client.communicate()
    bus.close()
    assert client.returncode == 0, trouble
    assert json.loads(text) == {
        "there": True,
        "hardware": 0,
        "before": [50, 0, 0x20, 0, 0, 1],
        "after": [50, 0, 0x20, 0, 0, 0],
        "fault": [50, 0, 0, 0x80, 0, 0],
    }
    assert twin.goal == Velocity("left", 3000 * twin.device.options.erpm)
    assert twin.mode is Mode.ARMED
