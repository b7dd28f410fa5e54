"""Frames of a recording, from its transforms: where a sensor is on the robot, and where the robot was.

Rules. A frame has one parent; the newest transform of a pair counts. Names with and without a slash before
them are one (tf of ROS 1). A place is asked for by way of the frame that both have above them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np

from brain.belief import Floats, Pose
from brain.perception.mount import Mount

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
DEEPEST = 64
"""Frames above one another; more are a circle."""
STILL = 1e-3
"""m, rad: transforms that differ by less are the same."""
MOST_TEXT = 4_000_000
"""Characters of a description of a robot."""


class Transform(NamedTuple):
    """From a child's coordinates to its parent's."""

    turn: Floats
    """3 × 3"""
    shift: Floats
    """m"""

    def then(self, outer: Transform) -> Transform:
        """Return this one, followed by another."""
        return Transform(outer.turn @ self.turn, outer.turn @ self.shift + outer.shift)

    def inverse(self) -> Transform:
        """Return the way back."""
        return Transform(self.turn.T, -self.turn.T @ self.shift)


IDENTITY = Transform(np.eye(3), np.zeros(3))


class Frames:
    """The tree of frames, as far as it is known."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Transform]] = {}
        self.moving: set[str] = set()
        """Frames that have moved in their parent's."""

    def add(self, message: Any) -> None:  # noqa: ANN401 -- of types that only a recording knows
        """Add the transforms of a tf message."""
        for one in message.transforms:
            shift, turn = one.transform.translation, one.transform.rotation
            made = transform((shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w))
            child, parent = name_of(one.child_frame_id), name_of(one.header.frame_id)
            if made is not None and child and parent and child != parent:
                self._set(child, parent, made)

    def describe(self, text: str) -> None:
        """Add the fixed joints of a robot's description (URDF), of frames that are not known otherwise."""
        if len(text) > MOST_TEXT or "<!ENTITY" in text:
            return
        try:
            root = ET.fromstring(text)  # noqa: S314 -- of bounded length, and without entities
        except ET.ParseError:
            return
        for joint in root.iter("joint"):
            parent, child, origin = joint.find("parent"), joint.find("child"), joint.find("origin")
            if joint.get("type") != "fixed" or parent is None or child is None:
                continue
            place = _numbers(None if origin is None else origin.get("xyz"))
            angles = _numbers(None if origin is None else origin.get("rpy"))
            inner, outer = name_of(child.get("link", "")), name_of(parent.get("link", ""))
            if place is not None and angles is not None and inner not in self._parents:
                roll, pitch, yaw = angles
                turn = np.array(
                    Mount(yaw=_wrapped(yaw), pitch=_wrapped(pitch), roll=_wrapped(roll)).rotation()
                )
                self._parents[inner] = outer, Transform(turn, np.array(place))

    def _set(self, child: str, parent: str, made: Transform) -> None:
        before = self._parents.get(child)
        if before is not None and before[0] == parent:
            turned = np.abs(before[1].turn - made.turn).max()
            apart = max(float(turned), float(np.abs(before[1].shift - made.shift).max()))
            if apart > STILL:
                self.moving.add(child)
            elif child not in self.moving:
                return
        self._parents[child] = parent, made

    def __contains__(self, frame: str) -> bool:
        return frame in self._parents or any(parent == frame for parent, _ in self._parents.values())

    def __len__(self) -> int:
        return len(self._parents)

    def _above(self, frame: str) -> list[tuple[str, Transform]]:
        """Return the frame and all above it, each with the transform into it."""
        way = [(frame, IDENTITY)]
        while (known := self._parents.get(way[-1][0])) is not None and len(way) < DEEPEST:
            way.append((known[0], way[-1][1].then(known[1])))
        return way

    def between(self, base: str, frame: str) -> Transform | None:
        """Return a frame's coordinates → those of `base`; None if they are not connected."""
        up, down = self._above(name_of(frame)), dict(self._above(name_of(base)))
        common = next(((name, one) for name, one in up if name in down), None)
        return None if common is None else common[1].then(down[common[0]].inverse())

    def way(self, fixed: str, moving: str) -> set[str]:
        """Return the frames whose transforms lead from one frame to another."""
        up, down = [{name for name, _ in self._above(name_of(one))} for one in (fixed, moving)]
        return up ^ down

    def moves(self, base: str, frame: str) -> bool:
        """Whether anything between two frames has moved."""
        up, down = [[name for name, _ in self._above(name_of(one))] for one in (frame, base)]
        shared = set(up) & set(down)
        return any(name in self.moving for name in (*up, *down) if name not in shared)

    def names(self) -> list[str]:
        """Return all frames."""
        return sorted({*self._parents, *(parent for parent, _ in self._parents.values())})


def name_of(frame: str) -> str:
    """Return a frame's name without the slash before it."""
    return frame.lstrip("/")


def transform(shift: tuple[float, float, float], turn: tuple[float, float, float, float]) -> Transform | None:
    """Return the transform of a translation and a quaternion x, y, z, w; None if they are no numbers."""
    x, y, z, w = turn
    size = math.sqrt(x * x + y * y + z * z + w * w)
    if not all(map(math.isfinite, (*shift, size))) or not size > 1e-6:
        return None
    x, y, z, w = x / size, y / size, z / size, w / size
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return Transform(np.array(rows), np.array(shift))


def mount_of(one: Transform) -> Mount | None:
    """Return a transform as a mounting; None if it is too far off to be one."""
    turn = one.turn
    pitch = math.asin(min(max(-float(turn[2, 0]), -1.0), 1.0))
    if abs(turn[2, 0]) < 1.0 - 1e-9:
        yaw, roll = math.atan2(turn[1, 0], turn[0, 0]), math.atan2(turn[2, 1], turn[2, 2])
    else:
        yaw, roll = math.atan2(-turn[0, 1], turn[1, 1]), 0.0
    x, y, z = map(float, one.shift)
    if max(abs(x), abs(y), abs(z)) > 10.0:
        return None
    return Mount(x, y, z, yaw, pitch, roll)


def pose_of(one: Transform) -> Pose:
    """Return a transform as a pose in the plane."""
    return Pose(float(one.shift[0]), float(one.shift[1]), math.atan2(one.turn[1, 0], one.turn[0, 0]))


def _numbers(text: str | None) -> tuple[float, float, float] | None:
    """Return three numbers of a text; zeros without one, None if it holds others."""
    parts: Iterable[str] = re.split(r"\s+", text.strip()) if text is not None else ("0", "0", "0")
    try:
        x, y, z = map(float, parts)
    except ValueError:
        return None
    return (x, y, z) if all(map(math.isfinite, (x, y, z))) else None


def _wrapped(angle: float) -> float:
    return math.remainder(angle, math.tau)
