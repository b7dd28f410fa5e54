"""The devices' end of a line whose devices speak only when asked: in virtual time, and on a pty."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from gateway import config
from gateway.buses.adapters.pty import SerialPty
from gateway.buses.virtual import open_world
from gateway.buses.virtual.bus import TwinBus, TwinWorld
from gateway.core.clock import SimulatedClock, WallClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.runtime.loop import Reader
from gateway.runtime.serve import LEAST, WAKING, serve
from protocols.frames import BusState, Frame, Packet
from protocols.line import Answer, Exchange
from protocols.messages import Event, Nanos, Torque
from protocols.plugin import Device
from tests.gateway.buses.adapter_helpers import open_path
from tests.gateway.processes import PATIENCE

ROBOT = """
name = "line"
rate_hz = 100
[buses.line]
kind = "serial"
interface = "twin"
baudrate = 1_000_000
latency_ms = 3
turnaround_ms = 0.05
[motors.one]
protocol = "plain"
bus = "line"
address = 1
gear = 1.0
options = { kind = "motor" }
limits = { velocity = 1.0, acceleration = 1.0, torque = 1.0 }
[brain]
body = "joints"
[brain.joints]
motors = ["one"]
"""
BYTE: Nanos = 10_000
DELAY: Nanos = 33_000
"""From the end of a question to the answer."""
MS = 1_000_000


@dataclass
class Answerer:
    """A device that answers each frame, after its delay."""

    device: Device
    seed: int
    at: Nanos | None = None
    what: bytes = b""

    def receive(self, t: Nanos, frame: Frame) -> None:
        assert isinstance(frame, bytes)
        self.at, self.what = t + DELAY, b"<" + frame + b">"

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        if self.at is None or self.at > now:
            return (), ()
        self.at = None
        return (), (self.what,)

    def due(self) -> Nanos | None:
        return self.at

    def provoke(self, code: int) -> None: ...


def robot() -> Robot:
    made = config.parse_robot(ROBOT)
    motor = made.motors["one"]
    spec = replace(motor.spec, line="half-duplex")
    motor = replace(motor, spec=spec, plugin=replace(motor.plugin, twin=Answerer))
    bus = replace(made.buses["line"], devices=(spec,))
    return replace(made, motors={"one": motor}, buses={"line": bus})


def world() -> tuple[TwinWorld, TwinBus]:
    made = open_world(robot(), 1)
    made.buses["line"].read(0)
    return made, made.buses["line"]


def test_an_answer_takes_its_time_and_the_loop_is_told_when_to_look() -> None:
    _, bus = world()
    bus.write(100_000, [b"question"])
    now, looks = 100_000, 0
    while not (packets := bus.read(now)[1]):
        files, look = bus.wakes(now)
        assert files == ()
        assert look is not None
        assert look > now
        now, looks = look, looks + 1
    (packet,) = packets
    assert (packet.t, packet.frame) == (100_000 + 8 * BYTE + DELAY + 10 * BYTE, b"<question>")
    assert now == packet.t
    assert looks == 3  # the question's end, the answer's beginning, its end
    assert bus.overlaps == 0


def test_what_two_send_at_once_is_garbled_and_counted() -> None:
    _, bus = world()
    bus.write(0, [b"question"])
    bus.write(8 * BYTE + DELAY + 3 * BYTE, [b"too early"])
    packets = bus.read(MS)[1]
    assert bus.overlaps == 1
    assert packets[0].frame != b"<question>"


def test_what_is_sent_comes_back_first_where_the_adapter_echoes() -> None:
    _, bus = world()
    bus.echoes = True
    bus.write(0, [b"question"])
    echo, answer = bus.read(MS)[1]
    assert (echo.t, echo.frame, answer.frame) == (8 * BYTE, b"question", b"<question>")


def whole(asked: bytes, held: bytes) -> tuple[int, int] | None:
    size = len(asked) + 2
    return (0, size) if len(held) >= size else None


@pytest.mark.parametrize("awaited", [True, False])
def test_the_loop_waits_until_an_answer_is_complete_and_not_longer(awaited: bool) -> None:
    """In virtual time, to the nanosecond; without a question until the end."""
    made = robot()
    _, bus = world()
    gateway, clock = Gateway(made), SimulatedClock()
    reader = Reader(gateway, {"line": bus}, clock)
    line = gateway.lines["line"]
    assert (line.slack, line.gap) == (3 * MS + 300_000, 50_000)
    if awaited:
        line.put(0, [Exchange(b"question", Answer(10, whole), about="it")])
        (taken,) = line.take(0)
        bus.write(0, [bytes(taken[1])])
    reader.wait(9 * MS)
    assert clock.now() == (8 * BYTE + DELAY + 10 * BYTE if awaited else 9 * MS)
    assert [packet.frame for packet in reader.packets] == ([b"<question>"] if awaited else [])


def test_an_answer_that_does_not_come_is_waited_for_until_the_line_gives_it_up() -> None:
    made = robot()
    made_world, bus = world()
    made_world.disconnect("one")
    gateway, clock = Gateway(made), SimulatedClock()
    line = gateway.lines["line"]
    line.put(0, [Exchange(b"question", Answer(10, whole), about="it")])
    bus.write(0, [bytes(exchange) for _, exchange in line.take(0)])
    Reader(gateway, {"line": bus}, clock).wait(line.due() or 0)
    assert clock.now() == line.overdue == 18 * BYTE + line.slack
    (ended,) = line.expire(clock.now())
    assert (ended.data, ended.complete, line.lost, line.cut) == (b"", False, 1, 0)


def over_a_pty(echo: bool, *questions: bytes) -> tuple[bytes, TwinBus]:
    """Ask by a pty, in real time; all that comes, until there is an answer to each."""
    made, bus = world()
    bus.echoes = echo
    outer = SerialPty(robot().buses["line"])
    clock, came = WallClock(), b""
    with closing(outer):
        client = open_path(outer.pty.path)
        outer.read(0)
        served = serve(made.buses, {"line": outer}, clock)
        asked = 0
        for one in served:
            if came.count(b">") >= asked or (asked and len(came) > 200):
                if asked == len(questions):
                    break
                os.write(client, questions[asked])
                asked += 1
            with suppress(BlockingIOError):
                came += os.read(client, 1000)
            if one.now > PATIENCE * 1e9:
                pytest.fail("no answer")
        os.close(client)
        next(served)
        assert outer.read(0)[0] == [] or outer._state is BusState.GONE
        served.close()
    return came, bus


@dataclass
class Outer:
    """What another program sends on a port, and when it is handed something."""

    sends: list[tuple[Nanos, bytes]]
    handed: list[tuple[Nanos, bytes]] = field(default_factory=list)
    name = "line"

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        came = [data for at, data in self.sends if at <= now]
        self.sends = [each for each in self.sends if each[0] > now]
        return (), [Packet(now, self.name, data) for data in came]

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        self.handed += [(now, frame) for frame in frames if isinstance(frame, bytes)]

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:
        return (), None

    def close(self) -> None: ...


class WakenClock(SimulatedClock):
    """Waken by what comes on a port, as by its file."""

    def __init__(self, outer: Outer) -> None:
        super().__init__()
        self.outer = outer

    def wait(self, until: Nanos, files: Sequence[int] = ()) -> None:
        super().wait(min([until, *(at for at, _ in self.outer.sends if at > self.now())]), files)


def test_what_a_port_and_waking_take_is_taken_off_at_both_ends() -> None:
    """As far as they do not take it, an answer is handed over too soon by so much."""
    made, bus = world()
    times = 10_500_000, 20_500_000
    outer = Outer([(times[0], b"question"), (times[1], b"another")])
    for _ in serve(made.buses, {"line": outer}, WakenClock(outer), until=30 * MS):
        pass
    assert [frame for _, frame in outer.handed] == [b"<question>", b"<another>"]
    for (at, frame), came in zip(outer.handed, times, strict=True):
        ends = came - WAKING + (len(frame) - 2) * BYTE + DELAY + len(frame) * BYTE
        assert ends - WAKING <= at <= ends - WAKING + LEAST
    assert bus.overlaps == 0


@pytest.mark.parametrize("echo", [False, True])
def test_a_program_at_a_pty_is_answered_and_echoed(echo: bool) -> None:
    came, bus = over_a_pty(echo, b"one", b"two", b"three")
    assert came == (b"one<one>two<two>three<three>" if echo else b"<one><two><three>")
    assert bus.overlaps == 0


def test_a_pty_that_nobody_has_open_does_not_wake_the_loop() -> None:
    outer: Any = SerialPty(robot().buses["line"])
    with closing(outer):
        assert outer.wakes(0) == ((), None)
        client = open_path(outer.pty.path)
        outer.read(0)
        assert outer.wakes(0) == ((outer.pty.fileno(),), None)
        os.close(client)
        outer.read(1)
        assert outer.wakes(1) == ((), None)
