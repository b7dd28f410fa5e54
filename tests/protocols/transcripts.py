"""The transcripts of this project's protocols: fixtures/transcripts/<protocol>."""

from __future__ import annotations

from protocols import transcripts
from protocols.transcripts import Block, read, run
from tests.distributions import ROOT

__all__ = ["Block", "blocks", "read", "run"]


def blocks(protocol: str) -> list[Block]:
    """Return the blocks of a protocol's transcripts, file by file."""
    return transcripts.blocks(ROOT / "fixtures" / "transcripts" / protocol)
