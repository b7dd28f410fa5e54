"""A robot as a picture in three dimensions: its parts, how they stand, and the meshes of its URDF.

Rules. What a URDF describes is drawn by it; every limb that it does not by the limb's own dimensions. Where a
motor's position is not known, its part is drawn at rest. Of meshes STL is read (both forms), at most `MOST`
bytes and triangles; one that is not there, or no STL, is left out, and named. Nothing else of a file goes on.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from brain.bodies import urdf
from brain.bodies.limbs import limbs
from brain.bodies.parts import UPRIGHT, Part, carried, of_urdf
from brain.bodies.urdf import Geometry, Origin
from gateway.core.robot import Robot

MOST_BYTES = 20_000_000
"""Of all meshes of a robot together."""
MOST_TRIANGLES = 2000
"""Of one mesh, as it is drawn: of a finer one corners that are near each other become one."""
PIECE = 400
"""Triangles in one message: 7 kB."""
FINEST, COARSEST = 64, 4
"""Cells along the longest side of a mesh, within each of which its corners become one."""
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""A triangle of a binary STL."""

Triangles = npt.NDArray[np.float32]
"""n × 3 corners × (x, y, z), in the file's own unit."""


@dataclass(slots=True)
class Figure:
    """What a robot looks like. Made once for a robot."""

    parts: tuple[Part, ...]
    meshes: tuple[Triangles, ...] = ()
    """In the order in which the parts' shapes have them; a mesh of several shapes is there once."""
    numbers: Mapping[str, int] = field(default_factory=dict)
    """By a mesh's name in the URDF: its index."""
    missing: tuple[str, ...] = ()
    """Meshes that are not drawn, each with the reason."""

    @property
    def described(self) -> list[dict[str, Any]]:
        """As a page gets it: see `gateway/view/cockpit.py`."""
        return [
            {
                "carrier": part.carrier,
                "at": _numbers(*part.origin.xyz, *part.origin.rpy),
                "motor": part.motor,
                "axis": _numbers(*part.axis),
                "slides": part.slides,
                "rest": part.rest,
                "shapes": [self._shape(shape) for shape in part.shapes],
            }
            for part in self.parts
        ]

    def _shape(self, shape: Geometry) -> dict[str, Any]:
        at = _numbers(*shape.origin.xyz, *shape.origin.rpy)
        made = {"kind": shape.kind, "size": _numbers(*shape.size), "at": at, "colour": shape.colour}
        return made | ({"mesh": self.numbers.get(shape.file)} if shape.kind == "mesh" else {})

    def stands(self, robot: Robot, positions: Mapping[str, float | None]) -> list[float | None]:
        """Return the position of each part that a motor moves, in their order: rad or m; None: at rest.

        `positions`: of each motor, as it is measured."""
        at = dict(positions)
        for limb in limbs(robot.brain.body).values():
            arm = limb.body.as_linkage
            known = [] if arm is None else [at.get(motor) for motor in arm.joints]
            if arm is not None and None not in known:
                at |= zip(arm.joints, arm.angles([one for one in known if one is not None]), strict=True)
        moved = (at.get(part.motor) for part in self.parts if part.motor)
        return [round(one, 4) if one is not None and isfinite(one) else None for one in moved]


def figure(robot: Robot) -> Figure:
    """Return what a robot looks like."""
    parts = _parts(robot)
    found, names, missing = list[Triangles](), dict[str, int](), list[str]()
    read = 0
    for name in dict.fromkeys(one.file for part in parts for one in part.shapes if one.kind == "mesh"):
        try:
            file = _file(name, robot.folder, MOST_BYTES - read)
            read += file.stat().st_size
            mesh = coarser(read_stl(file.read_bytes()))
        except (OSError, ValueError) as error:
            missing.append(f"{name}: {error}")
            continue
        names[name] = len(found)
        found.append(mesh)
    return Figure(tuple(parts), tuple(found), names, tuple(missing))


def _parts(robot: Robot) -> list[Part]:
    """Return the parts of the whole robot."""
    described, parts = robot.described, list[Part]()
    every = limbs(robot.brain.body)
    base = next((limb.body for limb in every.values() if limb.body.as_base is not None), None)
    once = len(set(described.values())) == len(described)  # not one arm's description for two of them
    whole = bool(described) and once and (base is None or any(one in described for one in base.joints))
    if whole:
        motors = {joint: motor for motor, joint in described.items()}
        parts += of_urdf(urdf.parse(robot.description), motors, UPRIGHT)
    for limb in every.values():
        if not (whole and all(one in described for one in limb.body.joints)):
            own, at = limb.body.parts(), Origin((limb.at.x, limb.at.y, limb.at.z), (0.0, 0.0, limb.at.yaw))
            parts += carried(own, at, len(parts)) if own else []
    return parts


def _file(name: str, place: str, most: int) -> Path:
    """Return the file that a URDF names: by its path, or of a ROS package by what of it lies beside the URDF.

    Raises ValueError if there is none, or a larger one than `most` bytes."""
    if not place:
        raise ValueError("where the URDF is, is not known")
    if not name.lower().endswith(".stl"):
        raise ValueError("only STL is drawn")
    folder = Path(place)
    package = re.fullmatch(r"(?:package|model)://([^/]+)/(.+)", name)
    if package is None:
        tried = [folder / name.removeprefix("file://")]
    else:
        above = [folder, *list(folder.resolve().parents)[:4]]
        tried = [one / inner for one in above for inner in (package[2], f"{package[1]}/{package[2]}")]
    for one in tried:
        if one.is_file():
            if one.stat().st_size > most:
                raise ValueError(f"with it there are more than {MOST_BYTES // 1_000_000} MB of meshes")
            return one
    raise ValueError("there is no such file")


def read_stl(data: bytes) -> Triangles:
    """Return the triangles of an STL file, binary or text. Raises ValueError if it is none."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + count * RECORD.itemsize:
        found = np.frombuffer(data, RECORD, count, 84)["corners"]
    elif data.lstrip().startswith(b"solid"):
        words = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
        if len(words) % 3:
            raise ValueError("it is no STL: a facet has not three corners")
        found = np.array(words, dtype=np.float32).reshape(-1, 3, 3)
    else:
        raise ValueError("it is no STL: its length does not fit the number of its triangles")
    if not found.size or not np.isfinite(found).all():
        raise ValueError("it has no triangles, or some that are nowhere")
    return np.ascontiguousarray(found, dtype=np.float32)


def coarser(mesh: Triangles) -> Triangles:
    """Return a mesh of at most `MOST_TRIANGLES`: corners that are near each other become one, by a grid."""
    if len(mesh) <= MOST_TRIANGLES:
        return mesh
    low = mesh.min(axis=(0, 1))
    side = float((mesh.max(axis=(0, 1)) - low).max())
    cells, found = FINEST, mesh
    while cells >= COARSEST and len(found) > MOST_TRIANGLES:
        step = side / cells or 1.0
        at = np.round((mesh - low) / step).astype(np.int64)
        key = (at[..., 0] * (cells + 1) + at[..., 1]) * (cells + 1) + at[..., 2]
        differ = (key[:, 0] != key[:, 1]) & (key[:, 1] != key[:, 2]) & (key[:, 2] != key[:, 0])
        _, first = np.unique(np.sort(key[differ], axis=1), axis=0, return_index=True)
        found = (low + at[differ][np.sort(first)] * step).astype(np.float32)
        cells = cells * 3 // 4
    return found[:MOST_TRIANGLES]


def _numbers(*values: float) -> list[float]:
    return [round(value, 5) for value in values]
