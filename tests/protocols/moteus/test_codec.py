"""Bytes both ways: tables, the independent vectors, and moteus 1.1.1 on random frames."""

from __future__ import annotations

import io
import json
import math
from importlib.resources import files
from typing import Any

import moteus
import numpy as np
import pytest
from moteus import multiplex as mp
from moteus import protocol as theirs

from protocols.frames import CanFrame
from protocols.moteus import plugin
from protocols.moteus.codec import (
    F32,
    INT8,
    INT16,
    INT32,
    LENGTHS,
    POLL,
    READ_ERROR,
    REPLY,
    TO_DEVICE,
    WRITE,
    WRITE_ERROR,
    Console,
    Error,
    Query,
    Subframe,
    Values,
    command_id,
    encode,
    from_raw,
    header,
    make_frame,
    parse,
    reply_id,
    to_raw,
    varuint,
    write,
)
from protocols.moteus.messages import (
    IDENTIFY,
    STOP,
    Limits,
    names,
    position_command,
    torque_command,
    written,
)
from protocols.moteus.registers import NAMES, SCALES, Mode, Register, mode_name, scale_of
from protocols.moteus.reply import decode
from protocols.reference_vectors import Vector, vectors_of
from tests.protocols.moteus.from_package import entries

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
PLAIN = Limits(0.1)
LIMITED = Limits(0.1, 1.5, 4.0, 20.0)
MOVE = (0.25, -1.5, 0.125)


def made(data: bytes, address: int = 5, host: int = 0, prefix: int = 0) -> CanFrame:
    return make_frame(command_id(address, host, prefix), data)


def test_the_vectors_of_the_package_are_made_again() -> None:
    stored = json.loads((files("gateway.fixtures") / "vectors/moteus.json").read_text("utf-8"))
    again = {entry["name"]: entry for entry in entries()}
    assert {entry["name"]: entry for entry in stored if entry["name"] in again} == again


def _told_by(vector: Vector) -> dict[int, float | None]:
    """What the package reads in an answer, by register number."""
    parsed = vector.meaning["parsed_by_moteus"]
    ours = {k: v for k, v in parsed.items() if k not in ("errors", "read")}
    return {NAMES[k.lower()] if k.lower() in NAMES else int(k, 16): v for k, v in ours.items()}


@pytest.mark.parametrize(
    "vector",
    [v for v in VECTORS.values() if v.direction == "from_device" and "parsed_by_moteus" in v.meaning],
    ids=lambda v: v.name,
)
def test_vectors_of_replies_are_decoded_as_by_the_package(vector: Vector) -> None:
    assert isinstance(vector.frame, CanFrame)
    data = vector.frame.data
    reported = decode(data.ljust(min(n for n in LENGTHS if n >= len(data)), b"\x50"))
    assert reported is not None
    expected = _told_by(vector)
    assert set(reported.values) == set(expected)
    for register, value in expected.items():
        assert reported.values[register] == (None if value is None else pytest.approx(value))
    errors = [[f"{e.register:03X}", e.number] for e in reported.errors]
    assert errors == vector.meaning["parsed_by_moteus"].get("errors", [])


SUBFRAMES: tuple[tuple[Subframe, str], ...] = (
    (Values(WRITE, 0, INT8, (10,)), "01000a"),
    (Values(WRITE, 0x20, INT16, (96, 288, -176)), "0720 6000 2001 50ff"),
    (Values(WRITE, 0x20, F32, (0.5, -2.0)), "0e20 0000003f 000000c0"),
    (Values(WRITE, 0x131, F32, (0.0,)), "0db102 00000000"),
    (Values(REPLY, 0, INT16, (10, 80, 256, -144)), "240400 0a00 5000 0001 70ff"),
    (Values(REPLY, 0x150, INT32, (1, -2)), "2ad002 01000000 feffffff"),
    (Query(0, INT16, 4), "140400"),
    (Query(0x0D, INT8, 3), "130d"),
    (Query(0x4000, F32, 5), "1c05808001"),
    (Error(WRITE_ERROR, 0x0F, 2), "300f02"),
    (Error(READ_ERROR, 0x158, 1), "31d80201"),
    (Console(TO_DEVICE, 1, b"tel stop\n"), "400109 74656c2073746f700a"),
    (Console(POLL, 1, b"", 48), "420130"),
)


@pytest.mark.parametrize(("subframe", "data"), SUBFRAMES, ids=[data for _, data in SUBFRAMES])
def test_vectors_of_subframes(subframe: Subframe, data: str) -> None:
    plain = bytes.fromhex(data)
    assert encode(subframe) == plain
    assert parse(plain) == ([subframe], True)
    assert parse(b"\x50" + plain + b"\x50\x50") == ([subframe], True)
    for cut in range(1, len(plain)):
        found, sound = parse(plain[:cut])
        assert not sound
        assert all(isinstance(each, Values) for each in found)  # what stands before the flaw is obeyed


