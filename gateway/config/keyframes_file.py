"""The keyframes of a map as a file beside its image, and back, or what is wrong with it.

Rules. An archive of arrays (numpy's .npz; each with a checksum). It belongs to one image: who edits that
draws other walls than the keyframes saw, and takes the key `keyframes` out of the map's YAML. Everything is
looked at before it is believed: a length is never trusted, nothing but numbers is read, and what is not
finite, or out of order, is refused.
"""

from __future__ import annotations

import hashlib
import math
import zipfile
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats
from brain.perception.body_scan import PackedScan
from brain.perception.graph import Edge
from brain.perception.loops import GROUP
from brain.perception.saved_keyframes import SavedKeyframe, SavedKeyframes

FORMAT = 1
MOST_BYTES, MOST_KEYFRAMES, MOST_BEAMS, MOST_AWAY, MOST_TURN = 1 << 28, 1 << 20, 10_000, 1e6, 8.0 * math.pi
"""Bytes of all arrays; keyframes that there have been; beams of one; m from the origin, and travelled; rad"""
ROUNDED = 1e-6
"""Of a matrix, by which it may be uneven"""
SHAPES: dict[str, tuple[str, int]] = {
    "format": ("<i8", 0), "image": ("|u1", 1), "poses": ("<f8", 2),
    "numbers": ("<i8", 1), "ways": ("<f8", 1), "covariances": ("<f8", 3),
    "origins": ("<f8", 2), "beams": ("<i8", 1), "bearings": ("<f4", 1), "ranges": ("<u2", 1),
    "hits": ("|u1", 1),
    "groups": ("<i8", 1), "ends": ("<i8", 2), "seen": ("<f8", 2), "information": ("<f8", 3),
}  # fmt: skip
"""Type and number of dimensions of each array; of beams and their hits, one keyframe after another; of edges
(ends, seen, information) first those from group to group, then the loops"""
WANTED = "expected the file that `gateway map` has written beside the map"


def keyframes_file(saved: SavedKeyframes, image: bytes) -> bytes:
    """Return keyframes as the bytes of a file, to an image."""
    kept, edges = list(saved.kept.values()), (*saved.joins, *saved.ties)
    scans = [one.scan for one in kept]
    arrays: dict[str, Any] = {
        "format": FORMAT,
        "image": np.frombuffer(hashlib.sha256(image).digest(), np.uint8),
        "poses": saved.poses,
        "numbers": list(saved.kept),
        "ways": [one.way for one in kept],
        "covariances": np.array([one.covariance for one in kept]).reshape(-1, 3, 3),
        "origins": np.array([scan.origin for scan in scans]).reshape(-1, 2),
        "beams": [len(scan.ranges) for scan in scans],
        "bearings": np.concatenate([np.zeros(0), *(scan.bearings for scan in scans)]),
        "ranges": np.concatenate([np.zeros(0), *(scan.ranges for scan in scans)]),
        "hits": np.concatenate([np.zeros(0), *(scan.hit for scan in scans)]),
        "groups": saved.groups,
        "ends": np.array([(one.first, one.second) for one in edges]).reshape(-1, 2),
        "seen": np.array([one.pose for one in edges]).reshape(-1, 3),
        "information": np.array([one.information for one in edges]).reshape(-1, 3, 3),
    }
    made = BytesIO()
    typed = {name: np.asarray(arrays[name], dtype=kind) for name, (kind, _) in SHAPES.items()}
    np.savez_compressed(made, allow_pickle=False, **typed)
    return made.getvalue()


