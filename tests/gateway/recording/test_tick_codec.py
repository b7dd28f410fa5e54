"""Ticks as bytes: exact both ways, readable by any ROS 2 tool, protected by digests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from gateway.core.tick import Inputs, Outputs, Tick
from gateway.recording import tick_codec
from gateway.recording.ros_views import typestore
from gateway.recording.tick_codec import CHAIN_START, DigestChain, TickCodecError, decode, encode
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import Feedback
from tests.gateway import little


@cache
def store() -> Typestore:
    made = typestore()
    made.register(get_types_from_msg(tick_codec.DEFINITION, tick_codec.TYPE))
    return made


chains = st.builds(DigestChain, st.binary(min_size=16, max_size=16), st.binary(min_size=16, max_size=16))


@given(little.ticks, chains)
@settings(max_examples=300, deadline=None)
def test_a_tick_comes_back_exactly(tick: Tick, before: DigestChain) -> None:
    data, after = encode(tick, before)
    entry = decode(data, before)
    # repr distinguishes -0.0 from 0.0, == does not
    assert repr(entry.tick) == repr(tick)
    assert entry.written == entry.computed == after
    assert entry.damage() == ()
    assert encode(entry.tick, before) == (data, after)


@given(tick=little.ticks)
@settings(max_examples=200, deadline=None)
def test_the_bytes_are_those_of_a_general_serialiser(tick: Tick) -> None:
    made = store()
    data, _ = encode(tick, CHAIN_START)
    message: Any = made.deserialize_cdr(data, tick_codec.TYPE)
    assert bytes(made.serialize_cdr(message, tick_codec.TYPE, little_endian=True)) == data
    assert (message.number, message.now) == (tick.number, tick.now)
    assert [(s.bus, s.state) for s in message.states] == [(b, s.value) for b, s in tick.inputs.states]
    for reported, packet in zip(message.received, tick.inputs.packets, strict=True):
        frame = packet.frame
        data_in = frame.data if isinstance(frame, CanFrame) else frame
        assert (reported.t, reported.bus, reported.data.tobytes()) == (packet.t, packet.bus, data_in)
        assert reported.kind == isinstance(frame, CanFrame)
        assert reported.id == (frame.id if isinstance(frame, CanFrame) else 0)
    assert len(message.instructions) == len(tick.inputs.instructions)
    assert len(message.sent) == len(tick.outputs.packets)
    assert [n.text for n in message.notes] == [n.text for n in tick.outputs.notes]


FRAME = Packet(7, "can0", CanFrame(0x029, bytes.fromhex("0011223344556677")))
SERIAL = Packet(9, "tty", b"\xa5\x57")
TICK = Tick(
    3,
    10,
    Inputs((("can0", BusState.UP),), (FRAME, SERIAL)),
    Outputs((Packet(10, "can0", CanFrame(0x00D, b"12345678")),), (Feedback("left", 7, 1.0),)),
)


@pytest.mark.parametrize(
    ("written", "changed", "reported"),
    [
        (
            "0011223344556677",
            "0111223344556677",
            "input on bus can0, frame 029#0111223344556677, does not match",
        ),
        ("a557", "a556", "input on bus tty, bytes A5 56, does not match"),
        (
            "3132333435363738",
            "3132333435363739",
            "output on bus can0, frame 00D#3132333435363739, does not match",
        ),
        ("0300000075700000", "040000006f666600", "inputs do not match the digest"),  # "up" to "off"
    ],
    ids=["frame", "serial", "sent", "state"],
)
def test_what_was_changed_is_named(written: str, changed: str, reported: str) -> None:
    raw, _ = encode(TICK, CHAIN_START)
    assert raw.count(bytes.fromhex(written)) == 1
    damage = decode(raw.replace(bytes.fromhex(written), bytes.fromhex(changed)), CHAIN_START).damage()
    assert len(damage) == 1
    assert reported in damage[0]


@pytest.mark.parametrize("bit", range(8))
def test_any_flipped_bit_is_found(bit: int) -> None:
    raw, after = encode(TICK, CHAIN_START)
    for at in range(len(raw)):
        changed = bytearray(raw)
        changed[at] ^= 1 << bit
        try:
            entry = decode(bytes(changed), CHAIN_START)
        except TickCodecError:
            continue
        assert entry.damage(), f"bit {bit} of byte {at} was flipped unseen"
    assert decode(raw, CHAIN_START).written == after


def test_a_tick_left_out_is_found() -> None:
    _, first = encode(TICK, CHAIN_START)
    data, _ = encode(replace(TICK, number=4), first)
    assert decode(data, first).damage() == ()
    assert "the tick before it is missing" in decode(data, CHAIN_START).damage()[0]


@given(st.binary(max_size=200))
@settings(max_examples=300, deadline=None)
def test_no_bytes_raise_anything_else(data: bytes) -> None:
    for raw in (data, b"\x00\x01\x00\x00" + data):
        with pytest.raises(TickCodecError):
            decode(raw, CHAIN_START)


def test_a_cut_tick_is_none() -> None:
    raw, _ = encode(TICK, CHAIN_START)
    for size in range(len(raw)):
        with pytest.raises(TickCodecError, match="not the bytes of a tick"):
            decode(raw[:size], CHAIN_START)
    with pytest.raises(TickCodecError, match="after the last note"):
        decode(raw + b"\0", CHAIN_START)
