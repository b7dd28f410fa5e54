"""A participant of DDS: discovery, and endpoints that match, repeat and acknowledge. No socket, no clock.

Datagrams go in with the time and where they come from, and come out of `outgoing`; `step` does what is due.
Endpoints are known from the start and stay. What is not here: keys (ROS 2 has none), content filters,
deadlines, liveliness other than a participant's, security.

Rules. A writer never waits: it keeps its newest samples, and who asks for an older one is told that there is
none. Everything that others send is bounded: participants, endpoints, samples that wait for an earlier one,
fragments. Data go to the address that a participant's discovery came from, at the ports that it names: so
what listens on this machine alone sends to this machine alone, whatever others announce.

Source: OMG formal/2021-03-03 (RTPS 2.3), chapters 8.4 (endpoints) and 8.5 (discovery), table 9.8 (ports).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.ros import rtps_wire as wire
from gateway.ros.rtps_wire import (
    Acknack,
    Data,
    Entity,
    Fragment,
    Gap,
    Guid,
    Heartbeat,
    Identity,
    Locator,
    NackFragments,
    Prefix,
    Received,
)
from protocols.messages import MILLISECOND, SECOND, Nanos

ANNOUNCEMENT: Nanos = SECOND
"""Between two announcements of ourselves."""
LEASE_S = 10.0
"""After which others forget who is not heard of."""
LONGEST_LEASE: Nanos = 60 * SECOND
HEARTBEAT: Nanos = 100 * MILLISECOND
"""Between two heartbeats to a reader that lacks something."""
REPLY_TIMEOUT: Nanos = 2 * SECOND
"""How long a reply waits for its client's reader to be discovered."""
FRAGMENT = 16_384
"""Bytes of a fragment; a larger sample goes out in several datagrams,"""
FRAGMENTS_AT_ONCE = 4
"""so many of which are sent in one step."""
MOST_PARTICIPANTS, MOST_ENDPOINTS = 100, 5000
MOST_WAITING, MOST_SAMPLE = 64, 1 << 20
"""Samples of a writer that wait for an earlier one; bytes of a sample that is put together."""
RESENT = 32
"""Samples that are sent again for one request."""

PARTICIPANT: Entity = bytes.fromhex("000001c1")
SPDP_WRITER, SPDP_READER = bytes.fromhex("000100c2"), bytes.fromhex("000100c7")
PUBLICATIONS = bytes.fromhex("000003c2"), bytes.fromhex("000003c7")
SUBSCRIPTIONS = bytes.fromhex("000004c2"), bytes.fromhex("000004c7")
BUILTIN = 0x3F
"""We announce participants, publications and subscriptions, and listen to announcements of these."""
MULTICAST = "239.255.0.1"
EVERYBODY = bytes(12)


def ports(domain: int, participant: int) -> tuple[int, int, int]:
    """Return the ports of discovery by multicast, of discovery, and of data."""
    base = 7400 + 250 * domain
    return base, base + 10 + 2 * participant, base + 11 + 2 * participant


@dataclass(frozen=True, slots=True)
class Qos:
    """What a writer offers, or a reader wants."""

    reliable: bool = True
    transient: bool = False
    """Whether who comes later gets the newest samples, too"""
    depth: int = 10


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One of ours."""

    topic: str
    """As DDS has it: "rt/odom"""
    type: str
    writes: bool
    qos: Qos
    user_data: bytes = b""


class Sample(NamedTuple):
    """What came for one of our readers."""

    endpoint: int
    """Its place among ours"""
    payload: bytes
    identity: Identity
    related: Identity | None


class Match(NamedTuple):
    """How many endpoints of others match one of ours."""

    endpoint: int
    others: int


@dataclass(slots=True)
class _Change:
    number: int
    payload: bytes
    related: Identity | None = None
    ends: bool = False
    key: bytes = b""


