"""A message beside cantools, which has it from a DBC: what a user takes where no package knows the device.

Rules. cantools does what its documentation shows first, `encode_message` and `decode_message` with the checks
it makes by default. Bare `struct` knows its message beforehand, checks nothing and makes no frame: it is the
lower bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from protocols.frames import id_number

RIVAL = ("cantools", "cantools", "cantools on a DBC of these messages")
NEAR = 1e-9


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], object]
    struct: Callable[[], object]
    id: int
    """Of its frame, with the bit of its format."""
    data: bytes
    """Of its frame: what encoding must give, what is decoded."""
    values: Mapping[str, float] = field(default_factory=dict)
    """The fields to encode by the DBC's names; {} for a message to decode."""

    def theirs(self, known: Any) -> Callable[[], object]:  # noqa: ANN401 -- cantools has no types
        """Return the same operation in cantools."""
        number, data, values = self.id, self.data, self.values
        if not values:
            return lambda: known.decode_message(number, data)
        return lambda: known.encode_message(number, dict(values))

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or fields
        """True if encoding gave the same bytes, or decoding the same fields in order. (Ours may have numbers
        of the id behind them, a DBC the byte of the command before them.)"""
        if self.values:
            return bool(theirs == struct == ours.data == self.data and id_number(ours) == self.id)
        fields = list(ours.values.values())[: len(struct)]
        others = [getattr(value, "value", value) for value in theirs.values()]
        return _near(fields, others[-len(fields) :]) and _near(fields, struct)


def _near(some: Sequence[float], others: Sequence[float]) -> bool:
    return len(some) == len(others) and all(
        abs(one - other) < NEAR for one, other in zip(some, others, strict=True)
    )


def database(cantools: Any, messages: str) -> Any:  # noqa: ANN401 -- cantools has no types
    """Return these messages of a DBC as a cantools database."""
    return cantools.database.load_string(f'VERSION ""\nBU_: host motor\n{messages}', "dbc")
