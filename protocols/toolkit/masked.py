"""Messages whose fields are chosen by the bits of a mask."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from protocols.toolkit.table import CODES, Field


class Masked:
    """The fields by the bit that chooses them: a bit may choose several. Big-endian. A constant."""

    def __init__(self, fields: Sequence[Sequence[Field]]) -> None:
        self.fields = tuple(map(tuple, fields))
        self.bit = {each.name: 1 << bit for bit, some in enumerate(self.fields) for each in some}
        self.layout = lru_cache(64)(self._layout)
        self._reader = lru_cache(64)(self._compiled)

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
        return self._reader(mask)(data) if len(data) >= self.size(mask) else None

    def _compiled(self, mask: int) -> Callable[[bytes], dict[str, float | None]]:
        """Return what reads the fields of a mask."""
        packed, fields = self.layout(mask)
        taken, values, end = "", list[str](), (1 << 31) - 1
        for at, each in enumerate(fields):
            value = f"r{at}" if each.unit == 1.0 else f"r{at} * {each.unit!r}"
            within = f" if {-end} < r{at} < {end} else None" * (each.bits == 32)
            taken += f"r{at}, "
            values.append(f"{each.name!r}: {value}{within}")
        statement = f"({taken}) = unpack(data)" if fields else "pass"
        scope: dict[str, Any] = {"unpack": packed.unpack_from}
        source = f"def read(data):\n    {statement}\n    return {{{', '.join(values)}}}"
        exec(source, scope)  # noqa: S102 -- generated from the constants of fields alone
        read: Callable[[bytes], dict[str, float | None]] = scope["read"]
        return read
