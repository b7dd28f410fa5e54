"""Frames, settings and streams for the tests of slcan and fdcanusb."""

from __future__ import annotations

import os
import select
import time
import tty
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

import pytest
from hypothesis import strategies as st

from gateway.buses.adapters.adapter_pty import Adapter
from gateway.buses.adapters.pty import Pty
from gateway.buses.can import CanBus
from gateway.buses.frame_time import LENGTHS
from gateway.core.robot import BusSettings
from protocols.frames import CanFrame
from protocols.messages import Nanos
from tests.gateway.processes import PATIENCE

T = TypeVar("T")
RATE, DATA_RATE = 1_000_000, 5_000_000
CLASSIC = BusSettings("can0", "can", "twin", RATE)
FD = BusSettings("can0", "canfd", "twin", RATE, DATA_RATE)

cuts = st.lists(st.integers(1, 40), min_size=1, max_size=10)
"""Sizes of the pieces into which a stream is cut, over and over."""


def can_frames(min_size: int = 0) -> st.SearchStrategy[CanFrame]:
    """Frames of any kind but remote ones, with data of a length that exists."""
    return st.builds(
        lambda number, data, extended, fd, brs: CanFrame(
            number if extended else number & 0x7FF,
            data.ljust(min(n for n in LENGTHS if n >= len(data)), b"\0") if fd else data[:8],
            extended,
            False,
            fd,
            fd and brs,
        ),
        st.integers(0, 0x1FFFFFFF),
        st.binary(min_size=min_size, max_size=64),
        st.booleans(),
        st.booleans(),
        st.booleans(),
    )


def cut(data: bytes, sizes: Sequence[int]) -> Iterator[bytes]:
    at = turn = 0
    while at < len(data):
        yield data[at : at + sizes[turn % len(sizes)]]
        at, turn = at + sizes[turn % len(sizes)], turn + 1


def feed(adapter: Adapter, pieces: Iterable[bytes]) -> tuple[list[CanFrame], bytes]:
    """The frames and the replies to a stream in pieces."""
    fed = [adapter.feed(piece) for piece in pieces]
    return [frame for frames, _ in fed for frame in frames], b"".join(replies for _, replies in fed)


def cuttings(data: bytes) -> tuple[list[bytes], ...]:
    """A stream whole, byte by byte, and in two."""
    return [data], [bytes([byte]) for byte in data], [data[:7], data[7:]]


def open_path(path: str) -> int:
    return os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


def wait_for_input(fd: int) -> None:
    """A pty hands bytes over in the kernel's own time."""
    assert select.select([fd], [], [], 60.0)[0]


def poll(look: Callable[[], T]) -> T:
    """Look until there is something: a pty hands bytes over in the kernel's own time."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if seen := look():
            return seen
    pytest.fail("nothing came")


def gather(look: Callable[[], bytes], count: int) -> bytes:
    """Look until there are `count` bytes: a kernel may hand over a write, or two, in any pieces."""
    got = b""
    while len(got) < count:
        got += poll(look)
    return got


def frames_of(bus: CanBus, now: Nanos, count: int) -> list[object]:
    """Read until `count` frames have come: a line may be cut anywhere, and what is behind it comes later."""
    frames: list[object] = []
    while len(frames) < count:
        frames += [packet.frame for packet in poll(lambda: bus.read(now)[1])]
    return frames


def taken(fd: int, count: int) -> bytes:
    """At least `count` bytes from a file, which may block."""

    def look() -> bytes:
        wait_for_input(fd)
        return os.read(fd, 65536)

    return gather(look, count)


def raw_pty() -> tuple[int, int]:
    """The device's end of a terminal line, and the host's."""
    ends = os.openpty()
    for end in ends:
        tty.setraw(end)
    return ends


def is_connected(pty: Pty) -> bool:
    return pty.connected  # a function, since mypy takes an attribute for constant
