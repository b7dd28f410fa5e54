"""The transcripts of fixtures/transcripts/odrive_ascii."""

from __future__ import annotations

import pytest

from protocols.odrive_ascii import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("odrive_ascii"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
