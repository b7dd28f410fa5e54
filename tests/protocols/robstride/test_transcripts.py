"""The transcripts of fixtures/transcripts/robstride."""

from __future__ import annotations

import pytest

from protocols.robstride import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("robstride"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
