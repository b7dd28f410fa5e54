"""Frames that were made to do harm, most of them valid in form: what `noise` does not reach.

Valid frames with an extreme number in them, their checksums recomputed; valid frames in any order; wrong
lengths, ids, formats; on a stream: glued, cut, between noise. `line` feeds them to both ends of a protocol,
`robot` to a whole gateway and a monitor.
"""

from __future__ import annotations

import resource
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import msgpack

from gateway.config import load_robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from gateway.monitor import render
from gateway.monitor.candidates import of_robot
from gateway.monitor.decoder import BusMonitor
from gateway.runtime.session import open_session
from protocols import messages as msg
from protocols.conformance import bench as tools
from protocols.conformance import noise
from protocols.conformance.case import Case, addresses_of, variants
from protocols.conformance.states import Situation, situations
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, Feedback
from protocols.plain.table import ADDRESS, FRAMING
from protocols.plugin import Plugin, load_all
from protocols.toolkit.serial import Stream

PLUGINS = {plugin.name: plugin for plugin in load_all()[0]}
ROBOTS = {
    "plain": "diffbot",
    "odrive_can": "bench",
    "cia402": "diffbot_cia402",
    "moteus": "diffbot_moteus",
    "myactuator": "diffbot_myactuator",
    "cubemars": "diffbot_cubemars",
    "damiao": "diffbot_damiao",
    "robomaster": "diffbot_robomaster",
    "robstride": "diffbot_robstride",
    "vesc": "diffbot_vesc",
    "zlac8015d": "diffbot_zlac8015d",
    "dynamixel": "diffbot_dynamixel",
    "feetech": "diffbot_feetech",
    "ddsm": "diffbot_ddsm",
    "roboclaw": "diffbot_roboclaw",
    "sabertooth": "diffbot_sabertooth",
    "maestro": "car",
    "pca9685": "pan_tilt",
    "j1939_valve": "boom",
    "hoverboard": "diffbot_hoverboard",
    "ld06": "diffbot_sensors",
    "witmotion": "diffbot_sensors",
    "rplidar": "diffbot_rplidar",
    "bno08x": "diffbot_gnss",
    "camera": "diffbot_camera",
    "cia406": "diffbot_encoder",
    "nmea": "diffbot_gnss",
    "vesc_uart": "diffbot_vesc_uart",
    "odrive_ascii": "diffbot_odrive_ascii",
    "dbc": str(Path(__file__).parent / "dbc" / "bench_dbc.toml"),
}
NUMBERS = (0.0, -0.0, 5e-324, 1e-40, 1e-19, -1.0, 6.5e4, 3.4e38, 1e300, float("inf"), float("nan"))
INTEGERS = (0, 1, -1, 2**31, 2**63, -(2**63), 2**64 - 1)
VALUES: tuple[object, ...] = (*NUMBERS, *INTEGERS, None, True, "", "\x1b[2J\n", b"", bytes(9), [], [1.0])
EXTREME = sorted(
    {
        struct.pack(f"{order}{code}", number)
        for code in "efd"
        for order in "<>"
        for number in (5e-8, 65504.0, float("inf"), float("nan"))
    }
    | {bytes(size) for size in (1, 2, 4, 8)}
    | {b"\xff" * size for size in (1, 2, 4, 8)}
    | {b"\x80" + bytes(size - 1) for size in (1, 2, 4, 8)}
    | {bytes(size - 1) + b"\x80" for size in (2, 4, 8)}
)
"""Numbers of every size and order: the largest, the smallest, not finite."""
CALLS, CALLS_PER_BYTE = 3000, 150
"""Function calls that one frame may cost at either end."""


