"""Any message there is, and vectors of packed messages from an independent source."""

from __future__ import annotations

import json
import types
from dataclasses import fields
from importlib.resources import files
from typing import Any, Union, get_args, get_origin, get_type_hints

from hypothesis import strategies as st

from protocols import messages
from protocols.message_codec import CODES
from protocols.messages import Message, Mode

VECTORS: dict[str, Any] = json.loads(
    (files("gateway.fixtures") / "vectors" / "messages.json").read_text("utf-8")
)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)
INTS = st.integers(-(2**63), 2**64 - 1)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
PLAIN = st.recursive(
    st.one_of(FLOATS, INTS, st.booleans(), TEXTS, st.none()),
    lambda of: st.lists(of, max_size=3).map(tuple),
    max_leaves=6,
)
"""What a field of another distribution's skill may hold."""


def message_of(row: dict[str, Any]) -> Message:
    """The message that a row of the vectors names."""
    kind = getattr(messages, row["word"])
    values: dict[str, Any] = {key: _value(value) for key, value in row["fields"].items()}
    if "mode" in values:
        values["mode"] = Mode(values["mode"])
    if "cells" in values:
        values["cells"] = bytes.fromhex(values["cells"])
    message: Message = kind(**values)
    return message


def _value(value: object) -> Any:
    if isinstance(value, dict):
        return message_of(value)
    return tuple(_value(item) for item in value) if isinstance(value, list) else value


def _strategy(hint: object) -> st.SearchStrategy[Any]:
    plain: dict[object, st.SearchStrategy[Any]] = {
        float: FLOATS,
        int: INTS,
        bool: st.booleans(),
        str: TEXTS,
        bytes: st.binary(max_size=40),
        Mode: st.sampled_from(Mode),
    }
    if hint in plain:
        return plain[hint]
    if get_origin(hint) in (Union, types.UnionType):
        return st.one_of(*(st.none() if part is type(None) else _strategy(part) for part in get_args(hint)))
    items = get_args(hint)
    if items[-1] is Ellipsis and items[0] is float:
        return st.lists(FLOATS, max_size=40).map(tuple)
    if items[-1] is Ellipsis and get_origin(items[0]) is tuple and get_args(items[0])[0] is str:
        return st.lists(st.tuples(TEXTS, PLAIN), max_size=4).map(tuple)
    if items[-1] is Ellipsis and get_origin(items[0]) is tuple:
        return st.lists(st.tuples(FLOATS, FLOATS), max_size=20).map(tuple)
    if items[-1] is Ellipsis:
        return st.lists(_several(items[0]), max_size=2).map(tuple)
    return st.tuples(*(_strategy(item) for item in items))


def _several(kinds: object) -> st.SearchStrategy[Message]:
    """Messages of these kinds; what holds further ones seldom enough to end."""
    simple = [kind for kind in get_args(kinds) if kind not in (messages.Repeat, messages.Try)]
    return st.one_of(*(messages_of(kind) for kind in simple))


def messages_of(kind: type[Message]) -> st.SearchStrategy[Message]:
    """Words of a kind, with any values that they may hold."""
    hints = get_type_hints(kind)
    return st.builds(kind, *(_strategy(hints[f.name]) for f in fields(kind)))


ANY_MESSAGE = st.one_of(*(messages_of(kind) for kind in CODES.values()))