@dataclass(slots=True, eq=False)
class _Other:
    """A reader that one of our writers writes to."""

    guid: Guid
    to: Locator
    reliable: bool
    first: int
    """The first number that concerns it"""
    acknowledged: int
    asked_at: Nanos = 0
    """When it was last sent a heartbeat"""


@dataclass(slots=True, eq=False)
class _Writer:
    entity: Entity
    qos: Qos
    index: int = -1
    number: int = 0
    count: int = 0
    history: deque[_Change] = field(default_factory=deque)
    readers: dict[Guid, _Other] = field(default_factory=dict)

    def heartbeat(self, reader: _Other, *, final: bool = False) -> bytes:
        self.count += 1
        oldest = self.history[0].number if self.history else self.number + 1
        first = min(max(oldest, reader.first), self.number + 1)
        return wire.write(
            Heartbeat(reader.guid[12:], self.entity, first, self.number, self.count & 0x7FFFFFFF, final)
        )


@dataclass(slots=True)
class _Parts:
    """A sample that is put together."""

    data: bytearray
    left: set[int]
    related: Identity | None


@dataclass(slots=True, eq=False)
class _Source:
    """A writer that one of our readers reads from."""

    guid: Guid
    to: Locator
    reliable: bool
    next: int = 1
    heartbeats: int = -1
    count: int = 0
    waiting: dict[int, tuple[bytes, Identity | None] | None] = field(default_factory=dict)
    """By number; None: no sample for us"""
    parts: dict[int, _Parts] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class _Reader:
    entity: Entity
    qos: Qos
    index: int = -1
    writers: dict[Guid, _Source] = field(default_factory=dict)


@dataclass(slots=True)
class _Peer:
    """Another participant."""

    prefix: Prefix
    discovery: Locator
    data: Locator
    lease: Nanos
    heard: Nanos
    endpoints: set[Guid] = field(default_factory=set)


class _Pending(NamedTuple):
    until: Nanos
    writer: _Writer
    payload: bytes
    related: Identity | None
    client: Guid
    """Its reader, or any endpoint of its participant"""
    exact: bool


