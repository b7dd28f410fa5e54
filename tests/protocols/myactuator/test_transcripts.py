"""The transcripts of fixtures/transcripts/myactuator."""

from __future__ import annotations

import pytest

from protocols.myactuator import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("myactuator"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
