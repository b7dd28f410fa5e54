"""Bytes of SDO messages, PDOs and objects: what holds for all of them."""

from __future__ import annotations

import numpy as np
import pytest
from canopen.sdo.exceptions import SdoAbortedError

from protocols.canopen import sdo
from protocols.canopen.dictionary import Dictionary
from protocols.canopen.objects import Type, from_bytes, to_bytes
from protocols.canopen.pdo import Entry, decode_entry, encode_entry, mapping, packing
from protocols.canopen.server import SdoServer
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS

SEED = 20261121


def test_the_numbers_of_the_abort_codes_are_the_packages() -> None:
    assert set(sdo.ABORTS) == set(SdoAbortedError.CODES)
    assert "unknown" in sdo.abort_text(1)


def test_what_does_not_fit_an_sdo_message_is_an_error() -> None:
    for bad in (
        sdo.Download(0x6040, 0, b""),
        sdo.Download(0x6040, 0, b"12345"),
        sdo.DownloadSegment(False, b"12345678", False),
    ):
        with pytest.raises(ValueError, match="bytes"):
            sdo.encode(bad)


def test_any_eight_bytes_are_served_and_decoded() -> None:
    random, server = np.random.Generator(np.random.PCG64(SEED)), SdoServer()
    dictionary = Dictionary(OBJECTS, 1, {})
    for _ in range(2000):
        data = random.bytes(8)
        sdo.decode_response(data)
        response, _ = server.handle(dictionary, data)
        if data[0] >> 5 == 4:  # a client's abort
            assert response is None
        else:
            assert response is not None
            assert sdo.decode_response(response) is not None, f"{SEED}: {data.hex()}"


def test_packing_keeps_values_in_whole_bytes_or_not() -> None:
    random = np.random.Generator(np.random.PCG64(SEED))
    keys = [row.key for row in OBJECTS.values() if row.mappable]
    for _ in range(300):
        chosen: list[Entry] = []
        for at in random.permutation(len(keys)):
            entry = mapping(OBJECTS, keys[at])[0]
            bits = entry.bits if random.random() < 0.6 else int(random.integers(1, entry.bits + 1))
            if sum(e.bits for e in chosen) + bits <= 64:
                chosen.append(Entry(entry.index, entry.sub, bits))
        pack = packing(OBJECTS, chosen)
        values = []
        for entry, signed in zip(pack.entries, pack.signed, strict=True):
            low, high = (-(1 << entry.bits - 1), 1 << entry.bits - 1) if signed else (0, 1 << entry.bits)
            values.append(int(random.choice([low, high - 1, 0, int(random.integers(low, high))])))
        data = pack.pack(values)
        assert len(data) == pack.size
        assert pack.unpack(data) == pack.unpack(data + b"more") == tuple(values)
        assert pack.unpack(data[:-1]) is None
        general = type(pack)(pack.entries, pack.size, "", pack.signed)
        assert general.pack(values) == data
        assert general.unpack(data) == tuple(values)
        assert [decode_entry(encode_entry(entry)) for entry in pack.entries] == list(pack.entries)


def test_a_value_too_large_for_its_place_is_refused() -> None:
    for pack in (
        packing(OBJECTS, mapping(OBJECTS, o.CONTROLWORD, o.MODE)),
        packing(OBJECTS, [Entry(0x6040, 0, 12), Entry(0x6060, 0, 8)]),
    ):
        for values in ((1 << 16, 0), (-1, 0), (0, 128), (0, -129)):
            with pytest.raises(ValueError, match="fit"):
                pack.pack(values)
    with pytest.raises(ValueError, match="72 bits"):
        packing(OBJECTS, mapping(OBJECTS, o.TARGET_POSITION, o.TARGET_VELOCITY, o.MODE))
    with pytest.raises(ValueError, match="without bits"):
        packing(OBJECTS, [Entry(0x6040, 0, 0)])


@pytest.mark.parametrize("type_", [t for t in Type if t.bits], ids=lambda t: t.name)
def test_types_at_their_limits(type_: Type) -> None:
    for value in (type_.low, type_.high, 0):
        assert from_bytes(type_, to_bytes(type_, value)) == value
    for value in (type_.low - 1, type_.high + 1):
        with pytest.raises(ValueError, match=str(value)):
            to_bytes(type_, value)
    assert from_bytes(type_, b"") is None
    assert from_bytes(type_, bytes(type_.bits // 8 + 1)) is None
