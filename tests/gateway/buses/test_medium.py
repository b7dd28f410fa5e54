"""A shared medium in virtual time: durations, arbitration, order, limits."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from gateway.buses.frame_time import frame_bits, frame_time, priority
from gateway.buses.virtual.medium import Medium
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND
from tests.gateway.buses.bit_layout import CRC_15, CRC_17, CRC_21, layout, remainder

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


def test_the_layout_that_judges_has_the_checksums_of_the_catalogue_of_crcs() -> None:
    """Check values, of "123456789", of CRC-15/CAN, CRC-17/CAN-FD and CRC-21/CAN-FD."""
    message = "".join(f"{byte:08b}" for byte in b"123456789")
    values = [int(remainder(message, powers, 0), 2) for powers in (CRC_15, CRC_17, CRC_21)]
    assert values == [0x059E, 0x04F03, 0x0ED841]


def random_frame(rng: np.random.Generator, number: int) -> CanFrame:
    fd, extended, plain = (bool(rng.integers(2)) for _ in range(3))
    length = int(rng.choice((0, 1, 7, 8, 12, 16, 20, 24, 32, 48, 64) if fd else range(9)))
    data = bytes([int(rng.choice((0x00, 0xFF, 0x78, 0xF8)))]) * length if plain else rng.bytes(length)
    ident = 0 if number % 8 == 0 else int(rng.integers(0x20000000 if extended else 0x800))
    remote = not fd and not data and bool(rng.integers(2))
    requested = int(rng.integers(9)) if remote else 0
    return CanFrame(ident, data, extended, remote, fd, fd and bool(rng.integers(2)), requested)


def test_the_lengths_of_random_frames_are_those_of_their_bits() -> None:
    rng = np.random.Generator(np.random.PCG64(11))
    for number in range(SAMPLE):
        frame = random_frame(rng, number)
        slow, fast = frame_bits(frame)
        laid_out = layout(frame)
        assert slow + fast == len(laid_out.bits), frame
        # Nominal and data bit in ns: 1 and 5 Mbit/s.
        taken = laid_out.duration(Fraction(1000), Fraction(200))
        assert frame_time(frame, MBIT, 5 * MBIT) == taken, frame
        length = 8 * len(frame.data)
        if frame.fd:  # Linux, include/linux/can/length.h: fields of a frame, without the stuff bits
            fields = (86 if frame.extended else 67) - (0 if len(frame.data) > 16 else 21 - 17 + 1)
            assert slow + fast - laid_out.stuffed == fields + length, frame
        else:  # Davis et al. 2007, "Controller Area Network (CAN) schedulability analysis", eq. 1
            checked = (54 if frame.extended else 34) + length
            assert checked + 13 <= slow <= checked + 13 + (checked - 1) // 4


def test_the_rate_changes_within_brs_and_the_crc_delimiter_wherever_their_sample_points_are() -> None:
    frame = CanFrame(0x123, bytes(range(24)), fd=True, brs=True)
    for slow, fast in ((0.8, 0.7), (0.875, 0.5), (0.5, 0.9)):
        points = Fraction(slow).limit_denominator(), Fraction(fast).limit_denominator()
        taken = layout(frame).duration(Fraction(2000), Fraction(500), points)
        assert taken == frame_time(frame, MBIT // 2, 2 * MBIT)


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
