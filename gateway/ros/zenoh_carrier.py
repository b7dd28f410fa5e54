"""The graph of rmw_zenoh: a session of zenoh between the network and the loop's pipe. Needs the extra `ros`.

Rules. Whoever uses rmw_zenoh connects to a router at `tcp/localhost:7447`: if there is none, this session is
it, for this machine alone; else it is a peer at that one. Nothing is searched by multicast. What a thread of
zenoh has received waits in channels of bounded size, each row's own, and is read here every `POLL_S`. Samples
are sent with DROP: nothing waits for a subscriber.
"""

from __future__ import annotations

import json
import select
from collections.abc import Iterable, Sequence
from typing import Any

import zenoh
import zenoh.ext
from zenoh import ZError as ZError
from zenoh.handlers import RingChannel

from gateway.core.clock import WallClock
from gateway.ros import zenoh_keys as keys
from gateway.ros.images import BEGINS, GOES_ON, Pictures
from gateway.ros.intake import Intake, readers
from gateway.ros.link import Link, Setup, dds_type
from gateway.ros.network import zenoh_endpoint
from protocols.messages import Nanos

POLL_S = 0.002
STREAM, QUEUE, TOKENS = 64, 256, 20_000
"""What waits of a stream, of another row, and of what is told of others."""
MOST_OPEN = 200
"""Requests without an answer; then the oldest gets none."""
HEARTBEAT_S = 0.5
"""After a sample that is kept, as rmw_zenoh's: who lacks it asks for it."""
KINDS = {"publish": keys.PUBLISHES, "subscribe": keys.SUBSCRIBES, "serve": keys.SERVES}


def open_session(address: str) -> tuple[Any, str]:
    """Return a session, and where it is in words. Raises zenoh.ZError if it cannot be opened."""
    endpoint, may_route = zenoh_endpoint(address)
    if may_route:
        try:
            return zenoh.open(_config("router", listen=endpoint)), f"{endpoint}, as its router"
        except ZError:  # somebody is there: that is the router
            pass
    peer = _config("peer", listen="tcp/127.0.0.1:0", connect=endpoint)
    return zenoh.open(peer), f"{endpoint}, as a peer of the router there"


def _config(mode: str, *, listen: str, connect: str = "") -> Any:  # noqa: ANN401 -- zenoh's
    settings = {
        "mode": mode,
        "listen": {"endpoints": [listen]},
        "connect": {"endpoints": [connect] if connect else []},
        "scouting": {"multicast": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {"shared_memory": {"enabled": False}},
    }
    return zenoh.Config.from_json5(json.dumps(settings))


class _Publisher:
    """One row that we publish."""

    def __init__(self, session: Any, key: str, one: keys.Endpoint, text: str) -> None:  # noqa: ANN401
        self._gid, self._number = keys.gid(text), 0
        drop = zenoh.CongestionControl.DROP
        if one.transient:
            cache = zenoh.ext.CacheConfig(max_samples=one.depth)
            beats = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
            self._made: Any = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=drop,
                cache=cache,
                sample_miss_detection=beats,
                publisher_detection=True,
            )
        else:
            self._made = session.declare_publisher(key, congestion_control=drop)

    def put(self, stamp: Nanos, payload: bytes) -> None:
        self._number += 1
        self._made.put(payload, attachment=keys.attachment(self._number, stamp, self._gid))


