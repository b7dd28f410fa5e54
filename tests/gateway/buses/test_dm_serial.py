"""dm-serial: packets of independent sources both ways, streams cut anywhere and with rubbish between, errors.

`tests/protocols/damiao/test_motorbridge.py` lets somebody else's client drive a twin behind this adapter.
"""

from __future__ import annotations

import logging
import os
from contextlib import closing
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.dm_serial import (
    FROM_ADAPTER,
    REPORTING,
    SENT,
    EmulatedAdapter,
    PacketSplitter,
    decode_received,
    encode_received,
    encode_send,
)
from gateway.buses.adapters.pty import Pty
from gateway.buses.can import CanBus, open_can
from gateway.core.clock import SimulatedClock
from gateway.errors import BusError
from protocols.frames import CanFrame
from tests.gateway.buses.adapter_helpers import (
    CLASSIC,
    FD,
    RATE,
    can_frames,
    cut,
    cuts,
    cuttings,
    feed,
    frames_of,
    open_path,
)

# fmt: off
PACKETS = [
    # frame, to the adapter, from it; source
    # `enable` as motorbridge 0.5.6 writes it; DM_CAN.py's template with this id and data is the same
    (CanFrame(1, b"\xff" * 7 + b"\xfc"),
        "55aa1e03 01000000 0a000000 00 01000000 00 08 0000 fffffffffffffffc 00",
        "aa 11 08 01000000 fffffffffffffffc 55"),
    # refresh, DM_CAN.py `refresh_motor_status`: id 7FF, the motor's id and CC
    (CanFrame(0x7FF, bytes.fromhex("0100cc0000000000")),
        "55aa1e03 01000000 0a000000 00 ff070000 00 08 0000 0100cc0000000000 00",
        "aa 11 08 ff070000 0100cc0000000000 55"),
    # the fields of damiao.h: less data, 29 bits, remote
    (CanFrame(0x123, b"\xaa\x55"),
        "55aa1e03 01000000 0a000000 00 23010000 00 02 0000 aa55000000000000 00",
        "aa 11 02 23010000 aa55000000000000 55"),
    (CanFrame(0x1ABCDEF0, bytes(8), True),
        "55aa1e03 01000000 0a000000 01 f0debc1a 00 08 0000 0000000000000000 00",
        "aa 11 48 f0debc1a 0000000000000000 55"),
    (CanFrame(0x7E6, remote=True),
        "55aa1e03 01000000 0a000000 00 e6070000 01 00 0000 0000000000000000 00",
        "aa 11 80 e6070000 0000000000000000 55"),
]
# fmt: on
frames = can_frames().filter(lambda frame: not frame.fd)


@pytest.mark.parametrize(("frame", "sent", "received"), PACKETS, ids=[str(frame) for frame, _, _ in PACKETS])
def test_a_frame_is_its_packets_in_both_directions(frame: CanFrame, sent: str, received: str) -> None:
    assert encode_send(frame) == bytes.fromhex(sent)
    assert encode_received(frame) == bytes.fromhex(received)
    for pieces in cuttings(bytes.fromhex(sent)):
        assert feed(EmulatedAdapter(RATE), pieces) == ([frame], b"")
    assert PacketSplitter(FROM_ADAPTER).feed(bytes.fromhex(received)) == [bytes.fromhex(received)]
    assert decode_received(bytes.fromhex(received)) == (0x11, frame)
    assert EmulatedAdapter(RATE).report(0, frame) == bytes.fromhex(received)


def test_a_report_follows_where_it_is_asked_for() -> None:
    frame = PACKETS[0][0]
    found, reply = EmulatedAdapter(RATE).feed(encode_send(frame, REPORTING) + encode_send(frame))
    assert found == [frame, frame]
    assert [decode_received(reply)] == [(SENT, frame)]


@pytest.mark.parametrize(
    ("at", "byte"),
    [(2, 0x1D), (3, 2), (3, 4), (4, 2), (12, 2), (14, 8), (15, 1), (17, 2), (18, 9)],
    ids=["head", "handshake", "command", "times", "ide", "id", "id of 29 bits", "rtr", "length"],
)
def test_what_is_no_packet_is_skipped_and_the_next_one_is_sent(at: int, byte: int) -> None:
    frame = PACKETS[0][0]
    broken = bytearray(encode_send(frame))
    broken[at] = byte
    for pieces in cuttings(bytes(broken) + encode_send(frame)):
        assert feed(EmulatedAdapter(RATE), pieces) == ([frame], b"")


pieces_of_streams = st.lists(
    st.one_of(
        st.binary(max_size=30), st.sampled_from([b"\x55\xaa\x1e", b"\xaa\x11\x08"]), frames.map(encode_send)
    ),
    max_size=20,
)


@settings(deadline=None, derandomize=True)
@given(pieces_of_streams, cuts)
def test_any_bytes_cut_anywhere_raise_nothing_and_decode_alike(pieces: list[bytes], sizes: list[int]) -> None:
    data = b"".join(pieces)
    assert feed(EmulatedAdapter(RATE), cut(data, sizes)) == EmulatedAdapter(RATE).feed(data)


@settings(deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.binary(max_size=40), frames), min_size=1, max_size=8), cuts)
def test_after_rubbish_without_a_head_every_packet_is_read(
    pairs: list[tuple[bytes, CanFrame]], sizes: list[int]
) -> None:
    splitter = PacketSplitter(FROM_ADAPTER)
    pairs = [(rubbish.replace(b"\xaa", b""), frame) for rubbish, frame in pairs]
    data = b"".join(rubbish + encode_received(frame) for rubbish, frame in pairs)
    read = [decode_received(packet)[1] for piece in cut(data, sizes) for packet in splitter.feed(piece)]
    assert read == [frame for _, frame in pairs]
    assert splitter.skipped == sum(len(rubbish) for rubbish, _ in pairs)


# -- the host's end --------------------------------------------------------------------------------


def opened(path: str) -> CanBus:
    return open_can(replace(CLASSIC, interface=f"dm-serial:{path}"), SimulatedClock())


def test_errors_are_logged_once_each_and_rubbish_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "gateway")
    pty = Pty()
    frame = PACKETS[0][0]
    heartbeat, failed = (encode_received(CanFrame(0), command) for command in (0x00, 0x02))
    with closing(pty), closing(opened(pty.path)) as host:
        pty.read()
        pty.write(heartbeat + b"rubbish" + failed + encode_received(frame) + failed)
        assert frames_of(host, 0, 1) == [frame]
        while not caplog.records:  # the last of it may come later
            host.read(0)
        assert host.bad == 1
        assert [record.message for record in caplog.records] == [
            f"dm-serial {pty.path} reports: could not send ({failed.hex(' ')})"
        ]


def test_can_fd_on_it_is_refused() -> None:
    with pytest.raises(BusError, match="a dm-serial adapter carries classic CAN only"):
        AdapterPty(FD, ("dm-serial",))


def test_a_program_that_writes_half_a_packet_and_hangs_up_leaves_none() -> None:
    frame = PACKETS[0][0]
    with closing(AdapterPty(CLASSIC, ("dm-serial",))) as adapters:
        for data, expected in ((encode_send(frame)[:20], []), (encode_send(frame), [frame])):
            other = open_path(adapters.paths[0])
            os.write(other, data)
            assert [packet.frame for packet in adapters.read(0)[1]] == expected
            os.close(other)
            adapters.read(0)
