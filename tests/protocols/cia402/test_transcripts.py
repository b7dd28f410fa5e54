"""The transcripts of fixtures/transcripts/cia402, with drives of package canopen as the driver's peers."""

from __future__ import annotations

import pytest

from protocols.cia402 import plugin
from tests.protocols.cia402.drive import Drive
from tests.protocols.cia402.notation import notation
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("cia402"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin, notation, Drive)
