"""Noise at the full rate of a line: every valid message is found, and what is held stays small."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import remainder, tau
from random import Random
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest

from protocols import sensors
from protocols.conformance.bench import sensor_events
from protocols.messages import MILLISECOND, SECOND, LaserScan, Measurement
from protocols.plugin import Device, load
from protocols.rplidar import table as rp
from protocols.sensors import SensorKind


class Line(NamedTuple):
    """What streams, on which line."""

    protocol: str
    rate: int
    """bit/s"""
    longest: int
    """Bytes of a message"""
    options: Mapping[str, Any] = MappingProxyType({})
    minute: float = 60.0
    """s in the ordinary tests: less of what shares its code with another one, on a faster line"""


LINES = {
    "ld06": Line("ld06", 230_400, 47),
    "stl27l": Line("ld06", 921_600, 47, {"model": "STL-27L"}, 6.0),
    "rplidar express": Line("rplidar", 115_200, 84),
    "rplidar ultra": Line("rplidar", 256_000, 132, {"model": "A3", "scan": "ultra"}, 10.0),
    "rplidar dense": Line("rplidar", 460_800, 84, {"model": "C1", "scan": "dense"}, 10.0),
    "rplidar hq": Line("rplidar", 256_000, 781, {"model": "A3", "scan": "hq"}, 20.0),
    "witmotion": Line("witmotion", 115_200, 11),
    "bno08x": Line("bno08x", 115_200, 19),
    "nmea": Line("nmea", 38_400, 128),
}
PIECE = 64
"""Bytes that are read at once"""
BEAMS = 9 * 2200
"""Bytes of the beams of a turn"""


def measured_by(protocol: str, device: Device) -> list[SensorKind]:
    """The kinds of what a device measures: others are not made up, which takes most of the time."""
    ranges = load(protocol).spec(device).ranges
    names = {one.partition(".")[0] for one in ranges} or {"LaserScan"}  # of a lidar that is not started
    return [kind for kind in sensors.kinds().by_type.values() if kind.message.__name__ in names]


def next_rays(whole: Measurement, number: int, beams: int) -> Measurement:
    """Of a lidar what it sees in the next part of its turn: rays as near to each other as its beams."""
    if not isinstance(whole, LaserScan):
        return whole
    count, width = len(whole.ranges), tau / beams
    begins = remainder(-width * count * (number + 1), tau)
    took = -(SECOND // 10) * (count - 1) // beams
    return replace(whole, angle_min=begins, angle_increment=width, duration=took)


def messages_of(name: str, device: Device) -> Iterator[bytes]:
    """Yield what a device sends, without end."""
    protocol = LINES[name].protocol
    twin: Any = load(protocol).twin(device, 0)
    if protocol == "rplidar":
        twin.receive(0, rp.express_scan(device.options.mode))
    first = sensor_events("", 0, 0)
    measured = measured_by(protocol, device)
    beams = getattr(device.options, "count", 0) or getattr(device.options, "beams", 1)
    for number in range(10**9):
        now = SECOND + number * 2 * MILLISECOND
        truth = [kind.sample(device.name, now, number) for kind in measured] if number else first
        truth = [next_rays(each, number, beams) for each in truth]
        yield from (
            frame for frame in twin.step(now, truth)[1] if isinstance(frame, bytes) and len(frame) > 7
        )


def noise(random: Random, name: str, longest: int) -> bytes:
    """Return bytes between two messages; in text also lines, and what looks like the beginning of one."""
    data = random.randbytes(1 + random.randrange(120))
    if name == "nmea":
        return data + b"$GPGGA,\r\n" * random.randrange(2) + b"\r\n"
    # What begins in noise ends in it: else it may take the message behind it for its own.
    return data + bytes(longest)


def judge(name: str, seconds: float, seed: int) -> None:
    """Feed a driver bursts of messages and noise for so long, as the line carries them."""
    (protocol, rate, longest, options, _), random = LINES[name], Random(seed)
    plugin = load(protocol)
    device = Device("s", 1, plugin.options(**options), plugin.settings(), rate)
    driver: Any = plugin.driver([device])
    if protocol == "rplidar":
        driver.receive(0, rp.descriptor(device.options.scan))
    before = driver.counters.accepted
    sent, size, most, source = 0, 0, 0, messages_of(name, device)
    while size < rate / 10 * seconds:
        burst = [next(source) for _ in range(2 + random.randrange(4))]
        stream = b"".join(burst) + noise(random, name, longest)
        for at in range(0, len(stream), PIECE):
            now = SECOND + (size + at) * 10 * SECOND // rate
            driver.receive(now, stream[at : at + PIECE])
        assert len(driver.adapter._stream.held) <= longest + PIECE
        if not most and size > rate / 10 * seconds / 4:
            most = len(pickle.dumps([host.own for host in driver.hosts.values()]))
        sent, size = sent + len(burst), size + len(stream)
    # A turn of a lidar that has just begun, and one that is nearly whole, differ by its beams.
    assert len(pickle.dumps([host.own for host in driver.hosts.values()])) < most + BEAMS, (
        "what is kept has grown"
    )
    extra = driver.counters.accepted - before - sent
    assert sent > 5 * seconds
    # By chance, a message is in noise: for 255 with a wrong sum of 8 bits, there is one with a right one.
    chance = driver.counters.malformed / 255
    assert 0 <= extra <= seconds / 1000 + chance + 5.0 * chance**0.5, (sent, driver.counters)


@pytest.mark.parametrize("name", LINES)
def test_in_a_minute_of_noise_every_message_is_found(name: str) -> None:
    judge(name, LINES[name].minute, 1)


@pytest.mark.prove
@pytest.mark.parametrize("name", LINES)
def test_in_an_hour_of_noise_every_message_is_found(name: str) -> None:
    judge(name, 3600.0, 2)
