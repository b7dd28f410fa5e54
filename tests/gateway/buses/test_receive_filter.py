"""`receive_filter = "own"`: what the kernel then keeps back changes nothing that a driver understands."""

from __future__ import annotations

from random import Random

import pytest

from gateway import config
from gateway.config import resources
from gateway.core.robot import Robot
from gateway.errors import ConfigError
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Event, Scan
from protocols.plugin import Device, Plugin

TEXT = resources.find("robots", "diffbot").read_text()


def own(text: str = TEXT) -> Robot:
    return config.parse_robot(text.replace("[buses.can0]", '[buses.can0]\nreceive_filter = "own"', 1))


def let_in(received: tuple[tuple[int, int], ...], frame: CanFrame) -> bool:
    """As the kernel chooses (linux/can.h): one choice that fits is enough."""
    return not received or any(frame.id & mask == number & mask for number, mask in received)


def test_everything_is_heard_unless_the_file_says_otherwise() -> None:
    assert config.parse_robot(TEXT).buses["can0"].receive_filter == ()
    text = TEXT.replace("[buses.can0]", '[buses.can0]\nreceive_filter = "all"', 1)
    assert config.parse_robot(text).buses["can0"].receive_filter == ()


def test_own_is_what_the_specs_expect_and_overhear() -> None:
    robot = own()
    received = robot.buses["can0"].receive_filter
    assert robot.buses["sensors"].receive_filter == ()
    specs = [motor.spec for motor in robot.motors.values()]
    assert all(let_in(received, CanFrame(number)) for spec in specs for number in spec.expects)
    assert not let_in(received, CanFrame(0x7F0))
    assert 0 < sum(let_in(received, CanFrame(number)) for number in range(0x800)) < 0x800 // 4


def test_a_serial_line_and_another_word_are_mistakes() -> None:
    with pytest.raises(ConfigError, match="a serial bus has no ids"):
        config.parse_robot(TEXT.replace("[buses.sensors]", '[buses.sensors]\nreceive_filter = "own"', 1))
    with pytest.raises(ConfigError, match="receive_filter"):
        config.parse_robot(TEXT.replace("[buses.can0]", '[buses.can0]\nreceive_filter = "mine"', 1))


@pytest.mark.parametrize("seed", range(4))
def test_a_driver_is_told_the_same_by_what_is_let_in(seed: int) -> None:
    """Random frames of every 11-bit id, of the right length more often than not, before and during a scan."""
    robot = own()
    (plugin, devices), received = _of_can0(robot), robot.buses["can0"].receive_filter
    all_, some = plugin.driver(devices), plugin.driver(devices)
    random, kept_back = Random(seed), 0
    said: tuple[list[Event], list[Event]] = ([], [])
    for n in range(12_000):
        now = n * MILLISECOND
        number = random.randrange(0x800)
        frame = CanFrame(number, _data(random, number), remote=random.random() < 0.02)
        said[0].extend(all_.receive(now, frame))
        if let_in(received, frame):
            said[1].extend(some.receive(now, frame))
        else:
            kept_back += 1
        if n % 5 == 0:
            words = [Scan("can0")] if n == 5000 else []
            for driver, events in zip((all_, some), said, strict=True):
                reported, _ = driver.send(now, words)
                events.extend(reported)
    assert said[0] == said[1]
    assert len(said[0]) > 100
    assert (some.counters.accepted, some.counters.malformed) == (
        all_.counters.accepted,
        all_.counters.malformed,
    )
    assert all_.counters.ignored == some.counters.ignored + kept_back > kept_back > 5_000


def _of_can0(robot: Robot) -> tuple[Plugin, list[Device]]:
    motors = [motor for motor in robot.motors.values() if motor.bus == "can0"]
    return motors[0].plugin, [motor.device for motor in motors]


def _data(random: Random, number: int) -> bytes:
    """Eight bytes, mostly; where a node answers a roll call, its own number first."""
    data = random.randbytes(8 if random.random() < 0.9 else random.randrange(9))
    return bytes([number >> 5]) + data[1:] if number & 0x1F == 6 and data else data
