from __future__ import annotations

import pytest

from protocols.frames import (
    EXTENDED_BIT,
    BusState,
    CanFrame,
    Frame,
    IdMask,
    any_matches,
    exact,
    id_matches,
    id_number,
    overlap,
)

# candump's own notation: id in three or eight digits, # or ##flags, data in upper case, R for a remote frame
# (linux-can/can-utils `lib.h`, sprint_canframe and parse_canframe).
NOTATION: list[tuple[CanFrame, str]] = [
    (CanFrame(0x123, bytes.fromhex("deadbeef")), "123#DEADBEEF"),
    (CanFrame(0x123), "123#"),
    (CanFrame(0x1), "001#"),
    (CanFrame(0x7FF, bytes(8)), "7FF#0000000000000000"),
    (CanFrame(0x123, extended=True), "00000123#"),
    (CanFrame(0x12345678, b"\x11", extended=True), "12345678#11"),
    (CanFrame(0x123, remote=True), "123#R"),
    (CanFrame(0x123, remote=True, requested=8), "123#R8"),
    (CanFrame(0x1ABCDEF0, remote=True, extended=True), "1ABCDEF0#R"),
    (CanFrame(0x123, b"\xab", fd=True), "123##0AB"),
    (CanFrame(0x123, b"\xab", fd=True, brs=True), "123##1AB"),
    (CanFrame(0x12345678, b"\xde\xad\xbe\xef", extended=True, fd=True, brs=True), "12345678##1DEADBEEF"),
]


@pytest.mark.parametrize(("frame", "text"), NOTATION, ids=[text for _, text in NOTATION])
def test_a_frame_reads_as_candump_has_it(frame: CanFrame, text: str) -> None:
    assert str(frame) == text
    assert f"{frame}" == text


def test_frames_that_differ_in_anything_differ() -> None:
    base = CanFrame(0x123, b"\1")
    others: list[Frame] = [
        CanFrame(0x124, b"\1"),
        CanFrame(0x123, b"\2"),
        CanFrame(0x123, b"\1", extended=True),
        CanFrame(0x123, b"\1", fd=True),
        CanFrame(0x123, b"\1", fd=True, brs=True),
        CanFrame(0x123, remote=True),
        CanFrame(0x123, remote=True, requested=1),
        b"\1",
    ]
    assert len({base, *others}) == len(others) + 1
    assert base == CanFrame(0x123, b"\1")


def test_bus_states_are_their_own_text() -> None:
    assert [f"{state}" for state in BusState] == ["up", "passive", "off", "full", "gone", "back"]


def test_an_id_of_29_bits_is_another_one_than_the_same_number_in_11() -> None:
    short, long = CanFrame(0x123), CanFrame(0x123, extended=True)
    assert id_number(long) == 0x123 | EXTENDED_BIT
    assert (id_matches(exact(0x123), short), id_matches(exact(0x123), long)) == (True, False)
    assert any_matches([exact(0x124), exact(0x123, extended=True)], long)
    assert not any_matches([exact(0x124), exact(0x123, extended=True)], short)
    assert not any_matches([], short)


# As of a CyberGear: message type, 16 bits of torque, device (29 bits).
TORQUE_IN_ID: IdMask = (EXTENDED_BIT | 1 << 24 | 5, EXTENDED_BIT | 0x1F00_00FF)


@pytest.mark.parametrize(
    ("one", "other", "both"),
    [
        (exact(0x41), exact(0x41), True),
        (exact(0x41), exact(0x41, extended=True), False),
        (exact(0x41), (0x40, 0x7F0), True),
        (exact(0x41), (0x40, 0x7F2), True),
        (exact(0x41), (0x42, 0x7F2), False),
        (TORQUE_IN_ID, exact(0x0180_0005, extended=True), True),
        (TORQUE_IN_ID, exact(0x0180_0006, extended=True), False),
        (TORQUE_IN_ID, (EXTENDED_BIT | 0x0080_0000, EXTENDED_BIT | 0x0080_0000), True),
    ],
)
def test_ids_with_open_bits_overlap_where_fixed_bits_agree(one: IdMask, other: IdMask, both: bool) -> None:
    assert overlap(one, other) is overlap(other, one) is both
    assert all(id_matches(TORQUE_IN_ID, 1 << 24 | torque << 8 | 5 | EXTENDED_BIT) for torque in (0, 0xFFFF))
