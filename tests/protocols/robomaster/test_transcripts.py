"""The transcripts of fixtures/transcripts/robomaster."""

from __future__ import annotations

import pytest

from protocols.robomaster import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("robomaster"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
