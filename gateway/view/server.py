"""One port for pages and WebSocket clients, polled by the loop: no thread, no asyncio, nothing that waits.

Rules. Each poll has a bounded share: connections accepted, and bytes read, hence messages. What is sent is
either an event, which is never dropped, or a sample, of which only the newest waits while a client does not
read, or what was sent before is not known to have arrived: nothing is queued on a slow link. A client that
stays slow, or leaves too much unread, is closed with the reason. Connections that do not get on with their
handshake, or to which a page was sent, are closed after a while; if there are too many the oldest goes. If
there are too many clients, a new one takes the place of one that has been silent for long, or is refused.
"""

from __future__ import annotations

import gzip
import logging
import socket
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import TypeAlias

from websockets.datastructures import Headers
from websockets.frames import Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.typing import Subprotocol

from gateway.errors import UserError
from gateway.view.access import Access, Address, parse_address
from protocols.messages import MILLISECOND, SECOND, Nanos

Message: TypeAlias = str | bytes

MAX_ACCEPTED = 8
"""Connections accepted in one poll."""
MAX_READ = 1024
"""Bytes read of one connection in one poll: up to 170 frames, each of which takes some µs."""
MAX_BUSY = {True: 3, False: 1}
"""Clients, and connections that are none (yet), that are read in one poll, of those that have sent something:
the others have their turn next."""
MAX_DISCARDED = 1 << 16
"""Bytes, if it is closing."""
MAX_SIZE = 1 << 16
"""Bytes of a message that a client may send."""
MAX_PENDING = 32
"""Connections that are no clients (yet)."""
MAX_CLIENTS = 16
SILENCE: Nanos = 10 * SECOND
"""After which a client gives way to a new one. Our pages send something every 2 s."""
MAX_UNSENT = 4 << 20
"""Bytes of events that a client may leave unread."""
SEND_BUFFER = 1 << 18
"""Bytes in the kernel's send buffer: little, so that what arrives is new."""
UNDER_WAY = 3 << 10
"""Bytes that may be on their way to a client when samples are made for it, if they have been for some time.
What is queued on a slow link would be old when it arrives: 20 kB/s take 0.15 s for so many."""
QUICK: Nanos = 50 * MILLISECOND
"""For which more than that may be on their way."""
PROBE_SPACING = 1 << 10
"""Bytes after which a client is asked for an answer, by which what was sent is known to have arrived."""
HANDSHAKE_TIMEOUT: Nanos = 5 * SECOND
"""How long a connection may be no client."""
PATIENCE: Nanos = 10 * SECOND
"""How long a client may leave anything unread."""
LINGER: Nanos = SECOND
"""How long a closing handshake may take."""

_log = logging.getLogger("gateway.view.wire")
_log.setLevel(logging.CRITICAL)  # what clients do wrong is theirs


