"""The independent vectors of CiA 402, as the plugin names them."""

from __future__ import annotations

import json
from pathlib import Path

import fixtures
from protocols.reference_vectors import Vector, _vector

FILE = Path(fixtures.__file__).parent / "vectors" / "cia402.json"
VECTORS: tuple[Vector, ...] = tuple(_vector(entry) for entry in json.loads(FILE.read_text("utf-8")))
