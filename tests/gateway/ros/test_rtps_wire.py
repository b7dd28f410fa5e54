"""RTPS's bytes: those that Fast DDS and the specification have, there and back, and whatever else comes."""

from __future__ import annotations

import random

import pytest

from gateway.ros import rtps_wire as wire
from gateway.ros.rtps_wire import Acknack, Data, Fragment, Gap, Heartbeat, Identity, NackFragments, Received

SOURCE, TO = bytes(range(12)), bytes(range(12, 24))
READER, WRITER = b"\x00\x00\x01\x04", b"\x00\x00\x02\x03"
HEAD = b"RTPS\x02\x03\x01\x0f" + SOURCE
SENT: list[wire.Submessage] = [
    Data(READER, WRITER, 7, b"\x00\x01\x00\x00abcd"),
    Data(READER, WRITER, (5 << 32) + 3, b"\x00\x01\x00\x00abcd", Identity(SOURCE + WRITER, 2**31 + 1)),
    Data(READER, WRITER, 2, b"", None, ends=True, key=SOURCE + WRITER),
    Fragment(READER, WRITER, 9, 2, 1, 4, 10, b"efgh"),
    Fragment(READER, WRITER, 9, 3, 1, 4, 10, b"ij\0\0", Identity(SOURCE + WRITER, 1)),
    Heartbeat(READER, WRITER, 3, 2**33, 77, final=True),
    Acknack(READER, WRITER, 3, (3, 4, 40, 200), 5),
    Acknack(READER, WRITER, 3, (), 6),
    Gap(READER, WRITER, 3, 9, (11, 12)),
]


@pytest.mark.parametrize("one", SENT)
def test_what_is_written_is_read(one: wire.Submessage) -> None:
    assert wire.read(wire.datagram(SOURCE, TO, [wire.write(one)])) == [Received(SOURCE, TO, one)]


def test_several_are_read_in_order() -> None:
    found = wire.read(wire.datagram(SOURCE, bytes(12), map(wire.write, SENT)))
    assert [one.content for one in found] == SENT
    assert {one.destination for one in found} == {bytes(12)}


# The examples of the specification's mapping, written by hand, in both orders of bytes.
BYTES = [
    ("06 01 1c00 00000104 00000203 00000000 03000000 02000000 000000c0 09000000",
     Acknack(READER, WRITER, 3, (3, 4), 9)),
    ("06 00 001c 00000104 00000203 00000000 00000003 00000002 c0000000 00000009",
     Acknack(READER, WRITER, 3, (3, 4), 9)),
    ("07 00 001c 00000104 00000203 00000000 00000001 00000000 00000002 00000005",
     Heartbeat(READER, WRITER, 1, 2, 5, final=False)),
    ("12 01 2000 00000104 00000203 00000000 04000000 01000000 03000000 000000a0 01000000",
     NackFragments(READER, WRITER, 4, (1, 3))),
    ("09 01 0800 0000000000000000 15 05 1c00 0000 1000 00000104 00000203 00000000 01000000 00010000 61000000",
     Data(READER, WRITER, 1, b"\x00\x01\x00\x00a\0\0\0")),
    ("15 05 0000 0000 1000 00000104 00000203 00000000 01000000 00010000",
     Data(READER, WRITER, 1, b"\x00\x01\x00\x00")),
]  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), BYTES)
def test_bytes_of_others_are_read(text: str, expected: wire.Submessage) -> None:
    assert [one.content for one in wire.read(HEAD + bytes.fromhex(text.replace(" ", "")))] == [expected]


def test_whatever_comes_raises_nothing() -> None:
    whole = wire.datagram(SOURCE, TO, map(wire.write, SENT))
    for size in range(len(whole)):
        assert len(wire.read(whole[:size])) <= len(SENT)
    chance = random.Random(1)
    for _ in range(3000):
        broken = bytearray(whole)
        for _ in range(chance.randrange(1, 9)):
            broken[chance.randrange(20, len(broken))] = chance.randrange(256)
        wire.read(bytes(broken))
        wire.read_parameters(b"\x00\x03\x00\x00" + chance.randbytes(chance.randrange(60)))
    assert wire.read(b"RTPX" + whole[4:]) == []


def test_a_set_of_numbers_is_bounded() -> None:
    many = wire.write(Acknack(READER, WRITER, 1, tuple(range(1, 300)), 1))
    assert wire.read(wire.datagram(SOURCE, TO, [many])) == []


@pytest.mark.parametrize("seconds", [0.0, 0.1, 20.0, float("inf")])
def test_durations(seconds: float) -> None:
    assert wire.read_duration(wire.duration(seconds)) == pytest.approx(seconds, abs=1e-6)


def test_values_that_are_none() -> None:
    assert wire.read_duration(b"") == float("inf")
    assert wire.read_string(b"\xff\xff\xff\xffabc") == ""
    assert wire.read_locator(wire.locator(wire.Locator("127.0.0.1", 7411))) == ("127.0.0.1", 7411)
    assert wire.read_locator(b"\x02\0\0\0" + bytes(20)) is None  # IPv6
    assert wire.read_locator(b"") is None
