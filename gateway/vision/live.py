"""A live camera: V4L2, or a video file in its place, by OpenCV; and how its pictures are looked at.

Rules. `Capture` waits for a picture: whoever asks it has a thread for that. `Watch` owns no clock; a picture
brings its time. A picture of another size than the lens was described for is not looked at.

Source: modules/videoio/src/cap_v4l.cpp of opencv/opencv@02b4975 (what is set before the first picture; the
stamp of a buffer as CAP_PROP_POS_MSEC, which uvcvideo takes from the monotonic clock).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np

from gateway.vision.camera import Image, Intrinsics, events, opencv
from gateway.vision.detectors import CameraSettings
from protocols.bounds import Bounds, Invalid, check
from protocols.messages import MILLISECOND, SECOND, Marker, Nanos

MODELS = (0, 4, 5, 8)
"""Numbers of distortion that OpenCV's models have"""
LASTS: Nanos = SECOND
"""How long pictures must be dark, or slow, to be told."""
SMOOTH = 0.1
"""Share of the newest interval in the mean of those between pictures"""
SPARSE = 8
"""Every so many rows and columns are looked at for their brightness."""


@dataclass(frozen=True, slots=True)
class LiveCamera(CameraSettings):
    """A camera of this machine."""

    rate_hz: Annotated[float, Bounds(0.5, 240.0)] = 30.0
    """Pictures per second that it is asked for; a video file has its own"""
    encoding: Literal["its own", "MJPG", "YUYV"] = "its own"
    """How pictures come over USB: large ones come faster as MJPG"""
    lens: Intrinsics | None = None
    """As calibrated, for this size; without it `view` says it"""
    darkest: Annotated[float, Bounds(0.0, 100.0)] = 3.0
    """Mean grey of 255 below which pictures are black"""
    slowest_hz: Annotated[float, Bounds(0.1, 240.0)] = 2.0
    """Pictures looked at per second, fewer than which are too slow"""

    def __post_init__(self) -> None:
        check(self)
        if self.lens is not None and len(self.lens.distortion) not in MODELS:
            text = "lens.distortion has 4, 5 or 8 numbers (k1, k2, p1, p2, k3 …), or none"
            raise Invalid(("lens.distortion", text))

    @property
    def projection(self) -> Intrinsics:
        """How it projects."""
        return self.lens or self.intrinsics


class Capture:
    """An open camera, or video file. OpenCV says nothing by itself: who asks is told."""

    def __init__(self, path: str, settings: LiveCamera, *, is_file: bool) -> None:
        cv2: Any = opencv()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        self._cv2, self._is_file = cv2, is_file
        self._device = cv2.VideoCapture(path, cv2.CAP_ANY if is_file else cv2.CAP_V4L2)
        if self.is_open and not is_file:
            for name, value in _asked(cv2, settings):
                self._device.set(name, value)

    @property
    def is_open(self) -> bool:
        """Whether there is something that gives pictures."""
        return bool(self._device.isOpened())

    @property
    def period(self) -> Nanos:
        """Of the pictures of a file; 0: a camera has its own."""
        rate = float(self._device.get(self._cv2.CAP_PROP_FPS)) if self._is_file else 0.0
        return round(SECOND / rate) if 0.1 < rate < 1000.0 else 0

    def next(self) -> tuple[Image, Nanos | None] | None:
        """Wait for a picture; return it, and its stamp on the monotonic clock if it has one; None: none
        comes any more."""
        there, found = self._device.read()
        if not there or found is None:
            return None
        stamp = None if self._is_file else self._device.get(self._cv2.CAP_PROP_POS_MSEC)
        colours = found if found.ndim == 3 else np.repeat(found[..., None], 3, axis=2)
        image = np.ascontiguousarray(colours[..., ::-1], dtype=np.uint8)
        return image, round(stamp * MILLISECOND) if stamp else None

    def close(self) -> None:
        """Release it."""
        self._device.release()


def _asked(cv2: Any, settings: LiveCamera) -> list[tuple[int, float]]:  # noqa: ANN401 -- OpenCV has no types
    """Return what a camera is asked for, in this order; one buffer, so that no picture waits."""
    given = settings.encoding != "its own"
    encoding = [(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.encoding))] if given else []
    return [
        *encoding,
        (cv2.CAP_PROP_FRAME_WIDTH, settings.width),
        (cv2.CAP_PROP_FRAME_HEIGHT, settings.height),
        (cv2.CAP_PROP_FPS, settings.rate_hz),
        (cv2.CAP_PROP_BUFFERSIZE, 1),
    ]


@dataclass(frozen=True, slots=True)
class Look:
    """What one picture shows, and how it is."""

    number: int
    taken: Nanos
    width: int
    height: int
    rate: float
    """Pictures per second"""
    grey: float
    """Mean, of 255"""
    fits: bool
    """It has the size that was asked for."""
    dark: bool
    slow: bool
    seen: tuple[Marker, ...]


Since: TypeAlias = Nanos | None


@dataclass(slots=True)
class Watch:
    """Looks at the pictures of a camera, one after the other. Plain data."""

    settings: LiveCamera
    number: int = 0
    taken: Since = None
    """When the newest picture was taken"""
    interval: float = 0.0
    """ns between pictures, their mean"""
    since: dict[str, Nanos] = field(default_factory=dict)
    """From when on pictures have been dark, or slow"""

    def look(self, image: Image, taken: Nanos) -> Look:
        """Look at a picture."""
        settings, (height, width) = self.settings, image.shape[:2]
        if self.taken is not None and taken > self.taken:
            newest = float(taken - self.taken)
            self.interval += (newest - self.interval) * (SMOOTH if self.interval else 1.0)
        self.number, self.taken = self.number + 1, taken
        grey = float(image[::SPARSE, ::SPARSE].mean())
        rate = SECOND / self.interval if self.interval else 0.0
        fits = (width, height) == (settings.width, settings.height)
        sightings = settings.detectors.detect(image, settings.projection) if fits else []
        return Look(
            self.number,
            taken,
            width,
            height,
            rate,
            grey,
            fits,
            self._lasts("dark", taken, is_so=grey < settings.darkest),
            self._lasts("slow", taken, is_so=0.0 < rate < settings.slowest_hz),
            tuple(events("", taken, sightings)),
        )

    def _lasts(self, what: str, now: Nanos, *, is_so: bool) -> bool:
        if not is_so:
            self.since.pop(what, None)
            return False
        return now - self.since.setdefault(what, now) >= LASTS
