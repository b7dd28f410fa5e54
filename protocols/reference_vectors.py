"""Reference vectors: bytes of messages from independent software, firmware or manuals.

Rules. A file is a JSON list; an entry has `name`, `direction` (`to_device`, `from_device`), `bus` (`can`,
`canfd`, `serial`, `i2c`), `data` (hex), `meaning` (an object) and `source` (package and version, repository
and commit, or manual and paragraph); of a frame also `id`, `extended`, and where they are so `rtr`, `brs`; of
an answer on a serial line that does not say what it answers also `asked` (hex); of several messages at once
`messages`, how many. Other keys are the
protocol's own. An entry with KNOWN_SDK_BUG in its name, or BUG in its meaning's `note`, records a mistake
of the source: a driver must not send it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

from protocols.frames import OF_BYTES, CanFrame, Frame
from protocols.plugin import Plugin


@dataclass(frozen=True, slots=True)
class Vector:
    """One message, as an independent source encodes it."""

    name: str
    direction: Literal["to_device", "from_device"]
    frame: Frame
    meaning: Mapping[str, Any]
    source: str
    wrong: bool
    """It records a mistake of the source."""
    entry: Mapping[str, Any]
    """The entry of the file, unchanged."""

    @property
    def asked(self) -> bytes:
        """What it answers, if its own bytes do not say that; else b""."""
        return bytes.fromhex(self.entry.get("asked", ""))

    @property
    def count(self) -> int:
        """How many messages of a stream it holds."""
        return int(self.entry.get("messages", 1))


def vectors_of(plugin: Plugin) -> tuple[Vector, ...]:
    """Read a plugin's vectors.

    Raises OSError, ValueError or KeyError if the file is missing or ill-formed."""
    if plugin.vectors is None:
        return ()
    package, path = plugin.vectors
    return tuple(_vector(entry) for entry in json.loads((files(package) / path).read_text("utf-8-sig")))


def _vector(entry: Mapping[str, Any]) -> Vector:
    meaning, name = entry["meaning"], entry["name"]
    wrong = "KNOWN_SDK_BUG" in name or "BUG" in str(meaning.get("note", ""))
    return Vector(name, entry["direction"], _frame(entry), meaning, entry["source"], wrong, entry)


def _frame(entry: Mapping[str, Any]) -> Frame:
    data = bytes.fromhex(entry["data"])
    if entry["bus"] in OF_BYTES:
        return data
    fd = entry["bus"] == "canfd"
    remote, brs = bool(entry.get("rtr", False)), bool(entry.get("brs", False))
    return CanFrame(entry["id"], data, bool(entry["extended"]), remote, fd, brs)
