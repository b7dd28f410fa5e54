"""How much of what is sent goes on to the loop, whoever floods: the newest of streams, and a stop always."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest

from gateway.ros import intake
from gateway.ros.intake import ALWAYS, BYTES, IN_ALL, REQUESTS, SMALL, THINNED, Intake, Share
from gateway.ros.link import Link


@pytest.fixture
def ends() -> Iterator[tuple[Intake, Link]]:
    ours, theirs = (Link(end) for end in socket.socketpair())
    yield Intake(ours), theirs
    ours.close()
    theirs.close()


def come(taken: Intake, link: Link) -> list[list[Any]]:
    taken.link.flush()
    return link.receive()


def test_of_a_stream_the_newest_of_each_writer_goes_on(ends: tuple[Intake, Link]) -> None:
    taken, link = ends
    for number in range(100):
        taken.stream(3, bytes([number]), b"one")
    taken.stream(3, b"x", b"two")
    taken.turn(THINNED - 1)
    assert come(taken, link) == []
    taken.turn(THINNED)
    assert come(taken, link) == [["sample", 3, bytes([99]), b"one", 100], ["sample", 3, b"x", b"two", 1]]
    for number in range(10 * REQUESTS):
        taken.stream(3, b"", number.to_bytes(4, "big"))
    taken.turn(2 * THINNED)
    assert len(come(taken, link)) == REQUESTS


def test_a_flood_of_requests_leaves_room_for_a_stop(ends: tuple[Intake, Link]) -> None:
    taken, link = ends
    for row in range(20):
        for number in range(1000):
            taken.request(row, bytes(100), [number])
    for _ in range(50):
        taken.sample(20, bytes(1 << 20), b"large")
    assert taken.request(21, bytes(8), ["stop"])
    found = come(taken, link)
    assert found[-1] == ["request", 21, bytes(8), ["stop"]]
    assert len(found) <= IN_ALL + 21 * ALWAYS
    assert [one[3] for one in found if one[1] == 0] == [[number] for number in range(REQUESTS)]


@pytest.mark.parametrize(
    ("size", "goes"),
    [
        (SMALL, [REQUESTS, REQUESTS]),
        (BYTES // 4, [4, 4]),  # what there are bytes for
        (4 * BYTES, [1, 0, 0, 0, 1]),  # one goes on, and then its bytes are paid back
    ],
)
def test_the_share_of_a_row(size: int, goes: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    if size == SMALL:
        monkeypatch.setattr(intake, "BYTES", 1 << 20)
    share = Share(left=intake.BYTES)
    for count in goes:
        assert sum(share.take(1, size) for _ in range(100)) == count
        share.begin()
