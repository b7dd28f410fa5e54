"""The twin's own data sheet: written from the dictionary, read by canopen, and true of the twin."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import canopen
import pytest

import protocols.cia402
from protocols.canopen import sdo
from protocols.cia402.objects import OBJECTS, Key, Type, from_bytes
from protocols.cia402.twin import eds
from tests.protocols.cia402.transfer import Transfer
from tests.protocols.cia402.twin_bench import NODE, TwinBench

FILE = Path(protocols.cia402.__file__).parent / "twin.eds"
LIVE = {(0x6041, 0), (0x6079, 0), (0x60A9, 0), (0x60AA, 0)}
"""Not what they are at power-on when they can first be read, or the bench's own."""


@cache
def variables() -> dict[Key, Any]:
    """Every value in the data sheet, as canopen reads it."""
    found: dict[Key, Any] = {}
    for index, thing in canopen.import_od(str(FILE), node_id=NODE).items():
        parts = [thing] if isinstance(thing, canopen.objectdictionary.ODVariable) else thing.values()
        found |= {(index, part.subindex): part for part in parts}
    return found


def test_the_file_is_what_the_dictionary_makes() -> None:
    """To write it anew: python -c "from protocols.cia402.twin import eds; print(eds(), end='')" > twin.eds"""
    assert FILE.read_text("utf-8") == eds()


def test_canopen_reads_every_object_of_it() -> None:
    assert set(variables()) == set(OBJECTS)


@pytest.fixture(scope="module")
def bench() -> TwinBench:
    return TwinBench()


@pytest.mark.parametrize("key", sorted(OBJECTS), ids=lambda k: f"{k[0]:04X}:{k[1]:02X}")
def test_the_twin_answers_as_its_data_sheet_says(bench: TwinBench, key: Key) -> None:
    reported, row = variables()[key], OBJECTS[key]
    assert (reported.data_type, reported.access_type, reported.pdo_mappable) == (
        row.type.code,
        row.access,
        row.mappable,
    )
    read = bench.transfer(Transfer(*key))
    if key[0] == 0x1003 and key[1]:
        assert read.abort == sdo.NO_DATA, "there was no error yet"
        return
    assert read.abort is None
    if row.type is Type.TEXT:
        assert read.value.decode("ascii") == reported.default
        return
    value = from_bytes(row.type, read.value)
    assert key in LIVE or value == reported.default
    written = bench.transfer(Transfer(*key, read.value))
    assert (written.abort == sdo.READ_ONLY) is (row.access != "rw")
