"""The detectors of one camera, by a table of a file: each is optional, and a further one is one more key."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from gateway.vision.camera import Detector, Image, Intrinsics, Sighting
from gateway.vision.tags import Tags
from gateway.vision.targets import Target
from protocols.bounds import Bounds, Invalid

MOST = 16
"""Targets of one camera"""


@dataclass(frozen=True, slots=True)
class Detectors:
    """What a camera looks for. It is a detector itself."""

    tags: Tags | None = None
    targets: tuple[Target, ...] = ()

    def __post_init__(self) -> None:
        if not self.parts:
            raise Invalid(("", "tags or targets must say what to look for"))
        numbers = [target.marker for target in self.targets]
        if len(set(numbers)) < len(numbers) or len(numbers) > MOST:
            raise Invalid(("targets", f"targets must be at most {MOST}, each with a number of its own"))

    @property
    def parts(self) -> tuple[Detector, ...]:
        """One after the other."""
        return (*([self.tags] if self.tags else []), *self.targets)

    def detect(self, image: Image, intrinsics: Intrinsics) -> list[Sighting]:
        """Return what all of them find."""
        return [sighting for part in self.parts for sighting in part.detect(image, intrinsics)]


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """A camera, in the world or live, and what is looked for in its pictures."""

    detectors: Detectors
    width: Annotated[int, Bounds(16, 4096)] = 640
    """Pixels"""
    height: Annotated[int, Bounds(16, 4096)] = 480
    """Pixels"""
    view: Annotated[float, Bounds(10.0, 150.0, "degrees")] = 70.0
    """From its left edge to its right one"""

    @property
    def intrinsics(self) -> Intrinsics:
        """How it projects, without distortion."""
        focal = self.width / 2.0 / math.tan(math.radians(self.view) / 2.0)
        return Intrinsics(focal, focal, self.width / 2.0 - 0.5, self.height / 2.0 - 0.5)
