"""Checksums at their published check values, and messages on a stream that is cut anywhere."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import pytest

from protocols.frames import CanFrame
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import (
    CRC8_MAXIM,
    CRC16_MODBUS,
    CRC16_XMODEM,
    CRC32,
    Checksum,
    Finds,
    FrameFormat,
    Framing,
    Stream,
    Stuffing,
    TextLines,
    crc,
    inverted_sum8,
    messages_in,
    sum8,
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


def resize(head: bytes, size: int) -> bytes:
    return head[:-1] + bytes((size,))


FRAMINGS = {
    "two sync bytes, CRC-16 of the body": Framing(b"\xaa\x55", 3, body, CRC16_MODBUS, 2, covers=3),
    "two equal sync bytes, an id, complement of the sum": Framing(
        b"\xff\xff", 4, body, inverted_sum8, 1, covers=2
    ),
    "one sync byte, big-endian CRC-16 of all": Framing(b"\x02", 2, body, CRC16_XMODEM, 2, "big"),
    "a byte behind the checksum": Framing(b"\x02", 2, body, CRC16_XMODEM, 2, "big", 2, b"\x03"),
    "stuffed": Framing(
        b"\xff\xff\xfd\x00", 6, body, CRC16_MODBUS, 2, stuffing=Stuffing(b"\xff\xff\xfd", b"\xfd", resize)
    ),
}
EVERY_FRAMING = pytest.mark.parametrize("framing", FRAMINGS.values(), ids=FRAMINGS)


def message(framing: Framing, content: bytes) -> bytes:
    filler = bytes(framing.head - len(framing.sync) - 1)
    return framing.sync + filler + bytes((len(content),)) + content


@pytest.mark.parametrize("size", [0, 1, 13, 255, 256, 257, 600])
def test_a_sum_is_that_of_all_bytes_however_many(size: int) -> None:
    for data in (bytes(size), b"\xff" * size, Random(size).randbytes(size)):
        assert sum8(data) == sum(data) % 256
        assert inverted_sum8(data) == 255 - sum(data) % 256


def test_what_stands_beside_messages_in_a_frame_is_seen() -> None:
    framing = FRAMINGS["two sync bytes, CRC-16 of the body"]
    one, two = message(framing, b"12"), message(framing, b"")
    both = framing.frame(one) + framing.frame(two)
    assert messages_in(framing, both) == ([one, two], True)
    assert messages_in(framing, both + b"\0") == messages_in(framing, b"\0" + both) == ([one, two], False)
    assert messages_in(framing, both[:-1]) == ([one], False)
    assert messages_in(framing, CanFrame(1, b"")) == ([], False)


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
    behind = framing.checksum_size + len(framing.tail)
    wanted = [results.get(each) or whole[int(each)][:-behind] for each in expected.split()]
    stream = Stream(framing)
    assert stream.feed(data) == wanted
    assert stream.skipped == len(data) - len(whole[0]) * sum(each.isdigit() for each in expected.split())
    stream = Stream(framing)
    assert [each for byte in data for each in stream.feed(bytes((byte,)))] == wanted


@EVERY_FRAMING
@pytest.mark.parametrize("seed", range(30))
def test_a_stream_may_be_cut_anywhere_and_what_follows_noise_is_found(framing: Framing, seed: int) -> None:
    random = Random(seed)
    pieces = [
        random.choice(
            (
                framing.frame(message(framing, random.randbytes(random.randint(0, 15)))),
                framing.frame(message(framing, (b"\xff\xff\xfd" * 5)[: random.randint(0, 15)])),
                random.randbytes(random.randint(0, 9)),
                framing.sync,
            )
        )
        for _ in range(20)
    ]
    last = message(framing, b"last")
    # The false beginning that noise may end with is refuted when as many bytes have come.
    data = b"".join(pieces) + framing.frame(last) * 3 + bytes(3 * framing.head + 30)
    whole, size_of_all = Stream(framing).feed(data), len(data)
    assert whole.count(last) >= 2, f"seed {seed}"
    stream, parts = Stream(framing), list[bytes | Rx]()
    while data:
        size = random.randint(0, 9)
        parts += stream.feed(data[:size])
        data = data[size:]
        assert len(stream.held) <= framing.head + 20 + framing.checksum_size + len(framing.tail)
        fed = sum(len(framing.frame(part)) for part in parts if isinstance(part, bytes))
        assert fed + stream.skipped + len(stream.held) == size_of_all - len(data), f"seed {seed}"
    assert parts == whole, f"seed {seed}"


def test_a_partial_message_can_be_dropped() -> None:
    (framing, *_) = FRAMINGS.values()
    stream, whole = Stream(framing), framing.frame(message(framing, b"abc"))
    assert stream.feed(whole[:5]) == []
    stream.drop()
    assert stream.messages(whole[5:] + whole) == [whole[:-2]]


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: Framing(b"", 0, body, CRC32, 4), "needs a sync"),
        (lambda: Framing(b"\xff\xff", 1, body, CRC32, 4), "does not hold a sync"),
        (lambda: Framing(b"\xff", 1, body, CRC32, -1), "not negative"),
        (
            lambda: Framing(b"\xff", 1, body, CRC32, 4, stuffing=Stuffing(b"", b"\xfd", resize)),
            "behind a pattern",
        ),
        (lambda: TextLines(b";"), "bytes that end it"),
        (lambda: TextLines(longest=0), "at least one byte"),
        (lambda: TextLines(mark=b""), "is one"),
    ],
)
def test_a_framing_that_no_stream_could_be_split_by_is_refused(
    make: Callable[[], object], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        make()


DYNAMIXEL = Framing(
    b"\xff\xff\xfd\x00",
    7,
    lambda head: size - 2 if 3 <= (size := int.from_bytes(head[5:7], "little")) <= 1024 else None,
    crc(16, 0x8005, reflected=False),
    2,
    stuffing=Stuffing(
        b"\xff\xff\xfd", b"\xfd", lambda head, size: head[:5] + (size + 2).to_bytes(2, "little")
    ),
)
"""Framing of Dynamixel 2.0 (ROBOTIS e-Manual, Protocol 2.0, "Byte Stuffing")."""


@pytest.mark.parametrize(
    ("plain", "stuffed"),
    [
        ("fffffd0001030001", "fffffd0001030001"),
        ("fffffd00010900037400fffffd00", "fffffd00010a00037400fffffdfd00"),
        ("fffffd00010900037400fffffdfd", "fffffd00010a00037400fffffdfdfd"),
        ("fffffd00010c00037400fffffdfffffd00", "fffffd00010e00037400fffffdfdfffffdfd00"),
        ("fffffd00010800037400fffffd", "fffffd00010900037400fffffdfd"),
    ],
)
def test_stuffing_is_part_of_the_length_and_of_the_checksum(plain: str, stuffed: str) -> None:
    message, line = bytes.fromhex(plain), bytes.fromhex(stuffed)
    line += crc(16, 0x8005, reflected=False)(line).to_bytes(2, "little")
    assert DYNAMIXEL.frame(message) == line
    assert Stream(DYNAMIXEL).feed(line) == [message]


def test_a_stuffed_message_that_is_cut_short_keeps_none_behind_it_waiting() -> None:
    long = DYNAMIXEL.frame(bytes.fromhex("fffffd0001fe03") + bytes(1020))
    ping = bytes.fromhex("fffffd0001030001194e")
    assert Stream(DYNAMIXEL).feed(long[:20] + ping) == [Rx.MALFORMED, ping[:-2]]


TEXT = TextLines(longest=20, check=xor8)
"""As that of ODrive (docs/ascii-protocol.rst of its firmware 0.5.6, where the first line below stands)."""
OPTIONAL = TextLines(longest=20, check=xor8, required=False)


@pytest.mark.parametrize(
    ("lines", "data", "expected"),
    [
        (TEXT, b"r vbus_voltage *93\n", [b"r vbus_voltage "]),
        (TEXT, b"0.5 1.0*036\r\n\r\n1*49\r\n", [b"0.5 1.0", b"1"]),
        (TEXT, b"0.5 1.1*36\n1*49\n", [Rx.MALFORMED, b"1"]),
        (TEXT, b"0.5 1.0\n1*49\n", [Rx.MALFORMED, b"1"]),
        (TEXT, b"0.5\x001.0*36\n\xff\xff\n1*49\n\x7f\n", [Rx.IGNORED, b"1", Rx.IGNORED]),
        (TEXT, b"1" * 21 + b"\n" + b"1" * 99 + b"\n1*49\n", [Rx.IGNORED, b"1"]),
        (TEXT, b"*0\n", []),
        (TEXT, b"1*" + b"4" * 18 + b"\n", [Rx.MALFORMED]),
        (OPTIONAL, b"0.5 1.0*36\n0.5 1.0\n0.5 1.0*9\n", [b"0.5 1.0*36", b"0.5 1.0", Rx.MALFORMED]),
        (TextLines(), b"a*b\rc\n", [b"a*b", b"c"]),
    ],
)
def test_lines_of_text(lines: TextLines, data: bytes, expected: list[bytes | Rx]) -> None:
    stream = Stream(lines)
    assert stream.feed(data) == expected
    skipped, stream = stream.skipped, Stream(lines)
    assert [each for byte in data for each in stream.feed(bytes((byte,)))] == expected
    assert stream.skipped == skipped
    for each in expected:
        assert not isinstance(each, bytes) or Stream(lines).feed(lines.frame(each)) == [each]


@pytest.mark.parametrize("text", [b"two\nlines", b"\xff", b"1" * 19])
def test_what_is_no_line_of_text_is_not_made_one(text: bytes) -> None:
    with pytest.raises(ValueError, match="no line of text"):
        TEXT.frame(text)


HOSTILE: dict[str, tuple[FrameFormat, bytes | None]] = {
    "plain noise": (FRAMINGS["two sync bytes, CRC-16 of the body"], None),
    "sync bytes": (FRAMINGS["two equal sync bytes, an id, complement of the sum"], b"\xff"),
    "heads": (FRAMINGS["one sync byte, big-endian CRC-16 of all"], b"\x02\x14"),
    "heads of the longest": (DYNAMIXEL, b"\xff\xff\xfd\x00\x01\xff\x03"),
    "a line without an end": (TEXT, b"1"),
    "ends": (TEXT, b"\r\n"),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("chunk", [1, 64, 10_000])
def test_work_is_bounded_whatever_comes(name: str, chunk: int) -> None:
    """Counted, not timed: how often a stream looks for a message, and how many bytes it sums up."""
    framing, pattern = HOSTILE[name]
    data = Random(7).randbytes(10_000) if pattern is None else (pattern * 10_000)[:10_000]
    counted = Counted(framing)
    stream = Stream(counted)
    for at in range(0, len(data), chunk):
        stream.feed(data[at : at + chunk])
    assert counted.reads <= 2 * len(data) + len(data) // chunk
    assert len(stream.held) <= 1033


class Counted:
    """Counts how often it is asked."""

    def __init__(self, framing: FrameFormat) -> None:
        self.framing, self.reads = framing, 0

    def frame(self, message: bytes) -> bytes:
        return self.framing.frame(message)

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        self.reads += 1
        one, end = self.framing.read(held, at)
        assert at <= end <= len(held)
        assert one is None or end > at
        return one, end


def from_device_1(asked: bytes, message: bytes) -> bool:
    return message[2] == 1


@pytest.mark.parametrize(
    ("parts", "found"),
    [
        ("", None),
        ("own", (0, 9)),
        ("cut", None),
        ("other own", (9, 18)),
        ("begun own", (4, 13)),
        ("noise own noise", (3, 12)),
        ("cut own other", (8, 17)),
    ],
)
def test_an_answer_is_found_among_others(parts: str, found: tuple[int, int] | None) -> None:
    framing = FRAMINGS["two equal sync bytes, an id, complement of the sum"]
    own = framing.frame(b"\xff\xff\x01\x04abcd")
    known = {
        "own": own,
        "other": framing.frame(b"\xff\xff\x02\x04abcd"),
        "cut": own[:-1],
        "begun": b"\xff\xff\x01\x14",
        "noise": b"\x11\x12\xff",
    }
    held = b"".join(known[part] for part in parts.split())
    assert Finds(framing, from_device_1)(b"", held) == found


def test_an_answer_of_several_devices_ends_with_the_last() -> None:
    framing = FRAMINGS["two equal sync bytes, an id, complement of the sum"]
    one = framing.frame(b"\xff\xff\x01\x04abcd")
    finds = Finds(framing, from_device_1, 3)
    assert finds(b"", b"\x00" + one * 2) is None
    assert finds(b"", b"\x00" + one * 2 + b"\x00" + one) == (1, 29)
