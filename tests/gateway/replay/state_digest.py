"""A digest of a state: equal for two that are the same in every value, whatever they share."""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Mapping
from hashlib import blake2b
from struct import Struct
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import numpy as np

from gateway.core.step import Gateway
from gateway.replay.keyframes import StateCodec


def constants_of(fresh: Gateway) -> list[object]:
    """What never changes in a gateway that has not stepped yet."""
    return StateCodec(fresh, [fresh.robot]).constants


def digest(gateway: Gateway, constants: list[object]) -> str:
    gateway.belief()  # the map keeps the copy that was last asked for
    return _Walk({id(each) for each in constants}).of(gateway).hex()


class _Walk:
    def __init__(self, constants: set[int]) -> None:
        self.constants = constants
        self.done: dict[int, bytes] = {}

    def of(self, each: object) -> bytes:
        known = self.done.get(id(each))
        if known is None:
            self.done[id(each)] = b"within itself"
            known = blake2b(repr(self._parts(each)).encode(), digest_size=16).digest()
            self.done[id(each)] = known
        return known

    def _parts(self, each: Any) -> object:
        kind = type(each).__qualname__
        if isinstance(each, FunctionType | BuiltinFunctionType | type):
            return each.__qualname__
        if isinstance(each, enum.Enum):
            return kind, each.name
        if id(each) in self.constants:
            return kind
        if isinstance(each, MethodType):
            return self.of(each.__self__), each.__name__
        if isinstance(each, Struct):
            return each.format
        if isinstance(each, np.ndarray):
            return str(each.dtype), each.shape, blake2b(each.tobytes()).digest()
        if isinstance(each, Mapping):
            return kind, [(self.of(key), self.of(value)) for key, value in each.items()]
        if isinstance(each, set | frozenset):
            return kind, sorted(self.of(one) for one in each)
        if isinstance(each, list | tuple | deque):
            return kind, [self.of(one) for one in each]
        names = [*getattr(each, "__dict__", {})]
        names += [name for base in type(each).__mro__ for name in getattr(base, "__slots__", ())]
        if names:
            return kind, [(name, self.of(getattr(each, name, None))) for name in names]
        return kind, "" if " object at 0x" in repr(each) else repr(each)
