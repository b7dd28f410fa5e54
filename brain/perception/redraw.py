"""The map drawn again from keyframes, after loops have moved them.

Rules. Keyframes about the robot are drawn first, into a map of its own; it takes the place of the old one
at the moment in which the poses move, so that map and pose agree at all times. What is farther follows, the
nearest first. One keyframe is drawn at a time. What has moved so little that the map does not show it is not
drawn again.
"""

from __future__ import annotations

import math

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.graph import after, between
from brain.perception.keyframes import Keyframes
from brain.perception.map import Map

VISIBLE, LEVER = 0.1, 5.0
"""m: what moves walls at this distance [m] by more is seen in the map"""
NEAR = 15
"""Keyframes that are drawn before the map is replaced"""
SPARSE, SPARSE_YAW = 0.7, 0.5
"""m, rad: among them, none nearer to one that is drawn"""


class Redraw:
    """What is left to be drawn again. Plain data."""

    def __init__(self) -> None:
        self._drawn: Floats = np.zeros((0, 3))
        """Poses from which keyframes are in the map"""
        self._poses: Floats | None = None
        """Poses that wait for the map"""
        self._chart: Map | None = None
        """The map that is to replace the old one"""
        self._near: list[int] = []
        """Keyframes left to be drawn into it"""
        self._far: list[int] = []
        """Left to be drawn afterwards, the nearest last"""

    @property
    def busy(self) -> bool:
        """Whether there is something left to draw."""
        return self._poses is not None or bool(self._far)

    @property
    def waiting(self) -> bool:
        """Whether poses wait for the map."""
        return self._poses is not None

    def forget(self) -> None:
        """Drop what is under way: the map begins anew."""
        self._drawn, self._poses, self._chart = np.zeros((0, 3)), None, None
        self._near, self._far = [], []

    def begin(self, keyframes: Keyframes, poses: Floats, chart: Map) -> bool:
        """Take the poses that keyframes are to have; return whether they may have them at once, since the map
        does not show the difference."""
        new = len(poses)
        drawn = np.concatenate([self._drawn, keyframes.poses[len(self._drawn) : new]])
        off = np.abs(between(drawn, poses))
        if float((np.hypot(off[:, 0], off[:, 1]) + LEVER * off[:, 2]).max(initial=0.0)) < VISIBLE:
            self._drawn = drawn
            return True
        self._drawn = poses.copy()
        self._poses, self._chart = poses, chart.anew()
        here = poses[-1]
        kept = np.array([number for number in keyframes.kept if number < new], dtype=np.int64)
        nearest = kept[np.argsort(np.hypot(*(poses[kept, :2] - here[:2]).T), kind="stable")].tolist()
        near: list[int] = []
        for number in nearest:
            if len(near) < NEAR and _apart(poses, number, near):
                near.append(number)
        self._near = sorted(near, reverse=True)
        self._far = [number for number in reversed(nearest) if number not in set(near)]
        return False

    def advance(self, keyframes: Keyframes, chart: Map) -> Floats | None:
        """Draw one keyframe; return the poses of all keyframes when the map has been replaced."""
        if self._poses is not None and self._chart is not None:
            if self._near:
                number = self._near.pop()
                self._draw(self._chart, keyframes, number, self._poses[number])
                return None
            known = len(self._poses)
            rest = between(keyframes.poses[known - 1], keyframes.poses[known:])
            poses = np.concatenate([self._poses, after(self._poses[-1], rest)])
            self._far += [number for number in range(known, keyframes.count) if number in keyframes.kept]
            self._drawn = poses.copy()
            chart.become(self._chart)
            self._poses = self._chart = None
            return poses
        if self._far:
            number = self._far.pop()
            self._draw(chart, keyframes, number, keyframes.poses[number])
        return None

    def _draw(self, chart: Map, keyframes: Keyframes, number: int, pose: Floats) -> None:
        one = keyframes.kept.get(number)
        if one is not None:
            x, y, yaw = pose.tolist()
            chart.add(Pose(x, y, wrap(yaw)), one.scan.unpacked(), one.covariance)


def _apart(poses: Floats, number: int, others: list[int]) -> bool:
    """Return whether a keyframe is apart from all these."""
    if not others:
        return True
    off = np.abs(between(poses[others], poses[number]))
    beside = (np.hypot(off[:, 0], off[:, 1]) < SPARSE) & (off[:, 2] < SPARSE_YAW)
    return not bool(beside.any())


def correction(before: Floats, now: Floats) -> Pose:
    """Return how the frame "map" turns and shifts where a pose moves from one to another."""
    yaw = wrap(float(now[2] - before[2]))
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = before[:2].tolist()
    return Pose(float(now[0]) - c * x + s * y, float(now[1]) - s * x - c * y, yaw)
