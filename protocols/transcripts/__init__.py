"""Transcripts: what hosts and devices exchange, as text that needs no Python to read, run as tests.

docs/transcripts.md describes the format. A plugin's own test file has

    @pytest.mark.parametrize("block", blocks(Path(__file__).parent), ids=str)
    def test_transcript(block: Block) -> None:
        run(block, plugin, notation)

where `notation`, if there is one, returns the frame that a text means which is neither a name nor bytes; it
must not use the code under test. Needs no pytest. Imports the plugin interface and its bench, no protocol.
"""

from __future__ import annotations

from protocols.transcripts.file import Block, blocks, read
from protocols.transcripts.runner import run

__all__ = ["Block", "blocks", "read", "run"]
