from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.message_codec import pack
from protocols.messages import Done, Feedback, Imu, LaserScan, Message, Torque, WriteParameter
from protocols.plain import codec, plugin
from protocols.plain.codec import MAX_AGE, MAX_BODY, SYNC, Stream, decode, encode, frame
from protocols.reference_vectors import Vector, vectors_of
from tests.protocols.plain.published import encoded, framed, packed, ranges
from tests.protocols.plain.samples import VECTORS, message_of

GOOD = [framed(bytes((1, n))) for n in range(5)]
SHORT = framed(b"\1")


def fed(*pieces: bytes) -> tuple[list[bytes], int, int, bytes]:
    """Bodies, bad, noise, and what is held, of a stream that comes in these pieces."""
    stream = Stream()
    bodies = [body for piece in pieces for body in stream.feed(piece)]
    return bodies, stream.bad, stream.noise, stream._held


def bytewise(data: bytes) -> list[bytes]:
    return [data[at : at + 1] for at in range(len(data))]


@pytest.mark.parametrize("vector", vectors_of(plugin), ids=lambda vector: str(vector.name))
def test_vector_both_ways(vector: Vector) -> None:
    message, reported = message_of(dict(vector.meaning)), vector.meaning
    assert encode(reported["address"], message, reported["now"]) == vector.frame
    assert isinstance(vector.frame, bytes)
    bodies, bad, noise, held = fed(vector.frame)
    assert (bad, noise, held) == (0, 0, b"")
    assert bodies[0][0] == reported["address"]
    own = next((f for f in ("motor", "sensor", "bus", "name") if f in reported["fields"]), "")
    assert decode(bodies[0], reported["now"], reported["fields"].get(own, "")) == message


@pytest.mark.parametrize("vector", vectors_of(plugin), ids=lambda vector: str(vector.name))
def test_the_vectors_are_regenerated_from_the_table_alone(vector: Vector) -> None:
    """By msgpack in Python, struct and a bitwise CRC-32: the README on a message, written once more."""
    reported, row = vector.meaning, list[object]()
    own = next((f for f in ("motor", "sensor", "bus", "name") if f in reported["fields"]), "")
    for field, value in reported["fields"].items():
        put = {own: "", "t": reported["now"] - value if field == "t" else 0}.get(field, value)
        row.append(ranges(*value) if field == "ranges" else put)
    assert encoded(reported["address"], reported["word"], *row) == vector.frame


def test_minus_zero_and_denormals_become_zero() -> None:
    for tiny in (-0.0, 5e-324, -1e-310, 1e-40, -(2.0**-127)):
        assert encode(1, Torque("m", tiny)) == encode(1, Torque("m", 0.0))
        message = decode(b"\1" + pack(Torque("m", tiny)), 0, "m")
        assert repr(message) == repr(Torque("m", 0.0))
        scan = LaserScan("l", 0, tiny, 0.1, abs(tiny), 10.0, (1.0, abs(tiny), 2.0))
        received = decode(b"\1" + pack(scan), 0, "l")
        assert repr(received) == repr(LaserScan("l", 0, 0.0, 0.1, 0.0, 10.0, (1.0, 0.0, 2.0)))
        assert encode(1, scan) == encode(1, LaserScan("l", 0, 0.0, 0.1, 0.0, 10.0, (1.0, 0.0, 2.0)))
    for number in (2.0**-126, -(2.0**-126)):  # the smallest normal binary32 is a number like others
        assert decode(b"\1" + packed("Torque", "", number), 0, "m") == Torque("m", number)
        assert encode(1, Torque("m", number)) == encoded(1, "Torque", "", number)
        data = encoded(1, "Imu", "", 0, [1.0, number, 0.0], [number, -1.0, 2.0], None)
        assert encode(1, Imu("i", 0, (1.0, number, -0.0), (number, -1.0, 2.0))) == data
        assert decode(fed(data)[0][0], 0, "i") == Imu("i", 0, (1.0, number, 0.0), (number, -1.0, 2.0))
    data = encoded(1, "LaserScan", "", 0, 0.0, 0.1, 0.1, 10.0, ranges(2.0**-126, 1.0))
    assert encode(1, LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, (2.0**-126, 1.0))) == data


