"""What six servos get of a line at 1 Mbaud, in virtual time; and that `gateway schedule` says the same."""

from __future__ import annotations

import pytest

from gateway import config
from gateway.runtime.schedule import WINDOW, count_buses
from protocols.messages import SECOND
from tests.protocols.dynamixel.test_line import run

SIX = """
name = "six"
rate_hz = 200
world = "bench"
[buses.line0]
kind = "serial"
baudrate = 1_000_000
interface = "twin"
[defaults.motors]
protocol = "feetech"
bus = "line0"
gear = 1.0
limits = {{ velocity = 3.0, acceleration = 20.0, torque = 2.9 }}
options = {{ model = "sts3215", mode = "wheel", feedback_ms = 1, sync_read = {sync} }}
settings = {{ mode = 1, return_delay = 0 }}
[motors]
m1 = {{ address = 1 }}
m2 = {{ address = 2 }}
m3 = {{ address = 3 }}
m4 = {{ address = 4 }}
m5 = {{ address = 5 }}
m6 = {{ address = 6 }}
[brain]
body = "joints"
[brain.joints]
motors = ["m1", "m2", "m3", "m4", "m5", "m6"]
"""


@pytest.mark.prove
@pytest.mark.parametrize(("sync", "rate", "least"), [("false", 700.0, 400.0), ("true", 1000.0, 600.0)])
def test_all_of_them_are_read_and_written_and_the_schedule_says_how_often(
    sync: str, rate: float, least: float
) -> None:
    robot = config.parse_robot(SIX.format(sync=sync))
    done = run(robot, rate, 0.5)
    each = min(done.readings.values()) / done.seconds
    assert each >= least
    assert done.overlaps == 0
    (counted,) = count_buses(robot, rate)
    assert min(counted.readings.values()) * SECOND / WINDOW == pytest.approx(each, rel=0.02)
    assert len(counted.readings) == 6
