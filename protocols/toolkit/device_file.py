"""The tables of a device as data: `device.toml` beside its protocol's code.

Rules. Registers are rows as `protocols.toolkit.memory_map.rows` has them, messages as `table.rows_of`, faults
as `faults.faults`; what else stands in a file is for the protocol to say, in a comment above it.
"""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import Any


def device_file(package: str) -> dict[str, Any]:
    """Return the tables in the `device.toml` of a package."""
    return tomllib.loads((files(package) / "device.toml").read_text("utf-8"))
