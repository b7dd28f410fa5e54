"""AprilTags of the family 36h11 (Olson 2011; Wang and Olson 2016), found by OpenCV: pose and its
covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

import numpy as np

from gateway.vision.camera import Floats, Image, Intrinsics, Sighting, opencv
from protocols.bounds import Bounds, check

FAMILY = 587
"""Tags of the family: numbers from 0."""
CELLS = 8
"""Along each side of a tag, its black border included; `size` is that of these."""
UNLIKELY = 12.0
"""A second pose of the same tag is excluded by this difference of the squared errors of its corners over
their variance: to 1 in 400 (chi-square of two)."""
ALIKE = 0.1
"""rad: two poses nearer than this are one."""
REACH = 0.7
"""How far an edge is looked at to both sides, in cells: beyond a cell there is something else."""
LEAST_CONTRAST, LEAST_SINE, MOST_MOVED = 20.0, 0.2, 2.0
"""Of edges, and of the angle between two; and pixels by which corners may move: else they stay as found."""


@dataclass(frozen=True, slots=True)
class Tags:
    """Tags of one size."""

    size: Annotated[float, Bounds(0.005, 5.0, "m")]
    """m, outer edge of the black border"""
    corner_sigma: Annotated[float, Bounds(0.01, 10.0)] = 0.25
    """Pixels: standard deviation of a corner in each direction"""

    def __post_init__(self) -> None:
        check(self)

    def detect(self, image: Image, intrinsics: Intrinsics) -> list[Sighting]:
        """Return the tags in an image. Of one whose pose is ambiguous (far, seen almost straight) the
        orientation is not known."""
        cv2 = opencv()
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
        corners, numbers, _ = _detector().detectMarkers(grey)
        if numbers is None:
            return []
        found = sorted(zip(numbers.ravel().tolist(), corners, strict=True), key=lambda one: one[0])
        sightings = (
            self._sighting(number, _refined(grey, one[0], intrinsics), intrinsics) for number, one in found
        )
        return [sighting for sighting in sightings if sighting]

    def _sighting(self, number: int, corners: Any, intrinsics: Intrinsics) -> Sighting | None:  # noqa: ANN401
        """Return a tag by its four corners in an image without distortion, from the upper left clockwise."""
        cv2 = opencv()
        camera, distortion = intrinsics.matrix, np.zeros(0)
        flat = self._corners()
        count, rotations, places, _ = cv2.solvePnPGeneric(
            flat, corners.astype(np.float64), camera, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        poses: list[tuple[float, Floats, Floats]] = []
        for i in range(count):
            rotation, place = cv2.solvePnPRefineLM(
                flat, corners.astype(np.float64), camera, distortion, rotations[i], places[i]
            )
            seen, _ = cv2.projectPoints(flat, rotation, place, camera, distortion)
            missed = float(((seen[:, 0] - corners) ** 2).sum()) / self.corner_sigma**2
            if place[2, 0] > 0.0 and math.isfinite(missed):
                poses.append((missed, cv2.Rodrigues(rotation)[0], place[:, 0]))
        if not poses:
            return None
        poses.sort(key=lambda one: one[0])
        error, turned, place = poses[0]
        ambiguous = any(
            other - error < UNLIKELY and _angle(turned, rotation) > ALIKE for other, rotation, _ in poses[1:]
        )
        covariance = self._covariance(turned, place, intrinsics)
        sight = place / np.linalg.norm(place)
        along = float(sight @ covariance[:3, :3] @ sight)
        across = (float(np.trace(covariance[:3, :3])) - along) / 2.0
        if ambiguous:
            return Sighting(number, place, None, (along, across))
        return Sighting(number, place, turned, (along, across), float(covariance[4, 4]))

    def _corners(self) -> Floats:
        half = self.size / 2.0
        return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])

    def _covariance(self, turned: Floats, place: Floats, intrinsics: Intrinsics) -> Floats:
        """Return the covariance, 6 × 6, of the place, and of the rotation about the tag's own axes: that of
        least squares with the derivatives of the corners' projections, without distortion."""
        rows = []
        for corner in self._corners():
            x, y, z = turned @ corner + place
            across, down = intrinsics.fx / z, intrinsics.fy / z
            project = np.array([[across, 0.0, -across * x / z], [0.0, down, -down * y / z]])
            a, b, c = corner
            by_turn = -turned @ np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
            rows.append(project @ np.hstack((np.eye(3), by_turn)))
        whole = np.vstack(rows)
        covariance: Floats = self.corner_sigma**2 * np.linalg.inv(whole.T @ whole + 1e-9 * np.eye(6))
        return covariance


