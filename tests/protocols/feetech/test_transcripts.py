"""The transcripts of fixtures/transcripts/feetech."""

from __future__ import annotations

import pytest

from protocols.feetech import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("feetech"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
