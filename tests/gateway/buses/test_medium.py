"""A shared medium in virtual time: durations, arbitration, order, limits."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.buses.frame_time import frame_bits, frame_time, priority
from gateway.buses.virtual.medium import Medium
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND

MBIT = 1_000_000
SAMPLE = 10_000


def test_serial_bytes_take_ten_bits_each() -> None:
    assert frame_time(bytes(100), MBIT) == 1_000_000
    assert frame_time(bytes(100), MBIT // 2) == 2_000_000
    assert frame_time(b"", MBIT) == 0


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
    """The bits of a frame as they would be sent, laid out one by one (ISO 11898-1:2015, 10.4).

    Stuff bits behind five equal ones: in CAN FD up to the end of the data, and from there on at fixed places,
    so that it does not matter which bits the CRC has; in classic CAN to the end of the CRC."""
    ident = f"{frame.id:011b}" if not frame.extended else f"{frame.id >> 18:011b}11{frame.id & 0x3FFFF:018b}"
    code = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64).index(len(frame.data))
    rest = f"{code:04b}" + "".join(f"{byte:08b}" for byte in frame.data)
    if frame.fd:
        head = "0" + ident + ("0" if frame.extended else "00") + "10" + str(int(frame.brs))
        rest = "0" + rest  # ESI
    else:
        head, rest = "", "0" + ident + str(int(frame.remote)) + "00" + rest
        rest += checksum(rest)
    counts, same, last, stuffed = [0, 0], 0, "", False
    for at, bit in enumerate(head + rest):
        phase = int(at >= len(head))
        counts[phase] += 1
        same = same + 1 if bit == last else 1
        last, stuffed = bit, same == 5
        if stuffed:
            counts[phase] += 1
            same, last = 1, "10"[int(bit)]
    end = 1 + 1 + 1 + 7 + 3  # CRC delimiter, acknowledgement and its delimiter, end, gap
    if not frame.fd:
        return counts[1] + end, 0
    checked = 4 + (21 if len(frame.data) > 16 else 17)  # stuff count with parity, and CRC
    return counts[0] + end, counts[1] - stuffed + checked + 1 + checked // 4


def checksum(bits: str) -> str:
    """The remainder of a division by x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1, as on paper."""
    rest = [*map(int, bits), *[0] * 15]
    for at in range(len(bits)):
        if rest[at]:
            for power in (15, 14, 10, 8, 7, 4, 3, 0):
                rest[at + 15 - power] ^= 1
    return "".join(map(str, rest[-15:]))


def test_the_lengths_of_random_frames_are_those_of_their_bits() -> None:
    rng = np.random.Generator(np.random.PCG64(11))
    for at in range(SAMPLE):
        fd, extended, plain = (bool(rng.integers(2)) for _ in range(3))
        length = int(rng.choice((0, 1, 7, 8, 12, 16, 20, 24, 32, 48, 64) if fd else range(9)))
        data = bytes([int(rng.choice((0x00, 0xFF, 0x78, 0xF8)))]) * length if plain else rng.bytes(length)
        ident = 0 if at % 8 == 0 else int(rng.integers(0x20000000 if extended else 0x800))
        remote = not fd and not data and bool(rng.integers(2))
        frame = CanFrame(ident, data, extended, remote, fd, brs=fd and plain)
        assert frame_bits(frame) == bits_of(frame), frame
        if not fd:  # Davis et al. 2007, "Controller Area Network (CAN) schedulability analysis", eq. 1
            checked = (54 if extended else 34) + 8 * length
            assert checked + 13 <= frame_bits(frame)[0] <= checked + 13 + (checked - 1) // 4


def test_can_fd_data_is_padded_to_a_valid_length() -> None:
    line = Medium(MBIT, 5 * MBIT)
    for length in (8, 9, 13, 33, 49):
        line.send(0, "a", CanFrame(1, b"\x50" * length, fd=True, brs=True))
    arrived = [sent.frame for sent in line.run(MILLISECOND)]
    assert [len(frame.data) for frame in arrived if isinstance(frame, CanFrame)] == [8, 12, 16, 48, 64]
    assert arrived[1] == CanFrame(1, b"\x50" * 9 + bytes(3), fd=True, brs=True)
    nine, twelve = (CanFrame(1, bytes(n), fd=True, brs=True) for n in (9, 12))
    assert frame_time(nine, MBIT, 5 * MBIT) == frame_time(twelve, MBIT, 5 * MBIT)


def arrival(frame: CanFrame) -> int:
    """When it arrives [ns] if it begins at 0: the interframe space is not waited for."""
    return frame_time(frame, MBIT) - 3_000


def test_frames_of_both_kinds_share_a_bus() -> None:
    """The classic one wins by its id; the switched one takes less time and carries three times as much."""
    line = Medium(MBIT, 5 * MBIT)
    line.send(0, "fd", CanFrame(0x501, bytes(24), fd=True, brs=True))
    line.send(0, "classic", CanFrame(0x181, bytes(8)))
    first, second = line.run(MILLISECOND)
    assert (first.sender, first.t) == ("classic", arrival(CanFrame(0x181, bytes(8))))
    took = frame_time(CanFrame(0x501, bytes(24), fd=True, brs=True), MBIT, 5 * MBIT)
    assert (second.sender, second.t - first.t) == ("fd", took)


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
    took = [frame_time(sent.frame, MBIT) for sent in arrived]
    assert [sent.t for sent in arrived] == [sum(took[: i + 1]) - 3_000 for i in range(4)]


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
    line.drop("a")
    assert line.run(2 * MILLISECOND) == []


def test_a_destroyed_frame_is_sent_again_after_the_error_frame() -> None:
    line, hits = Medium(MBIT), [20, 0]
    line.destroyed = lambda _: hits.pop(0)
    line.send(0, "a", CanFrame(1, bytes(8)))
    [sent] = line.run(MILLISECOND)
    assert sent.t == 20_000 + (12 + 8 + 3) * 1000 + arrival(CanFrame(1, bytes(8)))
    assert line.errors == {"a": 7}


def test_a_sender_whose_frames_are_always_destroyed_goes_bus_off_and_the_others_go_on() -> None:
    line = Medium(MBIT)
    line.destroyed = lambda one: 50 if one.sender == "a" else 0
    line.send(0, "a", CanFrame(1))
    line.send(0, "b", CanFrame(2))
    [sent] = line.run(10 * MILLISECOND)
    assert (sent.sender, sent.t) == ("b", 32 * (50 + 23) * 1000 + arrival(CanFrame(2)))
    assert line.send(10 * MILLISECOND, "a", CanFrame(1))
    assert line.run(20 * MILLISECOND) == []
    line.drop("a")
    line.destroyed = None
    line.send(20 * MILLISECOND, "a", CanFrame(1))
    assert len(line.run(30 * MILLISECOND)) == 1
