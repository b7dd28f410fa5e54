"""What a camera tells of its pictures: markers with the time of their picture, pictures that are missing, and
what is wrong with them, in words."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import pytest

from protocols.camera import plugin, table
from protocols.camera.table import Picture
from protocols.messages import MILLISECOND, SECOND, Fault, Marker, State
from protocols.plugin import Device

PICTURE = Picture(7, 30 * MILLISECOND, 640, 480, 2997, 101)
TAG = Marker("eye", 0, 11, (1.5, -0.25, 0.125), (0.0, 0.0, 0.5, 0.75), (1e-4, 2e-6), 3e-3)
BALL = Marker("eye", 0, 1000, (2.0, 0.5, 0.0), None, (1e-3, 1e-5))
NOTHING = Marker("eye", 0, None)


def driver(**options: Any) -> Any:
    return plugin.driver([Device("eye", 1, plugin.options(**options), plugin.settings())])


def test_a_message_is_what_its_table_says() -> None:
    """Packed here by the layout in words."""
    head = struct.pack("<IQHHHBBBI", 7, 30_000_000, 640, 480, 2997, 101, 0, 15, 11)
    body = head + struct.pack("<10d", 1.5, -0.25, 0.125, 0.0, 0.0, 0.5, 0.75, 1e-4, 2e-6, 3e-3)
    assert table.encode(PICTURE, TAG) == b"\xca\x3e" + body + struct.pack("<I", zlib.crc32(body))


@pytest.mark.parametrize("seen", [TAG, BALL, NOTHING], ids=["tag", "ball", "nothing"])
def test_what_was_seen_has_the_time_of_its_picture(seen: Marker) -> None:
    (event,) = [
        one
        for one in driver(delay_ms=10.0).receive(SECOND, table.encode(PICTURE, seen))
        if isinstance(one, Marker)
    ]
    assert event.t == SECOND - 40 * MILLISECOND
    fields = ("marker", "position", "orientation", "variance", "turn_variance")
    assert [getattr(event, name) for name in fields] == [getattr(seen, name) for name in fields]


def test_pictures_that_are_missing_are_counted() -> None:
    eye = driver()
    for number in (0xFFFFFFFE, 0xFFFFFFFF, 0, 0, 3):  # two markers in one picture
        eye.receive(SECOND, table.encode(PICTURE._replace(number=number), TAG))
    (host,) = eye.hosts.values()
    assert host.own.lost == 2


@pytest.mark.parametrize(
    ("bit", "name"),
    [
        (table.SIZE, "pictures of another size"),
        (table.DARK, "pictures are black"),
        (table.SLOW, "pictures come too slowly"),
    ],
)
def test_what_is_wrong_with_pictures_is_a_fault_in_words_and_passes(bit: int, name: str) -> None:
    eye = driver()
    wrong = PICTURE._replace(faults=bit, width=320, height=240, rate=50, grey=0)
    events = eye.receive(SECOND, table.encode(wrong, NOTHING))
    (fault,) = [one for one in events if isinstance(one, Fault)]
    assert fault.name == name
    details = [one.detail for one in events if isinstance(one, State)]
    assert details == ["320 × 240, 0.5 pictures per second, grey 0"]
    assert bool([one for one in events if isinstance(one, Marker)]) == (bit != table.SIZE)
    later = eye.receive(2 * SECOND, table.encode(PICTURE, NOTHING))
    assert [one.detail for one in later if isinstance(one, State)] == ["sees"]


@pytest.mark.parametrize("at", range(2, 108))
def test_a_damaged_byte_is_no_reading(at: int) -> None:
    eye, whole = driver(), bytearray(table.encode(PICTURE, TAG))
    whole[at] ^= 0x10
    assert [one for one in eye.receive(SECOND, bytes(whole)) if isinstance(one, Marker)] == []
    assert (eye.counters.accepted, eye.counters.malformed) == (0, 1)


@pytest.mark.parametrize(
    "seen",
    [
        Marker("eye", 0, 1, (float("nan"), 0.0, 0.0)),
        Marker("eye", 0, 1, (1e7, 0.0, 0.0)),
        Marker("eye", 0, table.MOST + 1, (1.0, 0.0, 0.0)),
    ],
)
def test_what_no_camera_measures_is_not_sent(seen: Marker) -> None:
    with pytest.raises(ValueError, match="beyond what a camera measures"):
        table.encode(PICTURE, seen)
