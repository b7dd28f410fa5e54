from __future__ import annotations

import math
from typing import Any, get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols import messages, sensors
from protocols.message_codec import CODES, pack, unpack
from protocols.messages import Feedback, LaserScan, Message, Mode, SetId, State, Torque, Velocity
from tests.protocols.message_samples import ANY_MESSAGE, VECTORS, message_of
from tests.protocols.plain.published import packed, ranges

PACKED = VECTORS["packed"]


def ids(row: dict[str, Any]) -> str:
    return str(row.get("why") or row["word"])


def bits(message: Message) -> str:
    """A message as text that tells 0.0 from -0.0."""
    return repr(message)


@pytest.mark.parametrize("row", PACKED, ids=ids)
def test_vector_both_ways(row: dict[str, Any]) -> None:
    data = bytes.fromhex(row["bytes"])
    assert pack(message_of(row)) == data
    read = unpack(data)
    assert read is not None
    assert bits(read) == bits(message_of(row))


def test_every_word_has_a_code_and_a_vector() -> None:
    every = set(get_args(messages.Message)) - {messages.Arm, messages.Kept, messages.Measurement}
    every |= {kind.message for kind in sensors.OURS}
    assert set(CODES.values()) == every
    assert {row["word"] for row in PACKED} == {kind.__name__ for kind in every}


@pytest.mark.parametrize("row", VECTORS["also_read"], ids=ids)
def test_a_vector_of_other_writers_is_read(row: dict[str, Any]) -> None:
    read = unpack(bytes.fromhex(row["bytes"]))
    assert read == message_of(row)
    assert not isinstance(read, Torque) or type(read.torque) is float


@pytest.mark.parametrize("row", VECTORS["unreadable"], ids=ids)
def test_a_vector_that_is_no_word_is_none(row: dict[str, Any]) -> None:
    assert unpack(bytes.fromhex(row["bytes"])) is None


@settings(max_examples=600)
@given(ANY_MESSAGE)
def test_any_word_survives_bit_for_bit_and_has_one_encoding(message: Message) -> None:
    data = pack(message)
    read = unpack(data)
    assert read is not None
    assert type(read) is type(message)
    assert bits(read) == bits(message)
    assert pack(read) == data


@settings(max_examples=600)
@given(st.binary(max_size=80))
def test_no_bytes_raise(data: bytes) -> None:
    unpack(data)


@settings(max_examples=600)
@given(ANY_MESSAGE, st.data())
def test_no_damage_raises_or_lets_a_wrong_value_through(message: Message, data: st.DataObject) -> None:
    packed = bytearray(pack(message))
    for _ in range(data.draw(st.integers(1, 4))):
        packed[data.draw(st.integers(0, len(packed) - 1))] = data.draw(st.integers(0, 255))
    read = unpack(bytes(packed))
    if read is not None:
        assert unpack(pack(read)) == read  # pack refuses whatever is not finite or of a wrong type


def test_an_integer_is_written_as_the_float_it_stands_for() -> None:
    assert pack(Velocity("m", 1)) == pack(Velocity("m", 1.0))


BAD: list[Any] = [
    Velocity("m", math.nan),
    Velocity("m", 1.0, math.inf),
    Velocity("m", 10**400),
    Velocity("m", "1"),  # type: ignore[arg-type]  # what a careless caller may do
    Velocity(1, 1.0),  # type: ignore[arg-type]  # the same
    Velocity("\ud800", 1.0),
    Feedback("m", 1.0),  # type: ignore[arg-type]  # the same
    Feedback("m", True),
    Feedback("m", 2**64),
    SetId("b", -(2**63) - 1, 1),
    State("m", 0, "ready"),  # type: ignore[arg-type]  # the same
    LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, (1.0, math.inf)),
    LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, (math.inf, -math.inf)),
    LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, [1.0]),  # type: ignore[arg-type]  # the same
    LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, ("1",)),  # type: ignore[arg-type]  # the same
    messages.Imu("i", 0, (0.0, 0.0), (0.0, 0.0, 0.0)),  # type: ignore[arg-type]  # the same
    messages.Imu("i", 0, (0.0, 0.0, math.nan), (0.0, 0.0, 0.0)),
    Mode.READY,
    None,
    ("Velocity", "m", 1.0),
]


@pytest.mark.parametrize("message", BAD, ids=repr)
def test_there_is_no_vector_of_what_is_no_word(message: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        pack(message)


EDGES: list[tuple[Message, bytes]] = [
    (SetId("b", -(2**63), 2**64 - 1), packed("SetId", "b", -(2**63), 2**64 - 1)),
    (SetId("b", 0, -1), packed("SetId", "b", 0, -1)),
    (
        LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, (1.7e308,) * 3),
        packed("LaserScan", "l", 0, 0.0, 0.1, 0.1, 10.0, ranges(*[1.7e308] * 3), 0),
    ),
    (LaserScan("l", 0, 0.0, 0.1, 0.1, 10.0, ()), packed("LaserScan", "l", 0, 0.0, 0.1, 0.1, 10.0, b"", 0)),
]


@pytest.mark.parametrize(("message", "data"), EDGES)
def test_a_vector_at_the_edges_both_ways(message: Message, data: bytes) -> None:
    assert pack(message) == data
    assert unpack(data) == message


UNREADABLE: list[bytes] = [
    packed("LaserScan", "l", 0, 0.0, 0.1, 0.1, 10.0, ranges(1.7e308, 1.7e308, math.inf)),
    packed("LaserScan", "l", 0, 0.0, 0.1, 0.1, 10.0, ranges(math.inf, -math.inf)),
    packed("LaserScan", "l", 0, 0.0, 0.1, 0.1, 10.0, [1.0]),
    packed("LaserScan", "l", 0, 0.0, 0.1, 0.1, 10.0, "12345678"),
    packed("Imu", "i", 0, [0.0, 0.0], [0.0, 0.0, 0.0], None),
    packed("Imu", "i", 0, [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0], None),
    packed("Imu", "i", 0, b"123", [0.0, 0.0, 0.0], None),
    packed("Imu", "i", 0, [0.0, 0.0, None], [0.0, 0.0, 0.0], None),
]


@pytest.mark.parametrize("data", UNREADABLE, ids=bytes.hex)
def test_a_vector_whose_numbers_are_none(data: bytes) -> None:
    assert unpack(data) is None
