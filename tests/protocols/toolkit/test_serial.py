"""Checksums at their published check values, and messages on a stream that is cut anywhere."""

from __future__ import annotations

from random import Random

import pytest

from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import (
    CRC8_MAXIM,
    CRC16_MODBUS,
    CRC16_XMODEM,
    CRC32,
    Checksum,
    Framing,
    Stream,
    crc,
    inverted_sum8,
    xor8,
)

CRCS: dict[str, tuple[Checksum, int]] = {
    "CRC-8/SMBUS": (crc(8, 0x07, reflected=False), 0xF4),
    "CRC-8/MAXIM-DOW": (CRC8_MAXIM, 0xA1),
    "CRC-16/MODBUS": (CRC16_MODBUS, 0x4B37),
    "CRC-16/XMODEM": (CRC16_XMODEM, 0x31C3),
    "CRC-16/IBM-3740": (crc(16, 0x1021, 0xFFFF, reflected=False), 0x29B1),
    "CRC-16/UMTS": (crc(16, 0x8005, reflected=False), 0xFEE8),
    "CRC-16/KERMIT": (crc(16, 0x1021), 0x2189),
    "CRC-16/X-25": (crc(16, 0x1021, 0xFFFF, end=0xFFFF), 0x906E),
    "CRC-32/ISO-HDLC": (CRC32, 0xCBF43926),
    "CRC-32/ISO-HDLC, computed": (crc(32, 0x04C11DB7, 0xFFFFFFFF, end=0xFFFFFFFF), 0xCBF43926),
    "CRC-32/BZIP2": (crc(32, 0x04C11DB7, 0xFFFFFFFF, reflected=False, end=0xFFFFFFFF), 0xFC891918),
    "sum": (inverted_sum8, ~477 & 0xFF),
    "xor": (xor8, 0x31),
}
"""The check values are those of "123456789" in the catalogue of parametrised CRC algorithms."""


@pytest.mark.parametrize("name", CRCS)
def test_a_checksum_has_its_check_value(name: str) -> None:
    checksum, value = CRCS[name]
    assert checksum(b"123456789") == value


def body(head: bytes) -> int | None:
    """The length of these framings: the last byte of the head, up to 20."""
    return head[-1] if head[-1] <= 20 else None


FRAMINGS = {
    "two sync bytes, CRC-16 of the body": Framing(b"\xaa\x55", 3, body, CRC16_MODBUS, 2, covers=3),
    "two equal sync bytes, an id, complement of the sum": Framing(
        b"\xff\xff", 4, body, inverted_sum8, 1, covers=2
    ),
    "one sync byte, big-endian CRC-16 of all": Framing(b"\x02", 2, body, CRC16_XMODEM, 2, "big"),
}
EVERY_FRAMING = pytest.mark.parametrize("framing", FRAMINGS.values(), ids=FRAMINGS)


def message(framing: Framing, content: bytes) -> bytes:
    filler = bytes(framing.head - len(framing.sync) - 1)
    return framing.sync + filler + bytes((len(content),)) + content


def test_a_message_and_its_checksum() -> None:
    after_the_head = FRAMINGS["two sync bytes, CRC-16 of the body"]
    assert after_the_head.frame(b"\xaa\x55\x09123456789") == b"\xaa\x55\x09123456789\x37\x4b"
    of_all = Framing(b"1", 1, lambda _: 8, CRC16_XMODEM, 2, "big")
    assert of_all.frame(b"123456789") == b"123456789\x31\xc3"


@EVERY_FRAMING
@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ("", ""),
        ("0", "0"),
        ("0 1 2", "0 1 2"),
        ("noise 0", "ignored 0"),
        ("noise 0 noise 1 noise", "ignored 0 ignored 1 ignored"),
        ("bad 1", "malformed 1"),
        ("bad noise bad 1", "malformed malformed 1"),
        ("long 1", "ignored 1"),
        ("0 cut 1 2", "0 malformed 1 2"),
    ],
)
def test_what_is_no_message_is_skipped_and_reported(framing: Framing, parts: str, expected: str) -> None:
    whole = [framing.frame(message(framing, bytes((n, 7, n)))) for n in range(3)]
    known = {
        "noise": b"\x11\x12\x13",
        "bad": whole[0][:-1] + bytes((whole[0][-1] ^ 0x40,)),
        "long": framing.sync + bytes(framing.head - len(framing.sync) - 1) + b"\x63",
        "cut": whole[0][:-1],
    }
    data = b"".join(known.get(part) or whole[int(part)] for part in parts.split())
    results = {"ignored": Rx.IGNORED, "malformed": Rx.MALFORMED}
    wanted = [results.get(each) or whole[int(each)][: -framing.checksum_size] for each in expected.split()]
    assert Stream(framing).feed(data) == wanted
    stream = Stream(framing)
    assert [each for byte in data for each in stream.feed(bytes((byte,)))] == wanted


@EVERY_FRAMING
@pytest.mark.parametrize("seed", range(30))
def test_a_stream_may_be_cut_anywhere_and_what_follows_noise_is_found(framing: Framing, seed: int) -> None:
    random = Random(seed)
    pieces = [
        random.choice(
            (
                framing.frame(message(framing, random.randbytes(random.randint(0, 20)))),
                random.randbytes(random.randint(0, 9)),
                framing.sync,
            )
        )
        for _ in range(20)
    ]
    last = message(framing, b"last")
    # The false beginning that noise may end with is refuted when as many bytes have come.
    data = b"".join(pieces) + framing.frame(last) * 3 + bytes(3 * framing.head + 30)
    whole = Stream(framing).feed(data)
    assert last in whole, f"seed {seed}"
    stream, parts = Stream(framing), list[bytes | Rx]()
    while data:
        size = random.randint(0, 9)
        parts += stream.feed(data[:size])
        data = data[size:]
        assert len(stream._held) <= framing.head + 20 + framing.checksum_size
    assert parts == whole, f"seed {seed}"


def test_a_partial_message_can_be_dropped() -> None:
    (framing, *_) = FRAMINGS.values()
    stream, whole = Stream(framing), framing.frame(message(framing, b"abc"))
    assert stream.feed(whole[:5]) == []
    stream.drop()
    assert stream.messages(whole[5:] + whole) == [whole[:-2]]
