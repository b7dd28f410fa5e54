"""A frame of a known shape, taken apart at once, does to a device what it does subframe by subframe."""

from __future__ import annotations

from copy import deepcopy
from math import inf, nan
from random import Random

import pytest

from protocols.moteus import codec, plugin
from protocols.moteus import table as tb
from protocols.moteus.decoder import SHAPES_KEPT, Memory, Shapes, shape_of
from protocols.plugin import Device

SEED = 32
DEVICE = Device("m", 5, plugin.options(), plugin.settings())
NUMBERS = (0.0, -0.0, 1.5, -2.25, 1e-39, 3e38, nan, inf, -inf, None)
COMMAND, QUERY = 0x020, codec.read(0x000, codec.INT8) + codec.read(0x001, codec.F32, 3)


def memory() -> Memory:
    return Memory(DEVICE, b"")


def written(resolution: int, *numbers: float | None) -> bytes:
    """Quantities in the command registers; as binary32 also such as no encoder makes."""
    if resolution != codec.F32:
        return codec.write(COMMAND, *numbers, resolution=resolution)
    raw = tuple(nan if number is None else number for number in numbers)
    return codec.encode(codec.Subframe(codec.WRITE, COMMAND, codec.F32, raw))


def frame(mode: int, *written: bytes) -> bytes:
    data = codec.encode(codec.Subframe(codec.WRITE, tb.MODE, codec.INT8, (mode,))) + b"".join(written)
    return codec.make_frame(0x8005, data + QUERY).data


def test_both_ways_leave_a_device_the_same() -> None:
    random = Random(SEED)
    for _ in range(500):
        resolution = random.randrange(4)
        numbers = random.choices([n for n in NUMBERS if resolution == codec.F32 or n not in (inf, -inf)], k=4)
        numbers = [None if number != number else number for number in numbers]
        data = frame(random.choice(range(len(tb.Mode))), written(resolution, *numbers))
        shape = shape_of(data)
        assert shape is not None
        one, other = memory(), memory()
        list(one.obey(data))
        assert other.command_by(shape, data)
        assert repr(vars(one)) == repr(vars(other)), data.hex()
        assert repr(one.begins()) == repr(other.begins())


@pytest.mark.parametrize(
    "data",
    [
        b"",
        QUERY,
        frame(10)[1:],
        frame(10, codec.write(0x130, 0.0)),
        frame(10, codec.write(0x154, 1.0)),
        frame(10, codec.write(0x0F0, 1.0)),
        frame(10, written(codec.F32, 1.0))[:8],
        frame(10, bytes((codec.TO_DEVICE, 1, 1, 0x0A))),
        written(codec.F32, 1.0) + frame(10),
    ],
    ids=[
        "nothing",
        "only read",
        "no mode",
        "an action",
        "a UUID",
        "no command",
        "cut",
        "console",
        "mode late",
    ],
)
def test_what_does_anything_else_has_no_shape(data: bytes) -> None:
    assert shape_of(data) is None


def test_a_mode_that_there_is_not_is_left_to_the_long_way() -> None:
    shape = shape_of(frame(10, written(codec.F32, 1.0)))
    assert shape is not None
    device = memory()
    before = repr(vars(device))
    assert not device.command_by(shape, frame(99, written(codec.F32, 1.0)))
    assert repr(vars(device)) == before


def test_few_shapes_are_remembered_and_any_is_found() -> None:
    shapes = Shapes()
    for register in range(0x020, 0x020 + 2 * SHAPES_KEPT):
        data = frame(10, codec.write(register, 1.0))
        found = shapes.of(data)
        assert found is not None
        assert found.numbers(data) == (10, 1.0)
        again = shapes.of(frame(10, codec.write(register, 2.0)))
        assert again is not None
        assert again[:2] == found[:2]
    assert shapes.of(QUERY) is None


def test_a_copy_has_a_command_of_its_own() -> None:
    one = memory()
    other = deepcopy(one)
    list(other.obey(frame(10, written(codec.F32, 1.0))))
    assert one.command["command_position"] == 0.0
    assert other.command["command_position"] == 1.0
