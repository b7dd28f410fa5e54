"""The transcripts of fixtures/transcripts/dynamixel."""

from __future__ import annotations

import pytest

from protocols.dynamixel import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("dynamixel"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
