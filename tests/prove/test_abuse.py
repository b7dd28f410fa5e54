"""A robot that drives in real time while its live view is abused, kind by kind: what its loop misses.

The figures are printed beside those without any client. What is asserted does not depend on the machine:
the operator's stop comes through, and the run ends as it should.
"""

from __future__ import annotations

import random
import re
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from signal import SIGTERM
from typing import TypeAlias

import pytest

from gateway.operator import ask
from gateway.view import Address, parse_address
from tests.gateway.processes import Process
from tests.gateway.view.clients import Browser, get

pytestmark = pytest.mark.prove
SECONDS = 10.0
"""Of each kind of abuse."""

Held: TypeAlias = list[socket.socket | Browser]
Abuse = Callable[[Address, random.Random, Held], Callable[[], int]]
"""Begins, and returns what goes on with it: called again and again, it returns how much it has sent."""


def nobody(_address: Address, _dice: random.Random, _held: Held) -> Callable[[], int]:
    """Nothing at all."""

    def wait() -> int:
        time.sleep(0.01)
        return 0

    return wait


def computes(_address: Address, _dice: random.Random, _held: Held) -> Callable[[], int]:
    """Nothing but work for another processor, as every kind of abuse is."""
    return lambda: 0 * sum(range(10_000))


def connections(address: Address, _dice: random.Random, held: Held) -> Callable[[], int]:
    """A thousand connections, and new ones for those that are closed."""

    def more() -> int:
        for _ in range(20):
            with suppress(OSError):
                held.append(get(address, b"GET /cockpit HTTP/1.1\r\n"))
        while len(held) > 1000:
            held.pop(0).close()
        return 20

    return more


def strangers(address: Address, _dice: random.Random, held: Held) -> Callable[[], int]:
    """Handshakes from a foreign page, and with a foreign name."""

    def try_again() -> int:
        with suppress(OSError):
            for origin, host in (("https://evil.example", ""), (None, "evil.example")):
                one = Browser(address, origin=origin, host=host)
                for _ in range(5):
                    one.poll()
                    time.sleep(0.001)
                one.close()
        return 2

    return try_again


def slow_readers(address: Address, _dice: random.Random, held: Held) -> Callable[[], int]:
    """Sixteen pages that never read."""
    pages = [Browser(address) for _ in range(16)]
    held += pages

    def say_something() -> int:
        for one in pages:
            one.poll(read=False)
        time.sleep(0.01)
        return len(pages)

    return say_something


def huge_messages(address: Address, _dice: random.Random, held: Held) -> Callable[[], int]:
    """Messages of 100 MB, as fast as they are taken."""
    pages = [Browser(address) for _ in range(3)]
    held += pages

    def push() -> int:
        count = 0
        for at, one in enumerate(pages):
            one.poll()
            if one.status and not one._out:
                one.write(b"\x82\xff" + (100 << 20).to_bytes(8, "big") + bytes(4) + bytes(1 << 20))
                count += 1 << 20
            if one.status and not one.open:
                one.close()
                with suppress(OSError):
                    pages[at] = Browser(address)
                    held.append(pages[at])
        return count

    return push


def rubbish(address: Address, dice: random.Random, held: Held) -> Callable[[], int]:
    """Random bytes, as connections and as messages."""

    def more() -> int:
        with suppress(OSError):
            get(address, dice.randbytes(dice.randrange(1, 3000))).close()
            one = Browser(address)
            for _ in range(5):
                one.poll()
                time.sleep(0.001)
            if one.open:
                data = dice.randbytes(dice.randrange(1, 3000))
                one.send(data if dice.random() < 0.5 else data.decode("latin-1"))
            one.poll()
            one.close()
        return 2

    return more


def flood(address: Address, held: Held, message: Callable[[], object]) -> Callable[[], int]:
    """Three pages that send a message as fast as they can."""
    pages = [Browser(address) for _ in range(3)]
    held += pages

    def more() -> int:
        count = 0
        for one in pages:
            one.poll()
            if one.open and len(one._out) < 1 << 16:
                count += 50
                for _ in range(50):
                    one.send(message())
        return count

    return more


def goals(address: Address, dice: random.Random, held: Held) -> Callable[[], int]:
    """Three pages that ask for goals as fast as they can."""
    return flood(
        address, held, lambda: {"ask": f"goal {dice.uniform(0.0, 1.0):.2f} {dice.uniform(-0.5, 0.5):.2f}"}
    )


def holds(address: Address, _dice: random.Random, held: Held) -> Callable[[], int]:
    """Three pages that hold a drive as fast as they can."""
    return flood(address, held, lambda: {"held": "drive 0.1 0.2"})


KINDS: tuple[Abuse, ...] = (
    nobody,
    computes,
    connections,
    strangers,
    slow_readers,
    huge_messages,
    rubbish,
    goals,
    holds,
)


@contextmanager
def driving(folder: Path) -> Iterator[tuple[Process, Address]]:
    with Process(folder, "run", "diffbot", "--view", "0", "--steer", "-v") as robot:
        robot.until("diffbot is running", "ready")
        yield robot, parse_address(robot.find(r"live view: http://([^/]+)/"))


def ticks(path: Path) -> int:
    """Return how many ticks a robot has made: in a world of twins it misses none, and has fewer instead."""
    found = re.search(r"ticks: (\d+), 0 missed", ask(path, "status"))
    assert found is not None
    return int(found[1])


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_abuse_of_the_view_stops_neither_loop_nor_operator(kind: Abuse) -> None:
    with tempfile.TemporaryDirectory() as name, driving(Path(name)) as (robot, address):
        path = next(Path(name).rglob("*.sock"))
        page = Browser(address)  # of an operator
        while not page.open:
            page.poll()
        ask(path, "goal 1.5 0.5")
        before, used, count = ticks(path), robot.processor_time(), 0
        held: Held = []
        go_on = kind(address, random.Random(7), held)
        end, told = time.monotonic() + SECONDS, 0.0
        while time.monotonic() < end:
            count += go_on()
            if time.monotonic() > told + 1.0:
                page.send({})  # it is still there
                told = time.monotonic()
            page.poll()
            robot._read(0.0)
        after, used = ticks(path), robot.processor_time() - used
        asked = time.monotonic()
        page.send({"ask": "stop enough"})
        while not (seen := page.of("state")) or seen[-1]["stopped"] != "enough":
            count += go_on()
            page.poll()
            assert time.monotonic() - asked < 60.0
        waited = time.monotonic() - asked
        assert "enough" in ask(path, "status")
        status, text = robot.end(SIGTERM)
        for one in (page, *held):
            one.close()
        longest = re.search(r"longest step ([\d.]+ ms)", text)
        made = after - before
        print(
            f"{kind.__name__}: {made / SECONDS:.0f} of 200 ticks a second, {1e6 * used / made:.0f} µs of"
            f" processor each, longest step {longest and longest[1]}, stop of an operator's page shown there"
            f" within {1000 * waited:.0f} ms; {count} sent"
        )
        assert status == 0
        assert "Traceback" not in text
        assert made > 0
