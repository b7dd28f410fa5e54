"""A camera and what a detector sees in its image.

Frames. In an image columns grow to the right and rows downward, and the middle of the first pixel is (0, 0).
OpenCV's camera looks along z, x to the right, y down; a sensor of ours looks along x, y to the left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from gateway.errors import UserError
from protocols.bounds import Bounds
from protocols.messages import Marker, Nanos

if TYPE_CHECKING:
    from types import ModuleType

Image: TypeAlias = npt.NDArray[np.uint8]
"""Rows × columns × red, green, blue"""
Floats: TypeAlias = npt.NDArray[np.float64]

TO_SENSOR: Floats = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotates a vector of OpenCV's camera into the sensor's frame."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """How a camera without skew projects: pixels; distortion as OpenCV and sensor_msgs/CameraInfo have it."""

    fx: Annotated[float, Bounds(1.0, 1e5)]
    """Pixels: focal length, along the rows"""
    fy: Annotated[float, Bounds(1.0, 1e5)]
    """Pixels: focal length, along the columns"""
    cx: Annotated[float, Bounds(-1e4, 1e4)]
    """Pixels: column of the optical axis"""
    cy: Annotated[float, Bounds(-1e4, 1e4)]
    """Pixels: row of the optical axis"""
    distortion: tuple[Annotated[float, Bounds(-1e3, 1e3)], ...] = ()
    """k1, k2, p1, p2, k3 … of the model "plumb_bob", or "rational_polynomial" """

    @property
    def matrix(self) -> Floats:
        """The matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class Seen(NamedTuple):
    """An image of a camera."""

    t: Nanos
    image: Image
    intrinsics: Intrinsics


@dataclass(frozen=True, slots=True)
class Sighting:
    """One marker in one image, in the frame of OpenCV's camera."""

    marker: int
    position: Floats
    """m, of its centre"""
    rotation: Floats | None
    """From its own frame, x to its right, y up, z out of its face, as seen by who looks at it; None: not
    known"""
    variance: tuple[float, float]
    """m²: along the line of sight, and across it"""
    turn_variance: float | None = None
    """rad², of the rotation about its own upright axis"""


class Detector(Protocol):
    """What finds markers in images. A pure function of its settings and the image."""

    def detect(self, image: Image, intrinsics: Intrinsics) -> list[Sighting]:
        """Return the markers in an image, by their numbers."""


def events(sensor: str, t: Nanos, sightings: list[Sighting]) -> list[Marker]:
    """Return what a camera reports about an image of this time: at least that there is nothing in it."""
    return [_event(sensor, t, one) for one in sightings] or [Marker(sensor, t, None)]


def _event(sensor: str, t: Nanos, sighting: Sighting) -> Marker:
    x, y, z = (TO_SENSOR @ sighting.position).tolist()
    turned = None
    if sighting.rotation is not None:
        turned = _quaternion(TO_SENSOR @ sighting.rotation[:, [2, 0, 1]])
    variances = sighting.variance, sighting.turn_variance
    return Marker(sensor, t, sighting.marker, (x, y, z), turned, *variances)


def _quaternion(rotation: Floats) -> tuple[float, float, float, float]:
    """Return x, y, z, w of a rotation matrix, by the largest of the four (Shepperd 1978)."""
    trace = float(np.trace(rotation))
    squares = [*(2.0 * rotation[i, i] - trace for i in range(3)), trace]
    largest = int(np.argmax(squares))
    if largest == 3:
        antisymmetric = rotation - rotation.T
        found = [antisymmetric[2, 1], antisymmetric[0, 2], antisymmetric[1, 0], 1.0 + trace]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        found = [0.0] * 4
        found[i] = 1.0 + squares[i]
        found[j], found[k] = rotation[i, j] + rotation[j, i], rotation[i, k] + rotation[k, i]
        found[3] = rotation[k, j] - rotation[j, k]
    x, y, z, w = (np.array(found) / np.linalg.norm(found)).tolist()
    return x, y, z, w


def decoded(data: npt.NDArray[np.uint8]) -> Image | None:
    """Return a packed image (JPEG, PNG); None if it is damaged."""
    cv2: Any = opencv()
    try:
        found = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except cv2.error:  # it has more pixels than OpenCV takes, or none
        return None
    return None if found is None else np.ascontiguousarray(found[..., ::-1], dtype=np.uint8)


def packed(image: Image, width: int = 0, quality: int = 85) -> bytes:
    """Return an image as a JPEG, at most so many pixels wide (0: as it is). Raises UserError without
    OpenCV."""
    cv: Any = opencv()
    if scale := min(1.0, width / image.shape[1]):
        image = cv.resize(image, None, fx=scale, fy=scale, interpolation=cv.INTER_AREA)
    _, made = cv.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv.IMWRITE_JPEG_QUALITY, quality])
    return bytes(made)


def opencv() -> ModuleType:
    """Import OpenCV, in one thread. Raises UserError with the command that installs it."""
    try:
        import cv2
    except ImportError as error:
        raise UserError(f"a camera needs OpenCV ({error}): pip install 'motor-gateway[camera]'") from error
    cv2.setNumThreads(1)
    module: Any = cv2
    return module  # type: ignore[no-any-return]
