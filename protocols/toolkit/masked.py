"""Messages whose fields are chosen by the bits of a mask."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache

from protocols.toolkit.table import CODES, Field


class Masked:
    """The fields by the bit that chooses them: a bit may choose several. Big-endian. A constant."""

    def __init__(self, fields: Sequence[Sequence[Field]]) -> None:
        self.fields = tuple(map(tuple, fields))
        self.bit = {each.name: 1 << bit for bit, some in enumerate(self.fields) for each in some}
        self.layout = lru_cache(64)(self._layout)

    def __deepcopy__(self, memo: object) -> Masked:
        return self

    def mask(self, *names: str) -> int:
        """Return the mask that chooses these."""
        return sum({self.bit[name] for name in names})

    def _layout(self, mask: int) -> tuple[struct.Struct, tuple[Field, ...]]:
        """Return how the fields of a mask stand in a message."""
        fields = tuple(each for bit, some in enumerate(self.fields) if mask >> bit & 1 for each in some)
        return struct.Struct(">" + "".join(CODES[each.kind, each.bits] for each in fields)), fields

    def size(self, mask: int) -> int:
        """Return the bytes of the fields of a mask."""
        return self.layout(mask)[0].size

    def encode(self, mask: int, values: Mapping[str, float]) -> bytes:
        """Return the fields of a mask; what is not given is 0. Numbers saturate."""
        packed, fields = self.layout(mask)
        raw = []
        for each in fields:
            low, high = (round(end / each.unit) for end in each.ends())
            raw.append(max(low, min(high, round(values.get(each.name, 0) / each.unit))))
        return packed.pack(*raw)

    def decode(self, mask: int, data: bytes) -> dict[str, float | None] | None:
        """Return the values of a mask; None if there is too little. A number of 32 bits is None at its ends,
        where it may as well be beyond."""
        packed, fields = self.layout(mask)
        if len(data) < packed.size:
            return None
        values: dict[str, float | None] = {}
        for each, raw in zip(fields, packed.unpack_from(data), strict=True):
            beyond = each.bits == 32 and abs(raw) >= (1 << 31) - 1
            values[each.name] = None if beyond else raw if each.unit == 1.0 else raw * each.unit
        return values
