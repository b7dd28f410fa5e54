"""A map of ROS's map_server (YAML and PGM): what it says of each cell, or everything that is wrong with it.

Rules. As nav2_map_server reads it (map_io.cpp): a pixel's shade is from 0, black, to 1; its occupancy is
that, or if `negate` is not set the rest to 1. The first row is the uppermost; the origin is the lower left
corner.

| mode | a cell is |
|---|---|
| trinary (the default) | occupied above `occupied_thresh`, free below `free_thresh`, else not known |
| scale | the same, and between both so many percent; not known is nothing, since PGM has no transparency |
| raw | the pixel of 255, if it is at most 100, in percent; else not known |

The image is PGM or PPM (netpbm; plain or not, 8 or 16 bits). The key `keyframes`, which map_server passes
over, names the file of `gateway.config.keyframes_file`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from brain.perception.map import MapSettings
from brain.perception.saved_map import MOST_CELLS, Drawing, Percents, SavedMap, Start
from gateway.config.errors import Mistakes
from gateway.config.keyframes_file import keyframes_of
from gateway.config.text import read_text
from gateway.errors import ConfigError
from protocols.bounds import Invalid
from protocols.suggest import did_you_mean

MOST_CHARACTERS = 16 * 1024
"""Of the YAML"""
FORMATS = {b"\x89PNG": "PNG", b"\xff\xd8\xff": "JPEG", b"BM": "BMP", b"GIF8": "GIF", b"RIFF": "WebP"}
"""Of other images, by their first bytes"""
MODES = ("trinary", "scale", "raw")
KEYFRAMES = "keyframes"
"""The key that only this program knows: the name of the file with what the image was drawn from"""
GREY = 205
"""The shade of 255 that map_server's savers write for what is not known"""
NUMBERS = {"resolution": (1e-3, 10.0), "occupied_thresh": (0.0, 1.0), "free_thresh": (0.0, 1.0)}
"""Least and most of each"""


@dataclass(frozen=True, slots=True)
class MapKeys:
    """The table [map]: a map from before, in which the robot begins."""

    file: str
    """Of map_server: a YAML file, from this one, beside which is its image (PGM)"""
    start: Start | None = None
    """Where the robot is in it; left out: it looks for its place by its first scans"""


def files_of(text: str) -> list[str]:
    """Return the names of the files in a map's YAML, its image first; those that it has."""
    found = _yaml(text)
    names = [found.get(key) for key in ("image", KEYFRAMES)] if isinstance(found, dict) else []
    return [name for name in names if isinstance(name, str) and name]


def saved_map(
    text: str, files: Mapping[str, bytes | None], settings: MapSettings, start: Start | None
) -> SavedMap:
    """Return the map of a YAML text. Raises Invalid with everything that is wrong.

    Args:
        text: YAML.
        files: its image, and its keyframes if it has some, by name; None: it cannot be unpacked.
        settings: of the robot's map.
        start: where the robot is in it.
    """
    drawing, remark = drawing_of(text, files)
    image, *names = files_of(text)
    keyframes = None
    for name in names:
        try:
            keyframes = keyframes_of(files.get(name), files.get(image))
        except ValueError as error:
            raise Invalid(("", f"{name}: {error}")) from error
    made = SavedMap(drawing, settings.resolution, settings.low, settings.high, start, remark, keyframes)
    if (count := sum(1 for _ in made.tiles())) > settings.tiles:
        text = f"it has {count} tiles of 64 x 64 known cells; brain.perception.map.tiles is {settings.tiles}"
        raise Invalid(("", f"{text}: expected at least as many"))
    return made


def load_map(file: Path, settings: MapSettings, start: Start | None) -> SavedMap:
    """Read a map for who has no robot file with a table [map]. Raises ConfigError with everything that is
    wrong."""
    mistakes = Mistakes(str(file), "")
    try:
        text = read_text(file, MOST_CHARACTERS)
        there = {name: file.parent / name for name in files_of(text)}
        parts = {name: one.read_bytes() for name, one in there.items() if one.is_file()}
        return saved_map(text, parts, settings, start)
    except ConfigError:
        raise
    except Invalid as error:
        mistakes.invalid((), error)
    except (OSError, ValueError) as error:
        mistakes.add((), f"cannot be read: {getattr(error, 'strerror', None) or error}")
    raise mistakes.error()