@pytest.mark.parametrize(
    ("value", "data"), [(0, "00"), (0x7F, "7f"), (0x80, "8001"), (0x150, "d002"), (2**32 - 1, "ffffffff0f")]
)
def test_vectors_of_varuints(value: int, data: str) -> None:
    assert varuint(value) == bytes.fromhex(data)
    assert parse(bytes.fromhex("11" + data))[0] == [Query(value, INT8, 1)]


@pytest.mark.parametrize("flaw", ["03", "0101", "60", "32", "1080808080808001", "10ff0100", "4001ff00", "43"])
def test_vectors_of_what_is_no_subframe(flaw: str) -> None:
    before = Values(WRITE, 0, INT8, (0,))
    assert parse(encode(before) + bytes.fromhex(flaw)) == ([before], False)


def test_a_vector_that_is_cut_off_leaves_what_stands_before() -> None:
    data = bytes.fromhex("0f20 0000803e 0000c0bf 0000")
    assert parse(data) == ([Values(WRITE, 0x20, F32, (0.25, -1.5))], False)
    assert parse(bytes.fromhex("0720")) == ([], False)


def test_vectors_of_identifiers_and_padding() -> None:
    assert (command_id(5), command_id(0x7F), command_id(5, 3, 0x1ABC)) == (0x8005, 0x807F, 0x1ABC8305)
    assert (reply_id(5), reply_id(100, 3), reply_id(7, 0, 1)) == (0x500, 0x6403, 0x10700)
    for length in range(65):
        frame = make_frame(0x8005, b"\x01" * length)
        assert len(frame.data) in LENGTHS
        assert frame.data == b"\x01" * length + b"\x50" * (len(frame.data) - length)
    assert len(make_frame(0x8005, bytes(9)).data) == 12
    assert (make_frame(0x7FF, b"").extended, make_frame(0x800, b"").extended) == (False, True)
    assert make_frame(1, b"").fd
    assert make_frame(1, b"").brs


@pytest.mark.parametrize("register", Register)
def test_vectors_of_names_and_scales_are_the_package_s(register: Register) -> None:
    assert theirs.Register(register).name in (register.name, "REZERO", "REZERO_STATE", "SERIAL_NUMBER")
    if register in SCALES and register not in (0x130, 0x131):
        for resolution in (INT8, INT16, INT32, F32):
            scaled = theirs.scale_register(register, resolution, 1)
            if _package_scales(register):
                assert scaled == pytest.approx(scale_of(register)[resolution])


def _package_scales(register: int) -> bool:
    """The package leaves registers that only a command writes as they stand."""
    return theirs.scale_register(register, mp.INT8, 100) not in (100, None)


def test_vectors_of_modes_are_the_package_s() -> None:
    assert {mode.name: mode.value for mode in theirs.Mode} == {
        mode.name: mode.value for mode in Mode if mode not in (2, 3, 4)
    }
    assert (mode_name(10), mode_name(12), mode_name(77)) == ("position", "zero velocity", "mode 77")


@pytest.mark.parametrize(
    ("register", "resolution", "value", "raw"),
    [
        (Register.COMMAND_POSITION, INT8, 0.5, 50),
        (Register.COMMAND_POSITION, INT16, 0.0096, 96),  # the package truncates to 95 (±1 LSB)
        (Register.COMMAND_POSITION, INT32, -1.0, -100_000),
        (Register.COMMAND_POSITION, INT16, 99.0, 32767),
        (Register.COMMAND_POSITION, INT16, -99.0, -32767),
        (Register.COMMAND_POSITION, INT8, None, -128),
        (Register.COMMAND_POSITION, INT16, None, -32768),
        (Register.COMMAND_POSITION, INT32, None, -2147483648),
        (Register.COMMAND_KP_SCALE, INT8, 1.0, 127),
        (Register.COMMAND_TIMEOUT, INT16, 0.1, 100),
        (Register.TEMPERATURE, INT8, 41.0, 41),
        (Register.FAULT, INT16, 99.0, 99),
    ],
)
def test_vectors_of_numbers_in_counts(register: int, resolution: int, value: float | None, raw: int) -> None:
    assert to_raw(register, resolution, value) == raw
    back = from_raw(register, resolution, raw)
    if value is None:
        assert back is None
    elif abs(value) < 99.0:
        assert back == pytest.approx(value)


