"""One wire in virtual time: durations, arbitration, order, limits."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.buses.line import Line
from gateway.buses.timing import frame_bits, priority, wire_time
from protocols.wire import CanFrame, Wire
from protocols.words import MILLISECOND

MBIT = 1_000_000


@pytest.mark.parametrize(
    ("wire", "nanos"),
    [
        # Davis et al. 2007, table 1 and eq. 1: 8 bytes are at most 135 bits (standard), 160 (extended).
        (CanFrame(0x123, bytes(8)), 135_000),
        (CanFrame(0x123), 55_000),
        (CanFrame(0x12345678, bytes(8), extended=True), 160_000),
        (CanFrame(0x12345678, extended=True), 80_000),
        (bytes(100), 1_000_000),
        (b"", 0),
    ],
)
def test_how_long_a_wire_takes_at_one_megabit(wire: Wire, nanos: int) -> None:
    assert wire_time(wire, MBIT) == nanos
    assert wire_time(wire, MBIT // 2) == 2 * nanos


def test_can_fd_switches_its_data_phase() -> None:
    long = CanFrame(1, bytes(64), fd=True, brs=True)
    slow, fast = frame_bits(long)
    assert fast > 64 * 8
    assert wire_time(long, MBIT, 5 * MBIT) == slow * 1000 + fast * 200
    assert wire_time(CanFrame(1, bytes(64), fd=True), MBIT, 5 * MBIT) == (slow + fast) * 1000
    assert wire_time(long, MBIT) == (slow + fast) * 1000
    with pytest.raises(ValueError, match="carries nothing"):
        wire_time(b"", 0)


def test_who_wins_the_arbitration() -> None:
    ranked = [
        CanFrame(0x001, b"\0"),
        CanFrame(0x001, remote=True),
        CanFrame(0x001 << 18 | 5, b"\0", extended=True),
        CanFrame(0x001 << 18 | 6, b"\0", extended=True),
        CanFrame(0x002, b"\0"),
        CanFrame(0x7FF, b"\0"),
    ]
    order = np.random.Generator(np.random.PCG64(3)).permutation(len(ranked))
    assert sorted((ranked[i] for i in order), key=priority) == ranked


def test_frames_contend_and_each_sender_keeps_its_order() -> None:
    line = Line(MBIT)
    frames = {name: [CanFrame(i, bytes(8)) for i in ids] for name, ids in {"a": (9, 1), "b": (5, 5)}.items()}
    for name, sent in frames.items():
        for frame in sent:
            assert line.send(0, name, frame)
    arrived = line.run(MILLISECOND)
    assert [(sent.sender, getattr(sent.wire, "id", None)) for sent in arrived] == [
        ("b", 5),
        ("b", 5),
        ("a", 9),
        ("a", 1),
    ]
    assert [sent.t for sent in arrived] == [135_000 * (i + 1) for i in range(4)]


def test_a_frame_on_the_wire_is_not_interrupted() -> None:
    line = Line(MBIT)
    line.send(0, "a", CanFrame(0x700, bytes(8)))
    assert line.run(100_000) == []
    line.send(100_000, "b", CanFrame(0x001, bytes(8)))
    assert [sent.sender for sent in line.run(MILLISECOND)] == ["a", "b"]


def test_bytes_go_first_come_first_served() -> None:
    line = Line(MBIT)
    line.send(20_000, "late", b"x")
    line.send(10_000, "early", bytes(10))
    assert [(sent.t, sent.sender) for sent in line.run(MILLISECOND)] == [
        (110_000, "early"),
        (120_000, "late"),
    ]


def test_what_arrives_does_not_hang_on_how_often_one_looks() -> None:
    rng = np.random.Generator(np.random.PCG64(11))
    moments = np.sort(rng.integers(0, 20 * MILLISECOND, 150)).tolist()
    ids = rng.integers(0, 0x7FF, 150).tolist()

    def arrivals(step: int) -> list[tuple[int, str, Wire]]:
        line, seen, index = Line(MBIT), [], 0
        for now in range(0, 60 * MILLISECOND, step):
            while index < len(moments) and moments[index] <= now:
                line.send(moments[index], "abc"[index % 3], CanFrame(ids[index], bytes(8)))
                index += 1
            seen += line.run(now)
        return [(sent.t, sent.sender, sent.wire) for sent in seen]

    often = arrivals(10_000)
    assert len(often) == 150
    assert arrivals(50_000) == often


def test_a_full_queue_drops_the_oldest_and_says_so() -> None:
    line = Line(MBIT, limit=2)
    assert line.send(0, "a", CanFrame(1))
    assert line.send(0, "a", CanFrame(2))
    assert not line.send(0, "a", CanFrame(3))
    assert line.waiting("a") == 2
    assert [sent.wire for sent in line.run(MILLISECOND)] == [CanFrame(2), CanFrame(3)]
    line.send(MILLISECOND, "a", CanFrame(4))
    line.clear()
    assert line.run(2 * MILLISECOND) == []
