"""Bytes on a plain line, at the plugin's ends: vectors, damaged and endless streams, long scans."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.messages import (
    Command,
    Done,
    Found,
    LaserScan,
    Mode,
    Parameter,
    ReadParameter,
    Refused,
    Request,
    Scan,
    State,
    Stop,
    Zero,
)
from protocols.plain import plugin
from protocols.plugin import Device, Driver
from protocols.reference_vectors import Vector, vectors_of
from tests.protocols.message_samples import message_of
from tests.protocols.plain.published import encoded, framed, ranges

T = 10**12
GOOD = [encoded(1, "State", "", 0, "ready", str(n)) for n in range(5)]
ASKED: dict[type, Request] = {
    Found: Scan("s0"),
    Done: Zero("left"),
    Refused: Zero("left"),
    Parameter: ReadParameter("left", "velocity_gain"),
}
"""What is asked so that this is an answer."""
VECTORS = pytest.mark.parametrize("vector", vectors_of(plugin), ids=lambda vector: str(vector.name))


def device(name: str, address: int, kind: str = "motor") -> Device:
    return Device(name, address, plugin.options(kind), plugin.settings())


def driver() -> Driver:
    return plugin.driver([device("left", 1)])


@VECTORS
def test_a_vector_means_the_same_to_driver_and_devices(vector: Vector) -> None:
    message: Any = message_of(dict(vector.meaning))
    name = getattr(message, "sensor", "left")
    devices = [device(name, vector.meaning["address"] or 1, "motor" if name == "left" else "sensor")]
    if not isinstance(message, Command | Request):
        host = plugin.driver(devices)
        host.send(T, [ASKED[kind] for kind in ASKED if isinstance(message, kind)])
        named = replace(message, detail="left, motor") if isinstance(message, Found) else message
        assert host.receive(vector.meaning["now"], vector.frame) == [named]
        return
    assert plugin.driver(devices).send(T, [Stop(), message])[1] == [vector.frame]
    obeyed = repr(plugin.decoder(devices).decode(T, vector.frame)[-1])
    assert obeyed == repr(message).replace("bus='s0'", "bus=''")


@VECTORS
def test_the_vectors_are_regenerated_from_the_table_alone(vector: Vector) -> None:
    reported, row = vector.meaning, list[object]()
    own = next((f for f in ("motor", "sensor", "bus", "name") if f in reported["fields"]), "")
    for field, value in reported["fields"].items():
        put = {own: "", "t": reported["now"] - value if field == "t" else 0}.get(field, value)
        row.append(ranges(*value) if field == "ranges" else put)
    assert encoded(reported["address"], reported["word"], *row) == vector.frame


def received(*pieces: bytes) -> tuple[list[str], Any]:
    """The events in these pieces, and how they are counted."""
    host = driver()
    return [repr(event) for piece in pieces for event in host.receive(T, piece)], host.counters


@settings(max_examples=300)
@given(
    st.lists(st.one_of(st.sampled_from(GOOD), st.binary(max_size=12), st.just(GOOD[0][:7])), max_size=12),
    st.lists(st.integers(0, 300), max_size=20),
)
def test_a_stream_may_be_cut_anywhere_and_what_follows_noise_is_received(
    parts: list[bytes], cuts: list[int]
) -> None:
    # The false beginning that noise may end with is refuted as soon as its six bytes are there.
    data = b"".join([*parts, GOOD[4], GOOD[4], bytes(0x4000 + 10)])
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    whole = received(data)
    assert whole == received(*(data[a:b] for a, b in pairwise(edges)))
    assert repr(State("left", T, Mode.READY, "4")) in whole[0]


def test_the_receive_buffer_is_bounded() -> None:
    host = driver()
    for _ in range(4000):
        host.receive(T, b"\xa5\x57\x00\x40\xff\xbf")  # always the head of a longest message
        assert len(pickle.dumps(host)) < 0x4000 + 4000
    assert host.counters.malformed > 0


def test_the_longest_scan_is_sent_and_a_longer_one_is_not() -> None:
    def sent(beams: int) -> int:
        scan = LaserScan("lidar", T, 0.0, 0.001, 0.1, 10.0, (5.0,) * beams)
        return len(plugin.twin(device("lidar", 1, "sensor"), 0).step(T, [scan])[1])

    assert (sent(2000), sent(3000)) == (1, 0)
    host = driver()
    host.receive(T, framed(b"\1" * 0x4000))
    host.receive(T, framed(b"\1" * 0x4001))
    assert (host.counters.malformed, host.counters.ignored) == (1, 1)
