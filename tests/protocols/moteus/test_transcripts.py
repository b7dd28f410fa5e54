"""The transcripts of fixtures/transcripts/moteus."""

from __future__ import annotations

import pytest

from protocols.frames import CanFrame
from protocols.moteus import plugin
from protocols.transcripts.notation import digits, tokens
from tests.protocols.transcripts import Block, blocks, run

LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


def notation(text: str) -> CanFrame:
    """A frame padded with NOP, as the vendor pads: `frame 8005 01000a 0d20 0.5f`."""
    word, identifier, *rest = tokens(text)
    assert word == "frame", text
    data = bytes.fromhex("".join(map(digits, rest)))
    padded = data.ljust(min(length for length in LENGTHS if length >= len(data)), b"\x50")
    return CanFrame(int(identifier, 16), padded, int(identifier, 16) > 0x7FF, fd=True, brs=True)


@pytest.mark.parametrize("block", blocks("moteus"), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin, notation)
