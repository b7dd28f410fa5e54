"""What the live view costs in a tick: with nobody, with one page, with a page and a Foxglove client.

Rules. One robot drives in simulated time, and three views show it, so that all meet the same ticks; only
polling, taking and showing are timed. A sample is the mean over a second, since much is sent now and then
only: its median is the cost of a tick. The Foxglove client has subscribed to everything but frames. Clients
read all, outside of what is timed.
"""

from __future__ import annotations

import json
import socket
from contextlib import ExitStack, suppress

from websockets.client import ClientProtocol
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

import gateway
from benchmarks.measure import Effort, Figures, NotMeasured, figures
from benchmarks.rows import Row, Target, span
from gateway.core.clock import stopwatch
from gateway.core.tick import Tick
from gateway.recording.ros_views import TOPICS
from gateway.runtime.process import quiet_collector
from gateway.runtime.session import Session
from gateway.view import Access, Address, Scene, View, parse_address
from protocols.messages import MILLISECOND, SECOND, Nanos

GROUP = "the live view (in each tick of a robot that drives: poll, take, show)"
NOBODY, PAGE, BOTH = "nobody looks", "one page", "a page and a Foxglove client"
ROBOT = "diffbot"
WARM: Nanos = 2 * SECOND
"""Until all have connected, and the first of everything was sent."""
LEAST = {NOBODY: 0, PAGE: 50_000, BOTH: 100_000}
"""Bytes that clients get in a second, at least: else nothing was measured."""


def view(effort: Effort) -> list[Row]:
    """Return the three rows."""
    found = costs(effort.of(20, 2))
    targets = {BOTH: Target(at_most=0.3 * MILLISECOND)}
    tick = (span("a tick of 5 ms", 5 * MILLISECOND),)
    return [Row(GROUP, name, found[name], tick, targets.get(name)) for name in (NOBODY, PAGE, BOTH)]


def costs(seconds: int) -> dict[str, Figures]:
    """Return nanoseconds per tick, over so many seconds of a drive."""
    with ExitStack() as stack:
        session = stack.enter_context(gateway.open_session(ROBOT, simulated=True, seed=1))
        shown = {name: stack.enter_context(_Shown(session)) for name in (NOBODY, PAGE, BOTH)}
        shown[PAGE].connect("/cockpit")
        shown[BOTH].connect("/cockpit")
        shown[BOTH].connect("/", "foxglove.sdk.v1")
        for goal in session.tour():
            session.submit(goal)
        stack.enter_context(quiet_collector())
        for tick in session.run(seconds=WARM / SECOND + seconds):
            for each in shown.values():
                each.tick(tick)
            if tick.number == 100:
                shown[BOTH].subscribe()
    for name, each in shown.items():
        if each.got < LEAST[name] * seconds:
            raise NotMeasured(f"the view: {name}: {each.got} bytes in {seconds} s")
    return {name: figures(each.means()) for name, each in shown.items()}


class _Shown:
    """A view with its clients, and what its ticks took."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.view = View([Scene(session.gateway, "live", dict)], Address(port=0), Access())
        self.clients: list[tuple[socket.socket, ClientProtocol]] = []
        self.took: list[tuple[Nanos, Nanos]] = []
        self.got = 0

    def __enter__(self) -> _Shown:
        return self

    def __exit__(self, *_: object) -> None:
        for one, _protocol in self.clients:
            one.close()
        self.view.close()

    def connect(self, path: str, subprotocol: str = "") -> None:
        """Ask to become a client. It answers pings, as browsers do: what is not known to have arrived keeps
        the view from sending more."""
        address = parse_address(self.view.url.partition("//")[2].partition("/")[0])
        made = socket.create_connection((address.host, address.port))
        made.setblocking(False)
        spoken = [Subprotocol(subprotocol)] if subprotocol else None
        protocol = ClientProtocol(parse_uri(f"ws://{address}{path}"), subprotocols=spoken, max_size=None)
        protocol.send_request(protocol.connect())
        self.clients.append((made, protocol))
        self._send(made, protocol)

    def subscribe(self) -> None:
        """Subscribe to everything but frames: the topics that every robot has come first, by number."""
        rows = [{"id": number, "channelId": number} for number in range(1, len(TOPICS) + 1)]
        made, protocol = self.clients[-1]
        protocol.send_text(json.dumps({"op": "subscribe", "subscriptions": rows}).encode())
        self._send(made, protocol)

    def _send(self, made: socket.socket, protocol: ClientProtocol) -> None:
        for data in protocol.data_to_send():
            made.sendall(data)

    def tick(self, tick: Tick) -> None:
        """Show a tick, with a clock around it; then read what came."""
        belief = self.session.belief
        began = stopwatch()
        self.view.poll(tick.now)
        self.view.take(tick, belief)
        self.view.show(tick.now)
        ended = stopwatch()
        for made, protocol in self.clients:
            with suppress(BlockingIOError):
                while data := made.recv(1 << 20):
                    self.got += len(data)
                    protocol.receive_data(data)
            protocol.events_received()
            self._send(made, protocol)
        if tick.now >= WARM:
            self.took.append((tick.now, ended - began))

    def means(self) -> list[float]:
        """Return the mean of each second."""
        seconds: dict[int, list[Nanos]] = {}
        for now, took in self.took:
            seconds.setdefault(now // SECOND, []).append(took)
        return [sum(each) / len(each) for each in seconds.values()]
