"""The host's end of each adapter against the emulated adapter on a pty: one behaviour for both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.can import CanBus, open_can
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.buses.adapter_helpers import CLASSIC, FD, frames_of

FRAMES = [
    CanFrame(0x123, b"\x11\x22\x33"),
    CanFrame(0x1ABCDEF0, b"\xde\xad", extended=True),
    CanFrame(0x7E6, remote=True, requested=3),
    CanFrame(0x12345, remote=True, extended=True, requested=8),
    CanFrame(0x001, bytes(12), fd=True),
    CanFrame(0x1FFFFFFF, bytes(64), True, False, True),
    CanFrame(0x8001, bytes(range(12)), True, False, True, True),
]
EMPTY = CanFrame(0x7FF)
"""An fdcanusb cannot send it."""
KEPT = 4200
"""Bytes that a pty has handed over already, so that they cannot be purged."""
CLASSIC_FRAMES = [frame for frame in FRAMES if not frame.fd]

pytestmark = pytest.mark.parametrize("kind", ["slcan", "fdcanusb", "dm-serial"])


def settings_of(kind: str) -> BusSettings:
    return CLASSIC if kind == "dm-serial" else FD


@pytest.fixture
def adapters(kind: str) -> Iterator[AdapterPty]:
    with closing(AdapterPty(settings_of(kind), (kind, "slcan"))) as made:
        yield made


@pytest.fixture
def frames(kind: str) -> list[CanFrame]:
    """What such an adapter carries."""
    return {"slcan": [*FRAMES, EMPTY], "fdcanusb": FRAMES, "dm-serial": [*CLASSIC_FRAMES, EMPTY]}[kind]


def opened(kind: str, path: str, settings: BusSettings) -> CanBus:
    return open_can(replace(settings, interface=f"{kind}:{path}"), SimulatedClock())


def test_frames_of_every_kind_pass_in_both_directions(
    kind: str, adapters: AdapterPty, frames: list[CanFrame]
) -> None:
    with closing(opened(kind, adapters.paths[0], settings_of(kind))) as host:
        adapters.read(0)
        host.write(1, frames)
        assert [packet.frame for packet in adapters.read(1)[1]] == frames
        adapters.write(2, frames)
        assert frames_of(host, 2, len(frames)) == frames
        host.write(3, frames[:1])
        assert host.bad == 0
    states, packets = adapters.read(4)
    assert states == [BusState.GONE]
    assert [packet.frame for packet in packets] == frames[:1]  # sent just before closing: it arrives


def test_programs_on_different_ports_receive_each_other_and_not_themselves(
    kind: str, adapters: AdapterPty, frames: list[CanFrame]
) -> None:
    (first, second), settings = adapters.paths, settings_of(kind)
    with closing(opened(kind, first, settings)) as host, closing(opened("slcan", second, settings)) as other:
        adapters.read(0)
        host.write(0, frames)
        other.write(0, frames[::-1])
        adapters.read(0)
        assert frames_of(other, 1, len(frames)) == frames
        assert frames_of(host, 1, len(frames)) == frames[::-1]
        host.close()
        assert adapters.read(2)[0] == []  # the other program is still on the bus
    assert adapters.read(3)[0] == [BusState.GONE]


def test_the_host_never_waits_for_an_adapter_that_does_not_read(kind: str, adapters: AdapterPty) -> None:
    received: list[CanFrame] = []
    states: list[BusState] = []
    with closing(opened(kind, adapters.paths[0], settings_of(kind))) as host:
        adapters.read(0)
        for number in range(5000):
            host.write(number, [CanFrame(0x100 + number % 3, number.to_bytes(8, "big"))])
        assert host.read(5000)[0] == [BusState.FULL]
        for turn in range(1000):
            now = turn * 5 * MILLISECOND
            received += [p.frame for p in adapters.read(now)[1] if isinstance(p.frame, CanFrame)]
            states += host.read(now)[0]
    assert states == [BusState.UP]
    assert 50 < len(received) < 5000
    assert sorted(int.from_bytes(frame.data, "big") for frame in received[-3:]) == [4997, 4998, 4999]


def test_old_commands_do_not_go_out_when_an_adapter_goes_on(
    kind: str, adapters: AdapterPty, caplog: pytest.LogCaptureFixture
) -> None:
    """It takes nothing for 2 s."""
    received: list[int] = []
    purges, purged_at = 0, 0
    with closing(opened(kind, adapters.paths[0], settings_of(kind))) as host:
        adapters.read(0)
        for number in range(2000):
            host.write(number * MILLISECOND, [CanFrame(0x100 + number % 3, number.to_bytes(8, "big"))])
            host.read(number * MILLISECOND)
            if caplog.text.count("was purged") > purges:
                purges, purged_at = purges + 1, number
        for turn in range(2000, 2200):
            packets = adapters.read(turn * MILLISECOND)[1]
            received += [
                int.from_bytes(p.frame.data, "big") for p in packets if isinstance(p.frame, CanFrame)
            ]
            host.read(turn * MILLISECOND)
    assert received[-3:] == [1997, 1998, 1999]
    if kind == "dm-serial":  # without an end or a checksum: a packet that is cut could become another
        assert sum(number < 1000 for number in received) > 400
    else:
        assert purged_at > 500
        assert sum(number < purged_at for number in received) < KEPT // 20


def test_an_adapter_that_vanishes_is_reported_and_reopened(
    kind: str, frames: list[CanFrame], tmp_path: Path
) -> None:
    settings = settings_of(kind)
    with pytest.raises(BusError, match="No such file"):
        opened(kind, "/dev/there-is-none", settings)
    link = tmp_path / "adapter"
    first = AdapterPty(settings, (kind,))
    link.symlink_to(first.paths[0])
    host = opened(kind, str(link), settings)
    assert first.read(0)[0] == [BusState.BACK]
    with pytest.raises(BusError, match="can0"):
        opened(kind, first.paths[0], settings)
    assert first.read(0) == ([], [])  # it was not disturbed
    first.close()
    assert host.read(1) == ([BusState.GONE], [])
    host.write(2, [CanFrame(1, b"\x01")])
    assert host.dropped == 1
    with closing(AdapterPty(settings, (kind,))) as second:
        link.unlink()
        link.symlink_to(second.paths[0])
        assert host.read(SECOND // 2) == ([], [])
        assert host.read(2 * SECOND)[0] == [BusState.BACK]
        assert second.read(0)[0] == [BusState.BACK]
        host.write(2 * SECOND, frames)
        assert [packet.frame for packet in second.read(1)[1]] == frames
        host.close()
