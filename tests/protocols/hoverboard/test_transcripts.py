"""The transcripts of fixtures/transcripts/hoverboard."""

from __future__ import annotations

import pytest

from protocols.hoverboard import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("hoverboard"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