class Participant:
    """One participant.

    Args:
        prefix: 12 bytes that nobody else has.
        domain: 0 to 232.
        discovery: where it listens for discovery,
        data: and for data.
        endpoints: its own; `Sample.endpoint` is the place of one here.
        targets: where it announces itself, beside those that it knows.
        user_data: that others see of it.
    """

    def __init__(
        self,
        prefix: Prefix,
        domain: int,
        discovery: Locator,
        data: Locator,
        endpoints: Sequence[Endpoint],
        targets: Sequence[Locator],
        user_data: bytes = b"enclave=/;",
    ) -> None:
        self.prefix, self.endpoints = prefix, tuple(endpoints)
        self._domain, self._discovery, self._data = domain, discovery, data
        self._targets, self._user_data = tuple(targets), user_data
        self._announced: Nanos | None = None
        self._looked: Nanos = 0
        self._peers: dict[Prefix, _Peer] = {}
        self._out: list[tuple[Locator, bytes]] = []
        self._large: deque[tuple[Locator, bytes]] = deque()
        self._pending: list[_Pending] = []
        self._matches: dict[int, int] = {}
        kept = Qos(transient=True, depth=len(self.endpoints) + 1)
        self._publications = _Writer(PUBLICATIONS[0], kept)
        self._subscriptions = _Writer(SUBSCRIPTIONS[0], kept)
        builtin = (self._publications, self._subscriptions)
        self._writers = {one.entity: one for one in builtin}
        self._readers = {entity: _Reader(entity, Qos()) for entity in (PUBLICATIONS[1], SUBSCRIPTIONS[1])}
        self._by_writer: dict[Guid, list[tuple[_Reader, _Source]]] = {}
        self._mine: dict[int, _Writer | _Reader] = {}
        self._by_topic: dict[tuple[str, str, bool], list[int]] = {}
        for index, one in enumerate(self.endpoints):
            self._add(index, one)

    def _add(self, index: int, one: Endpoint) -> None:
        entity = (index + 1).to_bytes(3, "big") + (b"\x03" if one.writes else b"\x04")
        if one.writes:
            self._mine[index] = self._writers[entity] = _Writer(entity, one.qos, index)
        else:
            self._mine[index] = self._readers[entity] = _Reader(entity, one.qos, index)
        self._by_topic.setdefault((one.topic, one.type, one.writes), []).append(index)
        announcer = self._publications if one.writes else self._subscriptions
        self._append(announcer, self._described(one, entity), None)

    def _described(self, one: Endpoint, entity: Entity) -> bytes:
        reliability = (2 if one.qos.reliable else 1).to_bytes(4, "little") + wire.duration(0.1)
        depth = one.qos.depth.to_bytes(4, "little")
        parameters = [
            (wire.ENDPOINT_GUID, self.prefix + entity),
            (wire.PARTICIPANT_GUID, self.prefix + PARTICIPANT),
            (_TOPIC, wire.string(one.topic)),
            (_TYPE, wire.string(one.type)),
            (_RELIABILITY, reliability),
            (_DURABILITY, bytes((one.qos.transient, 0, 0, 0))),
            (_HISTORY, bytes(4) + depth),
            (_UNICAST, wire.locator(self._data)),
            (_REPRESENTATION, (1).to_bytes(4, "little") + bytes(4)),
        ]
        if one.user_data:
            parameters.append((_USER_DATA, wire.octets(one.user_data)))
        return wire.parameter_list(parameters)

    def guid(self, index: int | None = None) -> Guid:
        """Return that of an endpoint of ours, or of the participant."""
        return self.prefix + (PARTICIPANT if index is None else self._mine[index].entity)

    # -- what goes out ----------------------------------------------------------------------------

    def outgoing(self) -> list[tuple[Locator, bytes]]:
        """Return datagrams to be sent, with where to; of large samples some."""
        found, self._out = self._out, []
        for _ in range(min(FRAGMENTS_AT_ONCE, len(self._large))):
            found.append(self._large.popleft())
        return found

    @property
    def busy(self) -> bool:
        """Whether there are more datagrams to be sent."""
        return bool(self._large or self._out)

    def publish(self, now: Nanos, index: int, payload: bytes) -> None:
        """Write a sample, with its encapsulation."""
        writer = self._mine[index]
        assert isinstance(writer, _Writer), "readers publish nothing"
        self._publish(now, writer, payload, None)

    def reply(
        self, now: Nanos, index: int, payload: bytes, related: Identity | None, client: Guid, *, exact: bool
    ) -> None:
        """Write a reply once its client's reader is known: that reader, or any of its participant."""
        writer = self._mine[index]
        assert isinstance(writer, _Writer), "readers publish nothing"
        pending = _Pending(now + REPLY_TIMEOUT, writer, payload, related, client, exact)
        if not self._answered(now, pending) and len(self._pending) < MOST_WAITING:
            self._pending.append(pending)

    def _answered(self, now: Nanos, one: _Pending) -> bool:
        readers = one.writer.readers
        known = one.client in readers if one.exact else any(g[:12] == one.client[:12] for g in readers)
        if known:
            self._publish(now, one.writer, one.payload, one.related)
        return known

    def _append(self, writer: _Writer, payload: bytes, related: Identity | None) -> _Change:
        writer.number += 1
        change = _Change(writer.number, payload, related)
        writer.history.append(change)
        while len(writer.history) > writer.qos.depth:
            writer.history.popleft()
        return change

    def _publish(self, now: Nanos, writer: _Writer, payload: bytes, related: Identity | None) -> None:
        change = self._append(writer, payload, related)
        for reader in writer.readers.values():
            self._send(writer, reader, change)
            reader.asked_at = now

    def _send(self, writer: _Writer, reader: _Other, change: _Change) -> None:
        """Send a sample to a reader, with a heartbeat."""
        to, entity = reader.guid[:12], reader.guid[12:]
        beat = [writer.heartbeat(reader)] if reader.reliable else []
        if len(change.payload) <= FRAGMENT:
            data = wire.write(
                Data(
                    entity,
                    writer.entity,
                    change.number,
                    change.payload,
                    change.related,
                    change.ends,
                    change.key,
                )
            )
            self._out.append((reader.to, wire.datagram(self.prefix, to, [data, *beat])))
            return
        for number in range(1, -(-len(change.payload) // FRAGMENT) + 1):
            self._send_fragment(writer, reader, change, number)
        self._large += [(reader.to, wire.datagram(self.prefix, to, beat))] if beat else []

    def _send_fragment(self, writer: _Writer, reader: _Other, change: _Change, number: int) -> None:
        if (number - 1) * FRAGMENT >= len(change.payload) or number < 1:
            return
        part = change.payload[(number - 1) * FRAGMENT : number * FRAGMENT]
        fragment = Fragment(
            reader.guid[12:], writer.entity, change.number, number, 1, FRAGMENT, len(change.payload), part,
            change.related,
        )  # fmt: skip
        self._large.append((reader.to, wire.datagram(self.prefix, reader.guid[:12], [wire.write(fragment)])))

    # -- time ---------------------------------------------------------------------------------------

    def step(self, now: Nanos) -> None:
        """Do what is due: announce, ask readers that lack something, forget who is gone."""
        if self._announced is None or now - self._announced >= ANNOUNCEMENT:
            self._announced = now
            self._announce([*self._targets, *(one.discovery for one in self._peers.values())])
            for peer in [one for one in self._peers.values() if now - one.heard > one.lease]:
                self._forget(peer)
        self._pending = [one for one in self._pending if one.until > now and not self._answered(now, one)]
        if now - self._looked >= HEARTBEAT // 4:
            self._looked = now
            self._ask_readers(now)

    def _ask_readers(self, now: Nanos) -> None:
        if len(self._large) > 4 * FRAGMENTS_AT_ONCE:  # what they lack is on its way
            return
        for writer in self._writers.values():
            for reader in writer.readers.values():
                lacks = reader.reliable and reader.acknowledged < writer.number
                if lacks and now - reader.asked_at >= HEARTBEAT:
                    reader.asked_at = now
                    self._beat(writer, reader)

    def _beat(self, writer: _Writer, reader: _Other) -> None:
        self._out.append(
            (reader.to, wire.datagram(self.prefix, reader.guid[:12], [writer.heartbeat(reader)]))
        )

    def _announce(self, targets: Sequence[Locator], *, ends: bool = False) -> None:
        guid = self.prefix + PARTICIPANT
        payload = b"" if ends else wire.parameter_list([
            (0x0015, wire.VERSION), (0x0016, wire.VENDOR), (wire.PARTICIPANT_GUID, guid),
            (_DISCOVERY, wire.locator(self._discovery)), (_DATA, wire.locator(self._data)),
            (_LEASE, wire.duration(LEASE_S)), (_BUILTIN, BUILTIN.to_bytes(4, "little")),
            (_DOMAIN, self._domain.to_bytes(4, "little")), (_USER_DATA, wire.octets(self._user_data)),
        ])  # fmt: skip
        data = wire.write(
            Data(SPDP_READER, SPDP_WRITER, 2 if ends else 1, payload, None, ends, guid if ends else b"")
        )
        for target in dict.fromkeys(targets):
            self._out.append((target, wire.datagram(self.prefix, EVERYBODY, [data])))

    def leave(self) -> None:
        """Announce that it is gone."""
        self._announce([*self._targets, *(one.discovery for one in self._peers.values())], ends=True)

    # -- what comes in --------------------------------------------------------------------------------

    def receive(self, now: Nanos, datagram: bytes, host: str) -> list[Sample]:
        """Return the samples that a datagram brings. Never raises."""
        found: list[Sample] = []
        for received in wire.read(datagram):
            if received.source == self.prefix or received.destination not in (EVERYBODY, self.prefix):
                continue
            if isinstance(received.content, Data) and received.content.writer == SPDP_WRITER:
                self._on_participant(now, received.content, host)
            elif received.source in self._peers:
                found += self._on(now, received)
        return found

    def matches(self) -> list[Match]:
        """Return what matches now, of what has changed since the last call."""
        found = [Match(index, count) for index, count in self._matches.items()]
        self._matches.clear()
        return found

    def _on(self, now: Nanos, received: Received) -> list[Sample]:
        one, source = received.content, received.source
        if isinstance(one, Acknack | NackFragments):
            writer = self._writers.get(one.writer)
            reader = writer.readers.get(source + one.reader) if writer is not None else None
            if writer is not None and reader is not None:
                self._on_request(now, writer, reader, one)
            return []
        found: list[Sample] = []
        for reader_, from_ in self._by_writer.get(source + one.writer, ()):
            if one.reader in (wire.UNKNOWN, reader_.entity):
                found += self._on_sample(now, reader_, from_, one)
        return found

    def _on_request(self, now: Nanos, writer: _Writer, reader: _Other, one: Acknack | NackFragments) -> None:
        """Send a reader again what it lacks, or that there is none."""
        history = {change.number: change for change in writer.history if change.number >= reader.first}
        if isinstance(one, NackFragments):
            if (change := history.get(one.number)) is not None and len(self._large) < 256:
                for number in one.missing:
                    self._send_fragment(writer, reader, change, number)
            return
        reader.acknowledged = max(reader.acknowledged, min(one.base - 1, writer.number))
        gone: list[int] = []
        for number in one.missing:
            if number in history:
                large = len(history[number].payload) > FRAGMENT
                if number - one.base < RESENT and not (large and self._large):
                    self._send(writer, reader, history[number])
                    reader.asked_at = now
            elif 0 < number <= writer.number:
                gone.append(number)
        if gone:
            gap = Gap(reader.guid[12:], writer.entity, gone[0], gone[0] + 1, tuple(gone[1:]))
            parts = [wire.write(gap), writer.heartbeat(reader)]
            self._out.append((reader.to, wire.datagram(self.prefix, reader.guid[:12], parts)))
        elif not one.missing and one.base <= writer.number:  # it has just begun to listen
            reader.asked_at = now
            self._beat(writer, reader)

    def _on_sample(
        self, now: Nanos, reader: _Reader, source: _Source, one: Data | Fragment | Heartbeat | Gap
    ) -> list[Sample]:
        match one:
            case Data():
                return self._take(now, reader, source, one.number, (one.payload, one.related), one)
            case Fragment():
                whole = _put_together(source, one)
                if whole is not None:
                    return self._take(now, reader, source, one.number, whole, None)
            case Gap() if source.reliable:
                if one.start <= source.next < one.base:
                    source.next = one.base
                begin = max(one.start, source.next)
                for number in (*range(begin, min(one.base, begin + MOST_WAITING)), *one.others):
                    if number >= source.next and len(source.waiting) < MOST_WAITING:
                        source.waiting.setdefault(number, None)
                return self._deliver(now, reader, source)
            case Heartbeat() if source.reliable and one.serial != source.heartbeats:
                source.heartbeats = one.serial
                source.next = max(source.next, one.first)
                found = self._deliver(now, reader, source)
                self._acknowledge(reader, source, one)
                return found
        return []

    def _acknowledge(self, reader: _Reader, source: _Source, one: Heartbeat) -> None:
        last = min(one.last, source.next + wire.MOST_BITS - 1)
        missing = tuple(n for n in range(source.next, last + 1) if n not in source.waiting)
        if one.final and not missing:
            return
        source.count += 1
        ack = Acknack(reader.entity, source.guid[12:], source.next, missing, source.count)
        self._out.append((source.to, wire.datagram(self.prefix, source.guid[:12], [wire.write(ack)])))

    def _take(
        self,
        now: Nanos,
        reader: _Reader,
        source: _Source,
        number: int,
        sample: tuple[bytes, Identity | None],
        whole: Data | None,
    ) -> list[Sample]:
        if whole is not None and (whole.ends or not whole.payload):
            if reader.index < 0 and len(whole.key) == wire.GUID:
                self._remove(whole.key)
            if not source.reliable:
                return []
            source.waiting[number] = None
            return self._deliver(now, reader, source)
        if not source.reliable:
            if number < source.next:
                return []
            source.next = number + 1
            return self._sample(now, reader, source, number, *sample)
        if number >= source.next and (number == source.next or len(source.waiting) < MOST_WAITING):
            source.waiting[number] = sample
        return self._deliver(now, reader, source)

    def _deliver(self, now: Nanos, reader: _Reader, source: _Source) -> list[Sample]:
        """Return what comes next, in order."""
        found: list[Sample] = []
        for number in [one for one in source.waiting if one < source.next]:
            del source.waiting[number]
        while source.next in source.waiting:
            number, source.next = source.next, source.next + 1
            sample = source.waiting.pop(number)
            if sample is not None:
                found += self._sample(now, reader, source, number, *sample)
        return found

    def _sample(
        self,
        now: Nanos,
        reader: _Reader,
        source: _Source,
        number: int,
        payload: bytes,
        related: Identity | None,
    ) -> list[Sample]:
        if reader.index >= 0:
            return [Sample(reader.index, payload, Identity(source.guid, number), related)]
        self._on_endpoint(now, dict(wire.read_parameters(payload)), writes=reader.entity == PUBLICATIONS[1])
        return []

    # -- discovery ------------------------------------------------------------------------------------

    def _on_participant(self, now: Nanos, one: Data, host: str) -> None:
        parameters = dict(wire.read_parameters(one.payload))
        guid = parameters.get(wire.PARTICIPANT_GUID, one.key)
        prefix = guid[:12]
        if len(guid) != wire.GUID or prefix == self.prefix:
            return
        if one.ends:
            if prefix in self._peers:
                self._forget(self._peers[prefix])
            return
        if parameters.get(_DOMAIN, self._domain.to_bytes(4, "little")) != self._domain.to_bytes(4, "little"):
            return
        known = self._peers.get(prefix)
        if known is not None:
            known.heard = now
            return
        discovery, data = (wire.read_locator(parameters.get(pid, b"")) for pid in (_DISCOVERY, _DATA))
        if discovery is None or len(self._peers) >= MOST_PARTICIPANTS:
            return
        lease = wire.read_duration(parameters.get(_LEASE, b""))
        peer = self._peers[prefix] = _Peer(
            prefix,
            Locator(host, discovery.port),
            Locator(host, (data or discovery).port),
            min(LONGEST_LEASE, round(min(lease, 1e6) * SECOND)),
            now,
        )
        self._announce([peer.discovery])
        has = int.from_bytes(parameters.get(_BUILTIN, b"")[:4], "little")
        for (writer, reader), bit in ((PUBLICATIONS, 2), (SUBSCRIPTIONS, 4)):
            if has >> (bit + 1) & 1:
                other = _Other(prefix + reader, peer.discovery, True, 1, 0, now)
                self._writers[writer].readers[other.guid] = other
                self._beat(self._writers[writer], other)
            if has >> bit & 1:
                self._listen(self._readers[reader], prefix + writer, peer.discovery, reliable=True)

    def _listen(self, reader: _Reader, guid: Guid, to: Locator, *, reliable: bool) -> None:
        source = reader.writers[guid] = _Source(guid, to, reliable)
        self._by_writer.setdefault(guid, []).append((reader, source))
        if reliable:  # it has nothing yet
            self._acknowledge(reader, source, Heartbeat(reader.entity, guid[12:], 1, 0, 0, False))

    def _on_endpoint(self, now: Nanos, found: Mapping[int, bytes], *, writes: bool) -> None:
        """Match what somebody announces with our own."""
        guid = found.get(wire.ENDPOINT_GUID, b"")
        peer = self._peers.get(guid[:12])
        if len(guid) != wire.GUID or peer is None:
            return
        self._remove(guid)
        topic, type_ = (wire.read_string(found.get(pid, b"")) for pid in (_TOPIC, _TYPE))
        reliability, durability = found.get(_RELIABILITY, b""), found.get(_DURABILITY, b"")
        reliable = reliability[:1] not in (b"", b"\x01") if reliability else writes
        transient = durability[:1] not in (b"", b"\x00")
        unicast = wire.read_locator(found.get(_UNICAST, b""))
        to = peer.data if unicast is None else Locator(peer.data.host, unicast.port)
        if sum(len(one.endpoints) for one in self._peers.values()) >= MOST_ENDPOINTS:
            return
        for index in self._by_topic.get((topic, type_, not writes), ()):
            mine = self._mine[index]
            theirs = Qos(reliable, transient)
            offered, wanted = (theirs, mine.qos) if writes else (mine.qos, theirs)
            if (wanted.reliable and not offered.reliable) or (wanted.transient and not offered.transient):
                continue
            peer.endpoints.add(guid)
            if isinstance(mine, _Writer):
                first = 1 if transient and mine.qos.transient else mine.number + 1
                other = mine.readers[guid] = _Other(guid, to, reliable, first, first - 1, now)
                if reliable:
                    self._beat(mine, other)
                self._matches[index] = len(mine.readers)
            else:
                self._listen(mine, guid, to, reliable=wanted.reliable)
                self._matches[index] = len(mine.writers)

    def _remove(self, guid: Guid) -> None:
        """Forget an endpoint of another participant, if it is known."""
        for writer in self._writers.values():
            if writer.readers.pop(guid, None) is not None and writer.index >= 0:
                self._matches[writer.index] = len(writer.readers)
        for reader, _ in self._by_writer.pop(guid, ()):
            reader.writers.pop(guid, None)
            if reader.index >= 0:
                self._matches[reader.index] = len(reader.writers)

    def _forget(self, peer: _Peer) -> None:
        del self._peers[peer.prefix]
        for guid in self._guids_of(peer.prefix):
            self._remove(guid)
        self._pending = [one for one in self._pending if one.client[:12] != peer.prefix]
        self._large = deque(one for one in self._large if one[0] not in (peer.discovery, peer.data))

    def _guids_of(self, prefix: Prefix) -> Iterator[Guid]:
        known = {guid for writer in self._writers.values() for guid in writer.readers} | set(self._by_writer)
        return (guid for guid in known if guid[:12] == prefix)


_TOPIC, _TYPE, _RELIABILITY, _DURABILITY, _HISTORY = 0x0005, 0x0007, 0x001A, 0x001D, 0x0040
_UNICAST, _REPRESENTATION, _USER_DATA = 0x002F, 0x0073, 0x002C
_DISCOVERY, _DATA, _LEASE, _BUILTIN, _DOMAIN = 0x0032, 0x0031, 0x0002, 0x0058, 0x000F


def _put_together(source: _Source, one: Fragment) -> tuple[bytes, Identity | None] | None:
    """Keep some fragments; return the sample once it is whole."""
    count = -(-one.total // one.size) if one.size else 0
    if not 0 < one.total <= MOST_SAMPLE or not 1 <= one.first <= count or one.number < source.next:
        return None
    parts = source.parts.get(one.number)
    if parts is None:
        while len(source.parts) >= 4:
            del source.parts[min(source.parts)]
        parts = source.parts[one.number] = _Parts(bytearray(one.total), set(range(1, count + 1)), one.related)
    if len(parts.data) != one.total:
        return None
    at = (one.first - 1) * one.size
    payload = one.payload[: min(one.parts * one.size, one.total - at)]
    parts.data[at : at + len(payload)] = payload
    parts.left.difference_update(range(one.first, min(one.first + one.parts, count + 1)))
    if parts.left:
        return None
    del source.parts[one.number]
    return bytes(parts.data), parts.related
