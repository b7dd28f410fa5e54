"""The transcripts of fixtures/transcripts/ddsm."""

from __future__ import annotations

import pytest

from protocols.ddsm import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("ddsm"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
