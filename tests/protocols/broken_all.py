"""All plugins that are broken on purpose."""

from __future__ import annotations

from tests.protocols import (  # noqa: F401 -- they register theirs
    broken_asked,
    broken_frames,
    broken_kinds,
    broken_lines,
    broken_safety,
)
from tests.protocols.broken import BROKEN

__all__ = ["BROKEN"]
