"""A WebSocket client without a thread: both ends of a connection are polled by one loop."""

from __future__ import annotations

import json
import socket
from collections.abc import Sequence
from typing import Any

from websockets.client import ClientProtocol
from websockets.datastructures import Headers
from websockets.frames import Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.typing import Origin, Subprotocol
from websockets.uri import parse_uri

from gateway.view.access import Address


class Browser:
    """One client. `poll` reads what has come; `messages` keeps it, binary ones by their header."""

    def __init__(
        self,
        address: Address,
        path: str = "/cockpit",
        *,
        origin: str | None = None,
        host: str = "",
        subprotocols: Sequence[str] = (),
        max_size: int | None = None,
    ) -> None:
        self.socket = connected(address)
        self.protocol = ClientProtocol(
            parse_uri(f"ws://{host or address}{path}"),
            origin=None if origin is None else Origin(origin),
            subprotocols=[Subprotocol(one) for one in subprotocols] or None,
            max_size=max_size,
        )
        self.messages: list[Any] = []
        self.status = 0
        """Of the handshake's response."""
        self.reason = ""
        """Its body, if it was refused; or why the connection was closed."""
        self.code = 0
        """With which it was closed."""
        self._out = bytearray()
        self.protocol.send_request(self.protocol.connect())

    @property
    def open(self) -> bool:
        return self.protocol.state is State.OPEN

    def send(self, message: object) -> None:
        """Send text as it is, bytes as they are, anything else as JSON; a line with the newest time of the
        gateway's, as the page does."""
        if isinstance(message, dict) and "ask" in message and (timed := self.of("signals")):
            message |= {"heard": timed[-1].get("clock")}
        if isinstance(message, bytes):
            self.protocol.send_binary(message)
        else:
            self.protocol.send_text((message if isinstance(message, str) else json.dumps(message)).encode())

    def hold(self, line: str) -> None:
        """Hold what a line asks, as the page does."""
        self.send({"held": line, "heard": self.of("signals")[-1]["clock"]})

    def write(self, data: bytes) -> None:
        """Send bytes that are no message."""
        self._out += data

    def poll(self, read: bool = True) -> None:
        """Send what there is room for, and read."""
        for data in self.protocol.data_to_send():
            self._out += data
        try:
            while self._out:
                del self._out[: self.socket.send(self._out)]
        except OSError:
            pass
        while read:
            try:
                data = self.socket.recv(1 << 20)
            except OSError:
                return
            if not data:
                self.protocol.receive_eof()
                self._closed()
                return
            self.protocol.receive_data(data)
            self._events()

    def of(self, kind: str) -> list[Any]:
        """Return the messages of a kind so far."""
        return [one for one in self.messages if one.get("kind") == kind]

    def close(self) -> None:
        self.socket.close()

    def _events(self) -> None:
        for event in self.protocol.events_received():
            if isinstance(event, Response):
                self.status, self.reason = event.status_code, bytes(event.body).decode()
            elif isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                self.messages.append(json.loads(bytes(event.data)))
            elif isinstance(event, Frame) and event.opcode is Opcode.BINARY:
                length = int.from_bytes(event.data[:4], "little")
                header = json.loads(bytes(event.data[4 : 4 + length]))
                self.messages.append(header | {"bytes": bytes(event.data[4 + length :])})
            elif isinstance(event, Frame) and event.opcode is Opcode.CLOSE:
                self._closed()

    def _closed(self) -> None:
        if self.protocol.close_rcvd is not None:
            self.code, self.reason = self.protocol.close_rcvd.code, self.protocol.close_rcvd.reason


def connected(address: Address) -> socket.socket:
    """Return a connection that never waits, not even for an acknowledgement before it sends (Nagle): that
    comes by the machine's clock, while the loop counts its own."""
    connection = socket.create_connection((address.host, address.port))
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def get(address: Address, request: bytes) -> socket.socket:
    """Send a request, and return the connection."""
    connection = connected(address)
    connection.sendall(request)
    return connection


__all__ = ["Browser", "Headers", "Request", "connected", "get"]
