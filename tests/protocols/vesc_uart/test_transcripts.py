"""The transcripts of fixtures/transcripts/vesc_uart."""

from __future__ import annotations

import pytest

from protocols.vesc_uart import plugin
from tests.protocols.transcripts import Block, blocks, run


@pytest.mark.parametrize("block", blocks("vesc_uart"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
