"""Images of a bag → markers, by the detectors: sensor_msgs/Image or CompressedImage with the newest
CameraInfo before it.

An image is looked at when it is read, and not kept: a bag may hold more of them than fit into memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from gateway.core.robot import BagCamera
from gateway.rosbag.convert import stamp
from gateway.vision.camera import Image, Intrinsics, decoded, events
from protocols.messages import Measurement

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CameraInfo as RosCameraInfo
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CompressedImage as RosCompressed
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Image as RosImage

ENCODINGS = {
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
}
"""Bytes of a pixel, and where red, green and blue are in it (sensor_msgs/image_encodings.hpp)."""
MODELS = ("plumb_bob", "rational_polynomial", "")
"""Models of distortion that OpenCV has under these numbers (sensor_msgs/CameraInfo.msg)."""


class BagImages:
    """The cameras of a bag, by sensor."""

    def __init__(self, cameras: dict[str, BagCamera]) -> None:
        self._cameras = cameras
        self._known: dict[str, Intrinsics] = {}

    def look(self, role: str, message: object) -> Sequence[Measurement] | str:
        """Take an image or its camera's description; return what was found, or why it is not used."""
        _, sensor, what = role.split(".")
        if what == "info":
            known = intrinsics(cast("RosCameraInfo", message))
            if isinstance(known, str):
                return known
            self._known[sensor] = known
            return []
        if sensor not in self._known:
            return "before the camera's description"
        packed = hasattr(message, "format")
        image = unpacked(cast("RosCompressed", message)) if packed else pixels(cast("RosImage", message))
        t = stamp(message)
        if isinstance(image, str):
            return image
        if t <= 0:
            return "no stamp"
        return events(sensor, t, self._cameras[sensor].detectors.detect(image, self._known[sensor]))


def intrinsics(message: RosCameraInfo) -> Intrinsics | str:
    """Return how a camera projects, or why that is not used."""
    k, d = (tuple(float(one) for one in _either(message, name)) for name in ("k", "d"))
    if message.distortion_model not in MODELS or len(d) not in (0, 4, 5, 8):
        return f"distortion model {message.distortion_model!r}"
    if not (k[0] > 0.0 and k[4] > 0.0 and all(map(math.isfinite, (*k, *d)))):
        return "not calibrated"
    return Intrinsics(k[0], k[4], k[2], k[5], d)


def _either(message: RosCameraInfo, name: str) -> Sequence[float]:
    """Return a field that ROS 1 writes with a capital letter."""
    found: Sequence[float] = getattr(message, name if hasattr(message, name) else name.upper())
    return found


def unpacked(message: RosCompressed) -> Image | str:
    """Return a packed image with red, green and blue, or why it is not used."""
    image = decoded(np.ascontiguousarray(message.data, dtype=np.uint8))
    return f"not an image of format {message.format!r}" if image is None else image


def pixels(message: RosImage) -> Image | str:
    """Return the image with red, green and blue, or why it is not used."""
    if message.encoding not in ENCODINGS:
        return f"encoding {message.encoding!r}"
    depth, channels = ENCODINGS[message.encoding]
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    if min(rows, columns) < 1 or step < columns * depth or len(data) < rows * step:
        return "not an image"
    whole = data[: rows * step].reshape(rows, step)[:, : columns * depth].reshape(rows, columns, depth)
    return np.ascontiguousarray(whole[..., channels])
