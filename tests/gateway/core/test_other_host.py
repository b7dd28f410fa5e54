"""Another host on the bus: that it commands our motors is a fault of them; reading and disarming is none."""

from __future__ import annotations

import pytest

from gateway import config
from gateway.core.faults import OTHER_HOST
from gateway.core.other_hosts import OVERHEARD
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols import messages as msg
from protocols.frames import CanFrame, Frame, Packet
from tests.gateway.rig import Rig

ROBOTS = ("bench", "diffbot_cubemars", "diffbot_damiao", "diffbot_moteus", "diffbot_myactuator",
          "diffbot_robomaster", "diffbot_robstride", "diffbot_vesc")  # fmt: skip


def heard(rig: Rig, *frames: Frame, bus: str = "can0") -> list[str]:
    """Let the gateway receive what others send; return the notes that name another host."""
    now = rig.clock.now()
    packets = tuple(Packet(now, bus, frame) for frame in frames)
    notes = rig.gateway.step(now, Inputs(packets=packets)).notes
    return [note.source for note in notes if "another host commands it" in note.text]


def faults(gateway: Gateway) -> list[str]:
    codes = {name: [code for code, _ in joint.faults] for name, joint in gateway.joints.items()}
    return [name for name, found in codes.items() if OTHER_HOST in found]


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", ROBOTS)
def test_set_points_sent_again_by_another_host_are_a_fault(name: str) -> None:
    rig = Rig(config.load_robot(name).text)
    rig.run(1.5)
    motor = next(iter(rig.robot.motors))
    ticks = rig.run(0.5, msg.Velocity(motor, 3.0), msg.Drive(0.1, 0.0))
    assert not faults(rig.gateway)
    bus = rig.robot.motors[motor].bus
    sent = [packet.frame for tick in ticks for packet in tick.outputs.packets if packet.bus == bus]
    assert motor in heard(rig, *sent[-OVERHEARD:], bus=bus)
    assert motor in faults(rig.gateway)


def test_what_reads_or_disarms_is_no_fault_and_a_motor_that_is_not_ours_is_noted_once() -> None:
    rig = Rig(config.load_robot("bench").text)
    rig.run(1.5)
    address = rig.robot.motors["left"].device.address << 5
    arm, idle = (CanFrame(address | 7, bytes((state, 0, 0, 0))) for state in (8, 1))
    read = CanFrame(address | 9, remote=True)
    assert heard(rig, idle, read) == []
    assert heard(rig, arm, arm) == ["left"]
    assert heard(rig, arm) == faults(rig.gateway) == []
    rig.run(0.3, msg.Velocity("left", 3.0))
    assert heard(rig, idle, read) == faults(rig.gateway) == []


def test_few_frames_of_other_hosts_are_read_in_a_step() -> None:
    rig = Rig(config.load_robot("bench").text)
    rig.run(1.5)
    left, right = (rig.robot.motors[name].device.address << 5 for name in ("left", "right"))
    others = [CanFrame(right | 7, bytes((1, 0, 0, 0)))] * OVERHEARD
    assert heard(rig, *others, CanFrame(left | 7, bytes((8, 0, 0, 0)))) == []
