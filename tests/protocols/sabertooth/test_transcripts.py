"""The transcripts of fixtures/transcripts/sabertooth."""

from __future__ import annotations

import pytest

from protocols.sabertooth import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("sabertooth"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
