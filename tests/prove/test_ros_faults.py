"""A robot in ROS 2's graph, 2,000 ticks, half of them under a fault of the graph: what each tick has to do
stays bounded, nothing moves that must not, and a stop comes through.

All is in one loop and in simulated time: the robot with its bridge, the process with the sockets as an
object, and other participants, on a network whose sockets lose what they have no room for. So work is counted
in messages and bytes, whatever the machine does meanwhile; how long the bridge took is printed beside it.
"""

from __future__ import annotations

import math
import random
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from itertools import count, pairwise
from typing import Any

import numpy as np
import pytest

import gateway
from brain.belief import Belief, MapView
from brain.perception.lines import TILE
from brain.perception.tiles import UNIT
from gateway.config import load_robot, parse_robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs, Tick
from gateway.ros import bridge, graph, process, trajectory, types
from gateway.ros.bridge import BYTES_IN_A_STEP, IN_A_STEP, Bridge
from gateway.ros.link import Link, Setup
from gateway.ros.process import Carrier
from gateway.ros.rtps import ports
from gateway.ros.types import make
from gateway.runtime.session import Session
from gateway.view.foxglove_map import MAX_CELLS
from gateway.view.scene import Scene
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Drive, Instruction, Nanos
from tests.gateway.ros.rig import LOG, TWIST, Peer, twist
from tests.gateway.ros.test_bridge import TRIGGER, stamped
from tests.gateway.ros.test_trajectory import message, point

TICKS, BEGINS, ENDS = 2000, 500, 1500
"""Of a run, and of the fault in it"""
TURNS = 5
"""Of the network in a tick of 5 ms"""
ROOM = 1 << 20
"""Bytes that wait in a socket, at most"""
SPEED = 0.08
"""m/s"""
NUMBER = 3
"""Domain"""
STOPS_WITHIN, STALL = 20, 60
"""Ticks from a call of the service to the tick that has it, and those that a stalled process adds"""
MAP_WITH_ROOM = MAX_CELLS + 4096
"""Bytes of the largest message"""


class Wire:
    """A socket of a simulated network: a queue with a bound."""

    def __init__(self, network: Network, port: int) -> None:
        self._network, self._port = network, port
        self._waiting: deque[tuple[bytes, tuple[str, int]]] = deque()
        self._room = ROOM
        network.wires[port] = self

    def getsockname(self) -> tuple[str, int]:
        return "127.0.0.1", self._port

    def sendto(self, data: bytes, to: tuple[str, int]) -> None:
        other = self._network.wires.get(to[1])
        if other is not None and other._room >= len(data):
            other._waiting.append((data, self.getsockname()))
            other._room -= len(data)

    def recvfrom(self, _most: int) -> tuple[bytes, tuple[str, int]]:
        if not self._waiting:
            raise BlockingIOError
        found = self._waiting.popleft()
        self._room += len(found[0])
        return found

    def close(self) -> None:
        self._network.wires.pop(self._port, None)


@dataclass
class Network:
    """All sockets, by port."""

    wires: dict[int, Wire] = field(default_factory=dict)

    def open(self, _address: str, domain: int) -> tuple[Wire, Wire]:
        for number in count():
            _, first, second = ports(domain, number)
            if first not in self.wires:
                return Wire(self, first), Wire(self, second)
        raise AssertionError


@dataclass
class Work:
    """What the bridge did in one tick."""

    read: int = 0
    """Messages"""
    read_bytes: int = 0
    made_bytes: int = 0
    largest: int = 0
    took: Nanos = 0
    """Of the processor, in the bridge"""