@dataclass(frozen=True, slots=True)
class Page:
    """What is sent for a path."""

    kind: str
    """Its media type."""
    body: bytes
    packed: bytes = field(init=False)
    """The same by gzip."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "packed", gzip.compress(self.body, mtime=0))


@dataclass(slots=True, eq=False)
class Client:
    """One WebSocket connection, or one that may become one."""

    socket: socket.socket
    protocol: ServerProtocol
    since: Nanos
    """When it was accepted."""
    path: str = ""
    """Where it has connected,"""
    subprotocol: str = ""
    """and what it speaks there."""
    open: bool = False
    """Whether it has become a client."""
    received_at: Nanos = 0
    """When it last sent a message."""
    answered: Nanos | None = None
    """When the newest ping was sent that it has answered; None: it has answered none."""
    heard: Nanos | None = None
    """The same before the first message of the last poll in which it sent some: none of these is older."""
    inbox: list[Message] = field(default_factory=list)
    """What has come in this poll."""
    parts: list[bytes] = field(default_factory=list)
    """Of a message in fragments."""
    text: bool = False
    unsent: bytearray = field(default_factory=bytearray)
    samples: dict[str, Callable[[], Message]] = field(default_factory=dict)
    sampled: int = 0
    """Bytes of samples that are not sent yet, at most: they may be as large as they are."""
    sent: int = 0
    """Bytes sent so far,"""
    arrived: int = 0
    """and those of them that are known to have arrived."""
    pings: deque[tuple[Nanos, int]] = field(default_factory=deque)
    """Those that were not answered: when, and how much was sent with them."""
    stuck_since: Nanos | None = None
    ending: Nanos | None = None
    """When it is closed at the latest."""
    shut: bool = False
    """Whether our end is closed."""

    def send(self, message: Message) -> None:
        """Send an event. It is not dropped; a client that leaves too many unread is."""
        if self.open and self.protocol.state is State.OPEN:
            if isinstance(message, str):
                self.protocol.send_text(message.encode())
            else:
                self.protocol.send_binary(message)
            self.collect()

    def ping(self, now: Nanos) -> None:
        """Ask for an answer, which every client's WebSocket gives by itself."""
        if self.open and self.protocol.state is State.OPEN:
            self.protocol.send_ping(now.to_bytes(8))
            self.collect()
            self.pings.append((now, self.sent + len(self.unsent)))

    def on_answer(self, pinged: Nanos) -> None:
        """Take the answer to a ping, which is one to all before it."""
        self.answered = pinged
        while self.pings and self.pings[0][0] <= pinged:
            self.arrived = self.pings.popleft()[1]

    def sample(self, key: str, message: Callable[[], Message]) -> None:
        """Send a sample when there is room: until then a newer one of this key takes its place."""
        self.samples[key] = message

    def end(self, code: int, reason: str) -> None:
        """Close the connection with a reason."""
        if self.protocol.state is State.OPEN:
            self.protocol.send_close(code, reason[:120])
        self.samples.clear()
        self.collect()

    def idle(self, now: Nanos) -> bool:
        """Return whether everything that was sent has left, and little of it may still be on a slow link."""
        quick = not self.pings or now - self.pings[0][0] < QUICK
        return not self.unsent and (quick or self.sent - self.arrived < UNDER_WAY)

    def probe(self, now: Nanos) -> None:
        """Ask whether what was sent has arrived, if that is not asked already."""
        asked = self.pings[-1][1] if self.pings else self.arrived
        if self.sent + len(self.unsent) - asked >= PROBE_SPACING:
            self.ping(now)

    def collect(self) -> None:
        """Take over what the protocol has to send."""
        for data in self.protocol.data_to_send():
            self.unsent += data


