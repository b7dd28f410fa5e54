"""Files that a robot file names: its URDF, its map, and those of a protocol's options (`FileText`).

Rules. A recording carries the robot file alone, so they are put into it when it is loaded (table [files], by
name), and read from there and from nowhere else: texts as they are, bytes packed (zlib, base64). A name is
one of a file beside the robot file, or of one that ships with the robots, or with the protocol. A protocol
is given the text behind the name.
"""

from __future__ import annotations

import base64
import binascii
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeAlias

from brain.bodies.urdf import MOST_CHARACTERS
from gateway.config import map_file, resources
from gateway.config.errors import Key, Mistakes
from gateway.config.text import read_text, read_toml
from gateway.errors import ConfigError
from protocols.bounds import hints, keys, names_file
from protocols.plugin import Plugin, UnknownProtocol

Table: TypeAlias = dict[str, Any]
QUOTES = "'''"
Limits: TypeAlias = tuple[int, str]
URDF: Limits = MOST_CHARACTERS, ""
MAP: Limits = map_file.MOST_CHARACTERS, ""
OPTION: Limits = 200_000, "cp1252"
"""Most characters of a text, and what else than UTF-8 it may be: DBC files of many tools are"""
MOST_PACKED, MOST_BYTES = 1_500_000, 1 << 27
"""Characters of packed bytes; bytes of a file"""
SMALLER = "crop an image, or save it coarser; take keyframes out of the map's YAML"
_HEADER = re.compile(r"^[ \t]*\[[ \t]*files[ \t]*\][ \t]*(#.*)?$", re.MULTILINE)
NO_TABLE = "expected a table with the line [files], or none: it is filled when the robot file is loaded"
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


def with_files(text: str, path: Path, mistakes: Mistakes, find: Callable[[str], Plugin]) -> str:
    """Return the text of a robot file with those of the files that it names and has not."""
    try:
        table = read_toml(text, Mistakes("", text))
    except ConfigError:
        return text  # what is wrong is reported when it is parsed
    there = table.get("files", {})
    if not isinstance(there, dict):
        mistakes.add(("files",), NO_TABLE)
        return text
    if "urdf" in table and "files" in table and table["urdf"] not in there:
        return text
    folders = (path.parent, resources.shipped("robots"), *_own_folders(table, find))
    found: dict[str, str] = {}
    for at, name, limits in _named(table, find):
        if name not in there and name not in found:
            found |= _text(at, name, folders, mistakes, limits)
        if at == ("map", "file") and name in found:
            found |= _of_map(at, found[name], path.parent / name, mistakes)
    if not found:
        return text
    parts = [
        f'"{name}" = {QUOTES}\n{content.removesuffix(chr(10))}\n{QUOTES}' for name, content in found.items()
    ]
    if "files" in table:
        text, count = _HEADER.subn(lambda header: "\n".join([header[0], *parts]), text, count=1)
        if not count:
            mistakes.add(("files",), NO_TABLE)
        return text
    return f"{text.rstrip()}\n\n[files]\n{chr(10).join(parts)}\n"


def _named(table: Table, find: Callable[[str], Plugin]) -> Iterator[tuple[Key, str, Limits]]:
    """Yield each key that names a text, the name, and what it may be."""
    if isinstance(name := table.get("urdf"), str):
        yield ("urdf",), name, URDF
    if isinstance(saved := table.get("map"), dict) and isinstance(name := saved.get("file"), str):
        yield ("map", "file"), name, MAP
    for at, options, key in _keys(table, find):
        if isinstance(name := options.get(key), str) and name and "\n" not in name:
            yield (*at, key), name, OPTION


def _keys(table: Table, find: Callable[[str], Plugin]) -> Iterator[tuple[Key, Table, str]]:
    """Yield where options are that have a file, the options, and its key."""
    defaults = table.get("defaults")
    for group in ("motors", "sensors"):
        usual = defaults.get(group) if isinstance(defaults, dict) else None
        usual = usual if isinstance(usual, dict) else {}
        devices = table.get(group)
        for name, one in [*(devices.items() if isinstance(devices, dict) else ())]:
            protocol = one.get("protocol", usual.get("protocol")) if isinstance(one, dict) else None
            if not isinstance(protocol, str):
                continue
            for key in _fields(protocol, find):
                for at, holder in (((group, name), one), (("defaults", group), usual)):
                    if isinstance(options := holder.get("options"), dict) and key in options:
                        yield (*at, "options"), options, key


