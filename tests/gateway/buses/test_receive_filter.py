"""`receive_filter = "own"`: what the kernel then drops changes nothing that a driver decodes."""

from __future__ import annotations

from random import Random

import pytest

from gateway import config
from gateway.config import resources
from gateway.core.robot import Robot
from gateway.errors import ConfigError
from protocols.frames import CanFrame, IdMask, id_number
from protocols.messages import MILLISECOND, Event, Scan
from protocols.plugin import Device, Plugin

TEXT = resources.find("robots", "diffbot").read_text()


def own(text: str = TEXT) -> Robot:
    return config.parse_robot(text.replace("[buses.can0]", '[buses.can0]\nreceive_filter = "own"', 1))


def accepted_by(received: tuple[IdMask, ...], frame: CanFrame) -> bool:
    """As the kernel filters (linux/can.h): one filter that matches is enough."""
    return not received or any(id_number(frame) & mask == number & mask for number, mask in received)


def test_every_id_is_received_unless_the_file_has_a_filter() -> None:
    assert config.parse_robot(TEXT).buses["can0"].receive_filter == ()
    text = TEXT.replace("[buses.can0]", '[buses.can0]\nreceive_filter = "all"', 1)
    assert config.parse_robot(text).buses["can0"].receive_filter == ()


def test_own_accepts_what_the_specs_expect() -> None:
    robot = own()
    received = robot.buses["can0"].receive_filter
    assert robot.buses["sensors"].receive_filter == ()
    specs = [motor.spec for motor in robot.motors.values()]
    assert all(accepted_by(received, CanFrame(number)) for spec in specs for number, _ in spec.expects)
    assert not accepted_by(received, CanFrame(0x7F0))
    assert 0 < sum(accepted_by(received, CanFrame(number)) for number in range(0x800)) < 0x800 // 4


def test_a_filter_on_a_serial_line_and_an_unknown_filter_are_mistakes() -> None:
    with pytest.raises(ConfigError, match="a serial bus has no ids"):
        config.parse_robot(TEXT.replace("[buses.sensors]", '[buses.sensors]\nreceive_filter = "own"', 1))
    with pytest.raises(ConfigError, match="receive_filter"):
        config.parse_robot(TEXT.replace("[buses.can0]", '[buses.can0]\nreceive_filter = "mine"', 1))


@pytest.mark.parametrize("seed", range(4))
def test_a_driver_decodes_the_same_events_behind_the_filter(seed: int) -> None:
    """Random frames of every 11-bit id, of the right length more often than not, before and during a scan."""
    robot = own()
    (plugin, devices), received = _of_can0(robot), robot.buses["can0"].receive_filter
    all_, some = plugin.driver(devices), plugin.driver(devices)
    random, dropped = Random(seed), 0
    events: tuple[list[Event], list[Event]] = ([], [])
    for n in range(12_000):
        now = n * MILLISECOND
        number = random.randrange(0x800)
        frame = CanFrame(number, _data(random, number), remote=random.random() < 0.02)
        events[0].extend(all_.receive(now, frame))
        if accepted_by(received, frame):
            events[1].extend(some.receive(now, frame))
        else:
            dropped += 1
        if n % 5 == 0:
            requests = [Scan("can0")] if n == 5000 else []
            for driver, found in zip((all_, some), events, strict=True):
                reported, _ = driver.send(now, requests)
                found.extend(reported)
    assert events[0] == events[1]
    assert len(events[0]) > 100
    assert (some.counters.accepted, some.counters.malformed) == (
        all_.counters.accepted,
        all_.counters.malformed,
    )
    assert all_.counters.ignored == some.counters.ignored + dropped > dropped > 5_000


def _of_can0(robot: Robot) -> tuple[Plugin, list[Device]]:
    motors = [motor for motor in robot.motors.values() if motor.bus == "can0"]
    return motors[0].plugin, [motor.device for motor in motors]


def _data(random: Random, number: int) -> bytes:
    """Eight bytes, mostly; in a reply to address discovery the node's own number first."""
    data = random.randbytes(8 if random.random() < 0.9 else random.randrange(9))
    return bytes([number >> 5]) + data[1:] if number & 0x1F == 6 and data else data