class Server:
    """The port. Use it as a context manager, or close it.

    Args:
        address: where to listen.
        access: who may connect.
        pages: by path.
        subprotocols: by path of WebSocket connections: those that are spoken there; "" for none.

    Raises:
        UserError: the address cannot be opened.
    """

    def __init__(
        self,
        address: Address,
        access: Access,
        pages: Mapping[str, Page],
        subprotocols: Mapping[str, Sequence[str]],
    ) -> None:
        self._access, self._pages, self._subprotocols = access, pages, subprotocols
        self._listener = _listen(address)
        self.address = Address(address.host, self._listener.getsockname()[1])
        everywhere = ip_address(address.host).is_unspecified
        self.name = f"{socket.gethostname()}:{self.address.port}" if everywhere else str(self.address)
        """How it is reached: by the machine's name where it listens on all of its addresses."""
        self._connections: list[Client] = []
        """The one that was read longest ago first."""

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def clients(self) -> list[Client]:
        """Those that have finished their handshake, and are not being closed."""
        return [one for one in self._connections if one.open and one.protocol.state is State.OPEN]

    def poll(self, now: Nanos) -> list[tuple[Client, list[Message]]]:
        """Return the messages since the last poll, those of the client read longest ago first. Never waits.

        `now` only times out."""
        messages: list[tuple[Client, list[Message]]] = []
        left = dict(MAX_BUSY)
        for client in list(self._connections):
            kind = client.open
            if left[kind] and self._read(now, client):
                left[kind] -= 1
                if client in self._connections:
                    self._connections.remove(client)
                    self._connections.append(client)
            if client.inbox:
                messages.append((client, client.inbox))
                client.inbox = []
        self._accept(now)
        for client in list(self._connections):
            self._time_out(now, client)
        return messages

    def flush(self, now: Nanos) -> None:
        """Send what there is room for. Never waits."""
        for client in list(self._connections):
            client.probe(now)
            if client.unsent:
                self._send(now, client)
            if client.samples and client.idle(now):
                samples, client.samples = client.samples, {}
                for message in samples.values():
                    client.send(message())
                client.probe(now)
                client.sampled = len(client.unsent)
                self._send(now, client)

    def close(self) -> None:
        """Send every client the end, and close everything."""
        for client in list(self._connections):
            client.end(1001, "the gateway ends")
            self._send(0, client)
            self._drop(client)
        self._listener.close()

    # -- in -----------------------------------------------------------------------------------

    def _accept(self, now: Nanos) -> None:
        for _ in range(MAX_ACCEPTED):
            try:
                connection, _address = self._listener.accept()
            except OSError:  # none waits, or it has gone again
                return
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            pending = [one for one in self._connections if not one.open]
            if len(pending) >= MAX_PENDING:
                self._drop(min(pending, key=lambda one: one.since))
            protocol = ServerProtocol(max_size=MAX_SIZE, logger=_log)
            self._connections.append(Client(connection, protocol, now))

    def _read(self, now: Nanos, client: Client) -> bool:
        """Read once; return whether there was anything."""
        try:
            data = client.socket.recv(MAX_READ if client.ending is None else MAX_DISCARDED)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            self._drop(client)
        elif client.ending is None:
            client.protocol.receive_data(data)
            for event in client.protocol.events_received():
                if isinstance(event, Request):
                    self._on_request(now, client, event)
                elif isinstance(event, Frame):
                    _on_frame(now, client, event)
            client.collect()
            if client.protocol.close_expected() or client.protocol.state is State.CLOSED:
                client.ending = now + LINGER
        return True

    def _on_request(self, now: Nanos, client: Client, request: Request) -> None:
        """Send a page, or become a client."""
        headers = request.headers
        origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
        path = request.path.partition("?")[0]
        page = self._pages.get(path)
        if len(hosts) != 1 or len(origins) > 1:
            response = client.protocol.reject(400, "one header Host and one Origin at most are expected\n")
        elif "Upgrade" not in headers:
            packed = any("gzip" in one for one in headers.get_all("Accept-Encoding"))
            response = (
                _page(page, packed=packed) if page else client.protocol.reject(404, "there is no such page\n")
            )
        else:
            response = self._upgrade(now, client, request, path, hosts[0], origins[0] if origins else None)
        client.protocol.send_response(response)
        client.open = response.status_code == 101
        client.received_at = now

    def _upgrade(
        self, now: Nanos, client: Client, request: Request, path: str, host: str, origin: str | None
    ) -> Response:
        status, reason = self._access.refused(request.path, host, origin)
        if status:
            return client.protocol.reject(status, reason + "\n")
        offered = self._subprotocols.get(path)
        if offered is None:
            return client.protocol.reject(404, "nothing is spoken at this path\n")
        asked = [
            name.strip()
            for header in request.headers.get_all("Sec-WebSocket-Protocol")
            for name in header.split(",")
        ]
        spoken = next((name for name in asked or [""] if name in offered), None)
        if spoken is None:
            known = ", ".join(filter(None, offered))
            return client.protocol.reject(400, f"one of these subprotocols is expected: {known}\n")
        client.protocol.available_subprotocols = [Subprotocol(spoken)] if spoken else None
        clients = self.clients
        if len(clients) >= MAX_CLIENTS:
            silent = min(clients, key=lambda one: one.received_at)
            if now - silent.received_at < SILENCE:
                return client.protocol.reject(503, f"there are {MAX_CLIENTS} clients already\n")
            silent.end(1013, f"there are more than {MAX_CLIENTS} clients, and this one was silent")
            self._send(now, silent)
            self._drop(silent)
        client.path, client.subprotocol = path, spoken
        return client.protocol.accept(request)

    # -- out ----------------------------------------------------------------------------------

    def _send(self, now: Nanos, client: Client) -> None:
        try:
            sent = client.socket.send(client.unsent)
            del client.unsent[:sent]
            client.sent += sent
        except BlockingIOError:
            sent = 0
        except OSError:
            self._drop(client)
            return
        if not client.unsent:
            client.stuck_since, client.sampled = None, 0
        elif client.stuck_since is None or sent:
            client.stuck_since = now

    def _time_out(self, now: Nanos, client: Client) -> None:
        """Close a connection that is too slow, or has ended."""
        late = now - client.since > HANDSHAKE_TIMEOUT and not client.open
        if client.ending is not None:
            if (
                not client.unsent and not client.shut
            ):  # what it still sends is read and discarded: a close with
                client.shut = True  # something unread would reset the connection, and the reason be lost
                with suppress(OSError):
                    client.socket.shutdown(socket.SHUT_WR)
            if now >= client.ending:
                self._drop(client)
        elif late:
            self._drop(client)
        elif client.open:
            stuck = client.stuck_since is not None and now - client.stuck_since > PATIENCE
            if stuck or len(client.unsent) - client.sampled > MAX_UNSENT:
                client.end(1008, "too slow: what was sent was not read")
            if client.protocol.state is not State.OPEN:
                client.ending = now + LINGER

    def _drop(self, client: Client) -> None:
        client.socket.close()
        client.open = False
        client.unsent.clear()
        if client in self._connections:
            self._connections.remove(client)


