"""Text files that a robot file names: its URDF, and those of a protocol's options (`FileText`).

Rules. A recording carries the robot file alone, so their texts are put into it when it is loaded (table
[files], by name), and read from there and from nowhere else. A name is one of a file beside the robot file,
or of one that ships with the robots, or with the protocol. A protocol is given the text behind the name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeAlias

from gateway.config import resources
from gateway.config.errors import Key, Mistakes
from gateway.config.text import read_text, read_toml
from gateway.errors import ConfigError
from protocols.bounds import hints, keys, names_file
from protocols.plugin import Plugin, UnknownProtocol

Table: TypeAlias = dict[str, Any]
QUOTES = "'''"
MOST = 200_000
"""Characters of one file"""
LEGACY = "cp1252"
"""What else than UTF-8 a file may be: DBC files of many tools are"""
_HEADER = re.compile(r"^\[files\][ \t]*$", re.MULTILINE)
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


def with_files(text: str, path: Path, mistakes: Mistakes, find: Callable[[str], Plugin]) -> str:
    """Return the text of a robot file with those of the files that it names and has not."""
    try:
        table = read_toml(text, Mistakes("", text))
    except ConfigError:
        return text  # what is wrong is reported when it is parsed
    there = table.get("files", {})
    named = dict.fromkeys(name for _, name in _named(table, find))
    if not isinstance(there, dict) or ("urdf" in table and "files" in table and table["urdf"] not in there):
        return text
    wanted = [name for name in named if name not in there]
    where = {name: at for at, name in reversed(list(_named(table, find)))}
    folders = (path.parent, resources.shipped("robots"), *_own_folders(table, find))
    parts = [part for name in wanted if (part := _part(name, folders, where[name], mistakes))]
    if not parts:
        return text
    if "files" in table:
        return _HEADER.sub(lambda found: "\n".join([found[0], *parts]), text, count=1)
    return f"{text.rstrip()}\n\n[files]\n{chr(10).join(parts)}\n"


def _named(table: Table, find: Callable[[str], Plugin]) -> Iterator[tuple[Key, str]]:
    """Yield each key that names a file, and the name."""
    if isinstance(name := table.get("urdf"), str):
        yield ("urdf",), name
    for at, options, key in _keys(table, find):
        if isinstance(name := options.get(key), str) and name and "\n" not in name:
            yield (*at, key), name


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


def _part(name: str, folders: Sequence[Path], at: Key, mistakes: Mistakes) -> str:
    """Return the line of [files] for one file; "" if a mistake was added."""
    try:
        found = next((each / name for each in folders if (each / name).is_file()), folders[0] / name)
        if not found.exists():
            mistakes.add(at, f"there is no {name!r} beside the robot file, and none that ships")
            return ""
        content = read_text(found, MOST, or_else=LEGACY)
    except (OSError, ValueError) as error:  # a name that can be none of a file is one, too
        mistakes.add(at, str(error))
        return ""
    if QUOTES in content or '"' in name or "\\" in name or _CONTROL.search(content):
        mistakes.add(
            at, f"{name!r} has {QUOTES} or control characters in it, or a quote in its name: expected none"
        )
        return ""
    return f'"{name}" = {QUOTES}\n{content.removesuffix(chr(10))}\n{QUOTES}'


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
