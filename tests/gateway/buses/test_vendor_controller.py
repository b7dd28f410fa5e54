"""The vendor's Controller (package moteus 1.1.1) on the twin's process, over fdcanusb and python-can's slcan.

On the wall clock, as processes and ptys are: only so is it shown that they work together."""

from __future__ import annotations

import asyncio
import math
import signal
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from moteus import Controller, Mode, Register
from moteus.device_info import DeviceInfo
from moteus.fdcanusb_device import FdcanusbDevice
from moteus.pythoncan_device import PythonCanDevice
from moteus.transport import Transport

from tests.gateway.processes import Process

SERVO = """
name = "servo"
rate_hz = 200
world = "bench"
[buses.can0]
kind = "canfd"
bitrate = 1_000_000
data_bitrate = 5_000_000
interface = "twin"
[defaults.motors]
protocol = "moteus"
bus = "can0"
limits = { velocity = 20.0, acceleration = 60.0, torque = 2.0 }
[motors.left]
address = 1
[motors.right]
address = 2
[brain]
body = "joints"
[brain.joints]
motors = ["left", "right"]
"""


def over_slcan(path: str) -> PythonCanDevice:
    return PythonCanDevice(interface="slcan", channel=path, bitrate=1_000_000, sleep_after_open=0)


async def answered(ask: Callable[[], Awaitable[Any]]) -> Any:
    """Return the answer to a question, which is asked again: the vendor's transport waits 0.1 s for it."""
    for _ in range(500):
        if (state := await ask()) is not None:
            return state
    raise AssertionError("no answer")


async def session(device: FdcanusbDevice | PythonCanDevice) -> list[float]:
    """Find both, turn one until it reports the velocity, stop it; return what it reported, in rev/s."""
    transport = Transport([device])
    velocities: list[float] = []
    try:
        found: list[DeviceInfo] = []
        for _ in range(100):  # each search ends after 0.2 s, whatever the machine does
            found = await transport.discover()
            if len(found) == 2:
                break
        assert sorted(info.can_id for info in found) == [1, 2]
        servo = Controller(id=1, transport=transport)
        state = await answered(servo.query)
        assert state.values[Register.MODE] == Mode.STOPPED
        assert state.values[Register.FAULT] == 0
        turn = partial(servo.set_position, position=math.nan, velocity=0.5, query=True)
        for _ in range(500):
            state = await answered(partial(turn, watchdog_timeout=5.0, maximum_torque=1.0))
            velocities.append(state.values[Register.VELOCITY])
            if state.values[Register.MODE] == Mode.POSITION and abs(velocities[-1] - 0.5) < 0.01:
                break
        await answered(partial(servo.set_stop, query=True))
        state = await answered(servo.query)
        assert state.values[Register.MODE] == Mode.STOPPED
    finally:
        transport.close()
    return velocities


@pytest.mark.parametrize(
    ("adapter", "opened"),
    [("fdcanusb", FdcanusbDevice), ("slcan", over_slcan)],
    ids=["fdcanusb", "python-can"],
)
def test_the_vendors_controller_turns_the_twin(
    adapter: str, opened: Callable[[str], FdcanusbDevice | PythonCanDevice], tmp_path: Path
) -> None:
    robot = tmp_path / "servo.toml"
    robot.write_text(SERVO)
    link = tmp_path / "ports"
    with Process(tmp_path, "twin", str(robot), "-v", "--adapter", adapter, "--link", str(link)) as twin:
        twin.until(f"can0={adapter}:{link}/can0")

        async def talk() -> list[float]:
            return await session(opened(str(link / "can0")))

        velocities = asyncio.run(talk())
        assert velocities[-1] == pytest.approx(0.5, abs=0.01)
        twin.until("can0: client connected", "left: armed", "left: ready", "can0: client disconnected")
        status, text = twin.end(signal.SIGTERM)
        assert status == 0, text
        assert "Traceback" not in text
