"""TMotorCANControl 1.2.6, which drives real ones, on our twin: through python-can's slcan on a pty, in a
process of its own (it is GPL). Its managers are made without their constructors, which call sudo.

Its setters of servo mode raise, all but that of the origin: a mistake of this version."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
from typing import Any

import pytest

from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.core.robot import BusSettings
from protocols.cubemars import plugin
from protocols.cubemars.options import Options
from protocols.cubemars.twin import CubeMarsTwin
from protocols.messages import MILLISECOND, Feedback, Mode
from protocols.plugin import Device

BEGIN = """
import json, sys
import can
from TMotorCANControl.mit_can import CAN_Manager
from TMotorCANControl.servo_can import CAN_Manager_servo

def manager(kind):
    kind.__del__ = lambda self: None
    made = object.__new__(kind)
    made.bus, made.debug = bus, False
    return made

bus = can.Bus(interface="slcan", channel=sys.argv[1], bitrate=1_000_000, sleep_after_open=0)
"""
MIT = """
cm, answers = manager(CAN_Manager), []
def asked(name, *args):
    getattr(cm, name)(1, *args)
    frame = bus.recv(60.0)
    answers.append([frame.arbitration_id, *cm.parse_MIT_message(bytes(frame.data), "AK80-9")])
asked("power_on")
asked("MIT_controller", "AK80-9", 0.5, 0.0, 20.0, 1.0, 0.0)
for _ in range(300):
    asked("MIT_controller", "AK80-9", 0.5, 0.0, 20.0, 1.0, 0.0)
asked("power_off")
asked("zero")
asked("MIT_controller", "AK80-9", 9.0, 0.0, 500.0, 1.0, 0.0)
bus.shutdown()
print(json.dumps(answers))
"""
SERVO = """
cm = manager(CAN_Manager_servo)
def heard():
    frame = bus.recv(60.0)
    try:
        state = cm.parse_servo_message([int(each) for each in frame.data])
    except OverflowError:  # numpy 2 takes no int16 from an unsigned number
        return None
    motion = state.position, state.velocity, state.current
    return [frame.arbitration_id, *motion, int(state.temperature), state.error]
before = heard()
cm.comm_can_set_origin(1, 0)
after = [heard() for _ in range(30)][-1]
bus.shutdown()
print(json.dumps([before, after]))
"""


def run(script: str, twin: CubeMarsTwin, position: float) -> list[Any]:
    """Run a client against the twin; its shaft follows the torque, on 0.01 kg·m², in milliseconds of its own
    for each frame, or while none comes. Returns what the client prints."""
    bus = AdapterPty(BusSettings("can0", "can", "twin", 1_000_000))
    now, velocity = 0, 0.0

    def step() -> None:
        nonlocal now, position, velocity
        now += MILLISECOND
        torques, frames = twin.step(now, [Feedback("m", now, position, velocity)])
        bus.write(now, frames)
        velocity += torques[0].torque / 0.01 * 1e-3
        position += velocity * 1e-3

    step()
    command = [sys.executable, "-c", BEGIN + script, *bus.paths]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        while client.poll() is None:
            packets = bus.read(now)[1]
            for packet in packets:
                twin.receive(now, packet.frame)
                step()
            if not packets:
                step()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    client.wait(0.002)
        text, trouble = client.communicate()
    bus.close()
    assert client.returncode == 0, trouble
    answers: list[Any] = json.loads(text.splitlines()[-1])
    return answers


def twin_of(options: Options) -> CubeMarsTwin:
    twin = plugin.twin(Device("m", 1, options, plugin.settings()), 0)
    assert isinstance(twin, CubeMarsTwin)
    return twin


def test_it_enters_holds_zeroes_and_leaves_mit_mode() -> None:
    twin = twin_of(Options(mode="mit"))
    first, *_, held, off, zeroed, ignored = run(MIT, twin, 0.2)
    assert first[:2] == pytest.approx([1, 0.2], abs=1e-3)
    assert first[4:] == [70, 0]  # °C and 40, which it leaves; no error
    assert held[1] == pytest.approx(0.5, abs=0.05)
    assert off[1] == pytest.approx(held[1], abs=0.05)
    assert zeroed[1] == pytest.approx(0.0, abs=1e-3)
    assert ignored[1] == pytest.approx(0.0, abs=1e-3)
    assert twin.mode is Mode.READY


def test_it_reads_reports_of_servo_mode_and_sets_the_origin() -> None:
    twin = twin_of(Options())
    before, after = run(SERVO, twin, math.radians(30.0))
    assert before == pytest.approx([0x2901, 30.0, 0.0, 0.0, 30, 0], abs=0.051)
    assert after == pytest.approx([0x2901, 0.0, 0.0, 0.0, 30, 0], abs=0.051)
