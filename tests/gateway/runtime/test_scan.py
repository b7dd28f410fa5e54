"""A scan without a robot file: what is found on a bus of several protocols, and which of them may ask."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from gateway import config
from gateway.buses import Bus
from gateway.buses.virtual.bus import open_world
from gateway.core.clock import SimulatedClock
from gateway.runtime import scan
from gateway.runtime.scan import Finding, Probe
from protocols.frames import BusState, CanFrame, Frame, Packet, id_number
from protocols.messages import Nanos
from protocols.plugin import load, load_all


class Asked:
    """A bus whose devices must be sent nothing but what only reads."""

    def __init__(self, bus: Bus, robot: str) -> None:
        self.name = bus.name
        self._bus = bus
        self._specs = [one.spec for one in config.load_robot(robot).devices_on(bus.name)]

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        return self._bus.read(now)

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        for frame in frames:
            ours = [one for one in self._specs if one.bus == "serial" or one.read_only(frame)]
            assert ours or not any(_addressed(frame, one.sends) for one in self._specs), frame
        self._bus.write(now, frames)

    def close(self) -> None:
        """The world goes on."""


def _addressed(frame: Frame, ids: Sequence[tuple[int, int]]) -> bool:
    return isinstance(frame, CanFrame) and any(
        id_number(frame) & mask == number & mask for number, mask in ids
    )


def scanned(robot: str, bus: str, *protocols: str) -> tuple[list[Finding], list[str], dict[int, int]]:
    """Scan a bus of twins. Returns the findings, what is said, and the ids that they leave unexplained."""
    its = config.load_robot(robot)
    world, clock, ids, said = open_world(its, 1), SimulatedClock(), dict[int, int](), list[str]()
    probes = [one for name in protocols if (one := scan.probe(load(name), its.buses[bus])) is not None]
    found = scan.scan(probes, lambda _: Asked(world.buses[bus], robot), clock, said.append, ids)
    return found, said, scan.unexplained(ids, found, probes)


def test_devices_of_several_protocols_are_told_apart_on_one_bus() -> None:
    found, said, left = scanned(
        "diffbot_mixed_can", "can0", "odrive_can", "cubemars", "robstride", "vesc", "cia402"
    )
    assert [(one.protocol, one.address, one.how) for one in found] == [
        ("cubemars", 3, "heard"),
        ("robstride", 2, "answered"),
        ("vesc", 1, "answered"),
    ]
    assert said == []  # what looks like an ODrive's heartbeat is the VESC's
    assert left == {}


def test_no_question_is_asked_that_a_device_found_there_would_obey() -> None:
    found, said, left = scanned("diffbot", "can0", "cia402", "myactuator", "odrive_can")
    assert [(one.protocol, one.address, one.serial is not None) for one in found] == [
        ("odrive_can", 1, True),
        ("odrive_can", 2, True),
    ]
    assert left == {}
    probes = [scan.probe(load("odrive_can"), config.load_robot("diffbot").buses["can0"])]
    assert scan.unexplained({0x029: 5, 0x049: 5}, found[:1], [one for one in probes if one]) == {0x049: 5}
    assert said == [
        f"{name} is not asked: its questions are Estop to the odrive_can found here"
        for name in ("cia402", "myactuator")
    ]


def test_a_line_is_scanned_for_servos_and_for_sensors_that_only_stream() -> None:
    found, _, _ = scanned("arm_feetech", "servos", "dynamixel", "feetech")
    assert [(one.protocol, one.address) for one in found] == [("feetech", number) for number in range(1, 8)]
    assert "firmware 3.10" in found[0].detail
    found, _, _ = scanned("diffbot_sensors", "lidar", "witmotion", "ld06")
    assert found == [Finding("ld06", 1, how="heard")]
    assert scan.probe(load("ld06"), config.load_robot("diffbot_sensors").buses["imu"]) is None  # another rate


@pytest.mark.prove
@pytest.mark.parametrize("kind", ["can", "serial"])
def test_protocols_ask_after_those_whose_devices_would_obey_them(kind: str) -> None:
    bus = config.load_robot("diffbot" if kind == "can" else "arm_feetech").buses
    settings = next(iter(bus.values()))
    probes: list[Probe] = [one for each in load_all()[0] if (one := scan.probe(each, settings)) is not None]
    before: set[str] = set()
    for one, rivals in scan.in_order(probes):
        assert rivals.keys() <= before, f"{one.name} asks before {rivals}"
        before.add(one.name)
    assert len(before) == len(probes) > 5
