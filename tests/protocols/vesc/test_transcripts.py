"""The transcripts of fixtures/transcripts/vesc."""

from __future__ import annotations

import pytest

from protocols.vesc import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("vesc"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
