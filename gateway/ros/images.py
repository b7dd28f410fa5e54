"""Images of cameras: bands of pixels from the loop, one in a step, and messages where the sockets are.

Rules. The newest image of a camera is sent if somebody takes it, and nothing else waits for the other end of
the pipe; until it is all sent, newer ones are left out. It is packed (JPEG) in the process with the sockets:
that takes milliseconds. The camera's description has the same stamp. An image is in the frame NAME_optical:
x to the right, y down, z ahead (REP-103), which /tf_static has.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Protocol

import numpy as np

from brain.perception.mount import Mount
from gateway.recording import ros_messages
from gateway.ros.link import Link
from gateway.ros.types import encode, make, store
from gateway.vision.camera import TO_SENSOR, Image, Intrinsics, Seen, opencv, packed
from protocols.messages import Nanos

IMAGE, INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
BAND = 1 << 16
"""Bytes of pixels that are sent in one step"""
MOST = 1 << 26
"""Bytes of an image that is put together"""
BEGINS, GOES_ON = "image", "pixels"
"""Messages of the pipe: row, the CDR before the data, height, width; row, bytes before, bytes"""


class Camera(Protocol):
    """A camera whose images can be had."""

    @property
    def name(self) -> str:
        """Of the sensor"""
        ...

    @property
    def mount(self) -> Mount:
        """On the robot"""
        ...

    @property
    def seen(self) -> Seen | None:
        """Its newest image, which is not changed any more"""
        ...


def topics(cameras: Sequence[str]) -> dict[str, str]:
    """Return the type of each topic of these cameras."""
    return {name: type_ for one in cameras for name, type_ in zip(_topics(one), (IMAGE, INFO), strict=True)}


def _topics(camera: str) -> tuple[str, str]:
    return f"/{camera}/image_raw/compressed", f"/{camera}/camera_info"


def frame(camera: str) -> str:
    """Return the frame of a camera's images."""
    return f"{camera}_optical"


def optical(mount: Mount) -> Mount:
    """Return where the frame of a camera's images is, on a robot where the camera is mounted so."""
    turned = np.array(mount.rotation()) @ TO_SENSOR
    pitch = math.asin(max(-1.0, min(1.0, -float(turned[2, 0]))))
    yaw, roll = math.atan2(turned[1, 0], turned[0, 0]), math.atan2(turned[2, 1], turned[2, 2])
    return Mount(mount.x, mount.y, mount.z, yaw, pitch, roll)


class ImageTopics:
    """The loop's end.

    Args:
        cameras: whose images are shown.
        rows: of the topics, by name.
        link: to the process with the sockets.
        publish: sends a message on a topic of the table.
        epoch: of the calendar, at our clock's zero.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        rows: dict[str, int],
        link: Link,
        publish: Callable[[str, bytes], None],
        epoch: Nanos,
    ) -> None:
        self._waiting = deque(cameras)
        """Of which the first is looked at next"""
        self._rows, self._link, self._publish, self._epoch = rows, link, publish, epoch
        self.names = frozenset(topics([one.name for one in cameras]))
        self._sent: dict[str, Nanos] = {}
        """When the image was taken that was sent last, by camera"""
        self._pixels: tuple[int, memoryview] | None = None
        """Row and pixels of what is being sent,"""
        self._at = 0
        """and how many bytes of it are"""

    def show(self, wanted: Collection[str]) -> None:
        """Send the next band, or begin with an image. `wanted`: topics that somebody takes."""
        if not self._waiting or self._link.waiting:
            return
        if self._pixels is not None:
            self._go_on(*self._pixels)
            return
        for _ in range(len(self._waiting)):
            self._waiting.rotate(-1)
            one = self._waiting[-1]
            image, info = _topics(one.name)
            if one.seen is None or one.seen.t == self._sent.get(one.name) or not {image, info} & {*wanted}:
                continue
            t, pixels, intrinsics = one.seen
            self._sent[one.name] = t
            if info in wanted:
                self._publish(info, encode(_info(one.name, t + self._epoch, pixels, intrinsics)))
            if image in wanted:
                self._begin(self._rows[image], one.name, t + self._epoch, pixels)
            return

    def _begin(self, row: int, camera: str, t: Nanos, pixels: Image) -> None:
        header = ros_messages.header(store().types, t, frame(camera))
        height, width, _ = pixels.shape
        self._link.send(BEGINS, row, encode(make(IMAGE, header=header, format="jpeg"))[:-4], height, width)
        self._pixels, self._at = (row, np.ascontiguousarray(pixels).data.cast("B")), 0

    def _go_on(self, row: int, pixels: memoryview) -> None:
        self._link.send(GOES_ON, row, self._at, bytes(pixels[self._at : self._at + BAND]))
        self._at += BAND
        if self._at >= len(pixels):
            self._pixels = None


def _info(camera: str, t: Nanos, pixels: Image, one: Intrinsics) -> object:
    """Return the description of a camera."""
    distortion = np.array((*one.distortion, *[0.0] * max(0, 5 - len(one.distortion))))
    height, width, _ = pixels.shape
    return make(
        INFO,
        header=ros_messages.header(store().types, t, frame(camera)),
        height=height,
        width=width,
        distortion_model="plumb_bob" if len(distortion) == 5 else "rational_polynomial",
        d=distortion,
        k=one.matrix.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.column_stack([one.matrix, np.zeros(3)]).reshape(-1),
    )


class Pictures:
    """The end with the sockets: images that are put together, and packed."""

    def __init__(self, types: Collection[str]) -> None:
        """`types`: of what is sent here; if there are images, OpenCV is imported now, which takes long."""
        if IMAGE in types:
            opencv()
        self._begun: dict[int, tuple[bytes, int, int, bytearray]] = {}
        """CDR before the data, height, width and pixels, by row"""

    def take(self, kind: str, row: int, *rest: object) -> bytes | None:
        """Take a part of an image; return its message if that is all of it. A part that follows none is left
        out."""
        if kind == BEGINS:
            head, height, width = rest
            assert isinstance(head, bytes) and isinstance(height, int) and isinstance(width, int)  # noqa: PT018
            self._begun[row] = head, height, width, bytearray()
            return None
        at, band = rest
        assert isinstance(band, bytes), "what the loop sends"
        if row not in self._begun:
            return None
        head, height, width, pixels = self._begun[row]
        if at != len(pixels) or len(pixels) > MOST:
            del self._begun[row]
            return None
        pixels += band
        if len(pixels) < 3 * height * width:
            return None
        del self._begun[row]
        data = packed(np.frombuffer(pixels, np.uint8).reshape(height, width, 3))
        return head + len(data).to_bytes(4, "little") + data