def test_vectors_of_numbers_in_binary32() -> None:
    assert to_raw(1, F32, -0.0) == 0.0
    assert math.copysign(1.0, to_raw(1, F32, -0.0)) == 1.0
    assert to_raw(1, F32, 1e-40) == 0.0
    assert to_raw(1, F32, 1e300) == 3.4028234663852886e38
    assert to_raw(1, F32, -1e39) == -3.4028234663852886e38
    assert [to_raw(1, F32, x) for x in (2.0**-126, -(2.0**-126))] == [2.0**-126, -(2.0**-126)]
    assert [to_raw(1, F32, x) for x in (2.0**-127, -(2.0**-127))] == [0.0, 0.0]
    assert math.isnan(to_raw(1, F32, None))
    assert from_raw(1, F32, math.nan) is None
    assert from_raw(1, F32, math.inf) is None
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="not finite"):
            to_raw(1, F32, bad)
        with pytest.raises(ValueError, match="not finite"):
            position_command(bad, 0.0, 0.0, PLAIN)
        with pytest.raises(ValueError, match="not finite"):
            torque_command(0.0, bad, PLAIN)


@pytest.mark.parametrize("size", [20, 48])
def test_damaged_vectors_are_read_by_short_cut_and_loop_alike(size: int) -> None:
    generator = np.random.Generator(np.random.PCG64(7))
    vector = VECTORS["reply_fast" if size == 20 else "reply_full"].frame
    assert isinstance(vector, CanFrame)
    for _ in range(300):
        data = bytearray(vector.data)
        for at in generator.integers(0, size, 2):
            data[at] = int(generator.integers(0, 256))
        reported = decode(bytes(data))
        subframes, sound = parse(bytes(data))
        if reported is None:
            loud = [s for s in subframes if isinstance(s, Values) and s.code == REPLY]
            infinite = any(s.resolution == F32 and any(map(math.isinf, s.raw)) for s in loud)
            assert not sound or len(loud) != len(subframes) or infinite
            continue
        again = {
            s.start + i: from_raw(s.start + i, s.resolution, raw)
            for s in subframes
            if isinstance(s, Values)
            for i, raw in enumerate(s.raw)
        }
        assert dict(reported.values) == again


def _their_write(register: int, resolution: int, value: float) -> bytes:
    buffer = io.BytesIO()
    writer = theirs.Writer(buffer)
    writer.write_int8(mp.WRITE_BASE | resolution << 2 | 1)
    writer.write_varuint(register)
    scale = scale_of(register)
    writer.write_mapped(value, scale[0], scale[1], scale[2], resolution)
    return buffer.getvalue()


def test_random_vectors_of_writes_are_the_package_s_within_a_count() -> None:
    generator = np.random.Generator(np.random.PCG64(11))
    for _ in range(300):
        register = list(SCALES)[int(generator.integers(len(SCALES)))]
        resolution = int(generator.integers(4))
        value = float(np.float32(generator.uniform(-2.0, 2.0)))
        ours, other = write(register, value, resolution=resolution), _their_write(register, resolution, value)
        assert header(WRITE, register, resolution, 1) == other[: -(1, 2, 4, 4)[resolution]]
        (mine,), (yours,) = (s.raw for s in (*parse(ours)[0], *parse(other)[0]) if isinstance(s, Values))
        assert abs(mine - yours) <= (0 if resolution == F32 else 1)


def test_random_vectors_of_queries_are_the_package_s() -> None:
    generator = np.random.Generator(np.random.PCG64(13))
    controller: Any = moteus.Controller(id=5, transport=object())
    for _ in range(100):
        start, count = int(generator.integers(0, 0x200)), int(generator.integers(1, 8))
        resolution = int(generator.integers(4))
        command = controller.make_custom_query({start + i: resolution for i in range(count)})
        assert parse(command.data) == ([Query(start, resolution, count)], True)
        assert encode(Query(start, resolution, count)) == command.data


def test_what_vectors_write_is_what_the_package_reads() -> None:
    for vector in VECTORS.values():
        if vector.direction == "to_device" and isinstance(vector.frame, CanFrame):
            subframes, sound = parse(vector.frame.data)
            assert sound
            other = (
                theirs.parse_registers(vector.frame.data) if vector.meaning.get("parsed_by_moteus") else None
            )
            if other is not None:
                mine = {k: math.nan if v is None else v for k, v in written(subframes).items() if k < 0x154}
                yours = {k: v for k, v in other.command.items() if k < 0x154}
                assert mine == pytest.approx(yours, nan_ok=True)


def test_what_is_no_vector_to_a_device_has_no_name() -> None:
    assert names(b"\x01\x00\x00") == ()
    assert names(VECTORS["reply_fast"].frame) == ()
    assert names(CanFrame(0x8005, b"\x01\x00", extended=True, fd=True)) == ()
    assert names(CanFrame(0x8085, STOP, extended=True, fd=True)) == ()
    assert names(made(IDENTIFY)) == ("read",)
