"""The transcripts of fixtures/transcripts/odrive_can; their frames are made by the vendor's DBCs (`dbc`)."""

from __future__ import annotations

import pytest

from protocols.odrive_can import plugin
from tests.protocols.odrive_can.dbc import notation
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("odrive_can"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin, notation)
