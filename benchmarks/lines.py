"""A serial port under noise: what a second of it costs, at full rate, without and with a question under way.

Rules. Noise is put into a pty at the line's rate, a millisecond's worth at a time, and read as the live loop
reads it: at each period, and while an answer is awaited when something comes. Then it goes where a step would
put it, the line and the driver of a protocol. What writes it, and the kernel, are measured too.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack, closing

from benchmarks.bridge import line
from benchmarks.measure import Call, Effort, in_turn
from benchmarks.rows import Row, Target, span
from gateway.buses import open_bus
from gateway.config import parse_robot
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from protocols.line import Answer, Exchange, Line
from protocols.messages import MILLISECOND, SECOND
from protocols.plugin import load

GROUP = "a serial line with noise at full rate, 1 Mbaud (100 kB/s), on a pty"
WHAT = "a second of it, while nothing is asked", "a second of it, while each answer is waited for"
RATE = 1_000_000
MOST = 0.1 * SECOND
"""The project's own: processor time for a second of it."""
ROBOT = """
name = "noise"
rate_hz = 1000
[buses.line]
kind = "serial"
interface = "twin"
baudrate = 1_000_000
[motors.one]
protocol = "plain"
bus = "line"
address = 1
options = { kind = "motor" }
gear = 1.0
limits = { velocity = 1.0, acceleration = 1.0, torque = 1.0 }
[brain]
body = "joints"
[brain.joints]
motors = ["one"]
"""
_SEED = 0x9E3779B9


def lines(effort: Effort) -> list[Row]:
    """Noise while nothing is asked, and while questions are."""
    with ExitStack() as stack:
        calls: dict[str, Call] = {}
        for what, asks in zip(WHAT, (False, True), strict=True):
            far, _, path = stack.enter_context(line())
            settings = BusSettings("line", "serial", f"serial:{path}", baudrate=RATE)
            bus = stack.enter_context(closing(open_bus(settings, SimulatedClock())))
            calls[what] = second(far, bus.read, asks)
        found = in_turn(calls, effort.of(10, 1))
    whole = span("a second", float(SECOND))
    return [Row(GROUP, what, each, (whole,), Target(at_most=MOST)) for what, each in found.items()]


def noise(size: int) -> bytes:
    """Bytes without a pattern, the same each time (xorshift)."""
    state, made = _SEED, bytearray()
    while len(made) < size:
        state ^= state << 13 & 0xFFFF_FFFF
        state ^= state >> 17
        state ^= state << 5 & 0xFFFF_FFFF
        made += state.to_bytes(4, "little")
    return bytes(made[:size])


def nothing(asked: bytes, held: bytes) -> None:
    """Find no answer."""


def second(far: int, read: Callable[[int], tuple[object, object]], asks: bool) -> Call:
    """Return a call that puts a second of noise into a line, reads it, and hands it on."""
    pieces = [noise(100 * (n + 1))[100 * n :] for n in range(97)]
    robot = parse_robot(ROBOT)
    driver = load("plain").driver([robot.motors["one"].device])
    question = Exchange(b"question", Answer(64, nothing), about="it")
    queue, now = Line(RATE, slack=2 * MILLISECOND), 0

    def call() -> int:
        nonlocal now
        for number in range(1000):
            now += MILLISECOND
            os.write(far, pieces[number % len(pieces)])
            if asks:
                queue.put(0, [question])
            queue.expire(now)
            queue.take(now)
            for packet in read(now)[1]:  # type: ignore[attr-defined]
                _, rest = queue.receive(packet.t, packet.frame)
                if rest:
                    driver.receive(packet.t, rest)
        return queue.stray

    return call
