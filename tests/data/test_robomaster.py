"""The traffic of a real RoboMaster S1 (its own protocol, of which the project has no plugin): the framing of
the toolkit finds every packet, however the stream is cut, and none with a wrong bit."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from protocols.toolkit.serial import Framing, Stream, crc

TRAFFIC = "robomaster/lab201.csv"
HEAD_CRC = crc(8, 0x31, 0x77)


def body(head: bytes) -> int | None:
    """Bytes between the head, which has a checksum of its own, and that of the packet."""
    length = head[1] | (head[2] & 0x03) << 8
    return length - 6 if length >= 6 and HEAD_CRC(head[:3]) == head[3] else None


FRAMING = Framing(b"\x55", 4, body, crc(16, 0x1021, 0x3692), 2)


@pytest.fixture(scope="module")
def packets(recording: Callable[[str], Path]) -> list[bytes]:
    lines = recording(TRAFFIC).read_text().split()
    return [bytes(int(number, 16) for number in line.split(",") if number) for line in lines]


@pytest.mark.parametrize("size", [1, 8, 1000])
def test_every_packet_is_found(packets: list[bytes], size: int) -> None:
    """8 bytes: as on CAN."""
    stream, line = Stream(FRAMING), b"".join(packets)
    found = [each for at in range(0, len(line), size) for each in stream.feed(line[at : at + size])]
    assert found == [packet[:-2] for packet in packets]
    assert len(found) == 6429


def test_no_packet_with_a_wrong_bit_is_found(packets: list[bytes]) -> None:
    seed = random.randrange(1 << 30)
    print(f"{seed=}")
    rng = random.Random(seed)
    for packet in packets:
        bit = rng.randrange(8 * len(packet))
        wrong = bytearray(packet)
        wrong[bit // 8] ^= 1 << bit % 8
        assert Stream(FRAMING).messages(bytes(wrong)) == []


def test_the_rest_of_a_cut_packet_costs_no_other(packets: list[bytes]) -> None:
    stream = Stream(FRAMING)
    assert stream.messages(packets[0][5:] + packets[1] + packets[2][:9]) == [packets[1][:-2]]
    stream.drop()
    assert stream.messages(packets[2][9:] + packets[3]) == [packets[3][:-2]]
