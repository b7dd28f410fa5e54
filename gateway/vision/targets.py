"""Coloured balls of known size: the simplest detector."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from gateway.vision.camera import Image, Intrinsics, Sighting, opencv
from protocols.bounds import Bounds, check

ROUND = 0.75
"""Least share of its surrounding circle that a ball covers: less is partly hidden, or no ball."""
SMALLEST = 3.0
"""Pixels: radius below which nothing is measured."""


@dataclass(frozen=True, slots=True)
class Target:
    """A ball of one colour, alone of its colour in sight: of several the largest is taken."""

    marker: Annotated[int, Bounds(0, 1_000_000)]
    """The number under which it is reported"""
    diameter: Annotated[float, Bounds(0.005, 5.0, "m")]
    hue: Annotated[float, Bounds(0.0, 360.0, "degrees")]
    """0 is red, 120 green, 240 blue"""
    hue_width: Annotated[float, Bounds(1.0, 90.0, "degrees")] = 15.0
    """To either side"""
    saturation: Annotated[float, Bounds(0.0, 1.0)] = 0.5
    """At least"""
    brightness: Annotated[float, Bounds(0.0, 1.0)] = 0.15
    """At least"""
    edge_sigma: Annotated[float, Bounds(0.01, 10.0)] = 0.5
    """Pixels: standard deviation of its radius and of its middle"""

    def __post_init__(self) -> None:
        check(self)

    def detect(self, image: Image, intrinsics: Intrinsics) -> list[Sighting]:
        """Return the ball, if it is whole in the image."""
        cv2 = opencv()
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV_FULL)
        turned = (hsv[..., 0].astype(np.int16) * (360.0 / 256.0) - self.hue + 180.0) % 360.0 - 180.0
        mask = np.abs(turned) <= self.hue_width
        mask &= (hsv[..., 1] >= 255.0 * self.saturation) & (hsv[..., 2] >= 255.0 * self.brightness)
        count, _, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        if count < 2:
            return []
        largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        left, top, width, height, area = stats[largest].tolist()
        radius, rows, columns = math.sqrt(area / math.pi), *image.shape[:2]
        whole = left > 0 and top > 0 and left + width < columns and top + height < rows
        circle = math.pi * (max(width, height) / 2.0) ** 2
        if not whole or radius < SMALLEST or area < ROUND * circle:
            return []
        column, row = centres[largest].tolist()
        return [self._sighting(column, row, radius, intrinsics)]

    def _sighting(self, column: float, row: float, radius: float, intrinsics: Intrinsics) -> Sighting:
        """Return the ball of this radius in the image: its outline is that of a cone about the line of
        sight."""
        cv2 = opencv()
        pixel = np.array([[[column, row]]])
        flat = cv2.undistortPoints(pixel, intrinsics.matrix, np.array(intrinsics.distortion))[0, 0]
        sight = np.array([flat[0], flat[1], 1.0])
        slant = float(np.linalg.norm(sight))
        # Off the optical axis its outline is an ellipse, whose area grows with the slant cubed.
        scale = math.sqrt(intrinsics.fx * intrinsics.fy)
        half = math.atan(radius / scale / slant**1.5)
        distance = self.diameter / 2.0 / math.sin(half)
        along, across = distance * self.edge_sigma / radius, distance * self.edge_sigma / scale / slant
        return Sighting(self.marker, sight / slant * distance, None, (along**2, across**2))
