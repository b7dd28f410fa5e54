"""What a robot file names beside itself (its URDF, its map), appended to its text as the table [files].

Rules. A recording carries the robot file alone, so what it names is read once, when it is loaded, and from
[files] ever after. Texts stand there as they are, bytes packed (zlib, base64).
"""

from __future__ import annotations

import base64
import binascii
import json
import zlib
from pathlib import Path

from brain.bodies.urdf import MOST_CHARACTERS
from gateway.config import map_file, resources
from gateway.config.errors import Key, Mistakes
from gateway.config.text import read_text, read_toml
from gateway.errors import ConfigError

QUOTES = "'''"
MOST_PACKED, MOST_BYTES = 1_500_000, 1 << 27
"""Characters of packed bytes; bytes of a file"""


def with_files(text: str, path: Path, mistakes: Mistakes) -> str:
    """Return the text of a robot file with those of the files that it names, if it names any and has none."""
    try:
        table = read_toml(text, Mistakes("", text))
    except ConfigError:
        return text  # what is wrong is reported when it is parsed
    if "files" in table:
        return text
    found: dict[str, str] = {}
    if isinstance(name := table.get("urdf"), str):
        found |= _text(("urdf",), name, path.parent / name, mistakes, MOST_CHARACTERS)
    saved = table.get("map")
    if isinstance(saved, dict) and isinstance(name := saved.get("file"), str):
        at, file = ("map", "file"), path.parent / name
        found |= _text(at, name, file, mistakes, map_file.MOST_CHARACTERS)
        if name in found:
            found |= _image(at, found[name], file, mistakes)
    if not found:
        return text
    parts = [f"{json.dumps(name)} = {QUOTES}\n{content}{QUOTES}\n" for name, content in found.items()]
    return f"{text.rstrip()}\n\n[files]\n{''.join(parts)}"


def _text(at: Key, name: str, file: Path, mistakes: Mistakes, most: int) -> dict[str, str]:
    """Return the text of a file, by its name; nothing, and a mistake, if it cannot be read."""
    try:
        found = file if file.is_file() else resources.shipped("robots") / name
        if not found.exists():
            mistakes.add(at, f"there is no {name!r} beside the robot file, and none that ships")
            return {}
        content = read_text(found, most)
    except (OSError, ValueError) as error:  # a name that can be none of a file is one, too
        mistakes.add(at, str(error))
        return {}
    if QUOTES in content or '"' in name:
        mistakes.add(at, f"{name!r} has {QUOTES} in it, or a quote in its name: expected none")
        return {}
    return {name: content}


def _image(at: Key, text: str, file: Path, mistakes: Mistakes) -> dict[str, str]:
    """Return the image of a map, packed, by its name. One that cannot be had is told with all that is wrong
    beside it."""
    image = map_file.image_of(text)
    packed = _bytes(at, image, file.parent / image, mistakes) if image else {}
    if image and not packed:
        for sentence in map_file.objections(text):
            mistakes.add(at, f"{file.name}: {sentence}")
    return packed


def _bytes(at: Key, name: str, file: Path, mistakes: Mistakes) -> dict[str, str]:
    """Return the bytes of a file, packed, by its name; nothing, and a mistake, if it cannot be read."""
    try:
        size = file.stat().st_size if file.is_file() else None
        data = file.read_bytes() if size is not None and size <= MOST_BYTES else b""
    except (OSError, ValueError) as error:
        mistakes.add(at, f"{name}: cannot be read: {getattr(error, 'strerror', None) or error}")
        return {}
    if size is None:
        mistakes.add(at, f"there is no image {name!r} beside the map's file")
        return {}
    packed = base64.b64encode(zlib.compress(data, 9)).decode()
    if size > MOST_BYTES or len(packed) > MOST_PACKED:
        text = f"{name} is too large, since a recording carries it: {len(packed)} packed, of {size} bytes"
        mistakes.add(at, f"{text}; expected at most {MOST_PACKED}: crop it, or save it coarser")
        return {}
    return {name: f"{packed}\n"}


def unpacked(text: str) -> bytes | None:
    """Return the bytes of a packed file; None if it is none."""
    try:
        unpack = zlib.decompressobj()
        data = unpack.decompress(base64.b64decode(text.strip(), validate=True), MOST_BYTES)
    except (binascii.Error, ValueError, zlib.error):
        return None
    return data if unpack.eof else None
