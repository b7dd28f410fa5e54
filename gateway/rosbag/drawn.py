"""A map and a path as files that other programs read.

map.pgm, map.yaml   as of ROS's map_server: occupied 0, free 254, unknown 205; the origin is the lower left
map.png             the same, with the path on it
map.keyframes       what it was drawn from (`gateway.config.keyframes_file`)
path.tum            t x y z qx qy qz qw; t [s] as stamped, the frame "map"
path.csv            the same as t, x, y, yaw
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from brain.belief import MapView, Pose
from protocols.messages import SECOND, Nanos

OCCUPIED, FREE, UNKNOWN = 0, 254, 205
SURE = 0.62
"""Log-odds from which on a cell counts: probabilities of 0.65 and 0.35"""
MARGIN = 10
"""Cells about what is known and about the path"""
MOST_CELLS = 100_000_000
PATH = (31, 79, 168)
"""Colour of the path"""

Pixels = npt.NDArray[np.uint8]


class Drawn:
    """A map as pixels, its first row at the top, and a path over it."""

    def __init__(self, view: MapView, path: Sequence[tuple[Nanos, Pose]]) -> None:
        """Raises ValueError if it has more than `MOST_CELLS`."""
        known = [tile for tile, values in view.tiles.items() if np.any(values)] or list(view.tiles)[:1]
        side = next(iter(view.tiles.values())).shape[0]
        self.resolution = view.resolution
        across = np.array([(pose.x, pose.y) for _, pose in path]).reshape(-1, 2)
        cells = np.floor((across - view.corner) / view.resolution).astype(np.int64)
        rows, columns = np.array(known).T * side
        lows = [min([*rows, *cells[:, 1]]) - MARGIN, min([*columns, *cells[:, 0]]) - MARGIN]
        highs = [
            max([*(rows + side), *cells[:, 1]]) + MARGIN,
            max([*(columns + side), *cells[:, 0]]) + MARGIN,
        ]
        height, width = (int(high - low) for low, high in zip(lows, highs, strict=True))
        if height * width > MOST_CELLS:
            raise ValueError(f"the map has {height} x {width} cells: expected at most {MOST_CELLS}")
        log_odds = np.zeros((height, width))
        for row, column in known:
            at = row * side - lows[0], column * side - lows[1]
            values = view.tiles[row, column] * view.unit
            log_odds[at[0] : at[0] + side, at[1] : at[1] + side] = values
        classes = np.full(log_odds.shape, UNKNOWN, dtype=np.uint8)
        classes[log_odds > SURE], classes[log_odds < -SURE] = OCCUPIED, FREE
        self.pixels: Pixels = classes[::-1]
        self.origin = tuple(
            float(edge + low * view.resolution)
            for edge, low in zip(view.corner, (lows[1], lows[0]), strict=True)
        )
        self._cells = np.column_stack([height - 1 - (cells[:, 1] - lows[0]), cells[:, 0] - lows[1]])

    def pgm(self) -> bytes:
        """Return it in the portable graymap format (netpbm)."""
        height, width = self.pixels.shape
        return b"P5\n%d %d\n255\n" % (width, height) + self.pixels.tobytes()

    def yaml(self, keyframes: str = "") -> str:
        """Return what map_server has to know of it, and the file of its keyframes, if there is one."""
        x, y = self.origin
        return (
            f"image: map.pgm\nresolution: {self.resolution:g}\norigin: [{x:.6g}, {y:.6g}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"  # with more, unknown is free
        ) + (f"keyframes: {keyframes}\n" if keyframes else "")

    def png(self) -> bytes:
        """Return it with the path, in the portable network graphics format (ISO/IEC 15948)."""
        image = np.repeat(self.pixels[:, :, None], 3, axis=2)
        for (row, column), (to_row, to_column) in zip(self._cells[:-1], self._cells[1:], strict=True):
            steps = int(max(abs(to_row - row), abs(to_column - column), 1))
            if steps * self.resolution > LEAP:
                continue
            share = np.linspace(0.0, 1.0, steps + 1)
            rows = np.rint(row + share * (to_row - row)).astype(np.int64)
            image[rows, np.rint(column + share * (to_column - column)).astype(np.int64)] = PATH
        height, width, _ = image.shape
        lines = b"".join(b"\0" + line.tobytes() for line in image)
        header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
        chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(lines, 6)), (b"IEND", b""))
        return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


LEAP = 2.0
"""m between two poses, of a path that was corrected: no line is drawn"""


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def tum(path: Sequence[tuple[Nanos, Pose]]) -> str:
    """Return a path in the TUM format."""
    return "".join(
        f"{_time(t)} {p.x:.6f} {p.y:.6f} 0 0 0 {math.sin(p.yaw / 2.0):.9f} {math.cos(p.yaw / 2.0):.9f}\n"
        for t, p in path
    )


def csv(path: Sequence[tuple[Nanos, Pose]]) -> str:
    """Return a path as a table."""
    return "".join(_lines(path))


def _lines(path: Sequence[tuple[Nanos, Pose]]) -> Iterator[str]:
    yield "t,x,y,yaw\n"
    for t, pose in path:
        yield f"{_time(t)},{pose.x:.6f},{pose.y:.6f},{pose.yaw:.6f}\n"


def _time(t: Nanos) -> str:
    return f"{t // SECOND}.{t % SECOND:09d}"
