"""Keyframes and their pose graph from before: what a map goes on from, and is drawn again from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from brain.belief import Floats
from brain.perception.body_scan import PackedScan
from brain.perception.graph import Edge


class SavedKeyframe(NamedTuple):
    """What is saved of one."""

    way: float
    """m that the robot had travelled"""
    covariance: Floats
    """3 × 3, of the pose when it was kept"""
    scan: PackedScan


class SavedKeyframes(NamedTuple):
    """All keyframes of a map, and what is known between them."""

    poses: Floats
    """n × 3, of every keyframe that there has been, by number; whole groups"""
    kept: Mapping[int, SavedKeyframe]
    """Those that were not forgotten, in order"""
    groups: tuple[int, ...]
    """Of the graph; so are the next"""
    joins: tuple[Edge, ...]
    ties: tuple[Edge, ...]