def _fields(protocol: str, find: Callable[[str], Plugin]) -> list[str]:
    """Return the options of a protocol that name files."""
    try:
        kind = find(protocol).options
    except UnknownProtocol:
        return []  # reported where it is used
    return [key for key, field in keys(kind).items() if names_file(hints(kind)[field.name])]


def _own_folders(table: Table, find: Callable[[str], Plugin]) -> list[Path]:
    """Return the folders of the protocols whose options name files."""
    found: list[Path] = []
    for group in ("motors", "sensors"):
        devices = table.get(group)
        for one in devices.values() if isinstance(devices, dict) else ():
            name = one.get("protocol") if isinstance(one, dict) else None
            if isinstance(name, str) and _fields(name, find):
                found += [Path(str(files(find(name).options.__module__.rpartition(".")[0])))]
    return [*dict.fromkeys(found)]


def _text(at: Key, name: str, folders: Sequence[Path], mistakes: Mistakes, limits: Limits) -> dict[str, str]:
    """Return the text of a file, by its name; nothing, and a mistake, if it cannot be read."""
    try:
        found = next((each / name for each in folders if (each / name).is_file()), folders[0] / name)
        if not found.exists():
            mistakes.add(at, f"there is no {name!r} beside the robot file, and none that ships")
            return {}
        content = read_text(found, limits[0], or_else=limits[1])
    except (OSError, ValueError) as error:  # a name that can be none of a file is one, too
        mistakes.add(
            at, f"{error}; expected the map's YAML file, not its image" if limits is MAP else str(error)
        )
        return {}
    if QUOTES in content or '"' in name or "\\" in name or _CONTROL.search(content):
        mistakes.add(
            at, f"{name!r} has {QUOTES} or control characters in it, or a quote in its name: expected none"
        )
        return {}
    return {name: content}


def _of_map(at: Key, text: str, file: Path, mistakes: Mistakes) -> dict[str, str]:
    """Return the image of a map, and its keyframes if it has some, packed, by name. What cannot be had is
    told with all that is wrong beside it."""
    names = map_file.files_of(text)
    packed: dict[str, str] = {}
    for name in names:
        packed |= _bytes(at, name, file.parent / name, mistakes)
    if len(packed) < len(set(names)):
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
        mistakes.add(at, f"there is no {name!r} beside the map's file")
        return {}
    packed = base64.b64encode(zlib.compress(data, 9)).decode()
    if size > MOST_BYTES or len(packed) > MOST_PACKED:
        text = f"{name} is too large, since a recording carries it: {len(packed)} packed, of {size} bytes"
        mistakes.add(at, f"{text}; expected at most {MOST_PACKED}: {SMALLER}")
        return {}
    return {name: packed}


def unpacked(text: str) -> bytes | None:
    """Return the bytes of a packed file; None if it is none."""
    try:
        unpack = zlib.decompressobj()
        data = unpack.decompress(base64.b64decode(text.strip(), validate=True), MOST_BYTES)
    except (binascii.Error, ValueError, zlib.error):
        return None
    return data if unpack.eof else None


def fill(table: Table, devices: dict[str, Table], find: Callable[[str], Plugin]) -> None:
    """Put the texts of [files] behind the names in the options of devices."""
    files = table.get("files")
    for one in devices.values():
        protocol, options = one.get("protocol"), one.get("options")
        if not isinstance(protocol, str) or not isinstance(options, dict) or not isinstance(files, dict):
            continue
        for key in _fields(protocol, find):
            name = options.get(key)
            if isinstance(name, str) and isinstance(text := files.get(name), str):
                one["options"] = options = {**options, key: f"{name}\n{text}"}
