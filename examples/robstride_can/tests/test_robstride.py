"""The table against bytes of the vendor's package, both ways; the transcripts."""

from pathlib import Path

import pytest
from protocols.reference_vectors import Vector, vectors_of
from protocols.transcripts import Block, blocks, run

from robstride_can import plugin
from robstride_can.table import TABLE


@pytest.mark.parametrize("vector", vectors_of(plugin), ids=lambda vector: str(vector.name))
def test_vector(vector: Vector) -> None:
    decoded = TABLE.decode(vector.frame, vector.direction)
    assert decoded is not None
    assert (decoded.name, decoded.address) == (vector.name.partition("_")[0], 5)
    for name, value in vector.meaning.items():  # the package's steps are 1/65,534 of the range, ours 1/65,535
        step = TABLE.row(decoded.name).field(name).step
        assert decoded.values[name] == pytest.approx(value, abs=2 * step)
    assert TABLE.encode(decoded.name, 5, **decoded.values) == vector.frame


@pytest.mark.parametrize("block", blocks(Path(__file__).parent), ids=str)
def test_transcript(block: Block) -> None:
    run(block, plugin)
