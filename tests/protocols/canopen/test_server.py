"""The twin's SDO server responds to every request as that of package canopen 2.4.1 does."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from canopen.objectdictionary import ODVariable

from protocols.cia402.settings import Settings
from protocols.frames import CanFrame
from protocols.plugin import Device, load
from tests.protocols.cia402.bus import TwinOnShaft
from tests.protocols.cia402.stack import Slave, dictionary

NODE = 2
LIVE = {0x1001, 0x1003, 0x1017, 0x6041, 0x6061, 0x6063, 0x6064, 0x6079}
"""What a drive measures or decides itself."""
CODED = (0x1005, 0x1010, 0x1011, 0x1029, 0x6007, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E, 0x6060, 0x6098)
"""Objects of which a drive supports some values only."""
NOT_THERE = [(0x5FFF, 0), (0x1018, 9), (0x2000, 1)]
SIZED = {1: 0x2F, 2: 0x2B, 3: 0x27, 4: 0x23}


def variables() -> Iterator[tuple[int, int, Any]]:
    """Yield every object: index, subindex, as canopen has it."""
    for index, known in sorted(dictionary(NODE).indices.items()):
        parts = {0: known} if isinstance(known, ODVariable) else known.subindices
        yield from ((index, sub, part) for sub, part in sorted(parts.items()))


VARIABLES = [*variables()]


class Both:
    """The twin and canopen's LocalNode, which receive the same requests."""

    def __init__(self) -> None:
        self.twin = TwinOnShaft(Settings(), NODE)
        self.slave = Slave(NODE)
        self.slave.take_sent()
        self.slave.node.data_store.clear()

    def ask(self, request: bytes) -> bytes | None:
        """Send a request to both; return their common response."""
        self.slave.receive(CanFrame(0x600 + NODE, request))
        theirs = next((frame.data for frame in self.slave.take_sent() if frame.id == 0x580 + NODE), None)
        ours = self.twin.answer(request)
        assert ours == theirs, f"{request.hex()}: {ours and ours.hex()}, not {theirs and theirs.hex()}"
        return ours


def request(command: int, index: int, sub: int, data: bytes = b"") -> bytes:
    """Return the bytes of a request that names an object."""
    return (bytes((command,)) + index.to_bytes(2, "little") + bytes((sub,)) + data).ljust(8, b"\0")


def test_every_object_is_read() -> None:
    both = Both()
    for index, sub in [(index, sub) for index, sub, _ in VARIABLES if index not in LIVE] + NOT_THERE:
        answer = both.ask(request(0x40, index, sub))
        if answer is not None and answer[0] == 0x41:  # in segments
            both.ask(bytes((0x60,)).ljust(8, b"\0"))


def test_every_object_is_written_in_its_own_length_alone() -> None:
    both = Both()
    known = {(index, sub): part for index, sub, part in VARIABLES}
    for index, sub in [*known, *NOT_THERE]:
        part = known.get((index, sub))
        for size in (1, 2, 3, 4):
            if part is None or not part.writable or len(part) != 8 * size:
                both.ask(request(SIZED[size], index, sub, bytes(size)))


def test_what_is_written_is_read() -> None:
    both = Both()
    for index, sub, part in VARIABLES:
        if part.writable and not 0x1400 <= index < 0x1C00 and index not in {*CODED, *LIVE}:
            for value in (1, 77):
                both.ask(request(SIZED[len(part) // 8], index, sub, part.encode_raw(value)))
                both.ask(request(0x40, index, sub))


PIECES = {
    # an upload of 1008, "twin402", 7 bytes: one segment; toggle bits; without a beginning; broken off
    "upload": "4008100000000000 6000000000000000",
    "upload, the toggle bit wrong": "4008100000000000 7000000000000000",
    "upload, begun twice": "4008100000000000 4008100000000000 6000000000000000",
    "upload, ended by an abort": "4008100000000000 8008100000000008",
    "download, 8 bytes into 4": "2181600008000000 0001020304050607 1D08000000000000 4081600000000000",
    "download, unfinished": "2181600008000000 0001020304050607 4081600000000000",
    "download, 4 bytes in segments": "2181600004000000 0701020304000000 4081600000000000",
    "download, no size announced": "2081600000000000 0701020304000000 4081600000000000",
    "download, the toggle bit wrong": "2181600008000000 1001020304050607",
    "block download": "C681600004000000",
    "expedited, without a size": "2281600039300000 4081600000000000",
}


@pytest.mark.parametrize("pieces", PIECES.values(), ids=PIECES)
def test_transfers_in_pieces(pieces: str) -> None:
    both = Both()
    for text in pieces.split():
        both.ask(bytes.fromhex(text))


def test_a_transfer_that_is_ended_or_too_short_writes_nothing() -> None:
    twin = TwinOnShaft(node=NODE)
    before = twin.answer(request(0x40, 0x6083, 0))
    for pieces in ("2183600004000000 4060600000000000 0701020304000000", "2183600009000000 0711000000000000"):
        answers = [twin.answer(bytes.fromhex(text)) for text in pieces.split()]
        assert answers[-1] is not None
        assert answers[-1][0] == 0x80
    assert twin.answer(request(0x40, 0x6083, 0)) == before


@pytest.mark.parametrize("name", ["cia402", "zlac8015d"])
def test_a_decoder_stands_the_upload_of_any_object_by_another_host(name: str) -> None:
    """A text that a device does not have was a KeyError, found by a conformance tool's trace."""
    plugin = load(name)
    decoder = plugin.decoder([Device("m", NODE, plugin.options(), plugin.settings())])
    for index in (*range(0x1000, 0x2100), *range(0x6000, 0x6800)):
        frame = CanFrame(0x600 + NODE, bytes([0x40, *index.to_bytes(2, "little"), 0, 0, 0, 0, 0]))
        assert decoder.decode(index, frame) is not None