class World:
    """A robot, its bridge and carrier, and others, in one loop."""

    def __init__(self, session: Session, network: Network) -> None:
        self.session, self.network = session, network
        self.peers: list[Peer] = []
        self.work: list[Work] = []
        self.moments: list[Nanos] = []
        self.asked: list[list[Instruction]] = []
        """By the graph, in each tick"""
        self.speeds: list[float] = []
        """That the belief has, in each tick"""
        self.stalled = self.stall = 0
        """Turns for which the carrier's process gets no processor now, and ticks for which it does at most"""
        self.map: MapView | None = None
        ours, theirs = socket.socketpair()
        scene = Scene(session.gateway, "live", dict)
        rows = graph.rows(session.robot, steers=True)
        self.bridge = Bridge(scene, rows, Link(ours), None, "", 0)
        made = Setup(*bridge.setup(session.robot, rows, "127.0.0.1", NUMBER))
        self.carrier = Carrier(made, Link(theirs))
        self._turn: Nanos = 0
        self._ticks = session.run(poll=self._poll)
        session.watch(self._watch)

    @property
    def now(self) -> Nanos:
        """The time of everything."""
        return self.session.clock.now() + self._turn

    def join(
        self,
        *,
        clock: Callable[[], Nanos] | None = None,
        publishes: dict[str, str] | None = None,
        subscribes: dict[str, str] | None = None,
        calls: dict[str, str] | None = None,
    ) -> Peer:
        """Return another participant; `clock`: its own."""
        one = Peer(
            NUMBER,
            publishes=publishes or {},
            subscribes=subscribes or {},
            calls=calls or {},
            clock=clock or (lambda: self.now),
            sockets=self.network.open,
        )
        self.peers.append(one)
        return one

    def tick(self) -> None:
        for turn in range(TURNS):
            self._turn = turn * MILLISECOND
            for peer in self.peers:
                peer.turn()
            self.stalled = max(0, self.stalled - 1)
            if not self.stalled:
                self.carrier.turn(self.now)
        self._turn = 0
        self.work.append(Work())
        next(self._ticks)

    def _poll(self) -> Sequence[Instruction]:
        began = time.thread_time_ns()
        asked = self.bridge.poll(self.session.clock.now())
        self.work[-1].took += time.thread_time_ns() - began
        self.asked.append(asked)
        return asked

    def _watch(self, tick: Tick, belief: Belief) -> None:
        self.moments.append(tick.now)
        estimate = belief.estimate
        self.speeds.append(abs(estimate.linear) + abs(estimate.angular) if estimate else 0.0)
        believed = belief if self.map is None else replace(belief, map=self.map)
        began = time.thread_time_ns()
        self.bridge.take(tick, believed)
        self.bridge.scene.belief = believed
        self.bridge.show(tick.now)
        self.work[-1].took += time.thread_time_ns() - began

    def close(self) -> None:
        self._ticks.close()
        self.bridge.close()
        self.carrier.link.close()


@contextmanager
def world(monkeypatch: pytest.MonkeyPatch, name: str) -> Iterator[World]:
    network = Network()
    monkeypatch.setattr(process, "open_sockets", network.open)
    robot = parse_robot(f"{load_robot(name).text}\n[ros]\n")
    with (
        gateway.open_session(robot, simulated=True, seed=1) as session,
        closing(World(session, network)) as one,
    ):

        def read(type_: str, data: bytes) -> Any:
            one.work[-1].read += 1
            one.work[-1].read_bytes += len(data)
            return decode(type_, data)

        def send(link: Link, *content: Any, may_drop: bool = False) -> None:
            if link is one.bridge._link and one.work:
                size = sum(len(part) for part in content if isinstance(part, bytes))
                one.work[-1].made_bytes += size
                one.work[-1].largest = max(one.work[-1].largest, size)
            sent(link, *content, may_drop=may_drop)

        decode, sent = types.decode, Link.send
        monkeypatch.setattr(bridge, "decode", read)
        monkeypatch.setattr(Link, "send", send)
        yield one


# -- faults ---------------------------------------------------------------------------------------

Goes = Callable[[int], None]
"""Called in each tick while the fault is there, with its number"""
Begin = Callable[[World, random.Random], Goes]


def nothing(_one: World, _dice: random.Random) -> Goes:
    """Nothing: what follows is compared with this."""
    return lambda _: None


def two_publishers(one: World, _dice: random.Random) -> Goes:
    """Another publisher of /cmd_vel, faster than the first, with another speed."""
    other = one.join(publishes={"/cmd_vel": TWIST})
    return lambda _: other.publish("/cmd_vel", twist(-0.3, 1.0))


def flood(one: World, dice: random.Random) -> Goes:
    """10 kHz of twists from a second publisher; 1.6 kHz of goals that are not finite, of places that are no
    messages, and of requests of two services."""
    other = one.join(
        publishes={
            "/cmd_vel": TWIST,
            "/goal_pose": graph.POSE_STAMPED,
            "/initialpose": graph.POSE_KNOWN,
        },
        calls={
            "/diffbot/clear_faults": graph.TRIGGER,
            "/diffbot/list_parameters": graph.PARAMETERS["list_parameters"],
        },
    )
    listing = make(f"{graph.PARAMETERS['list_parameters']}_Request")

    def more(_tick: int) -> None:
        for _ in range(50):
            other.publish("/cmd_vel", twist(dice.uniform(-1.0, 1.0)))
        for _ in range(8):
            other.publish("/goal_pose", stamped(math.nan, 0.0))
            other.publish_bytes("/initialpose", dice.randbytes(dice.choice((3, 300, 5000))))
            other.call("/diffbot/clear_faults", TRIGGER)
            other.call("/diffbot/list_parameters", listing)

    return more


def large(one: World, dice: random.Random) -> Goes:
    """Messages that are far too large, of every kind that is not a stream."""
    other = one.join(publishes={"/goal_pose": graph.POSE_STAMPED, "/initialpose": graph.POSE_KNOWN})

    def more(_tick: int) -> None:
        for name in ("/goal_pose", "/initialpose"):
            other.publish_bytes(name, dice.randbytes(dice.choice((2_000, 60_000, 900_000))))

    return more


