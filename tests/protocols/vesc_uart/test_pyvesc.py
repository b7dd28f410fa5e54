"""pyvesc-fix 1.0.3 drives the twin over a pty, in a process of its own: it imports itself by another name."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys

import pytest

from gateway.buses.adapters.pty import SerialPty
from gateway.core.robot import BusSettings
from protocols.messages import MILLISECOND, Mode, Velocity
from protocols.plugin import Device
from protocols.vesc_uart import plugin
from protocols.vesc_uart.options import Options, Settings
from protocols.vesc_uart.twin import VescUartTwin

CLIENT = """
import importlib.util, json, os, sys, types, warnings
warnings.simplefilter("ignore")
package = types.ModuleType("pyvesc")
package.__path__ = [os.path.dirname(importlib.util.find_spec("pyvesc_fix").origin)]
sys.modules["pyvesc"] = package
from pyvesc.VESC import VESC

client = VESC(sys.argv[1], start_heartbeat=False)
answers = {"version": client.get_firmware_version()}
client.set_rpm(3000)
client.get_rpm()
values = client.get_measurements()
answers |= {"volts": values.v_in, "hot": values.temp_fet, "fault": ord(values.mc_fault_code)}
answers["id"] = ord(values.app_controller_id)
client.serial_port.close()
print(json.dumps(answers))
"""


def test_it_asks_and_commands_a_controller() -> None:
    bus = SerialPty(BusSettings("uart", "serial", "twin", baudrate=115_200))
    twin = plugin.twin(Device("left", 23, Options(uart_id=23), Settings(supply=36.5)), 0)
    assert isinstance(twin, VescUartTwin)
    command = [sys.executable, "-c", CLIENT, bus.pty.path]
    now = 0
    twin.step(now, [])
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        while client.poll() is None:
            packets = bus.read(now)[1]
            for packet in packets:
                now += MILLISECOND
                twin.receive(now, packet.frame)
                bus.write(now, twin.step(now + MILLISECOND, [])[1])
            if not packets:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    client.wait(0.002)
        text, trouble = client.communicate()
    bus.close()
    assert client.returncode == 0, trouble
    told = json.loads(text)
    # It takes the letter behind the version for a part of it.
    assert told == {"version": "6.6.84", "volts": 36.5, "hot": 30.0, "fault": 0, "id": 23}
    assert twin.mode is Mode.ARMED
    assert isinstance(twin.goal, Velocity)
    assert twin.goal.velocity == pytest.approx(3000 * twin.device.options.erpm)
