"""The transcripts of fixtures/transcripts/plain; their frames are made by `published`."""

from __future__ import annotations

import pytest

from protocols.plain import plugin
from tests.protocols.plain.published import notation
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("plain"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin, notation)
