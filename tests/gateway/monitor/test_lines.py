"""What is told of a line that does not go as it should: each kind once, with the likeliest cause."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs, Tick
from gateway.monitor.lines import LineTroubles
from protocols.frames import Packet
from protocols.line import Line
from protocols.messages import SECOND
from tests.gateway.buses.test_twin_line import robot

DOUBLED = bytes([0x00, 0x06, 0x18, 0x1E, 0x60, 0x66, 0x78, 0x7E, 0x80, 0x86]) * 10
"""Each bit twice, from the start bit on."""


def late(line: Line) -> None:
    line.answered += 100
    line.lost += 20
    line.late += 20


def twice(line: Line) -> None:
    line.answered += 300
    line.lost += 50
    line.cut += 50
    line.silence[0, "3 motion"] = 5, 0


def garbage(line: Line) -> None:
    line.lost += 50
    line.cut += 50


def noisy(line: Line) -> None:
    line.answered += 300
    line.lost += 50
    line.cut += 50


def babble(line: Line) -> None:
    line.answered += 300
    line.stray += 1000


def fine(line: Line) -> None:
    line.answered += 300
    line.lost += 3
    line.cut += 3
    line.stray += 6


def unplugged(line: Line) -> None:
    """The motor is told to be offline; there is nothing wrong with the line."""
    line.answered += 300
    line.lost += 30


@pytest.mark.parametrize(
    ("trouble", "came", "said"),
    [
        (late, b"", "20 of 120 answers in a second came when they had been given up: raise latency_ms = 3"),
        (twice, b"", "50 of 350 answers in a second are garbage: all about '3 motion': an id twice"),
        (garbage, DOUBLED, "they look like bytes sent at 500000 bit/s, and received at 1000000"),
        (garbage, b"", "another baud rate, or two that always send at once"),
        (noisy, b"", "noise, a loose connector, an adapter that cuts packets, or another host"),
        (babble, b"x" * 2000, "1000 bytes in a second that nobody asked for"),
        (fine, b"x" * 2000, ""),
        (unplugged, b"", ""),
    ],
)
def test_what_is_wrong_is_told_once(
    trouble: Callable[[Line], None], came: bytes, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    gateway = Gateway(robot())
    line = gateway.lines["line"]
    troubles = LineTroubles(gateway, {})
    for number in range(5):
        packets = (Packet(0, "line", came),) if came else ()
        troubles.take(Tick(number, number * SECOND, Inputs((), packets, ()), Outputs((), (), ())))
        trouble(line)
    assert len(caplog.messages) == bool(said)
    assert all(said in message for message in caplog.messages)
