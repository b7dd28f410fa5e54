"""Markers that cameras see: known ones correct the pose, all of them are places on the map.

Rules. A marker is seen in the sensor's frame, and the robot drives on a plane: of what is seen the plane's
part is kept. A known marker that shows its orientation is a pose of the robot, one that does not (a ball) a
position; the noise is that of the camera, carried over to the robot (the marker's angle counts at its
distance). A marker that is not known is kept where it was seen last, its direction as the mean of what was
shown, by variance: an error of it counts at the distance of what docks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import moved, wrap
from brain.perception.filter_inputs import PoseFix
from brain.perception.mount import Mount, Vector
from protocols.bounds import Bounds, Invalid, check
from protocols.messages import MILLISECOND, Marker, Nanos, seconds

MOST = 256
"""Markers that are kept; the oldest one is forgotten first."""
FRESH: Nanos = 300 * MILLISECOND
"""A marker is seen now if an image of this age shows it."""
FARTHEST = 50.0
"""m: no camera measures a marker beyond."""
LEAST, MOST_VARIANCE = 1e-8, 1e6
"""m² and rad²: bounds of the variances that are used."""
TURNS = 1e-4
"""rad²/s: by how much more a direction may be wrong later."""
TURNED = 16.0
"""A marker whose direction is so much off (squared, over its variance) was turned meanwhile."""


@dataclass(frozen=True, slots=True)
class KnownMarker:
    """A marker whose place is known."""

    marker: Annotated[int, Bounds(0, 1e6)]
    """Its number"""
    x: Annotated[float, Bounds(-1e4, 1e4, "m")]
    """m, in the frame "map" """
    y: Annotated[float, Bounds(-1e4, 1e4, "m")]
    yaw: Annotated[float, Bounds(-10.0, 10.0, "rad")] = 0.0
    """rad: where its face looks to"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class MarkerSettings:
    """Known markers, and the errors of cameras that do not report any."""

    known: tuple[KnownMarker, ...] = ()
    """Markers whose place on the map is given: number, x, y [m], yaw [rad]"""
    sigma: Annotated[float, Bounds(1e-4, 10.0, "m")] = 0.03
    """m, of a marker's centre in each direction"""
    turn_sigma: Annotated[float, Bounds(1e-4, 4.0, "rad")] = 0.05
    """rad, of its orientation"""

    def __post_init__(self) -> None:
        check(self)
        numbers = [one.marker for one in self.known]
        if len(set(numbers)) < len(numbers):
            raise Invalid(("known", "known: each marker once"))
        if len(numbers) > MOST:
            raise Invalid(("known", f"known: at most {MOST} markers"))


class MarkerPlace(NamedTuple):
    """Where a marker is."""

    t: Nanos
    """When it was seen last"""
    pose: Pose
    """In the frame "map". The yaw is where its face looks to; of what never showed it, to where it was seen
    from first."""
    variance: float | None
    """Of the yaw [rad²]; None: it was never shown"""


