"""What is held over a link that delays: two real ends, a relay between them, and counted time."""

from __future__ import annotations

import logging
import random
import socket
from collections import deque
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf

import pytest

from gateway.operator.commands import FRESH
from gateway.view import Address
from gateway.view.requests import HELD, NO_TIME, OVERTAKEN
from protocols.messages import MILLISECOND, SECOND, Drive, Nanos, Release, Stop
from tests.gateway.view.clients import Browser, connected
from tests.gateway.view.test_foxglove import TWIST, App, twist
from tests.gateway.view.test_view import PERIOD, Bench, bench, rows

MOVES, STANDS = Drive(0.1, 0.3), Drive(0.0, 0.0)


@dataclass
class Wire:
    """One direction of a link: what came, and when it goes on."""

    source: socket.socket
    sink: socket.socket
    rate: float = inf
    """Bytes a second."""
    waiting: deque[tuple[Nanos, bytes]] = field(default_factory=deque)

    def poll(self, now: Nanos, delay: Nanos) -> None:
        """Take what has come, and pass on what is due, in its order."""
        with suppress(BlockingIOError):
            self.waiting.append((now + delay, self.source.recv(1 << 20)))
        room = self.rate * PERIOD / SECOND
        while self.waiting and self.waiting[0][0] <= now and room >= 1:
            due, data = self.waiting.popleft()
            part = data if len(data) <= room else data[: int(room)]
            self.sink.sendall(part)
            room -= len(part)
            if len(part) < len(data):
                self.waiting.appendleft((due, data[len(part) :]))


class Relay:
    """A link to a port, which delays. For one connection."""

    def __init__(self, address: Address) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = Address(port=self.listener.getsockname()[1])
        self.target = address
        self.wires: tuple[Wire, ...] = ()
        self.there = self.back = Nanos(0)
        """Delays, to the gateway and from it."""

    def accept(self) -> None:
        near, _ = self.listener.accept()
        near.setblocking(False)
        near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        far = connected(self.target)
        self.wires = Wire(near, far), Wire(far, near)

    def poll(self, now: Nanos) -> None:
        for wire, delay in zip(self.wires, (self.there, self.back), strict=True):
            wire.poll(now, delay)

    def close(self) -> None:
        for end in (self.listener, *(wire.source for wire in self.wires)):
            end.close()


@dataclass
class Person:
    """One who drives over a relay with a client of some kind, as its page or app does: 20 times a second."""

    loop: Bench
    relay: Relay
    client: Browser
    released: Nanos = 0

    def run(self, seconds: float, held: bool) -> None:
        """Hold, or let go, for so long."""
        end = self.loop.now + round(seconds * SECOND)
        while self.loop.now < end:
            if held and self.loop.now % (50 * MILLISECOND) == 0:
                self.hold()
            self.loop.tick()
            self.relay.poll(self.loop.now)

    def hold(self) -> None:
        self.client.hold("drive 0.1 0.3")

    def let_go(self) -> None:
        self.client.send({"held": ""})
        self.released = self.loop.now

    def stop(self) -> None:
        self.client.send({"ask": "stop"})

    def refusals(self) -> list[str]:
        return [one["text"] for one in self.client.of("answer")]

    def moved(self) -> list[Nanos]:
        """Return when it was asked to move."""
        return [t for t, one in self.loop.instructions if one == MOVES]


class AppUser(Person):
    """With Foxglove's Teleop panel, which says nothing when it is let go."""

    client: App

    def hold(self) -> None:
        self.client.publish(twist(0.1, 0.0, 0.3)[0])

    def let_go(self) -> None:
        self.released = self.loop.now

    def stop(self) -> None:
        self.client.call("/stop", b"{}")

    def refusals(self) -> list[str]:
        return [one["message"] for one in self.client.op("status")]


@pytest.fixture(params=[Person, AppUser])
def person(request: pytest.FixtureRequest) -> Iterator[Person]:
    with bench() as loop, closing(Relay(loop.address)) as relay:
        client = App(relay.address) if request.param is AppUser else Browser(relay.address)
        loop.browsers.append(client)
        relay.accept()
        person: Person = request.param(loop, relay, client)
        person.run(0.2, held=False)
        if isinstance(client, App):
            client.advertise("/cmd_vel", TWIST, "json")
        yield person


def test_what_is_held_over_a_quick_link_moves(person: Person) -> None:
    person.relay.there = person.relay.back = 100 * MILLISECOND
    person.run(1.0, held=True)
    person.let_go()
    person.run(1.0, held=False)
    assert len(person.moved()) == 20
    assert person.loop.asked(Drive)[-1] == STANDS
    assert not person.refusals()


