"""The transcripts of fixtures/transcripts/damiao."""

from __future__ import annotations

import pytest

from protocols.damiao import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("damiao"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