def huge_map(one: World, dice: random.Random) -> Goes:
    """A map of 16.8 million cells of which a part changes with each version, for two who take updates, one
    who does not, and one who comes and goes."""
    kinds = {"/map": "nav_msgs/msg/OccupancyGrid", "/map_updates": "map_msgs/msg/OccupancyGridUpdate"}
    for _ in range(2):
        one.join(subscribes=kinds)
    values = np.random.default_rng(dice.randrange(1000))
    tiles = {
        (y, x): values.integers(-99, 99, (TILE, TILE)).astype(np.int8) for y in range(64) for x in range(64)
    }
    one.map = MapView(1, 0.05, dict(tiles), UNIT)

    def more(tick: int) -> None:
        assert one.map is not None
        if tick % 20 == 0:
            rows, columns = dice.randrange(60), dice.randrange(60)
            for y in range(rows, rows + 4):
                tiles[y, columns] = values.integers(-99, 99, (TILE, TILE)).astype(np.int8)
            one.map = replace(one.map, version=one.map.version + 1, tiles=dict(tiles))
        if tick == 1000:
            one.join(subscribes={"/map": "nav_msgs/msg/OccupancyGrid"})

    return more


def clocks_jump(one: World, dice: random.Random) -> Goes:
    """Stamps of other centuries on what drives nobody; a participant whose clock jumps by hours, and a
    process with the sockets that gets no processor for 0.3 s."""
    jump, one.stall = [0], STALL
    other = one.join(clock=lambda: one.now + jump[0], publishes={"/cmd_vel": graph.TWIST_STAMPED})

    def more(tick: int) -> None:
        if tick % 100 == 0:
            jump[0] = dice.randrange(-3600, 3600) * SECOND
        if tick % 300 == 0:
            one.stalled = STALL * TURNS
        stamp = make("builtin_interfaces/msg/Time", sec=dice.choice((0, 1, 2**31 - 1, -(2**31))))
        header = make("std_msgs/msg/Header", stamp=stamp)
        other.publish("/cmd_vel", make(graph.TWIST_STAMPED, header=header, twist=twist(0.2)))

    return more


def killed(one: World, _dice: random.Random) -> Goes:
    """The publisher that drives is killed, without a word."""

    def more(tick: int) -> None:
        if tick == BEGINS:
            one.peers.pop(0).close()

    return more


def deaf(one: World, _dice: random.Random) -> Goes:
    """One who takes every topic of the robot, and then reads nothing any more."""
    names = {
        row.name: row.type for row in one.bridge.rows if row.kind == "publish" and "_action" not in row.name
    }
    other = one.join(subscribes=names)

    def more(tick: int) -> None:
        if tick == BEGINS + 200:
            one.peers.remove(other)

    return more


def everything(one: World, dice: random.Random) -> Goes:
    """All of it at once, but for the kill."""
    parts = [make_(one, dice) for make_ in (two_publishers, flood, large, huge_map, clocks_jump, deaf)]

    def more(tick: int) -> None:
        for part in parts:
            part(tick)

    return more


FAULTS: tuple[Begin, ...] = (
    nothing,
    two_publishers,
    flood,
    large,
    huge_map,
    clocks_jump,
    killed,
    deaf,
    everything,
)