def _on_frame(now: Nanos, client: Client, frame: Frame) -> None:
    """Put messages together, and take answers to pings; pings were answered by the protocol."""
    if frame.opcode is Opcode.PONG:
        client.on_answer(int.from_bytes(frame.data))
        return
    if frame.opcode in (Opcode.TEXT, Opcode.BINARY):
        client.text = frame.opcode is Opcode.TEXT
        client.parts = [bytes(frame.data)]
    elif frame.opcode is Opcode.CONT:
        client.parts += [bytes(frame.data)] if frame.data else []
    else:
        return
    if frame.fin:
        data = b"".join(client.parts)
        client.parts, client.received_at = [], now
        client.heard = client.heard if client.inbox else client.answered
        client.inbox.append(data.decode("utf-8", "replace") if client.text else data)


def _page(page: Page, *, packed: bool) -> Response:
    body = page.packed if packed else page.body
    headers = Headers(
        [
            ("Content-Type", page.kind),
            *([("Content-Encoding", "gzip")] if packed else []),
            ("Content-Length", str(len(body))),
            ("Connection", "close"),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", "default-src 'self'; img-src 'self' data:; frame-ancestors 'self'"),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
        ]
    )
    return Response(200, "OK", headers, body)


def _listen(address: Address) -> socket.socket:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((address.host, address.port))
        listener.listen(128)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise UserError(f"the view cannot listen on {address}: {error.strerror}") from error
    return listener


def place(address: str, token: str, origins: Sequence[str] = ()) -> tuple[Address, Access]:
    """Return where a view listens, and who may connect.

    Args:
        address: HOST:PORT, HOST or PORT; "": the default one, with a port that is free if its own is taken.
        token: what a client must bring.
        origins: foreign pages that may connect.

    Raises:
        UserError: the address is none, or needs a token.
    """
    where = parse_address(address) if address else Address()
    if not address:
        try:
            _listen(where).close()
        except UserError:
            where = Address(port=0)
    return where, Access(where.loopback, token, tuple(origins))
