"""The live view by its port: pages, clients, and those that abuse it. Both ends are polled by one loop."""

from __future__ import annotations

import gzip
import random
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import cycle, pairwise
from math import isnan
from typing import Any

import numpy as np
import pytest

from brain.belief import Estimate, Pose
from gateway.config import load_robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.view import Access, Address, Scene, View, cockpit, parse_address
from gateway.view.cockpit import MAX_SIGNALS
from gateway.view.requests import AT_ONCE, HELD, PER_POLL
from gateway.view.server import MAX_CLIENTS, MAX_SIZE, MAX_UNSENT, PATIENCE, SILENCE
from gateway.view.view import pages
from protocols.messages import MILLISECOND, SECOND, Drive, Goal, Instruction, LaserScan, Nanos, Set, Stop
from tests.gateway.view.clients import Browser, get

PERIOD: Nanos = 5 * MILLISECOND


@dataclass
class Bench:
    """A view, whatever is connected to it, and the loop that drives both. Time is counted."""

    view: View
    now: Nanos = 0
    browsers: list[Browser] = field(default_factory=list)
    instructions: list[tuple[Nanos, Instruction]] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    """For the next tick."""

    @property
    def address(self) -> Address:
        return parse_address(self.view.url.partition("//")[2].partition("/")[0])

    def browser(self, path: str = "/cockpit", **how: Any) -> Browser:
        self.browsers.append(Browser(self.address, path, **how))
        return self.browsers[-1]

    def page(self) -> Browser:
        """Return a page that has been greeted."""
        browser = self.browser()
        self.until(lambda: bool(browser.of("joints")))
        return browser

    def tick(self, read: bool = True) -> None:
        self.now += PERIOD
        for browser in self.browsers:
            browser.poll(read)
        asked = tuple(self.view.poll(self.now))
        self.instructions += [(self.now, one) for one in asked]
        notes, self.notes = tuple(self.notes), []
        scene = next(iter(self.view._cockpits.values())).scene
        tick = Tick(self.now // PERIOD, self.now, Inputs(instructions=asked), Outputs(notes=notes))
        self.view.take(tick, scene.gateway.belief())
        self.view.show(self.now)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * SECOND / PERIOD)):
            self.tick()

    def until(self, what: Callable[[], bool], ticks: int = 2000) -> int:
        """Tick until something is true; return after how many ticks."""
        for number in range(ticks):
            if what():
                return number
            self.tick()
        raise AssertionError(f"not within {ticks} ticks")

    def asked(self, kind: type[Instruction]) -> list[Any]:
        return [one for _, one in self.instructions if isinstance(one, kind)]


@contextmanager
def bench(access: Access | None = None, *, steer: bool = True, robot: str = "diffbot") -> Iterator[Bench]:
    scene = Scene(Gateway(load_robot(robot)), "live", dict)
    with View([scene], Address(port=0), access or Access(), steer=steer) as view:
        made = Bench(view)
        yield made
        for browser in made.browsers:
            browser.close()


@pytest.fixture
def loop() -> Iterator[Bench]:
    with bench() as made:
        yield made


