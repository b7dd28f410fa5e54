"""The process that speaks with the graph: sockets, and a participant between them and the loop's pipe.

Its standard input is the pipe. The first message says what there is (`Setup`); then the loop sends samples
and answers, and gets samples, requests, and how many match each row. It ends with the pipe, whatever happens:
it has nothing that a motor depends on.

| to the loop | |
|---|---|
| "opened", where | |
| "trouble", text | it ends |
| "match", row, count | how many others' endpoints match |
| "sample", row, payload, writer, count | of so many, this is the newest |
| "request", row, payload, token | to be answered with the token |
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from gateway.core.clock import WallClock
from gateway.errors import UserError
from gateway.ros.images import BEGINS, GOES_ON, Pictures
from gateway.ros.intake import Intake, readers
from gateway.ros.link import Link, Setup, dds_type
from gateway.ros.network import LOOPBACK, is_zenoh
from gateway.ros.rtps import MULTICAST, Endpoint, Participant, Qos, Sample, ports
from gateway.ros.rtps_wire import Identity, Locator
from protocols.messages import Nanos

if TYPE_CHECKING:
    from gateway.ros.zenoh_carrier import ZenohCarrier

MOST_PARTICIPANTS = 120
"""Of this machine, in one domain: their ports are tried one after the other."""
ANNOUNCED = 20
"""Of these, how many are told of us unasked; the others announce themselves to us."""
AT_ONCE = 256
"""Datagrams that are read before something else is done"""
IDLE, BUSY = 0.005, 0.0005
BUFFER = 1 << 20
ENCAPSULATION = b"\x00\x01\x00\x00"
DISCOVERY = "ros_discovery_info"


def endpoints(setup: Setup) -> tuple[list[Endpoint], list[tuple[int, ...]]]:
    """Return the endpoints, and those of each row: one of a topic; of a service its reader and its writer."""
    found: list[Endpoint] = []
    of_rows: list[tuple[int, ...]] = []
    for kind, name, type_, hash_, reliable, kept, depth in setup.rows:
        qos, data = Qos(reliable, kept, depth), f"typehash={hash_};".encode()
        if kind == "serve":
            found.append(Endpoint(f"rq{name}Request", dds_type(f"{type_}_Request"), False, qos, data))
            found.append(Endpoint(f"rr{name}Reply", dds_type(f"{type_}_Response"), True, qos, data))
            of_rows.append((len(found) - 2, len(found) - 1))
        else:
            found.append(Endpoint(f"rt{name}", dds_type(type_), kind == "publish", qos, data))
            of_rows.append((len(found) - 1,))
    type_ = dds_type("rmw_dds_common/msg/ParticipantEntitiesInfo")
    found.append(Endpoint(DISCOVERY, type_, True, Qos(transient=True, depth=1)))
    return found, of_rows


def discovery_info(participant: Participant, setup: Setup) -> bytes:
    """Return rmw_dds_common/ParticipantEntitiesInfo: one node, which has every endpoint."""
    out = bytearray(participant.guid())
    out += struct.pack("<I", 1)
    for text in (setup.namespace or "/", setup.node):
        data = text.encode() + b"\0"
        out += bytes(-len(out) % 4) + struct.pack("<I", len(data)) + data
    for writes in (False, True):
        own = [
            i
            for i, one in enumerate(participant.endpoints)
            if one.writes == writes and one.topic != DISCOVERY
        ]
        out += bytes(-len(out) % 4) + struct.pack("<I", len(own)) + b"".join(map(participant.guid, own))
    return ENCAPSULATION + bytes(out)


# -- sockets ------------------------------------------------------------------------------------


def _udp(host: str, port: int, *, shared: bool = False) -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        if shared:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        one.bind((host, port))
    except OSError:
        one.close()
        raise
    one.setblocking(False)
    return one


def open_sockets(address: str, domain: int) -> tuple[socket.socket, socket.socket]:
    """Return the sockets of discovery and of data, at the first ports that are free."""
    wrong: OSError | None = None
    for number in range(MOST_PARTICIPANTS):
        _, first, second = ports(domain, number)
        try:
            discovery = _udp(address, first)
        except OSError as error:
            wrong = wrong or error
            continue
        try:
            return discovery, _udp(address, second)
        except OSError as error:
            wrong = wrong or error
            discovery.close()
    assert wrong is not None
    raise wrong


def join(address: str, domain: int) -> socket.socket:
    """Return a socket that hears announcements on the network of an interface."""
    one = _udp(MULTICAST, ports(domain, 0)[0], shared=True)
    member = socket.inet_aton(MULTICAST) + socket.inet_aton(address)
    one.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    return one


# -- the process --------------------------------------------------------------------------------


@dataclass(slots=True)
class Carrier:
    """A participant between the pipe and the sockets."""

    setup: Setup
    link: Link
    clock: WallClock = field(default_factory=WallClock)
    participant: Participant = field(init=False)
    sockets: list[socket.socket] = field(init=False)
    _rows: list[tuple[int, ...]] = field(init=False)
    _of: dict[int, int] = field(init=False)
    """Rows by endpoint."""
    _intake: Intake = field(init=False)
    _pictures: Pictures = field(init=False)
    _unsendable: int = 0

    def __post_init__(self) -> None:
        setup, kinds = self.setup, [row[2] for row in self.setup.rows]
        self._intake, self._pictures = Intake(self.link, readers(kinds)), Pictures(kinds)
        discovery, data = open_sockets(setup.address, setup.domain)
        self.sockets = [discovery, data]
        targets = [Locator(LOOPBACK, ports(setup.domain, number)[1]) for number in range(ANNOUNCED)]
        if setup.address != LOOPBACK:
            self.sockets.append(join(setup.address, setup.domain))
            interface = socket.inet_aton(setup.address)
            data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
            targets = [Locator(MULTICAST, ports(setup.domain, 0)[0])]
        made, self._rows = endpoints(setup)
        self._of = {endpoint: row for row, both in enumerate(self._rows) for endpoint in both}
        where = Locator(*discovery.getsockname()), Locator(*data.getsockname())
        self.participant = Participant(os.urandom(12), setup.domain, *where, made, targets)
        self.participant.publish(0, len(made) - 1, discovery_info(self.participant, setup))

    @property
    def where(self) -> str:
        """Where it listens."""
        return ", ".join(f"{host}:{port}" for host, port in (one.getsockname() for one in self.sockets))

    def run(self) -> None:
        """Carry, until the pipe is closed."""
        while not self.link.closed:
            files = [self.link.fileno(), *(one.fileno() for one in self.sockets)]
            wait = BUSY if self.participant.busy else IDLE
            select.select(files, files[: self.link.waiting], [], wait)
            self.turn(self.clock.now())
        self.participant.leave()
        self._send()

    def take(self, now: Nanos, messages: Iterable[Sequence[Any]]) -> None:
        """Do what the loop asks."""
        for kind, *rest in messages:
            if kind == "publish":
                self.participant.publish(now, self._rows[rest[0]][0], rest[1])
            elif kind in (BEGINS, GOES_ON):
                if (payload := self._pictures.take(kind, *rest)) is not None:
                    self.participant.publish(now, self._rows[rest[0]][0], payload)
            elif kind == "answer":
                self._answer(now, *rest)

    def turn(self, now: Nanos) -> None:
        """Do what there is to do."""
        self.take(now, self.link.receive())
        self._listen(now)
        self.participant.step(now)
        for found in self.participant.matches():
            row = self._of.get(found.endpoint)
            if row is not None and self._rows[row][0] == found.endpoint:
                self.link.send("match", row, found.others)
        self._send()
        self._intake.turn(now)
        self.link.flush()

    def _listen(self, now: Nanos) -> None:
        for one in self.sockets:
            for _ in range(AT_ONCE):
                try:
                    data, (host, _) = one.recvfrom(65536)
                except OSError:  # nothing more, or what a port that is closed by now answered
                    break
                for found in self.participant.receive(now, data, host):
                    self._pass_on(self._of[found.endpoint], found)

    def _pass_on(self, row: int, found: Sample) -> None:
        if len(self._rows[row]) == 1:
            reliable = self.participant.endpoints[found.endpoint].qos.reliable
            take = self._intake.sample if reliable else self._intake.stream
            take(row, found.payload, found.identity.guid)
        elif found.related is not None:  # Fast DDS: the request's number, and the reader of its client
            token = [found.related.guid, found.identity.number, found.related.guid, b""]
            self._intake.request(row, found.payload, token)
        else:  # Cyclone DDS: client and number before the content
            token = [b"", 0, found.identity.guid, found.payload[4:20]]
            self._intake.request(row, found.payload[:4] + found.payload[20:], token)

    def _answer(self, now: Nanos, row: int, payload: bytes, token: Sequence[Any]) -> None:
        guid, number, client, head = token
        related = Identity(guid, number) if guid else None
        content = payload[:4] + head + payload[4:]
        self.participant.reply(now, self._rows[row][1], content, related, client, exact=related is not None)

    def _send(self) -> None:
        for to, data in self.participant.outgoing():
            try:
                self.sockets[1].sendto(data, to)
            except OSError:  # nobody is there, or there is no room: who lacks it will ask for it
                self._unsendable += 1


def open_carrier(setup: Setup, link: Link) -> Carrier | ZenohCarrier:
    """Return what carries, on the network that is asked for. Raises UserError if it cannot be opened."""
    if not is_zenoh(setup.address):
        try:
            return Carrier(setup, link)
        except OSError as error:
            raise UserError(f"the network of {setup.address} cannot be opened: {error}") from error
    try:
        from gateway.ros.zenoh_carrier import ZenohCarrier, ZError
    except ImportError as error:
        raise UserError(f"it needs zenoh ({error}): pip install 'motor-gateway[ros]'") from error
    try:
        return ZenohCarrier(setup, link)
    except ZError as error:
        raise UserError(f"{setup.address} cannot be opened: {error}") from error


def main(standard_input: int = 0) -> int:
    """Carry for the loop at the other end of the standard input; return 1 if the network cannot be opened."""
    end = socket.socket(fileno=standard_input)
    link = Link(end)
    first: list[list[Any]] = []
    while not first and not link.closed:
        select.select([link], [], [])
        first = link.receive()
    if not first:
        return 1
    setup = Setup(*first[0])
    try:
        carrier = open_carrier(setup, link)
    except UserError as error:
        link.send("trouble", str(error))
        return 1
    link.send("opened", carrier.where)
    carrier.take(carrier.clock.now(), first[1:])
    carrier.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