class Hostile:
    """Draws frames from a pool of valid ones."""

    def __init__(self, pool: Sequence[Frame], random: Random) -> None:
        self.random = random
        self._cans = [frame for frame in pool if isinstance(frame, CanFrame)]
        stream = Stream(FRAMING)
        found = [each for frame in pool if isinstance(frame, bytes) for each in stream.feed(frame)]
        self._messages = list(dict.fromkeys(each for each in found if isinstance(each, bytes)))
        self._bytes = [frame for frame in pool if isinstance(frame, bytes)]

    def frame(self) -> Frame:
        """Return the next frame."""
        if self._cans and not (self._bytes and self.random.random() < 0.5):
            return self._can()
        return self._serial()

    def _can(self) -> CanFrame:
        random = self.random
        frame = random.choice(self._cans)
        match random.randrange(10):
            case 0 | 1:
                return frame
            case 2 | 3 | 4 | 5:
                return replace(frame, data=self._patched(frame.data))
            case 6:
                size = random.choice((0, 1, 7, 8, 9, 12, 20, 48, 63, 64))
                return replace(frame, data=(frame.data + random.randbytes(64))[:size])
            case 7:
                other = random.choice(self._cans)
                return replace(frame, data=other.data, fd=other.fd)
            case 8:
                return CanFrame(frame.id, frame.data, *(random.random() < 0.5 for _ in range(4)))
        bit = 1 << random.randrange(29 if frame.extended else 11)
        return replace(frame, id=frame.id ^ bit)

    def _patched(self, data: bytes) -> bytes:
        """Return data with one or two extreme numbers at places where a field may be."""
        for _ in range(self.random.choice((1, 1, 2))):
            number = self.random.choice(EXTREME)
            if len(data) >= len(number):
                at = self.random.randrange(len(data) - len(number) + 1)
                data = data[:at] + number + data[at + len(number) :]
        return data

    def _serial(self) -> bytes:
        random = self.random
        match random.randrange(8):
            case 0:
                return random.choice(self._bytes)
            case 1:
                return self._patched(random.choice(self._bytes))
            case 2:
                whole = self._sealed()
                return whole[: random.randrange(len(whole) + 1)]
            case 3:
                return random.randbytes(random.randrange(40)) + self._sealed()
            case 4:
                return b"".join(self._sealed() for _ in range(random.randrange(5)))
        return self._sealed()

    def _sealed(self) -> bytes:
        """Return a message with hostile contents and a valid checksum."""
        random = self.random
        if not self._messages:
            return self._patched(random.choice(self._bytes))
        message = random.choice(self._messages)
        address, body = message[ADDRESS : ADDRESS + 1], message[ADDRESS + 1 :]
        row: Any = msgpack.unpackb(body)
        if random.random() < 0.9 and isinstance(row, list) and row:
            at = random.randrange(len(row))
            row[at] = self._value(row[at])
            if random.random() < 0.1:
                del row[random.randrange(len(row))]
            body = msgpack.packb(row)
        else:
            body = self._patched(body)
        address = bytes((random.randrange(256),)) if random.random() < 0.05 else address
        body = (address + body)[:0x4000]
        head = struct.pack("<2sHH", FRAMING.sync, len(body), len(body) ^ 0xFFFF)
        return FRAMING.frame(head + body)

    def _value(self, value: object) -> object:
        """Return another value of a field: extreme, or of another kind."""
        random = self.random
        if isinstance(value, list) and value and random.random() < 0.7:
            at = random.randrange(len(value))
            return [*value[:at], random.choice(NUMBERS), *value[at + 1 :]]
        if isinstance(value, bytes) and len(value) >= 8 and random.random() < 0.8:
            count = random.choice((0, 1, 2, len(value) // 8, 1900))
            number = struct.pack("<d", random.choice((*NUMBERS, 0.5, 30.0)))
            kept = value[: random.randrange(len(value) // 8 + 1) * 8]
            return (kept + number * count)[: 8 * 2000]
        if isinstance(value, float) and random.random() < 0.7:
            return random.choice(NUMBERS)
        if isinstance(value, int) and random.random() < 0.5:
            return random.getrandbits(random.choice((4, 8, 16, 32, 63)))
        return random.choice(VALUES)


def resident() -> float:
    """Return the memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


@contextmanager
def counted(most: int) -> Iterator[None]:
    """Raise AssertionError if the code inside makes more function calls."""
    calls = 0

    def count(_frame: object, event: str, _argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(None)
    assert calls <= most, f"{calls} calls"


@cache
def _cases(name: str) -> list[Case]:
    plugin: Plugin = PLUGINS[name]
    cases = [Case(plugin, options, 1, addresses_of(plugin)) for options in variants(plugin)]
    return [case for case in cases if noise.valid_frames(case)]  # some are silent by default


@cache
def _situations(name: str, number: int) -> list[Situation]:
    return list(situations(_cases(name)[number]))


def line(name: str, seed: int, count: int) -> None:
    """Feed both ends of a protocol: driver, decoder and twins, in any state. Raises what they raise."""
    random = Random(seed)
    chosen = random.randrange(len(_cases(name)))
    case = _cases(name)[chosen]
    hostile = Hostile(noise.valid_frames(case), random)
    bench = random.choice(_situations(name, chosen)).again()
    commands = [tools.build(kind, name, case.spec.ranges) for kind in case.kinds[:2] for name in tools.NAMES]
    for number in range(count):
        frame = hostile.frame()
        bench.now += random.choice((0, MILLISECOND // 8, MILLISECOND))
        size = len(frame) if isinstance(frame, bytes) else len(frame.data)
        if number % 64 == 0:
            with counted(CALLS + CALLS_PER_BYTE * size):
                _feed(bench, frame, number)
        else:
            _feed(bench, frame, number)
        if number % 16 == 0:
            given = random.choice(((), commands[:2], commands[-2:], [msg.Idle(n) for n in tools.NAMES]))
            bench.driver.send(bench.now, [each for each in given if case.kinds])
            bench.driver.due()


def _feed(bench: tools.Bench, frame: Frame, number: int) -> None:
    bench.driver.receive(bench.now, frame)
    bench.decoder.decode(bench.now, frame)
    twin = bench.twins[number % len(bench.twins)]
    twin.receive(bench.now, frame)
    if number % 8 == 0:
        at = number * 1e-3
        torques, _frames = twin.step(bench.now, [Feedback(tools.NAMES[0], bench.now, at, 1.0)])
        assert all(abs(torque.torque) < 1e6 for torque in torques), torques


@cache
def _traffic(name: str) -> dict[str, list[Frame]]:
    """Return what was sent on each bus of a robot in 0.2 s, in both directions."""
    pools: dict[str, dict[Frame, None]] = {}
    with open_session(name, simulated=True) as session:
        for tick in session.run(0.2):
            if tick.number == 10:
                bench = session.robot.name.startswith("bench")
                session.submit(msg.Velocity("left", 1.0) if bench else msg.Goal(1.0, 0.3))
            for packet in (*tick.inputs.packets, *tick.outputs.packets):
                pools.setdefault(packet.bus, {})[packet.frame] = None
    return {bus: list(pool) for bus, pool in pools.items()}


def robot(name: str, seed: int, count: int, per_step: int = 40) -> None:
    """Feed a whole gateway and a monitor, through steps of 5 ms. Raises what they raise."""
    random, robot = Random(seed), load_robot(ROBOTS[name])
    pools = {bus: Hostile(pool, random) for bus, pool in _traffic(ROBOTS[name]).items()}
    gateway = Gateway(robot)
    monitor = BusMonitor(robot.buses, of_robot(robot, robot.buses), 0, known=True)
    tasks: tuple[Callable[[], msg.Instruction], ...] = (
        lambda: msg.Goal(random.uniform(-3.0, 3.0), random.uniform(-3.0, 3.0)),
        lambda: msg.Velocity("left", 1.0),
        lambda: msg.ClearFault("all"),
        lambda: msg.Release(),
        lambda: msg.Stop("hostile"),
    )
    for step in range(count // per_step):
        now = step * robot.period
        packets = []
        for _ in range(per_step):
            bus = random.choice(list(pools))
            t = now if random.random() < 0.9 else now + random.choice((-1, 1)) * random.randrange(10**10)
            packets.append(Packet(t, bus, pools[bus].frame()))
        states = [(random.choice(list(pools)), random.choice(list(BusState)))] * (step % 97 == 0)
        given = [random.choice(tasks)()] * (step % 11 == 0)
        gateway.step(now, Inputs(tuple(states), tuple(packets), tuple(given)))
        for packet in packets:
            render.line(monitor.decode(replace(packet, t=now)))
    render.page(monitor, count * robot.period, "")
