"""The transcripts of fixtures/transcripts/zlac8015d, with a drive of package canopen as the driver's peer."""

from __future__ import annotations

import pytest

from protocols.zlac8015d import plugin
from tests.protocols.transcripts import Block, blocks, run
from tests.protocols.zlac8015d.drive import Drive


@pytest.mark.parametrize("block", blocks("zlac8015d"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin, peer=Drive)