def drawing_of(text: str, images: Mapping[str, bytes | None]) -> tuple[Drawing, str]:
    """Return what a YAML text and its image show, and what a person should look at, or "". Raises Invalid
    with everything that is wrong."""
    found = _yaml(text)
    wrong = objections(text)
    if isinstance(found, str):
        raise Invalid(("", found))
    image = found.get("image")
    pixels: npt.NDArray[np.float64] | None = None
    if isinstance(image, str) and image:
        try:
            pixels = read_pixels(images.get(image))
        except ValueError as error:
            wrong.append(f"{image}: {error}")
    if wrong or pixels is None:
        raise Invalid(*(("", each) for each in wrong))
    x, y, yaw = map(float, found["origin"])
    drawing = Drawing(_percents(found, pixels), float(found["resolution"]), (x, y, yaw))
    return drawing, _remark(found, pixels)


def _yaml(text: str) -> dict[str, Any] | str:
    """Return the mapping that a text is, or what is wrong with it."""
    from ruamel.yaml import YAML  # here, because it takes a tenth of a second to import
    from ruamel.yaml.error import YAMLError

    try:
        found = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark is not None else ""
        return f"it is not YAML{where}: {getattr(error, 'problem', None) or error}"
    if not isinstance(found, dict):
        return "expected the keys image, resolution, origin, negate, occupied_thresh and free_thresh"
    return {str(key): value for key, value in found.items()}


def objections(text: str) -> list[str]:
    """Return what is wrong with a map's YAML."""
    found = _yaml(text)
    if isinstance(found, str):
        return [found]
    known = ("image", "origin", "negate", "mode", KEYFRAMES, *NUMBERS)
    wrong = [
        f"{key}: not known{near}"
        for key in found
        if key not in known and (near := did_you_mean(key, [one for one in known if one not in found]))
    ]
    wrong += [f"{key}: missing; expected {EXPECTED[key]}" for key in EXPECTED if key not in found]
    for key, (least, most) in NUMBERS.items():
        if key in found and not (_is_number(found[key]) and least <= found[key] <= most):
            wrong.append(f"{key}: found {found[key]!r}, expected {EXPECTED[key]}")
    if "image" in found and not (isinstance(found["image"], str) and found["image"]):
        wrong.append(f"image: found {found['image']!r}, expected {EXPECTED['image']}")
    if KEYFRAMES in found and not (isinstance(found[KEYFRAMES], str) and found[KEYFRAMES]):
        wrong.append(f"keyframes: found {found[KEYFRAMES]!r}, expected the name of a file beside this one")
    origin = found.get("origin", [0, 0, 0])
    if not (isinstance(origin, list) and len(origin) == 3 and all(map(_is_number, origin))):
        wrong.append(f"origin: found {origin!r}, expected {EXPECTED['origin']}")
    elif max(abs(origin[0]), abs(origin[1])) > 10_000.0 or abs(origin[2]) > 2.0 * math.pi:
        wrong.append(f"origin: found {origin!r}, expected it within 10 km, and the yaw within a turn")
    if found.get("negate", 0) not in (0, 1):
        wrong.append(f"negate: found {found['negate']!r}, expected {EXPECTED['negate']}")
    if (mode := found.get("mode", MODES[0])) not in MODES and str(mode).lower() not in MODES:
        wrong.append(f"mode: found {mode!r}, expected one of {', '.join(MODES)}{did_you_mean(mode, MODES)}")
    free: Any = found.get("free_thresh")
    occupied: Any = found.get("occupied_thresh")
    if _is_number(free) and _is_number(occupied) and free >= occupied:
        wrong.append(f"free_thresh: found {free}, expected less than occupied_thresh, {occupied}")
    return wrong