def _refined(grey: Image, corners: Any, intrinsics: Intrinsics) -> Floats:  # noqa: ANN401 -- OpenCV's
    """Return the corners where lines through the four edges meet, without the lens's distortion.

    A blurred corner is rounded and lies too far inside: the tag would seem smaller, and farther away, in
    every image by the same share. An edge is where the brightness across it has the mean of both sides."""
    cv2 = opencv()
    camera, distortion = intrinsics.matrix, np.array(intrinsics.distortion)
    image = grey.astype(np.float32)
    here: Floats = corners.astype(np.float64)
    cell = float(np.linalg.norm(np.roll(here, -1, axis=0) - here, axis=1).min()) / CELLS
    reach = min(max(REACH * cell, 1.0), 4.0)
    along = np.linspace(0.1, 0.9, 16)[:, None]
    across = np.linspace(-reach, reach, 17)
    for _ in range(2):
        lines = []
        for a, b in zip(here, np.roll(here, -1, axis=0), strict=True):
            way = (b - a) / np.linalg.norm(b - a)
            outward = np.array([way[1], -way[0]])
            middle = a + along * (b - a)
            places = (middle[:, None] + across[:, None] * outward).astype(np.float32)
            values = cv2.remap(image, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            black, white = values[:, 0].mean(), values[:, -1].mean()
            if white - black < LEAST_CONTRAST:
                return _undistorted(corners, camera, distortion)
            bright = ((values - black) / (white - black)).mean(axis=1)
            edge = middle + (reach * (1.0 - 2.0 * bright))[:, None] * outward
            lines.append(_line(_undistorted(edge, camera, distortion)))
        meet = np.cross(np.roll(lines, 1, axis=0), lines)
        if np.abs(meet[:, 2]).min() < LEAST_SINE:
            return _undistorted(corners, camera, distortion)
        straight = meet[:, :2] / meet[:, 2:]
        here = here + (straight - _undistorted(here, camera, distortion))
    near = np.abs(here - corners).max() < MOST_MOVED
    return straight if near else _undistorted(corners, camera, distortion)


def _undistorted(points: Any, camera: Floats, distortion: Floats) -> Floats:  # noqa: ANN401 -- OpenCV's
    """Return points of an image as a camera without distortion would show them [pixels]."""
    found: Floats = opencv().undistortPoints(points.astype(np.float64)[:, None], camera, distortion, P=camera)
    return found[:, 0]


def _line(points: Floats) -> Floats:
    """Return the line of least squares through points: a, b, c of ax + by + c = 0, a and b a unit vector."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre)[2][1]
    return np.array([*normal, -normal @ centre])


def pattern(number: int) -> list[list[bool]]:
    """Return a tag's cells by rows from the top, its border included: True where it is black."""
    cv2 = opencv()
    drawn = cv2.aruco.generateImageMarker(_dictionary(), number, CELLS, borderBits=1)
    return [[value < 128 for value in row] for row in drawn.tolist()]


def _angle(a: Floats, b: Floats) -> float:
    """Return the angle between two rotations [rad]."""
    return math.acos(min(max((float(np.trace(a.T @ b)) - 1.0) / 2.0, -1.0), 1.0))


@cache
def _dictionary() -> Any:  # noqa: ANN401 -- OpenCV has no types
    cv2 = opencv()
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


@cache
def _detector() -> Any:  # noqa: ANN401
    cv2 = opencv()
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    return cv2.aruco.ArucoDetector(_dictionary(), parameters)
