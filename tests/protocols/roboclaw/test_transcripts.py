"""The transcripts of fixtures/transcripts/roboclaw."""

from __future__ import annotations

import pytest

from protocols.roboclaw import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("roboclaw"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
