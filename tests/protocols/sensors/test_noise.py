"""Noise at the full rate of a line: every valid message is found, and what is held stays small."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random
from typing import Any

import pytest

from protocols import sensors
from protocols.conformance.bench import sensor_events
from protocols.messages import MILLISECOND, SECOND
from protocols.plugin import Device, load
from protocols.rplidar import table as rp

RATES = {"ld06": 230_400, "rplidar": 115_200, "witmotion": 115_200, "bno08x": 115_200, "nmea": 38_400}
MOST_HELD = 130
"""Bytes: the longest message of these"""


def messages_of(name: str, device: Device) -> Iterator[bytes]:
    """Yield what a device sends, without end."""
    twin: Any = load(name).twin(device, 0)
    if name == "rplidar":
        twin.receive(0, rp.express_scan(0))
    kinds = sensors.kinds().by_type.values()
    for number in range(10**9):
        now = SECOND + number * 2 * MILLISECOND
        truth = (
            [kind.sample(device.name, now, number) for kind in kinds] if number else sensor_events("", 0, 0)
        )
        yield from (
            frame for frame in twin.step(now, truth)[1] if isinstance(frame, bytes) and len(frame) > 7
        )


def noise(random: Random, name: str) -> bytes:
    """Return bytes between two messages; in text also lines, and what looks like the beginning of one."""
    data = random.randbytes(1 + random.randrange(120))
    if name == "nmea":
        return data + b"$GPGGA,\r\n" * random.randrange(2) + b"\r\n"
    # What begins in noise ends in it: else it may take the message behind it for its own.
    return data + bytes(90)


def judge(name: str, seconds: float, seed: int) -> None:
    """Feed a driver bursts of messages and noise for so long, as the line carries them."""
    plugin, random = load(name), Random(seed)
    device = Device("s", 1, plugin.options(), plugin.settings(), RATES[name])
    driver: Any = plugin.driver([device])
    sent, size, source = 0, 0, messages_of(name, device)
    while size < RATES[name] / 10 * seconds:
        burst = [next(source) for _ in range(2 + random.randrange(4))]
        stream = b"".join(burst) + noise(random, name)
        for at in range(0, len(stream), 16):
            now = SECOND + (size + at) * 10 * SECOND // RATES[name]
            driver.receive(now, stream[at : at + 16])
        assert len(driver.adapter._stream.held) <= MOST_HELD
        sent, size = sent + len(burst), size + len(stream)
    extra = driver.counters.accepted - sent
    assert sent > 5 * seconds
    assert 0 <= extra <= seconds / 1000, (sent, driver.counters)  # by chance, a message may be in noise


@pytest.mark.parametrize("name", RATES)
def test_in_noise_every_message_is_found(name: str) -> None:
    judge(name, 10.0, 1)


@pytest.mark.prove
@pytest.mark.parametrize("name", RATES)
def test_in_an_hour_of_noise_every_message_is_found(name: str) -> None:
    judge(name, 3600.0, 2)