# -- pages and handshakes ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"200"),
        (b"GET /uplot.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"200"),
        (b"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"404"),
        (b"GET /../server.py HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"404"),
        (b"GET //[ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"404"),
        (b"GET /cockpit HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: x\r\nOrigin: http://[\r\n\r\n", b"403"),
        (b"GET /cockpit HTTP/1.1\r\nHost: [\r\nUpgrade: x\r\n\r\n", b"403"),
        (b"GET / HTTP/1.1\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b"400"),
        (b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"414"),
        (b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 200 + b"\r\n", b"431"),
        (b"\x00\xff\x16\x03\x01 rubbish\r\n\r\n", b""),
    ],
    ids=[
        "page",
        "script",
        "none",
        "outside",
        "bracket",
        "origin",
        "host",
        "no-host",
        "two-hosts",
        "long",
        "many",
        "rubbish",
    ],
)
def test_a_request_is_answered_and_closed(loop: Bench, request_: bytes, status: bytes) -> None:
    connection, got, ended = get(loop.address, request_), b"", False
    for _ in range(2000):
        loop.tick()
        try:
            data = connection.recv(1 << 16)
        except BlockingIOError:
            continue
        except ConnectionResetError:
            data = b""
        got, ended = got + data, not data
        if ended:
            break
    connection.close()
    assert ended
    head, _, body = got.partition(b"\r\n\r\n")
    assert head[9:12] == status
    if status == b"200":
        assert f"Content-Length: {len(body)}".encode() in head
        assert b"default-src 'self'" in head


TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    ("path", "how", "status"),
    [
        (f"/cockpit?token={TOKEN}", {}, 101),
        ("/cockpit", {}, 401),
        ("/cockpit?token=wrong", {}, 401),
        ("/cockpit?token=%ff%zz\xff", {}, 401),
        (f"/cockpit?token={TOKEN}", {"origin": "http://evil.example"}, 403),
        (f"/cockpit?token={TOKEN}", {"host": "evil.example"}, 403),
        (f"/nothing?token={TOKEN}", {}, 404),
        (f"/cockpit?token={TOKEN}", {"subprotocols": ["what"]}, 400),
    ],
)
def test_who_is_let_in(path: str, how: dict[str, Any], status: int) -> None:
    with bench(Access(token=TOKEN)) as loop:
        browser = loop.browser(path, **how)
        loop.until(lambda: bool(browser.status))
        loop.run(0.5)
        assert browser.status == status
        assert bool(browser.messages) is (status == 101)


# -- a page -------------------------------------------------------------------------------------------


def test_a_page_is_greeted_and_then_told_at_its_rates(loop: Bench) -> None:
    page = loop.page()
    assert [one["kind"] for one in page.messages[:2]] == ["hello", "settings"]
    assert page.messages[0]["steer"] is True
    loop.run(2.0)
    for kind, key, period in (("signals", "clock", 20), ("joints", "t", 0.1), ("state", "t", 0.1)):
        times = [one[key] for one in page.of(kind)]
        assert {round(later - before, 6) for before, later in pairwise(times)} == {period}
    names = [one["name"] for one in page.messages[0]["joints"]]
    assert names == ["left", "right"]
    assert len(page.of("joints")[-1]["rows"]) == 2


def rows(message: Any, signals: int) -> list[tuple[float, ...]]:
    """Return the rows of a message with signals: their times [s], and the values."""
    data = np.frombuffer(message["bytes"], "<f4").reshape(-1, 1 + signals)
    assert len(data) == message["rows"]
    return [(message["t"] + float(row[0]), *map(float, row[1:])) for row in data]


def test_a_page_gets_every_tick_of_what_it_plots(loop: Bench) -> None:
    page = loop.page()
    names = page.messages[0]["quantities"]
    assert names["velocity"] == names["velocity command"] == names["velocity error"] == "rad/s"
    chosen = [["left", "age"], ["right", "velocity command"]]
    page.send({"plot": {"id": 7, "signals": chosen}})
    loop.until(lambda: page.of("signals")[-1]["rows"] > 0)
    loop.run(2.0)
    loop.browsers.remove(page)  # a while in which it does not read
    loop.run(3.0)
    loop.browsers.append(page)
    loop.run(1.0)
    came = [row for one in page.of("signals") if one["rows"] for row in rows(one, 2)]
    assert {one["id"] for one in page.of("signals") if one["rows"]} == {7}
    assert not any("lost" in one for one in page.of("signals"))
    assert {round(later[0] - before[0], 4) for before, later in pairwise(came)} == {PERIOD / SECOND}
    assert len(came) > 5.9 * SECOND / PERIOD
    assert all(isnan(row[1]) and isnan(row[2]) for row in came)  # nothing was heard of it, and it is idle


def test_what_a_page_left_unread_for_too_long_is_told_to_be_lost(
    loop: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cockpit, "KEPT_ROWS", 100)
    page = loop.page()
    page.send({"plot": {"id": 1, "signals": [["left", "torque"]] * MAX_SIGNALS}})
    loop.until(lambda: page.of("signals")[-1]["rows"] > 0)
    loop.browsers.remove(page)
    loop.run(5.0)
    loop.browsers.append(page)
    loop.until(lambda: "lost" in page.of("signals")[-1])
    loop.run(1.0)
    came = [one for one in page.of("signals") if one["rows"]]
    times = [row[0] for one in came for row in rows(one, MAX_SIGNALS)]
    lost = sum(one.get("lost", 0) for one in came)
    assert lost + len(times) == 1 + round((times[-1] - times[0]) * SECOND / PERIOD)


@pytest.mark.parametrize(
    ("plot", "why"),
    [
        (None, "an id and a list"),
        ({"id": "1", "signals": []}, "an id and a list"),
        ({"id": 1 << 60, "signals": []}, "an id and a list"),
        ({"id": 1, "signals": {}}, "an id and a list"),
        ({"id": 1, "signals": [["left", "velocity"]] * (MAX_SIGNALS + 1)}, f"at most {MAX_SIGNALS}"),
        *(({"id": 1, "signals": [one]}, "is no signal: a pair is expected, one of left, right, and one of")
          for one in ("left", [], ["left"], ["lift", "velocity"], ["left", "velo"], [["left"], {}])),
    ],
)  # fmt: skip
def test_what_cannot_be_plotted_is_answered(loop: Bench, plot: object, why: str) -> None:
    page = loop.page()
    page.send({"plot": {"id": 5, "signals": [["left", "age"]]}})
    page.send({"plot": plot})
    loop.until(lambda: bool(page.of("answer")))
    assert why in page.of("answer")[-1]["text"]
    loop.run(0.1)
    assert page.of("signals")[-1]["id"] == 5  # what it plotted before


def test_a_page_is_sent_by_gzip_to_whom_takes_it(loop: Bench) -> None:
    for accepted in ("", "Accept-Encoding: br, gzip\r\n"):
        connection = get(loop.address, f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n{accepted}\r\n".encode())
        came = bytearray()
        loop.until(partial(received, connection, came))
        connection.close()
        head, _, body = bytes(came).partition(b"\r\n\r\n")
        assert (b"Content-Encoding: gzip" in head) is bool(accepted)
        assert (gzip.decompress(body) if accepted else body) == pages()["/"].body


def received(connection: socket.socket, came: bytearray) -> bool:
    """Add what has come; return whether that was all."""
    try:
        while data := connection.recv(1 << 16):
            came.extend(data)
    except BlockingIOError:
        return False
    return True


def test_a_late_tick_does_not_make_the_next_ones_late(loop: Bench) -> None:
    page = loop.page()
    for number, jitter in zip(range(400), cycle((0, 1, 2)), strict=False):
        loop.now = (number + 100) * PERIOD + jitter * MILLISECOND - PERIOD
        loop.tick()
    times = [one["clock"] / 1e3 for one in page.of("signals") if one["clock"] >= 500]
    assert abs(len(times) - (times[-1] - times[0]) / 0.02) <= 1.5


def test_a_scan_is_shown_from_where_it_was_measured() -> None:
    scene = Scene(Gateway(load_robot("diffbot")), "live", dict)
    belief = scene.belief
    for number in range(1, 11):
        now = number * PERIOD
        scan = LaserScan("lidar", 3 * PERIOD, 0.0, 0.1, 0.1, 5.0, (1.0, 2.0), duration=4 * PERIOD)
        estimate = Estimate(now, Pose(number / 100, 0.0, 0.0), 2.0, 0.0, np.zeros((3, 3)))
        outputs = Outputs(events=(scan,) if number == 10 else ())
        scene.observe(Tick(number, now, Inputs(), outputs), replace(belief, estimate=estimate))
    assert scene.swept == {"lidar": [[0.03, 0.0, 0.0], [0.07, 0.0, 0.0]]}


def test_a_page_asks_and_is_answered(loop: Bench) -> None:
    page = loop.page()
    for number, line in enumerate(["goal 1 2 90", "gaol 1 2", "set left.limits.velocity 3"]):
        page.send({"ask": line, "id": number})
    loop.until(lambda: len(page.of("answer")) == 3)
    assert [(one["id"], one["ok"]) for one in page.of("answer")] == [(0, True), (1, False), (2, True)]
    assert "goal" in page.of("answer")[1]["text"]
    assert [one.x for one in loop.asked(Goal)] == [1.0]
    assert loop.asked(Set) == [Set("left.limits.velocity", 3.0)]
    loop.until(lambda: len(page.of("settings")) == 2)  # what was changed is shown again


def test_what_a_page_holds_ends_when_it_falls_silent_and_when_it_is_gone(loop: Bench) -> None:
    page = loop.page()
    for _ in range(10):
        page.hold("drive 0.3 0")
        loop.run(0.05)
    assert set(loop.asked(Drive)) == {Drive(0.3, 0.0)}
    last = loop.instructions[-1][0]
    loop.run(1.0)
    assert [(one, t - last <= HELD + PERIOD) for t, one in loop.instructions[-1:]] == [
        (Drive(0.0, 0.0), True)
    ]
    page.hold("drive 0.3 0")
    loop.run(0.05)
    page.close()
    loop.tick()
    loop.tick()
    assert loop.asked(Drive)[-1] == Drive(0.0, 0.0)


def test_notes_are_shown_to_a_page_that_comes_later(loop: Bench) -> None:
    loop.notes = [Note("error", "left", "</script><b>fault")]
    loop.tick()
    page = loop.page()
    loop.notes = [Note("info", "brain", "ready")]
    loop.until(lambda: len(page.of("note")) == 2)
    assert [one["text"] for one in page.of("note")] == ["</script><b>fault", "ready"]


# -- abuse: the loop goes on, and a stop is heard --------------------------------------------------------


def stop_is_heard(loop: Bench, page: Browser) -> int:
    """Return after how many ticks the stop of a page is an instruction."""
    stops = len(loop.asked(Stop))
    page.send({"ask": "stop now"})
    return loop.until(lambda: len(loop.asked(Stop)) > stops)


def test_a_thousand_connections_that_say_nothing(loop: Bench) -> None:
    page = loop.page()
    silent = []
    for _ in range(1000):
        silent.append(get(loop.address, b"GET /cockpit HTTP/1.1\r\n"))
        loop.tick()
        if len(silent) > 200:
            silent.pop(0).close()
    assert stop_is_heard(loop, page) <= 3
    assert len(loop.view._server._connections) < 64
    loop.run(6.0)
    assert len(loop.view._server._connections) == 1  # the others did not get on
    for one in silent:
        one.close()


def test_a_page_that_comes_when_there_is_no_room_is_refused_until_one_falls_silent(loop: Bench) -> None:
    pages = [loop.page() for _ in range(MAX_CLIENTS)]
    late = loop.browser()
    loop.until(lambda: bool(late.status))
    assert late.status == 503
    assert all(one.open for one in pages)
    while loop.now < SILENCE:
        for one in pages[1:]:
            one.send({})  # it is still there
        loop.run(1.0)
    loop.page()
    loop.until(lambda: not pages[0].open)
    assert pages[0].code == 1013
    assert all(one.open for one in pages[1:])
    assert stop_is_heard(loop, pages[1]) <= 3


def test_a_huge_message_ends_its_connection_and_nothing_else(loop: Bench) -> None:
    page, rude = loop.page(), loop.page()
    rude.write(b"\x82\xff" + (100 << 20).to_bytes(8, "big") + bytes(4) + bytes(1 << 16))  # a frame's head
    loop.until(lambda: not rude.open)
    assert rude.code == 1009
    assert stop_is_heard(loop, page) <= 3
    rude, part = loop.page(), (MAX_SIZE - 1).to_bytes(2, "big") + bytes(4) + b" " * (MAX_SIZE - 1)
    rude.write(b"\x01\xfe" + part + b"\x00\xfe" + part)  # two fragments of one message
    loop.until(lambda: not rude.open)
    assert rude.code == 1009


@pytest.mark.parametrize("seed", range(8))
def test_rubbish_ends_its_connection_and_nothing_else(loop: Bench, seed: int) -> None:
    dice, page = random.Random(seed), loop.page()
    for _ in range(20):
        page.send({})  # it is still there
        rude = loop.page()
        data = dice.randbytes(dice.randrange(1, 3000))
        if dice.random() < 0.5:
            rude.send(
                dice.choice([data, data.decode("latin-1"), "[]", "{", '{"ask": 1}', '{"play": [1e400]}', "7"])
            )
        else:
            rude.write(data)
        loop.run(0.05)
    assert stop_is_heard(loop, page) <= 5
    assert all(isinstance(one, Stop) for _, one in loop.instructions)


@pytest.mark.parametrize("number", ["NaN", "1e400", "1" * 400, "[" * 900 + "]" * 900, '"x"', "{}", "true"])
def test_a_number_that_is_none_is_not_sent_back(loop: Bench, number: str) -> None:
    page = loop.page()
    page.send(f'{{"ask": "help", "id": {number}}}')
    loop.until(lambda: bool(page.of("answer")))
    assert page.of("answer")[0]["id"] is None or number == "true"


def test_fragments_without_data_take_no_memory(loop: Bench) -> None:
    rude = loop.page()
    rude.write(b"\x01\x80" + bytes(4) + (b"\x00\x80" + bytes(4)) * 5000)
    loop.run(0.5)
    (client,) = loop.view._server.clients
    assert len(client.parts) <= 1


def test_a_client_that_is_closed_and_does_not_answer_is_dropped(loop: Bench) -> None:
    rude = loop.page()
    rude.send("no JSON")
    loop.tick()
    loop.browsers.remove(rude)
    assert loop.view._server.clients == []
    loop.run(2.0)
    assert loop.view._server._connections == []
    rude.close()


def test_a_sample_may_be_as_large_as_it_is(loop: Bench) -> None:
    """One who reads is not slow, whatever is to be read."""
    page = loop.page()
    (client,) = loop.view._server.clients
    client.sample("large", lambda: b"\2\0\0\0{}" + bytes(3 * MAX_UNSENT))
    loop.browsers.remove(page)
    loop.run(0.2)  # a slow wire
    assert client.sampled
    loop.browsers.append(page)
    loop.run(1.0)
    assert page.open
    assert not client.sampled


def test_a_flood_of_what_is_held_moves_nothing_once_its_page_is_gone(loop: Bench) -> None:
    page, rude = loop.page(), loop.page()
    for _ in range(5000):
        rude.hold("drive 0.3 0")
    loop.run(0.05)
    rude.close()
    gone = loop.now
    loop.run(5.0)
    moved = [t for t, one in loop.instructions if isinstance(one, Drive) and one != Drive(0.0, 0.0)]
    assert moved[-1] - gone <= HELD
    assert loop.asked(Drive)[-1] == Drive(0.0, 0.0)
    assert stop_is_heard(loop, page) <= 3


def test_brackets_without_end_are_no_json(loop: Bench) -> None:
    rude = loop.page()
    rude.send("[" * 60_000)
    loop.until(lambda: not rude.open)
    assert (rude.code, rude.reason) == (1003, "JSON is expected: an object")


def test_a_flood_of_goals_is_heard_in_part_and_its_own_stop_too(loop: Bench) -> None:
    page, rude = loop.page(), loop.page()
    for number in range(5000):
        rude.send({"ask": f"goal {number} 0"})
    before = loop.now
    for _ in range(50):
        loop.tick()
        assert len([one for t, one in loop.instructions if t == loop.now]) <= PER_POLL
    assert AT_ONCE <= len(loop.asked(Goal)) <= AT_ONCE + 20 * (loop.now - before) / SECOND + 1
    assert stop_is_heard(loop, page) <= 3
    assert stop_is_heard(loop, rude) <= 250  # behind its own flood, as fast as that is read
    assert any("too many requests" in one["text"] for one in rude.of("answer"))


def test_a_slow_reader_gets_the_newest_samples_and_every_note_and_is_let_go_in_the_end(loop: Bench) -> None:
    slow, page = loop.page(), loop.page()
    told = 0
    loop.browsers.remove(slow)
    for _ in range(round(5 * SECOND / PERIOD)):
        told += 1
        loop.notes = [Note("info", "brain", f"{told} " + "x" * 2000)]
        loop.tick()
    loop.browsers.append(slow)  # reads again
    loop.until(lambda: len(slow.of("note")) == told)
    assert [int(one["text"].split()[0]) for one in slow.of("note")] == list(range(1, told + 1))
    assert len(slow.of("joints")) < len(page.of("joints"))
    loop.until(lambda: slow.of("state")[-1]["t"] >= (loop.now - SECOND) / SECOND)

    loop.browsers.remove(slow)
    waited = 0.0
    while len(loop.view._server.clients) == 2:
        loop.notes = [Note("info", "brain", "x" * 20_000)]
        loop.tick()
        waited += PERIOD / SECOND
        assert waited < 60.0
    sent = waited / (PERIOD / SECOND) * 20_000
    assert waited >= PATIENCE / SECOND or sent >= MAX_UNSENT
    slow.close()
    assert stop_is_heard(loop, page) <= 3


def test_a_client_that_only_pings_is_bounded(loop: Bench) -> None:
    page, rude = loop.page(), loop.page()
    rude.write(b"\x89\x80" + bytes(4) + (b"\x89\x80" + bytes(4)) * 100_000)
    for _ in range(100):
        loop.tick()
    assert stop_is_heard(loop, page) <= 3