def test_a_short_run_under_everything(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(everything, 1, 480, monkeypatch, capsys)


@pytest.mark.prove
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("begin", FAULTS)
def test_a_base_under_faults_of_the_graph(
    begin: Begin, seed: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(begin, seed, TICKS, monkeypatch, capsys)


@pytest.mark.prove
def test_what_a_step_of_twelve_joints_costs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Everything that a robot of twelve joints with a lidar publishes is taken, and a trajectory of 64 KB
    comes: processor time beside that of the steps themselves, printed; the work is counted."""
    steps, step = list[float](), Gateway.step

    def timed(gateway: Gateway, now: Nanos, inputs: Inputs) -> Outputs:
        began = time.thread_time_ns()
        made = step(gateway, now, inputs)
        steps.append((time.thread_time_ns() - began) / 1e3)
        return made

    monkeypatch.setattr(Gateway, "step", timed)
    with world(monkeypatch, "quadruped") as one:
        for _ in range(TICKS // 2):
            one.tick()
        alone, topics = sorted(steps), {r.name: r.type for r in one.bridge.rows if r.kind == "publish"}
        steps.clear()
        judge = one.join(subscribes={name: type_ for name, type_ in topics.items() if "_action" not in name})
        for _ in range(200):
            one.tick()
        one.work.clear()
        for _ in range(TICKS):
            one.tick()
        took = sorted(each.took / 1e3 for each in one.work)
        assert all(
            judge.got[name] for name in ("/odom", "/tf", "/joint_states", "/scan", "/imu/data", "/map")
        )
        assert max(each.made_bytes for each in one.work) <= MAP_WITH_ROOM
    joints = [f"j{k}" for k in range(6)]
    points = [point(0.1 * (k + 1), *[0.01 * k] * 6, velocities=(0.0,) * 6) for k in range(330)]
    data = types.encode(message(joints, *points))
    assert 40_000 < len(data) <= graph.LARGEST
    began = time.thread_time_ns()
    there = trajectory.packed(graph.TRAJECTORY, data)
    ready = time.thread_time_ns()
    read = trajectory.read(trajectory.unpacked(there)[0], joints, dict.fromkeys(joints, 0.0))
    ended = time.thread_time_ns()
    assert len(read.times) == 331
    with capsys.disabled():
        alone_, beside, own = (each[len(each) // 2] for each in (alone, sorted(steps), took))
        print(f"\na step alone {alone_:.0f} us, with all topics taken {beside:.0f}; the bridge {own:.0f},")
        most = took[len(took) * 99 // 100], took[-1]
        print(f"mean {sum(took) / len(took):.0f}, 99 % {most[0]:.0f}, at most {most[1]:.0f};")
        spans = (ready - began) / 1e3, (ended - ready) / 1e3
        print(f"{len(data)} bytes of a trajectory: {spans[0]:.0f} us outside, {spans[1]:.0f} us in a step")


def run(
    begin: Begin, seed: int, ticks: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Drive by /cmd_vel, with a fault in the middle of it, and stop in the middle of that."""
    dice = random.Random(seed)
    begins, ends = BEGINS * ticks // TICKS, ENDS * ticks // TICKS
    stops = dice.randrange((begins + ends) // 2 + 50, ends)
    with world(monkeypatch, "diffbot") as one:
        driver = one.join(publishes={"/cmd_vel": TWIST})
        judge = one.join(subscribes={"/rosout": LOG}, calls={"/diffbot/stop": graph.TRIGGER})
        goes: Goes = lambda _: None  # noqa: E731
        known = len(types.store().cache)
        for tick in range(ticks):
            if tick == begins:
                goes = begin(one, dice)
            if tick % 4 == 0:
                driver.publish("/cmd_vel", twist(SPEED))
            if begins <= tick < ends:
                goes(tick - begins + BEGINS)
            if tick == stops:
                judge.call("/diffbot/stop", TRIGGER)
            one.tick()
        check(one, begins, stops, begin)
        assert len(types.store().cache) == known, (
            "what reads and writes messages is made before the first step"
        )
        assert judge.got["/diffbot/stop"][0].success
        took = sorted(each.took / 1e3 for each in one.work)
        most = {
            name: max(getattr(each, name) for each in one.work)
            for name in ("read", "read_bytes", "made_bytes")
        }
    with capsys.disabled():
        print(
            f"\n{begin.__name__:>15} {seed}: in a tick at most {most['read']} messages, {most['read_bytes']} "
            f"bytes read, {most['made_bytes']} bytes made; the bridge took {took[ticks // 2]:.0f} us, "
            f"99 % {took[ticks * 99 // 100]:.0f}, at most {took[-1]:.0f}"
        )


def check(one: World, begins: int, stops: int, begin: Begin) -> None:
    """Hold a run against the rules."""
    steps = {later - earlier for earlier, later in pairwise(one.moments)}
    assert steps == {one.session.robot.period}, "a tick is missing"
    asked = [each for each in one.asked if each]
    assert asked, "it drove"
    stopped_at = next(i for i, each in enumerate(one.asked) if any(isinstance(x, msg.Stop) for x in each))
    assert stops <= stopped_at <= stops + STOPS_WITHIN + one.stall
    assert max(one.speeds[stopped_at + 80 :]) < 0.01
    after = [x for each in one.asked[stopped_at + 2 :] for x in each]
    assert not any(isinstance(x, Drive) and (x.linear or x.angular) for x in after)
    drives = {x.linear for each in one.asked for x in each if isinstance(x, Drive)}
    assert drives <= {SPEED, 0.0}, "another publisher drove"
    if begin is killed:
        assert max(one.speeds[begins + 220 : stops]) < 0.01, "it drove on without its publisher"
    else:
        assert min(one.speeds[begins - 20 : stopped_at]) > 0.5 * SPEED, "it did not drive on"
    for work in one.work:
        assert work.read <= IN_A_STEP + 8
        assert work.read_bytes <= BYTES_IN_A_STEP + graph.LARGEST + 8 * 2048
        assert work.largest <= MAP_WITH_ROOM
        assert work.made_bytes <= MAP_WITH_ROOM + 64 * 1024