EXPECTED = {
    "image": "the name of a PGM file beside this one",
    "resolution": "m per pixel, 0.001 to 10",
    "origin": "[x, y, yaw] of the lower left corner: m, m, rad",
    "negate": "0, or 1 if white is occupied",
    "occupied_thresh": "0 to 1: occupied above it, such as 0.65",
    "free_thresh": "0 to 1: free below it, such as 0.196",
}


def _is_number(value: Any) -> bool:  # noqa: ANN401 -- whatever stands in a file
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _percents(found: Mapping[str, Any], shades: npt.NDArray[np.float64]) -> Percents:
    """Return what the pixels (shades from 0 to 1, the first row at the top) say."""
    mode = str(found.get("mode", MODES[0])).lower()
    occupancy = shades if found["negate"] else 1.0 - shades
    free, occupied = float(found["free_thresh"]), float(found["occupied_thresh"])
    if mode == "raw":
        raw = np.floor(shades * 255.0 + 0.5)
        percents = np.where(raw <= 100.0, raw, -1.0)
    else:
        between = (occupancy - free) / (occupied - free) * 100.0
        percents = np.rint(between) if mode == "scale" else np.full(shades.shape, -1.0)
        percents = np.where(occupancy > occupied, 100.0, np.where(occupancy < free, 0.0, percents))
    return percents[::-1].astype(np.int8)


def _remark(found: Mapping[str, Any], shades: npt.NDArray[np.float64]) -> str:
    """Return what to look at, or ""."""
    trinary = str(found.get("mode", MODES[0])).lower() == "trinary" and not found["negate"]
    share = float(np.mean(np.rint(shades * 255.0) == GREY)) if trinary else 0.0
    if not share or found["free_thresh"] <= 1.0 - GREY / 255.0:
        return ""
    return (
        f"{100.0 * share:.0f} % of it are the grey {GREY} that map savers write for what is not known; with "
        f"free_thresh: {found['free_thresh']} it is free, as map_server takes it; with 0.196 it is unknown"
    )


# -- the image -------------------------------------------------------------------------------------

_HEADER = re.compile(rb"P([2356])" + rb"(?:\s|#[^\n]*\n)+(\d{1,9})" * 3 + rb"(?:\s|#[^\n]*\n)")
"""Kind; width, height, largest value; each after blanks and comments"""


def read_pixels(data: bytes | None) -> npt.NDArray[np.float64]:
    """Return the shades of a PGM or PPM image, from 0, black, to 1. Raises ValueError with what is wrong."""
    if data is None:
        raise ValueError("it is not among the files")
    for begins, name in FORMATS.items():
        if data.startswith(begins):
            raise ValueError(
                f"it is a {name}, expected a PGM: convert it (magick FILE map.pgm), and name that"
            )
    header = _HEADER.match(data)
    if header is None:
        raise ValueError("it is no PGM: expected P5 or P2, width, height and largest value")
    kind, width, height, most = map(int, header.groups())
    channels = 3 if kind in (3, 6) else 1
    count = width * height * channels
    if not 1 <= most <= 65535 or not 1 <= width * height <= MOST_CELLS:
        text = f"{width} x {height} pixels of at most {most}"
        raise ValueError(f"it has {text}; expected 1 to {MOST_CELLS} pixels, of at most 1 to 65535")
    rest = data[header.end() :]
    if kind in (2, 3):
        values = np.array(rest.split()[:count] or [b"0"])
        if not np.char.isdigit(values).all() or max(map(len, values.tolist())) > 5:
            raise ValueError("it has pixels that are no numbers")
        values = values.astype(np.int64)
    else:
        size = 2 if most > 255 else 1
        values = np.frombuffer(rest[: len(rest) // size * size], dtype=f">u{size}")[:count]
    if len(values) < count:
        raise ValueError(f"it ends after {len(values)} of {count} values")
    if values.max() > most:
        raise ValueError(f"it has a pixel of {values.max()}, and {most} as the largest value")
    pixels: npt.NDArray[np.float64] = (values / most).reshape(height, width, channels).mean(axis=2)
    return pixels
