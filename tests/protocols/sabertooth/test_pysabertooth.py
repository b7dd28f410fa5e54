"""pysabertooth 0.4.0 on our twins of both motors of a board, over a pty."""

from __future__ import annotations

import pytest

from protocols.messages import Idle, Mode, Velocity
from protocols.plugin import Device
from protocols.sabertooth import plugin
from protocols.sabertooth.options import Options, Settings
from protocols.sabertooth.twin import SabertoothTwin
from tests.protocols.on_pty import run_client

CLIENT = """
import sys, time
time.sleep = lambda s: None
from pysabertooth import Sabertooth
sb = Sabertooth(sys.argv[1], baudrate=9600, address=128)
%s
sb.stop = lambda: None  # its destructor would stop what it commanded
"""
FULL = 20.0


@pytest.mark.parametrize(
    ("calls", "left", "right", "timeout"),
    [
        ("sb.drive(1, 50)", 63 / 127, None, 0),
        ("sb.drive(1, -100); sb.drive(2, -25)", -1.0, -31 / 127, 0),
        ("sb.driveBoth(100, 50)", 1.0, 63 / 127, 0),
        ("sb.sendCommand(14, 5); sb.drive(2, 100)", None, 1.0, 5),
        ("sb.sendCommand(8, 64); sb.sendCommand(10, 10)", 74 / 127, 54 / 127, 0),
        ("sb.sendCommand(8, 64)", None, None, 0),
        ("sb.drive(1, 50); sb.stop()", 0.0, 0.0, 0),
    ],
)
def test_what_it_commands_is_obeyed(
    calls: str, left: float | None, right: float | None, timeout: int
) -> None:
    twins = [
        plugin.twin(Device(name, at, Options(full_scale=FULL), Settings()), at)
        for name, at in (("left", 128), ("right", 136))
    ]
    assert run_client(CLIENT % calls, twins) == ""
    for twin, name, share in zip(twins, ("left", "right"), (left, right), strict=True):
        assert isinstance(twin, SabertoothTwin)
        assert twin.serial_timeout == timeout
        assert twin.mode is (Mode.ARMED if share else Mode.READY)
        if share:
            assert isinstance(twin.goal, Velocity)
            assert twin.goal.velocity == pytest.approx(share * FULL)
        else:
            assert twin.goal == Idle(name) or twin.mode is Mode.READY
