"""The matrices of numbers in a MATLAB file of version 5 (MAT-File Format, MathWorks, 2019, chapter 1).

Rules. An element is a tag of type and size, then its bytes, padded to 8; a short one has both in 8 bytes.
What is no plain matrix of real numbers is passed over. Unpacked, a file may be `MOST_EXPANSION` times its
size.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from brain.belief import Floats
from gateway.errors import BagError

START = b"MATLAB 5.0 MAT-file"
HEADER = 128
"""Bytes before the first element; the last two tell the order of bytes."""
MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Types of an element's numbers (table 1-1)"""
FIRST_NUMERIC, LAST_NUMERIC = 6, 15
"""Classes of matrices that are full and numeric (table 1-3)"""
COMPLEX = 0x0800
MOST_EXPANSION = 200
LARGEST = 200_000_000
"""Bytes of a file, which is read as a whole"""


def matrices(path: Path) -> dict[str, Floats]:
    """Return the matrices of a file by name. Raises BagError if it is damaged."""
    try:
        if path.stat().st_size > LARGEST:
            raise BagError(f"{path}: larger than {LARGEST} bytes")
        data = path.read_bytes()
        order = "<" if data[HEADER - 2 : HEADER] == b"IM" else ">"
        return dict(_matrices(data[HEADER:], order, MOST_EXPANSION * len(data)))
    except OSError as error:
        raise BagError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, struct.error, zlib.error, KeyError, IndexError, OverflowError) as error:
        raise BagError(f"{path}: damaged: {error}") from error


def _matrices(data: bytes, order: str, most: int) -> Iterator[tuple[str, Floats]]:
    for kind, content in _elements(data, order):
        if kind == COMPRESSED:
            unpacked = zlib.decompressobj().decompress(content, most)
            yield from _matrices(unpacked, order, 0)
        elif kind == MATRIX and (made := _matrix(content, order)) is not None:
            yield made


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 8 <= len(data):
        first, size = struct.unpack_from(f"{order}II", data, at)
        if first >> 16:  # a short element: its size, its type, and at most four bytes
            yield first & 0xFFFF, data[at + 4 : at + 4 + min(first >> 16, 4)]
            at += 8
            continue
        content = data[at + 8 : at + 8 + size]
        if len(content) < size:
            raise ValueError("it is cut off")
        yield first, content
        at += 8 + (size if first == COMPRESSED else size + -size % 8)


def _matrix(content: bytes, order: str) -> tuple[str, Floats] | None:
    parts = list(_elements(content, order))
    if len(parts) < 4:
        return None
    (_, flags), (_, sizes), (_, name), (kind, numbers) = parts[:4]
    bits = struct.unpack_from(f"{order}I", flags)[0]
    shape = np.frombuffer(sizes, dtype=f"{order}i4").tolist()
    if not FIRST_NUMERIC <= bits & 0xFF <= LAST_NUMERIC or bits & COMPLEX or len(shape) != 2:
        return None
    values = np.frombuffer(numbers, dtype=order + NUMBERS[kind]).astype(np.float64)
    if len(values) != shape[0] * shape[1]:
        raise ValueError(f"{len(values)} numbers in a matrix of {shape[0]} x {shape[1]}")
    return name.decode("ascii", "replace"), values.reshape(shape, order="F")
