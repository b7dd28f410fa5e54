"""Hostile frames: no end of a protocol raises, at a bounded number of calls; nor does a gateway or a monitor.

`./go prove -k hostile_frames` takes ten million per protocol (tests/prove/test_hostile.py).
"""

from __future__ import annotations

import pickle
from random import Random

import pytest

from gateway.config import load_robot
from gateway.core.faults import MAX_FAULTS
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from gateway.monitor.candidates import of_robot
from gateway.monitor.decoder import BusMonitor
from protocols import messages as msg
from protocols.conformance.noise import valid_frames
from protocols.frames import Packet
from protocols.plain import table
from tests.protocols import hostile
from tests.protocols.hostile import PLUGINS
from tests.sampled import sampled


@pytest.mark.sample(8)
@pytest.mark.parametrize("name", sorted(PLUGINS))
def test_hostile_frames_do_not_raise(name: str) -> None:
    for seed in range(2):
        hostile.line(name, seed, 1000)


@pytest.mark.sample(2)
@pytest.mark.parametrize("name", sampled(sorted(PLUGINS), 3))
def test_a_gateway_and_a_monitor_take_hostile_frames(name: str) -> None:
    hostile.robot(name, 1, 800)


def test_a_device_cannot_fill_the_memory_with_faults() -> None:
    """Each code is another fault: driver, joint and monitor keep a bounded number."""
    robot = load_robot("husky")
    gateway = Gateway(robot)
    monitor = BusMonitor(robot.buses, of_robot(robot, robot.buses), 0, known=True)
    name, motor = next(iter(robot.motors.items()))
    for number in range(500):
        frame = table.encode(motor.device.address, msg.Fault("", 0, 1000 + number, f"fault {number}"))
        packet = Packet(number, motor.bus, frame)
        gateway.step(number, Inputs((), (packet,), ()))
        monitor.decode(packet)
        if number % 50 == 49:
            monitor.decode(Packet(number, motor.bus, table.encode(1, msg.State("", 0, msg.Mode.READY))))
    (record,) = [record for record in monitor.found.values() if record.name == name]
    assert 2 < len(gateway.joints[name].faults) <= MAX_FAULTS
    assert max(len(record.faults), len(record.past_faults)) <= MAX_FAULTS
    assert len(pickle.dumps(gateway._drivers[0].driver)) < 20_000


def test_the_frames_reach_what_they_are_to_reach() -> None:
    """Sealed messages are accepted often enough to matter, and not always."""
    case = hostile._cases("plain")[0]
    draw = hostile.Hostile(valid_frames(case), Random(1))
    driver = case.start().driver
    for _ in range(2000):
        driver.receive(0, draw.frame())
    counters = driver.counters
    assert min(counters.accepted, counters.malformed) > 300, counters
