"""All plugins that are broken on purpose."""

from __future__ import annotations

from tests.protocols import broken_asked, broken_frames, broken_kinds, broken_safety  # noqa: F401 -- they register theirs
from tests.protocols.broken import BROKEN

__all__ = ["BROKEN"]
