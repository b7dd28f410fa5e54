"""The twin's own data sheet: written from the dictionary, read by canopen, and true of the twin."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import canopen
import pytest

import protocols.cia402
from protocols.canopen import sdo
from protocols.canopen.objects import Key, Type
from protocols.cia402.objects import OBJECTS
from protocols.cia402.twin import eds
from tests.protocols.cia402.bus import TwinOnShaft, remote

FILE = Path(protocols.cia402.__file__).parent / "twin.eds"
NODE = 5
LIVE = {(0x6041, 0), (0x6079, 0)}
"""Not what they are at power-on when they can first be read."""
ERRORS = 0x1003
"""Its list of errors is empty."""


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
def node() -> Any:
    """Return package canopen's node of a twin."""
    return remote(TwinOnShaft(node=NODE))


def attempt(transfer: Callable[..., Any], *arguments: Any) -> tuple[Any, int]:
    """Return what a transfer returns, and its abort code, or 0."""
    try:
        return transfer(*arguments), 0
    except canopen.SdoAbortedError as refused:
        return None, refused.code


@pytest.mark.parametrize("key", sorted(OBJECTS), ids=lambda k: f"{k[0]:04X}:{k[1]:02X}")
def test_the_twin_answers_as_its_data_sheet_says(node: Any, key: Key) -> None:
    known, row = variables()[key], OBJECTS[key]
    assert (known.data_type, known.access_type, known.pdo_mappable) == (
        row.type.code,
        row.access,
        row.mappable,
    )
    data, code = attempt(node.sdo.upload, *key)
    if code:
        assert (key[0], code) == (ERRORS, sdo.NO_DATA)
    elif row.type is Type.TEXT:
        assert data.decode("ascii") == known.default
    else:
        assert key in LIVE or known.decode_raw(data) == known.default
        _, code = attempt(node.sdo.download, *key, data)
        assert (code == sdo.READ_ONLY) is (row.access != "rw")