def keyframes_of(data: bytes | None, image: bytes | None) -> SavedKeyframes:
    """Return the keyframes of a file's bytes, which belong to an image. Raises ValueError with what is
    wrong."""
    if data is None:
        raise ValueError("it is not among the files")
    arrays = _arrays(data)
    if int(arrays["format"]) != FORMAT:
        raise ValueError(f"it is of format {int(arrays['format'])}: this program reads {FORMAT}")
    if image is None or arrays["image"].tobytes() != hashlib.sha256(image).digest():
        raise ValueError(
            "it was written with another image: who has edited that takes `keyframes` out of the map's YAML"
        )
    poses, numbers, beams = arrays["poses"], arrays["numbers"], arrays["beams"]
    count, hits = len(numbers), (beams + 7) // 8
    _expect(
        poses.shape[1:] == (3,)
        and len(poses) <= MOST_KEYFRAMES
        and len(poses) % GROUP == 0
        and all(len(arrays[name]) == count for name in ("ways", "covariances", "origins", "beams"))
        and count > 0
        and bool((np.diff(numbers, prepend=-1, append=len(poses)) > 0).all())
        and bool(((beams > 0) & (beams <= MOST_BEAMS)).all())
        and len(arrays["bearings"]) == len(arrays["ranges"]) == beams.sum()
        and len(arrays["hits"]) == hits.sum()
        and arrays["origins"].shape == (count, 2)
        and bool((np.diff(arrays["ways"], prepend=0.0, append=MOST_AWAY) >= 0.0).all())
        and bool((np.abs(poses[:, :2]) <= MOST_AWAY).all())
        and bool((np.abs(arrays["bearings"]) <= MOST_TURN).all())
        and _is_spread(arrays["covariances"]),
        "its keyframes",
    )
    groups, ends, seen, information = (arrays[name] for name in ("groups", "ends", "seen", "information"))
    known = groups.tolist()
    joins = len(known) - 1
    _expect(
        known[:1] == [0]
        and known == np.unique(numbers // GROUP).tolist()
        and ends.shape == (len(seen), 2)
        and seen.shape == (len(information), 3)
        and ends[:joins].tolist() == np.column_stack([groups[:-1], groups[1:]]).tolist()
        and set(ends.ravel().tolist()) <= set(known)
        and bool((ends[:, 0] != ends[:, 1]).all())
        and _is_spread(information, least=0.0),
        "its pose graph",
    )
    edges = [
        Edge(first, second, pose, known_by)
        for (first, second), pose, known_by in zip(ends.tolist(), seen, information, strict=True)
    ]
    starts, bits = np.cumsum(beams) - beams, np.cumsum(hits) - hits
    kept = {
        number: SavedKeyframe(
            way,
            covariance,
            PackedScan(
                (x, y),
                arrays["bearings"][at : at + size],
                arrays["ranges"][at : at + size],
                arrays["hits"][bit : bit + size_of],
            ),
        )
        for number, way, covariance, (x, y), at, size, bit, size_of in zip(
            numbers.tolist(),
            arrays["ways"].tolist(),
            arrays["covariances"],
            arrays["origins"].tolist(),
            starts.tolist(),
            beams.tolist(),
            bits.tolist(),
            hits.tolist(),
            strict=True,
        )
    }
    return SavedKeyframes(poses, kept, tuple(known), tuple(edges[:joins]), tuple(edges[joins:]))


class _Stored(NamedTuple):
    """An array of an archive as its header has it, and its bytes."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]
    content: bytes


def _arrays(data: bytes) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an archive, each of its type. Raises ValueError."""
    found = {}
    for name, one in _stored(data).items():
        (kind, dimensions), shape = SHAPES[name], one.shape
        if one.dtype != np.dtype(kind) or len(shape) != dimensions:
            text = f"its array {name!r} is {len(shape)} x {one.dtype}"
            raise ValueError(f"{text}, expected {dimensions} x {np.dtype(kind)}: {WANTED}")
        if len(one.content) != math.prod(shape) * one.dtype.itemsize:
            text = f"its array {name!r} of {shape} has {len(one.content)} bytes"
            raise ValueError(f"{text}: it is cut off, or damaged: {WANTED}")
        array = np.frombuffer(one.content, one.dtype).reshape(shape, order="F" if one.fortran else "C")
        if array.dtype.kind == "f" and array.size and not np.abs(array).max() < math.inf:
            raise ValueError(f"its array {name!r} has numbers that are not finite: {WANTED}")
        found[name] = array
    return found


def _stored(data: bytes) -> dict[str, _Stored]:
    """Return what an archive stores, of which nothing is believed yet. Raises ValueError."""
    found, sizes = {}, dict[str, int]()
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            sizes = {one.filename: one.file_size for one in archive.infolist()}
            names = [name for name in SHAPES if f"{name}.npy" in sizes]
            for name in names if sum(sizes.values()) <= MOST_BYTES else ():
                with archive.open(f"{name}.npy") as file:
                    np.lib.format.read_magic(file)
                    header = np.lib.format.read_array_header_1_0(file, max_header_size=1000)
                    found[name] = _Stored(*header, file.read())
    except Exception as error:  # what zipfile and numpy raise at foreign bytes is declared nowhere
        raise ValueError(f"it is cut off, damaged or another file ({error}): {WANTED}") from error
    if sum(sizes.values()) > MOST_BYTES:
        raise ValueError(f"its arrays have more than {MOST_BYTES} bytes: {WANTED}")
    if missing := [name for name in SHAPES if name not in found]:
        raise ValueError(f"it has no array {missing[0]!r}: {WANTED}")
    return found


def _expect(sound: bool, what: str) -> None:
    if not sound:
        raise ValueError(f"{what} cannot be so: it is damaged, or made otherwise: {WANTED}")


def _is_spread(matrices: Floats, least: float = -ROUNDED) -> bool:
    """Whether these are covariances, or their inverses: symmetric, and in every direction more than `least`
    of their largest number."""
    if matrices.shape[1:] != (3, 3):
        return False
    turned, size = matrices.transpose(0, 2, 1), np.abs(matrices).max(axis=(1, 2), initial=0.0)
    even = np.abs(matrices - turned).max(axis=(1, 2), initial=0.0) <= ROUNDED * size
    across = np.linalg.eigvalsh(0.5 * (matrices + turned))[:, 0]
    return bool(even.all() and (across > least * size).all())
