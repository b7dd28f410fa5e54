"""A robot in simulated time with its bridge, and a participant of the same graph, in one loop."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import gateway
from brain.belief import Belief
from gateway.config import load_robot, parse_robot
from gateway.core.tick import Tick
from gateway.ros import graph, types
from gateway.ros.bridge import Bridge, open_bridge
from gateway.ros.link import dds_type
from gateway.ros.process import open_sockets
from gateway.ros.rtps import Endpoint, Participant, Qos, Sample, ports
from gateway.ros.rtps_wire import Identity, Locator
from gateway.runtime.session import Session
from gateway.view.scene import Scene
from protocols.messages import Instruction, Nanos
from tests.gateway.processes import PATIENCE
from tests.gateway.ros.judged import domain


class Peer:
    """Another participant: a publisher, subscriber or client of each of these names, with its type."""

    def __init__(
        self,
        number: int,
        *,
        publishes: dict[str, str],
        subscribes: dict[str, str],
        calls: dict[str, str],
        clock: Callable[[], Nanos] = time.monotonic_ns,
        sockets: Callable[[str, int], Sequence[Any]] = open_sockets,
    ) -> None:
        self._clock = clock
        endpoints = [Endpoint(f"rt{name}", dds_type(kind), True, Qos()) for name, kind in publishes.items()]
        endpoints += [
            Endpoint(f"rt{name}", dds_type(kind), False, Qos()) for name, kind in subscribes.items()
        ]
        for name, kind in calls.items():
            endpoints.append(Endpoint(f"rq{name}Request", dds_type(f"{kind}_Request"), True, Qos()))
            endpoints.append(Endpoint(f"rr{name}Reply", dds_type(f"{kind}_Response"), False, Qos()))
        self._sockets = sockets("127.0.0.1", number)
        where = [Locator(*one.getsockname()) for one in self._sockets]
        targets = [Locator("127.0.0.1", ports(number, i)[1]) for i in range(8)]
        self.participant = Participant(os.urandom(12), number, where[0], where[1], endpoints, targets)
        self._index = {one.topic: i for i, one in enumerate(endpoints)}
        self._types = {f"rt{n}": k for n, k in subscribes.items()} | {
            f"rr{n}Reply": f"{k}_Response" for n, k in calls.items()
        }
        self.matched: dict[str, int] = {}
        self.got: dict[str, list[Any]] = {one: [] for one in [*subscribes, *calls]}
        """Messages by topic, answers by service."""

    def publish(self, name: str, message: Any) -> None:
        self.publish_bytes(name, types.encode(message))

    def publish_bytes(self, name: str, data: bytes) -> None:
        self.participant.publish(self._clock(), self._index[f"rt{name}"], data)

    def call(self, name: str, request: Any) -> None:
        """Call a service as Fast DDS does: the identity names the reader of the answer."""
        reader = self.participant.guid(self._index[f"rr{name}Reply"])
        writer = self._index[f"rq{name}Request"]
        now = self._clock()
        made = self.participant._mine[writer]
        self.participant._publish(now, made, types.encode(request), Identity(reader, 0))  # type: ignore[arg-type]

    def turn(self) -> None:
        now = self._clock()
        self.participant.step(now)
        for to, data in self.participant.outgoing():
            self._sockets[1].sendto(data, to)
        for one in self._sockets:
            while True:
                try:
                    data, (host, _) = one.recvfrom(65536)
                except BlockingIOError:
                    break
                for sample in self.participant.receive(now, data, host):
                    self._take(sample)
        for match in self.participant.matches():
            self.matched[self.participant.endpoints[match.endpoint].topic] = match.others

    def _take(self, sample: Sample) -> None:
        topic = self.participant.endpoints[sample.endpoint].topic
        name = topic[2:].removesuffix("Reply") if topic.startswith("rr") else topic[2:]
        self.got[name].append(types.decode(self._types[topic], sample.payload))

    def close(self) -> None:
        for one in self._sockets:
            one.close()


class Rig:
    """All of it. A tick is 5 ms of the robot's time, by which what is held times out, too."""

    def __init__(self, session: Session, bridge: Bridge) -> None:
        self.session, self.bridge = session, bridge
        self.peers: list[Peer] = []
        self.number = domain()
        self.persons: list[Instruction] = []
        self.asked: list[Instruction] = []
        """By the graph."""
        self.most = 0
        """Instructions of the graph in one tick, at most."""
        self._ticks = session.run(poll=self._poll)
        session.watch(self._watch)

    def join(
        self,
        each: Callable[[], None] | None = None,
        *,
        publishes: dict[str, str] | None = None,
        subscribes: dict[str, str] | None = None,
        calls: dict[str, str] | None = None,
    ) -> Peer:
        peer = Peer(self.number, publishes=publishes or {}, subscribes=subscribes or {}, calls=calls or {})
        self.peers.append(peer)
        matched = lambda: len(peer.matched) == len(peer.participant.endpoints)  # noqa: E731
        self.until(matched, "a match of everything", each)
        return peer

    def _poll(self) -> Sequence[Instruction]:
        persons, self.persons = self.persons, []
        asked = self.bridge.poll(self.session.clock.now(), persons)
        self.asked += asked
        self.most = max(self.most, len(asked))
        return [*persons, *asked]

    def _watch(self, tick: Tick, belief: Belief) -> None:
        self.bridge.take(tick, belief)
        self.bridge.show(tick.now)

    def run(self, ticks: int = 1, each: Callable[[], None] | None = None) -> None:
        for _ in range(ticks):
            if each is not None:
                each()
            for peer in self.peers:
                peer.turn()
            next(self._ticks)

    def until(self, condition: Callable[[], Any], what: str, each: Callable[[], None] | None = None) -> Any:
        end = time.monotonic() + PATIENCE
        while not (found := condition()):
            assert time.monotonic() < end, f"{what} did not come about"
            self.run(1, each)
        return found

    def ready(self) -> None:
        self.until(lambda: self.session.belief.state.value == "ready", "a robot that is ready")


@contextmanager
def rig(name: str, settings: str = "", perceives: str = "") -> Iterator[Rig]:
    """`settings`: of the table [ros]; `perceives`: of [brain.perception]."""
    text = load_robot(name).text.replace("[brain.perception]\n", f"[brain.perception]\n{perceives}\n")
    robot = parse_robot(f"{text}\n[ros]\n{settings}\n")
    with gateway.open_session(robot, simulated=True, seed=1) as session:
        bridge = open_bridge(Scene(session.gateway, "live", dict), "127.0.0.1", domain(), 0)
        made = Rig(session, bridge)
        try:
            with closing(made._ticks):
                yield made
        finally:
            bridge.close()
            for peer in made.peers:
                peer.close()


TWIST, ARRAY, LOG = graph.TWIST, graph.ARRAY, "rcl_interfaces/msg/Log"


def twist(x: float = 0.0, z: float = 0.0) -> Any:
    vector = "geometry_msgs/msg/Vector3"
    return types.make(TWIST, linear=types.make(vector, x=x), angular=types.make(vector, z=z))