@dataclass(slots=True)
class Markers:
    """What was seen. Plain data."""

    settings: MarkerSettings
    places: dict[int, MarkerPlace] = field(default_factory=dict)
    """By number, oldest first."""

    def observe(self, event: Marker, mount: Mount, pose: Pose, yaw_variance: float) -> PoseFix | None:
        """Keep where a marker is, seen from a pose of the robot; return the measurement if it is a known
        one."""
        if event.marker is None or event.position is None:
            return None
        ahead, aside, _ = mount.place(event.position)
        turn = _facing(event, mount)
        seen = moved(pose, Pose(ahead, aside, math.atan2(-aside, -ahead) if turn is None else turn))
        variance = None if turn is None else self._turn_variance(event)
        before = self.places.pop(event.marker, None)
        if len(self.places) >= MOST:
            del self.places[next(iter(self.places))]
        self.places[event.marker] = _fused(before, MarkerPlace(event.t, seen, variance))
        known = next((one for one in self.settings.known if one.marker == event.marker), None)
        return (
            None if known is None else self._fix(event, known, (ahead, aside), turn, (pose.yaw, yaw_variance))
        )

    def shift(self, by: Pose) -> None:
        """Turn and shift the frame "map"."""
        for number, place in self.places.items():
            self.places[number] = place._replace(pose=moved(by, place.pose))

    def seen(self, marker: int, now: Nanos) -> Pose | None:
        """Return where a marker is that is seen now; None if it is not."""
        place = self.places.get(marker)
        return place.pose if place is not None and now - place.t <= FRESH else None

    def _fix(
        self,
        event: Marker,
        known: KnownMarker,
        at: tuple[float, float],
        turn: float | None,
        believed: tuple[float, float],
    ) -> PoseFix:
        """Return the robot's pose from a known marker at a place in its frame; by its orientation, or with
        the yaw that is believed."""
        ahead, aside = at
        yaw = believed[0] if turn is None else wrap(known.yaw - turn)
        c, s = math.cos(yaw), math.sin(yaw)
        value = [known.x - c * ahead + s * aside, known.y - s * ahead - c * aside]
        along, across = event.variance or (self.settings.sigma**2,) * 2
        sight = math.atan2(aside, ahead) + yaw
        axes = np.array([[math.cos(sight), -math.sin(sight)], [math.sin(sight), math.cos(sight)]])
        noise: Floats = axes @ np.diag([_bounded(along), _bounded(across)]) @ axes.T
        lever = np.array([s * ahead + c * aside, s * aside - c * ahead, 1.0])
        if turn is None:
            noise = noise + _bounded(believed[1]) * np.outer(lever[:2], lever[:2])
            return PoseFix(event.sensor, event.t, np.array(value), noise)
        whole = self._turn_variance(event) * np.outer(lever, lever)
        whole[:2, :2] += noise
        return PoseFix(event.sensor, event.t, np.array([*value, yaw]), whole)

    def _turn_variance(self, event: Marker) -> float:
        """Return the variance of an orientation [rad²]."""
        return _bounded(self.settings.turn_sigma**2 if event.turn_variance is None else event.turn_variance)


def is_possible(event: Marker) -> bool:
    """Return whether it is what a camera can see; one image without a marker is, too."""
    if event.marker is None or event.position is None:
        return True
    variances = (*(event.variance or ()), event.turn_variance or 0.0)
    if not (math.hypot(*event.position) <= FARTHEST and all(0.0 <= one < math.inf for one in variances)):
        return False
    turned = event.orientation
    return turned is None or abs(math.hypot(*turned) - 1.0) < 1e-3


def _facing(event: Marker, mount: Mount) -> float | None:
    """Return where a marker's face looks to, in the robot's frame [rad]; None if it is not known, or up or
    down."""
    if event.orientation is None:
        return None
    x, y, z, w = event.orientation
    out: Vector = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w))
    ahead, aside, _ = mount.rotate(out)
    return math.atan2(aside, ahead) if math.hypot(ahead, aside) > 0.5 else None


def _fused(before: MarkerPlace | None, now: MarkerPlace) -> MarkerPlace:
    """Return where a marker is that was seen before, with the mean of both directions."""
    if before is None or before.variance is None:
        return now if before is None or now.variance is not None else _facing_to(now, before.pose.yaw, None)
    variance = before.variance + TURNS * max(seconds(now.t - before.t), 0.0)
    if now.variance is None:
        return _facing_to(now, before.pose.yaw, variance)
    off = wrap(now.pose.yaw - before.pose.yaw)
    if off * off > TURNED * (variance + now.variance):
        return now
    share = variance / (variance + now.variance)
    return _facing_to(now, wrap(before.pose.yaw + share * off), (1.0 - share) * variance)


def _facing_to(place: MarkerPlace, yaw: float, variance: float | None) -> MarkerPlace:
    """Return a place with another direction."""
    return MarkerPlace(place.t, Pose(place.pose.x, place.pose.y, yaw), variance)


def _bounded(variance: float) -> float:
    return min(max(variance, LEAST), MOST_VARIANCE)
