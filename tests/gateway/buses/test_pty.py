"""Pseudo-terminals: bytes both ways, a reader that comes, goes, or does not read."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing

import pytest

from gateway.buses.adapters.pty import Pty, SerialPty
from gateway.core.robot import BusSettings
from protocols.frames import BusState, Packet
from tests.gateway.buses.adapter_helpers import gather, is_connected, open_path, taken, wait_for_input


@pytest.fixture
def pty() -> Iterator[Pty]:
    with closing(Pty()) as made:
        yield made


def test_bytes_pass_a_pty_unchanged_in_both_directions(pty: Pty) -> None:
    every = bytes(range(256))
    other = open_path(pty.path)
    assert pty.read() == b""
    assert pty.connected
    os.write(other, every)
    pty.write(every)
    assert taken(other, len(every)) == every
    assert gather(pty.read, len(every)) == every
    os.close(other)


def test_a_program_that_opens_a_pty_finds_no_old_bytes(pty: Pty) -> None:
    assert not is_connected(pty)
    pty.write(b"unread")
    for name in (b"first", b"second", b"third"):
        other = open_path(pty.path)
        pty.read()
        assert is_connected(pty)
        with pytest.raises(BlockingIOError):
            os.read(other, 100)
        pty.write(b"not read by " + name)
        os.write(other, b"sent last by " + name)
        os.close(other)
        assert pty.read() == b"sent last by " + name
        assert not is_connected(pty)
        pty.write(b"too late")


def test_a_reader_that_does_not_read_loses_the_oldest_messages_whole(pty: Pty) -> None:
    other = open_path(pty.path)
    pty.read()
    frames = [b"%06d:" % number + b"x" * 93 for number in range(1000)]
    for frame in frames:
        pty.write(frame)
    assert pty.dropped > 500
    got = b""
    while len(got) < 100 * (1000 - pty.dropped):
        pty.read()
        wait_for_input(other)
        got += os.read(other, 65536)
    os.close(other)
    whole = [got[at : at + 100] for at in range(0, len(got), 100)]
    assert len(whole) == 1000 - pty.dropped
    assert [frame for frame in frames if frame in whole] == whole
    assert whole[-1] == frames[-1]


def test_a_serial_bus_on_a_pty_reports_when_a_program_opens_and_closes_it() -> None:
    bus = SerialPty(BusSettings("sensors", "serial", "twin", baudrate=3_000_000))
    assert bus.read(0) == ([], [])
    other = open_path(bus.pty.path)
    assert bus.read(1) == ([BusState.BACK], [])
    os.write(other, b"hello")
    os.close(other)
    assert bus.read(2) == ([BusState.GONE], [Packet(2, "sensors", b"hello")])
    bus.close()
    assert not os.path.exists(bus.pty.path)  # noqa: PTH110 -- a device, not a file