# Numbers that may not stand in a message, behind such as may, or are not given: the message and its fields.
OUTSIDE: list[tuple[Message, tuple[object, ...], str]] = [
    (Feedback("m", 0, None, 1e9), (0, None, 1e9, None, None, None, None), "velocity 1000000000.0"),
    (Feedback("m", 0, 0.0, None, -1e9), (0, 0.0, None, -1e9, None, None, None), "torque -1000000000.0"),
    (
        Imu("i", 0, (0.0, 0.0, 1e9), (0.0, 0.0, 0.0)),
        (0, [0.0, 0.0, 1e9], [0.0, 0.0, 0.0], None),
        "angular_velocity",
    ),
    (
        Imu("i", 0, (0.0, 0.0, 0.0), (0.0, -1e9, 0.0)),
        (0, [0.0, 0.0, 0.0], [0.0, -1e9, 0.0], None),
        "linear_acceleration",
    ),
    (
        LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, (1.0, 1e9)),
        (0, 0.0, 0.1, 0.1, 10.0, ranges(1.0, 1e9)),
        "ranges",
    ),
    (
        LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, (-1.0, 1.0)),
        (0, 0.0, 0.1, 0.1, 10.0, ranges(-1.0, 1.0)),
        "ranges",
    ),
]


@pytest.mark.parametrize(("message", "values", "name"), OUTSIDE)
def test_a_number_out_of_limits_is_neither_encoded_nor_decoded(
    message: Message, values: tuple[object, ...], name: str
) -> None:
    kind = type(message).__name__
    with pytest.raises(ValueError, match=rf"^{kind}: {name}.* is not in "):
        encode(1, message)
    assert decode(b"\1" + packed(kind, "", *values), 0, "m") is None


def test_a_scan_without_ranges() -> None:
    scan = LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, ())
    data = encoded(1, "LaserScan", "", 0, 0.0, 0.1, 0.1, 10.0, b"")
    assert encode(1, scan) == data
    assert decode(fed(data)[0][0], 0, "l") == scan


# Bytes of a stream, the bodies in it, how many messages are bad, how many runs are noise.
CASES: list[tuple[str, bytes, list[int], int, int]] = [
    ("nothing", b"", [], 0, 0),
    ("one", GOOD[0], [0], 0, 0),
    ("two", GOOD[0] + GOOD[1], [0, 1], 0, 0),
    ("noise before", b"noise" + GOOD[0], [0], 0, 1),
    ("noise between", GOOD[0] + b"x" + GOOD[1], [0, 1], 0, 1),
    ("two runs of noise", b"x" + GOOD[0] + b"y" + GOOD[1] + b"z", [0, 1], 0, 3),
    ("false sync", SYNC + b"\1\2\3\4" + GOOD[0], [0], 0, 1),
    ("half a sync", SYNC[:1] + GOOD[0], [0], 0, 1),
    ("sync within sync", SYNC[:1] * 3 + GOOD[0], [0], 0, 1),
    ("wrong CRC", GOOD[0][:-1] + b"\0" + GOOD[1], [1], 1, 0),
    ("wrong CRC, noise, wrong CRC", GOOD[0][:-1] + b"\0abc" + GOOD[0][:-1] + b"\0" + GOOD[1], [1], 2, 0),
    ("cut short", GOOD[0][:-3] + GOOD[1] + GOOD[2], [1, 2], 1, 0),
    ("cut in the head", GOOD[0][:4] + GOOD[1], [1], 0, 1),
    ("a length of zero", SYNC + b"\0\0\xff\xff" + GOOD[0], [0], 0, 1),
    ("a length too long", SYNC + b"\1\x40\xfe\xbf" + GOOD[0], [0], 0, 1),
    ("a body of one byte", SHORT[:8] + b"\0" + GOOD[0], [0], 1, 0),
    ("a message inside a bad one", framed(b"\7" + GOOD[3] + b"\7")[:-1] + b"\0" + GOOD[1], [3, 1], 1, 1),
]


@pytest.mark.parametrize(
    ("data", "received", "bad", "noise"), [c[1:] for c in CASES], ids=[c[0] for c in CASES]
)
def test_messages_on_a_stream(data: bytes, received: list[int], bad: int, noise: int) -> None:
    for pieces in ([data], bytewise(data), [data, b""], [b"", data]):
        assert fed(*pieces)[:3] == ([bytes((1, n)) for n in received], bad, noise)


@settings(max_examples=300)
@given(
    st.lists(st.one_of(st.sampled_from(GOOD), st.binary(max_size=12), st.just(GOOD[0][:7])), max_size=12),
    st.lists(st.integers(0, 200), max_size=20),
)
def test_cut_anywhere_gives_the_same(parts: list[bytes], cuts: list[int]) -> None:
    data = b"".join(parts)
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    pieces = [data[a:b] for a, b in pairwise(edges)]
    assert fed(data) == fed(*pieces) == fed(*bytewise(data))


@settings(max_examples=300)
@given(st.binary(max_size=60), st.integers(0, 4))
def test_a_good_message_behind_noise_is_not_lost(noise: bytes, n: int) -> None:
    # The false beginning that noise may end with is refuted as soon as its six bytes are there.
    assert GOOD[n][6:-4] in fed(noise, GOOD[n], GOOD[n], bytes(MAX_BODY + 10))[0]