@pytest.mark.parametrize("there", [0, 2])
def test_what_is_held_over_a_slow_link_counts_for_nothing(
    person: Person, there: int, caplog: pytest.LogCaptureFixture
) -> None:
    person.relay.there, person.relay.back = there * SECOND, (2 - there) * SECOND
    with caplog.at_level(logging.WARNING):
        person.run(3.0, held=True)
        person.let_go()
        person.run(2.5, held=False)
    begun = 0 if there else 1  # the gateway's times that came while the link was quick count for a moment
    assert len(person.moved()) <= begun * (FRESH // (50 * MILLISECOND) + 2)
    (refusal,) = person.refusals()
    assert refusal.removeprefix("/cmd_vel: ").startswith("the link is slow: ")
    (logged,) = [one.getMessage() for one in caplog.records]
    assert "live view: the link is slow: " in logged
    person.stop()
    person.run(2.1, held=False)
    assert person.loop.asked(Stop)


@pytest.mark.parametrize("seed", range(2))
def test_however_the_link_delays_it_stands_soon_after_it_is_let_go(person: Person, seed: int) -> None:
    dice = random.Random(seed)
    for _ in range(3):
        person.relay.there = person.relay.back = 0
        person.run(0.3, held=True)
        for _ in range(dice.randrange(4)):
            person.relay.there = dice.choice((0, 100, 500, 2000)) * MILLISECOND
            person.relay.back = dice.choice((0, 100, 500, 2000)) * MILLISECOND
            person.run(dice.uniform(0.1, 1.0), held=True)
        person.let_go()
        begun = len(person.moved())
        person.run(4.1, held=False)
        assert all(t <= person.released + FRESH + PERIOD for t in person.moved()[begun:])
        ends = [t for t, one in person.loop.instructions if one == STANDS]
        assert not person.moved() or ends[-1] <= person.moved()[-1] + HELD + 2 * PERIOD
    assert person.moved()  # some of it was held over a quick link


@pytest.mark.parametrize(
    ("rate", "seconds"), [(10_000, 5), pytest.param(20_000, 60, marks=pytest.mark.prove)]
)
def test_a_slow_link_queues_nothing_old_and_brings_every_tick_of_a_plot(rate: int, seconds: int) -> None:
    with bench() as loop, closing(Relay(loop.address)) as relay:
        page = Browser(relay.address)
        loop.browsers.append(page)
        relay.accept()
        relay.wires[1].rate = rate
        person = Person(loop, relay, page)
        person.run(2.0, held=False)
        signals = [["left", "velocity"], ["left", "position"], ["right", "velocity"], ["right", "age"]]
        page.send({"plot": {"id": 1, "signals": signals}})
        person.run(2.0, held=False)
        ages = list[float]()
        end = loop.now + seconds * SECOND
        while loop.now < end:
            before = len(page.of("signals"))
            person.run(PERIOD / SECOND, held=False)
            ages += [loop.now / SECOND - one["clock"] / 1e3 for one in page.of("signals")[before:]]
        came = [row[0] for one in page.of("signals") if one["rows"] for row in rows(one, len(signals))]
        assert {round(later - before, 4) for before, later in pairwise(came)} == {PERIOD / SECOND}
        print(
            f"{rate} B/s, {seconds} s: {len(ages)} messages, {len(came)} ticks, {max(ages):.3f} s old at most"
        )
        assert len(came) > (seconds - 1) * SECOND // PERIOD
        assert len(ages) > 4 * seconds
        assert max(ages) < 0.5


def test_a_link_that_recovers_moves_again_once_it_is_held_anew(person: Person) -> None:
    person.relay.there = SECOND
    person.run(3.0, held=True)
    assert not person.moved()[FRESH // (50 * MILLISECOND) :]
    person.relay.there = 0
    person.let_go()
    person.run(3.0, held=False)
    before = len(person.moved())
    person.run(1.0, held=True)
    assert len(person.moved()) - before > 15


def test_a_release_that_is_under_way_when_another_stops_the_robot_releases_nothing() -> None:
    with bench() as loop, closing(Relay(loop.address)) as relay:
        far = Person(loop, relay, Browser(relay.address))
        loop.browsers.append(far.client)
        relay.accept()
        near = loop.page()
        far.run(0.2, held=False)
        relay.there = SECOND
        far.client.send({"ask": "release"})
        far.client.send({"ask": "goal 1 1"})
        far.run(0.5, held=False)
        near.send({"ask": "stop"})
        far.run(2.0, held=False)
        assert [type(one) for _, one in loop.instructions] == [Stop]
        assert [one["text"] for one in far.client.of("answer")] == [OVERTAKEN] * 2
        relay.there = 0
        far.client.send({"ask": "release"})
        far.run(1.2, held=False)  # behind what its WebSocket answered while the link was slow
        assert [type(one) for _, one in loop.instructions] == [Stop, Release]


@pytest.mark.parametrize("heard", [None, True, -1, 0.5, "1", 10**12, -(10**4000), 10**4000, [], {}])
def test_a_time_that_is_none_of_the_gateways_holds_nothing(heard: object) -> None:
    with bench() as loop:
        page = loop.page()
        loop.run(1.0)
        page.send({"held": "drive 0.1 0.3", "heard": heard})
        loop.until(lambda: bool(page.of("answer")))
        (answer,) = page.of("answer")
        assert answer["held"]
        assert heard is True or answer["text"] == NO_TIME
        assert not loop.asked(Drive)
