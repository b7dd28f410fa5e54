"""Images on their way: a band in a step, no wait for anybody, and whole or not at all at the other end."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from brain.perception.mount import Mount
from gateway.ros import types
from gateway.ros.images import BAND, BEGINS, GOES_ON, IMAGE, INFO, ImageTopics, Pictures, optical, topics
from gateway.ros.link import Link
from gateway.vision.camera import Image, Intrinsics, Seen, decoded
from protocols.messages import SECOND

LENS = Intrinsics(400.0, 410.0, 159.5, 119.5)
NAMES = [*topics(["eye"])]
ROWS = {name: number for number, name in enumerate(NAMES)}


@dataclass
class Eye:
    """A camera with an image that is given."""

    name: str = "eye"
    mount: Mount = Mount()  # noqa: RUF009 -- a frozen value
    seen: Seen | None = None


def drawn(seed: int, height: int = 240, width: int = 320) -> Image:
    """Smooth colours, which JPEG keeps."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows % 256, columns % 256, np.full_like(rows, 40 * seed)], axis=2).astype(np.uint8)


@contextmanager
def ends(*eyes: Eye) -> Iterator[tuple[ImageTopics, Link, list[tuple[str, bytes]]]]:
    ours, theirs = socket.socketpair()
    link, other, sent = Link(ours), Link(theirs), list[tuple[str, bytes]]()
    rows = {name: number for number, name in enumerate(topics([one.name for one in eyes]))}
    try:
        yield ImageTopics(eyes, rows, link, lambda *one: sent.append(one), 5 * SECOND), other, sent
    finally:
        link.close()
        other.close()


def test_an_image_goes_in_bands_and_comes_out_as_one_message() -> None:
    eye = Eye(seen=Seen(2 * SECOND, drawn(3), LENS))
    with ends(eye) as (show, other, sent):
        pictures, found, steps = Pictures([IMAGE]), list[bytes](), 0
        for _ in range(20):
            show.show(set(NAMES))
            parts = other.receive()
            assert len(parts) <= 1, "one in a step"
            assert sum(len(one) for part in parts for one in part if isinstance(one, bytes)) <= BAND
            found += [whole for part in parts if (whole := pictures.take(*part)) is not None]
            steps += bool(parts)
    assert steps == 1 + -(-240 * 320 * 3 // BAND)
    (message,) = (types.decode(IMAGE, one) for one in found)
    image = decoded(message.data)
    assert image is not None
    assert float(np.abs(image.astype(int) - drawn(3)).mean()) < 3.0
    ((name, info),) = sent
    described = types.decode(INFO, info)
    assert name == "/eye/camera_info"
    assert (described.width, described.height, described.k[4], described.k[2]) == (320, 240, 410.0, 159.5)
    assert described.header == message.header
    assert (message.header.stamp.sec, message.header.frame_id) == (7, "eye_optical")


@pytest.mark.parametrize(
    ("wanted", "described", "images"),
    [(set(), 0, 0), ({NAMES[0]}, 0, 1), ({NAMES[1]}, 1, 0), (set(NAMES), 1, 1)],
)
def test_what_nobody_takes_is_not_made(wanted: set[str], described: int, images: int) -> None:
    with ends(Eye(seen=Seen(1, drawn(1), LENS))) as (show, other, sent):
        parts: list[Any] = []
        for _ in range(20):
            show.show(wanted)
            parts += other.receive()
    assert len(sent) == described
    assert sum(part[0] == BEGINS for part in parts) == images


def test_nothing_waits_for_who_does_not_read_and_newer_images_take_its_place() -> None:
    eye, image = Eye(), drawn(3, 480, 640)
    with ends(eye) as (show, other, _):
        for number in range(100):
            eye.seen = Seen(number, image, LENS)
            show.show(set(NAMES))
            assert len(show._link._out) <= BAND + 1000
        pictures, found = Pictures([IMAGE]), list[bytes]()
        for _ in range(60):
            show._link.flush()
            show.show(set(NAMES))
            found += [whole for part in other.receive() if (whole := pictures.take(*part)) is not None]
    seconds = [types.decode(IMAGE, one).header.stamp.nanosec for one in found]
    assert len(seconds) >= 2
    assert seconds[1] == 99, "after what had begun, the newest"


def test_two_cameras_take_turns() -> None:
    eyes = Eye("left", seen=Seen(1, drawn(1), LENS)), Eye("right", seen=Seen(1, drawn(2), LENS))
    with ends(*eyes) as (show, other, _):
        begun: list[int] = []
        for number in range(60):
            for eye in eyes:
                assert eye.seen is not None
                eye.seen = eye.seen._replace(t=number)
            show.show(set(topics(["left", "right"])))
            begun += [part[1] for part in other.receive() if part[0] == BEGINS]
    assert begun[:4] == [0, 2, 0, 2]


def test_parts_that_do_not_fit_make_no_image() -> None:
    pictures, half = Pictures(()), bytes(6)
    assert pictures.take(GOES_ON, 0, 0, half) is None
    pictures.take(BEGINS, 0, b"", 2, 2)
    pictures.take(GOES_ON, 0, 0, half)
    assert pictures.take(GOES_ON, 0, 12, half) is None, "one is missing"
    assert pictures.take(GOES_ON, 0, 6, half) is None, "what went on is left out"
    pictures.take(BEGINS, 0, b"head", 2, 2)
    pictures.take(GOES_ON, 0, 0, half)
    whole = pictures.take(GOES_ON, 0, 6, half)
    assert whole is not None
    assert whole[:4] == b"head"


@pytest.mark.parametrize(
    "mount",
    [Mount(0.15, 0.0, 0.2), Mount(0.1, 0.2, 0.3, 0.7, 0.4, -0.2), Mount(0.0, 0.0, 1.0, 0.0, math.pi / 2)],
)
def test_the_optical_frame_looks_along_z(mount: Mount) -> None:
    """What lies 2 m ahead of the camera, 0.3 m to its left and 0.1 m up, lies there in both frames."""
    there = optical(mount)
    assert there.place((-0.3, -0.1, 2.0)) == pytest.approx(mount.place((2.0, 0.3, 0.1)))
