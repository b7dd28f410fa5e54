"""The transcripts of fixtures/transcripts/cubemars."""

from __future__ import annotations

import pytest

from protocols.cubemars import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("cubemars"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
