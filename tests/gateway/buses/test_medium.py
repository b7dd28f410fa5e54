"""A shared medium in virtual time: durations, arbitration, order, limits."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.buses.frame_time import frame_bits, frame_time, priority
from gateway.buses.virtual.medium import Medium
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND

MBIT = 1_000_000


@pytest.mark.parametrize(
    ("frame", "nanos"),
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
def test_duration_at_one_megabit(frame: Frame, nanos: int) -> None:
    assert frame_time(frame, MBIT) == nanos
    assert frame_time(frame, MBIT // 2) == 2 * nanos


def test_can_fd_switches_its_data_phase() -> None:
    long = CanFrame(1, bytes(64), fd=True, brs=True)
    slow, fast = frame_bits(long)
    assert fast > 64 * 8
    assert frame_time(long, MBIT, 5 * MBIT) == slow * 1000 + fast * 200
    assert frame_time(CanFrame(1, bytes(64), fd=True), MBIT, 5 * MBIT) == (slow + fast) * 1000
    assert frame_time(long, MBIT) == (slow + fast) * 1000
    with pytest.raises(ValueError, match="carries nothing"):
        frame_time(b"", 0)


def bits_of(frame: CanFrame) -> tuple[int, int]:
    """The bits of a CAN FD frame as they would be sent, laid out one by one (ISO 11898-1:2015, 10.4.2).

    Stuff bits behind five equal ones, up to the end of the data; from there on at fixed places, so that it
    does not matter which bits the CRC has."""
    ident = f"{frame.id:011b}" if not frame.extended else f"{frame.id >> 18:011b}11{frame.id & 0x3FFFF:018b}"
    head = (
        "0" + ident + ("0" if frame.extended else "00") + "10" + str(int(frame.brs))
    )  # RRS (IDE), FDF, res, BRS
    code = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64).index(len(frame.data))
    rest = f"0{code:04b}" + "".join(f"{byte:08b}" for byte in frame.data)
    counts, same, last = [0, 0], 0, ""
    for at, bit in enumerate(head + rest):
        phase = int(at >= len(head))
        counts[phase] += 1
        same = same + 1 if bit == last else 1
        last = bit
        if same == 5:
            counts[phase] += 1
            same, last = 1, "10"[int(bit)]
    checked = 4 + (21 if len(frame.data) > 16 else 17)  # stuff count with parity, and CRC
    counts[1] += checked + 1 + checked // 4
    counts[0] += 1 + 1 + 1 + 7 + 3  # CRC delimiter, acknowledgement and its delimiter, end, gap
    return counts[0], counts[1]


def test_a_can_fd_frame_takes_no_less_than_its_bits_and_little_more_than_the_worst() -> None:
    rng = np.random.Generator(np.random.PCG64(11))
    worst: dict[tuple[int, bool], int] = {}
    for length in (0, 1, 7, 8, 12, 16, 20, 24, 32, 48, 64):
        for extended in (False, True):
            alike = [
                bytes(length),
                b"\xff" * length,
                b"\x78\x3c\x1e\x0f\x87\xc3\xe1\xf0"[:length],
                b"\xf8" * length,
            ]
            for data in (*alike, *(rng.bytes(length) for _ in range(30))):
                number = int(rng.integers(0x20000000 if extended else 0x800))
                for ident in (number, 0):
                    frame = CanFrame(ident, data.ljust(length, b"\0"), extended, fd=True, brs=True)
                    (slow, fast), (most_slow, most_fast) = bits_of(frame), frame_bits(frame)
                    assert slow <= most_slow, frame
                    assert fast <= most_fast, frame
                    worst[length, extended] = max(worst.get((length, extended), 0), slow + fast)
            bound = sum(frame_bits(CanFrame(0, bytes(length), extended, fd=True, brs=True)))
            assert bound - worst[length, extended] <= 10 + 2 * length


def test_can_fd_data_is_padded_to_a_valid_length() -> None:
    line = Medium(MBIT, 5 * MBIT)
    for length in (8, 9, 13, 33, 49):
        line.send(0, "a", CanFrame(1, b"\x50" * length, fd=True, brs=True))
    arrived = [sent.frame for sent in line.run(MILLISECOND)]
    assert [len(frame.data) for frame in arrived if isinstance(frame, CanFrame)] == [8, 12, 16, 48, 64]
    assert arrived[1] == CanFrame(1, b"\x50" * 9 + bytes(3), fd=True, brs=True)
    nine, twelve = (CanFrame(1, bytes(n), fd=True, brs=True) for n in (9, 12))
    assert frame_time(nine, MBIT, 5 * MBIT) == frame_time(twelve, MBIT, 5 * MBIT)


def test_frames_of_both_kinds_share_a_bus() -> None:
    """The classic one wins by its id; the switched one takes less time and carries three times as much."""
    line = Medium(MBIT, 5 * MBIT)
    line.send(0, "fd", CanFrame(0x501, bytes(24), fd=True, brs=True))
    line.send(0, "classic", CanFrame(0x181, bytes(8)))
    first, second = line.run(MILLISECOND)
    assert (first.sender, first.t) == ("classic", 135_000)
    assert (second.sender, second.t - first.t) == ("fd", 34_000 + 55_600)


def test_arbitration() -> None:
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
    line = Medium(MBIT)
    frames = {name: [CanFrame(i, bytes(8)) for i in ids] for name, ids in {"a": (9, 1), "b": (5, 5)}.items()}
    for name, sent in frames.items():
        for frame in sent:
            assert line.send(0, name, frame)
    arrived = line.run(MILLISECOND)
    assert [(sent.sender, getattr(sent.frame, "id", None)) for sent in arrived] == [
        ("b", 5),
        ("b", 5),
        ("a", 9),
        ("a", 1),
    ]
    assert [sent.t for sent in arrived] == [135_000 * (i + 1) for i in range(4)]


def test_a_frame_being_sent_is_not_interrupted() -> None:
    line = Medium(MBIT)
    line.send(0, "a", CanFrame(0x700, bytes(8)))
    assert line.run(100_000) == []
    line.send(100_000, "b", CanFrame(0x001, bytes(8)))
    assert [sent.sender for sent in line.run(MILLISECOND)] == ["a", "b"]


def test_bytes_go_first_come_first_served() -> None:
    line = Medium(MBIT)
    line.send(20_000, "late", b"x")
    line.send(10_000, "early", bytes(10))
    assert [(sent.t, sent.sender) for sent in line.run(MILLISECOND)] == [
        (110_000, "early"),
        (120_000, "late"),
    ]


def test_arrivals_do_not_depend_on_how_often_the_medium_is_run() -> None:
    rng = np.random.Generator(np.random.PCG64(11))
    moments = np.sort(rng.integers(0, 20 * MILLISECOND, 150)).tolist()
    ids = rng.integers(0, 0x7FF, 150).tolist()

    def arrivals(step: int) -> list[tuple[int, str, Frame]]:
        line, seen, index = Medium(MBIT), [], 0
        for now in range(0, 60 * MILLISECOND, step):
            while index < len(moments) and moments[index] <= now:
                line.send(moments[index], "abc"[index % 3], CanFrame(ids[index], bytes(8)))
                index += 1
            seen += line.run(now)
        return [(sent.t, sent.sender, sent.frame) for sent in seen]

    often = arrivals(10_000)
    assert len(often) == 150
    assert arrivals(50_000) == often


def test_a_full_queue_drops_the_oldest_and_reports_it() -> None:
    line = Medium(MBIT, limit=2)
    assert line.send(0, "a", CanFrame(1))
    assert line.send(0, "a", CanFrame(2))
    assert not line.send(0, "a", CanFrame(3))
    assert line.waiting("a") == 2
    assert [sent.frame for sent in line.run(MILLISECOND)] == [CanFrame(2), CanFrame(3)]
    line.send(MILLISECOND, "a", CanFrame(4))
    line.clear()
    assert line.run(2 * MILLISECOND) == []