@settings(max_examples=300)
@given(st.integers(0, 8 * len(GOOD[1]) - 1))
def test_one_bit_wrong_is_one_count_and_no_neighbour_is_lost(bit: int) -> None:
    damaged = bytearray(GOOD[1])
    damaged[bit // 8] ^= 1 << bit % 8
    bodies, bad, noise, _ = fed(GOOD[0] + bytes(damaged) + GOOD[2] + GOOD[3])
    assert bodies == [bytes((1, n)) for n in (0, 2, 3)]
    assert bad + noise == 1


def test_the_buffer_is_bounded() -> None:
    stream = Stream()
    endless = SYNC + MAX_BODY.to_bytes(2, "little") + (MAX_BODY ^ 0xFFFF).to_bytes(2, "little")
    for _ in range(4000):
        stream.feed(endless)
        assert len(stream._held) <= MAX_BODY + 10
    assert stream.bad > 0


def test_the_longest_body_passes_and_a_longer_one_is_refused() -> None:
    body = bytes(range(256)) * (MAX_BODY // 256)
    assert fed(frame(body))[0] == [body]
    for wrong in (body + b"\0", b""):
        with pytest.raises(ValueError, match="a body of"):
            frame(wrong)


def test_a_scan_of_two_thousand_beams_fits_and_one_of_three_thousand_is_refused() -> None:
    def scan(beams: int) -> LaserScan:
        return LaserScan("l", 0, 0.0, 0.001, 0.1, 10.0, (5.0,) * beams)

    assert decode(fed(encode(1, scan(2000)))[0][0], 0, "l") == scan(2000)
    with pytest.raises(ValueError, match="a body of"):
        encode(1, scan(3000))


@pytest.mark.parametrize("address", [-1, 256])
def test_an_address_out_of_range_is_not_encoded(address: int) -> None:
    with pytest.raises(ValueError, match=f"address {address}"):
        encode(address, Torque("m", 0.0))


@pytest.mark.parametrize("name", sorted(codec.LIMITS))
def test_limits_hold_at_both_ends(name: str) -> None:
    low, high = codec.LIMITS[name]
    kind, _, field = name.partition(".")
    row = next(row for row in VECTORS["packed"][::-1] if row["word"] == kind and field in row["fields"])
    body_of = {value: _with(row, field, value) for value in (low, high, low - 1.0, high + 1.0)}
    for value, message in body_of.items():
        if low <= value <= high:
            assert (
                decode(fed(encode(1, message, word_time(message)))[0][0], word_time(message), "left")
                is not None
            )
        else:
            with pytest.raises(ValueError, match=field):
                encode(1, message, word_time(message))


def _with(row: dict[str, Any], field: str, value: float) -> Any:
    old = row["fields"][field]
    length = {"ranges": 2, "angular_velocity": 3, "linear_acceleration": 3, "orientation": 4}.get(field, 0)
    assert not isinstance(old, list) or length
    return message_of({**row, "fields": {**row["fields"], field: [value] * length if length else value}})


def word_time(message: Any) -> int:
    return int(getattr(message, "t", 0))


def body(message: Any, now: int = 0) -> bytes:
    return fed(encode(1, message, now))[0][0]


def test_the_age_of_a_measurement_becomes_its_time() -> None:
    data = body(Feedback("m", 900, 1.0), now=1000)
    assert decode(data, 5000, "x") == Feedback("x", 4900, 1.0)
    assert decode(data, 50, "x") == Feedback("x", -50, 1.0)


def test_a_measurement_from_the_future_has_no_age() -> None:
    assert decode(body(Feedback("m", 2000, 1.0), now=1000), 5000, "m") == Feedback("m", 5000, 1.0)


@pytest.mark.parametrize("age", [-1, MAX_AGE + 1, 2**63])
def test_an_age_out_of_range_is_malformed(age: int) -> None:
    assert decode(b"\1" + pack(Done(age, "Zero", "")), 0, "m") is None
    assert decode(b"\1" + pack(Done(MAX_AGE, "Zero", "")), 0, "m") == Done(-MAX_AGE, "Zero", "m")


def test_a_name_on_the_line_is_not_believed() -> None:
    imu = Imu("forged", 0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    assert decode(b"\1" + pack(imu), 5, "imu") == Imu("imu", 5, imu.angular_velocity, imu.linear_acceleration)


def test_a_text_that_is_no_utf8_is_not_encoded() -> None:
    with pytest.raises(ValueError, match="WriteParameter"):
        encode(1, WriteParameter("m", "\udcff", 1.0))