class ZenohCarrier:
    """A session between the pipe and the network."""

    def __init__(self, setup: Setup, link: Link) -> None:
        self.link, self.clock = link, WallClock()
        kinds = [row[2] for row in setup.rows]
        self._intake, self._pictures = Intake(link, readers(kinds)), Pictures(kinds)
        self.session, self.where = open_session(setup.address)
        node = keys.Node(setup.domain, str(self.session.zid()), setup.namespace, setup.node)
        self._publishers: dict[int, _Publisher] = {}
        self._readers: dict[int, Any] = {}
        """Subscribers and queryables, by row"""
        self._streams: set[int] = set()
        self._keys: dict[int, str] = {}
        self._open: dict[int, tuple[Any, int, bytes]] = {}
        """Requests without an answer: the query, its number there, and whose it is"""
        self._requests = 0
        self._of_topic: dict[tuple[str, str], int] = {}
        """Rows that we publish"""
        self._takers: dict[int, set[str]] = {}
        """Tokens of their subscriptions"""
        self._tokens = [self.session.liveliness().declare_token(keys.node_token(node))]
        for row, (kind, name, type_, hash_, reliable, kept, depth) in enumerate(setup.rows):
            one = keys.Endpoint(KINDS[kind], name, dds_type(type_), hash_, reliable, kept, depth)
            self._add(row, one, keys.data_key(setup.domain, one), keys.token(node, row + 1, one))
        everything = f"{keys.ROOT}/{setup.domain}/**"
        self._graph = self.session.liveliness().declare_subscriber(
            everything, RingChannel(TOKENS), history=True
        )

    def _add(self, row: int, one: keys.Endpoint, key: str, text: str) -> None:
        self._keys[row] = key
        if one.kind == keys.PUBLISHES:
            self._publishers[row] = _Publisher(self.session, key, one, text)
            self._of_topic[one.name, one.type] = row
        elif one.kind == keys.SERVES:
            self._readers[row] = self.session.declare_queryable(key, RingChannel(QUEUE), complete=True)
        else:
            waiting = QUEUE if one.reliable else STREAM
            self._readers[row] = self.session.declare_subscriber(key, RingChannel(waiting))
            if not one.reliable:
                self._streams.add(row)
        self._tokens.append(self.session.liveliness().declare_token(text))

    def run(self) -> None:
        """Carry, until the pipe is closed."""
        while not self.link.closed:
            select.select([self.link], [self.link] * self.link.waiting, [], POLL_S)
            self.turn(self.clock.now())
        self.session.close()

    def turn(self, now: Nanos) -> None:
        """Do what there is to do."""
        self.take(now, self.link.receive())
        self._look()
        for row, reader in self._readers.items():
            while (found := reader.try_recv()) is not None:
                if row in self._streams:
                    self._intake.stream(row, bytes(found.payload), _whose(found)[1])
                elif isinstance(found, zenoh.Query):
                    self._ask(row, found)
                else:
                    self._intake.sample(row, bytes(found.payload), _whose(found)[1])
        self._intake.turn(now)
        self.link.flush()

    def take(self, now: Nanos, messages: Iterable[Sequence[Any]]) -> None:
        """Do what the loop asks."""
        for kind, row, payload, *rest in messages:
            stamp = now + self.clock.system_offset()
            if kind == "publish":
                self._publishers[row].put(stamp, payload)
            elif kind in (BEGINS, GOES_ON):
                if (whole := self._pictures.take(kind, row, payload, *rest)) is not None:
                    self._publishers[row].put(stamp, whole)
            elif kind == "answer" and (found := self._open.pop(rest[0][0], None)) is not None:
                query, number, client = found
                query.reply(self._keys[row], payload, attachment=keys.attachment(number, stamp, client))
                query.drop()

    def _ask(self, row: int, query: Any) -> None:  # noqa: ANN401 -- zenoh's
        self._requests += 1
        payload = bytes(query.payload) if query.payload is not None else b""
        if not self._intake.request(row, payload, [self._requests]):
            query.drop()
            return
        while len(self._open) >= MOST_OPEN:
            self._open.pop(next(iter(self._open)))[0].drop()
        self._open[self._requests] = (query, *_whose(query))

    def _look(self) -> None:
        """Count who takes what we publish."""
        changed = set[int]()
        while (found := self._graph.try_recv()) is not None:
            text = str(found.key_expr)
            what = keys.subscribed(text)
            row = self._of_topic.get(what) if what is not None else None
            if row is None:
                continue
            takers = self._takers.setdefault(row, set())
            (takers.add if found.kind == zenoh.SampleKind.PUT else takers.discard)(text)
            changed.add(row)
        for row in sorted(changed):
            self.link.send("match", row, len(self._takers[row]))


def _whose(one: Any) -> tuple[int, bytes]:  # noqa: ANN401 -- zenoh's
    """Return the number of a sample or request, and who sent it; of one without that: 0, and nobody."""
    found = None if one.attachment is None else keys.read_attachment(bytes(one.attachment))
    return found or (0, bytes(16))
