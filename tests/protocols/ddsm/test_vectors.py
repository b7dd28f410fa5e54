"""Values ↔ bytes, both ways; the checksum beside crccheck's; answers found by what was asked."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any

import pytest
from crccheck.crc import Crc8Maxim

from protocols import messages as msg
from protocols.ddsm import plugin
from protocols.ddsm import table as ds
from protocols.ddsm.driver import Motor
from protocols.ddsm.options import Options, Settings
from protocols.ddsm.twin import memory_of
from protocols.messages import MILLISECOND, Feedback
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.toolkit.serial import CRC8_MAXIM, Stream

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
ARM = msg.Arm("left")
SENT: dict[str, tuple[str, int, dict[str, int], int, Sequence[Any]]] = {
    "velocity_id1_-50rpm": (
        "drive",
        1,
        {"value": -50, "brake": 0},
        ds.SPEED,
        [ARM, msg.Velocity("left", -50 * math.pi / 30)],
    ),
    "waveshare_vendor_default_packet": (
        "drive",
        1,
        {"value": -50, "brake": 0},
        ds.SPEED,
        [ARM, msg.Velocity("left", -50 * math.pi / 30)],
    ),
    "current_id1_2A": (
        "drive",
        1,
        {"value": 8191, "brake": 0},
        ds.CURRENT,
        [ARM, msg.Torque("left", 8191 / 32767 * 8.0 * 0.75)],
    ),
    "position_id1_90deg": (
        "drive",
        1,
        {"value": 8191, "brake": 0},
        ds.POSITION,
        [ARM, msg.Position("left", 8191 / 32767 * math.tau)],
    ),
    "brake_id1": ("drive", 1, {"value": 0, "brake": 0xFF}, ds.SPEED, [ARM, msg.Velocity("left", 0.0)]),
    "query_id1": ("query", 1, {}, ds.SPEED, []),
    "set_mode_velocity_id1": (
        "set mode 115",
        1,
        {"mode": 2},
        ds.CURRENT,
        [ARM, msg.Kept("left", "mode", 2.0), msg.Velocity("left", 0.0)],
    ),
    "id_query": ("id query", 0, {}, ds.SPEED, []),
    "set_id_2": ("set id", 0, {"id": 2}, ds.SPEED, [msg.WriteParameter("left", "id", 2.0)]),
    "ddsm210_set_mode_speed_id1": (
        "set mode 210",
        1,
        {"mode": 2},
        0,
        [ARM, msg.Kept("left", "mode", 2.0), msg.Velocity("left", 0.0)],
    ),
}
"""Message, address, numbers, the mode before, and what the motor obeys."""


def device(model: Any = "DDSM115", address: int = 1) -> Device:
    return Device("left", address, Options(model=model), Settings())


def model_of(name: str) -> str:
    return "DDSM210" if "210" in name else "DDSM115"


def test_no_vector_is_left_out() -> None:
    assert VECTORS.keys() == SENT.keys() | {"reply_to_0x64_id1"}


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends_and_a_motor_obeys(name: str) -> None:
    message, address, values, mode, does = SENT[name]
    frame = VECTORS[name].frame
    assert isinstance(frame, bytes)
    assert ds.encode(message, address, **values) == frame
    assert ds.ALL.names(frame) == (message,)
    memory = memory_of(device(model_of(name)))
    memory.mode = mode
    decoded = ds.PACKETS[model_of(name)].in_frame(frame)[0][0]
    assert decoded is not None
    obeyed = memory.obey(decoded)
    assert [type(each) for each in obeyed] == [type(each) for each in does]
    for one, other in zip(obeyed, does, strict=True):
        number = [getattr(each, f, 0.0) for each in (one, other) for f in ("velocity", "torque", "position")]
        assert number[:3] == pytest.approx(number[3:])
    assert ds.ALL.read_only(frame) == (message in ("query", "id query"))
    another = memory_of(device(model_of(name), 9))
    assert bool(another.obey(decoded)) == (message == "set id")


def test_what_a_motor_answers() -> None:
    frame = VECTORS["reply_to_0x64_id1"].frame
    assert isinstance(frame, bytes)
    values = ds.read("DDSM115", ds.DRIVE, frame)
    assert values == {"mode": 2, "current": 4096, "speed": -50, "angle": 16384, "error": 0}
    assert ds.answer("DDSM115", 0x64, 1, **values) == frame
    meaning = VECTORS["reply_to_0x64_id1"].meaning
    assert values["current"] * ds.AMPERE == pytest.approx(meaning["current_a"])
    assert math.degrees(values["angle"] * ds.ANGLE) == pytest.approx(meaning["position_deg"])
    (feedback,) = [e for e in plugin.driver([device()]).receive(0, frame) if isinstance(e, Feedback)]
    assert feedback.velocity == pytest.approx(-50 * math.pi / 30)
    assert feedback.position is None  # nobody has asked: it may be °C and a coarse angle


@pytest.mark.parametrize(
    ("model", "function", "numbers"),
    [
        (
            "DDSM115",
            0x74,
            {"mode": 1, "current": -3, "speed": 7, "temperature": 41, "coarse": 255, "error": 16},
        ),
        ("DDSM210", 0x64, {"speed": -2100, "current": 99, "temperature": 35, "error": 0}),
        ("DDSM210", 0x74, {"mileage": -5, "angle": 32767, "error": 8}),
    ],
)
def test_other_answers_there_and_back(model: str, function: int, numbers: dict[str, int]) -> None:
    assert ds.read(model, function, ds.answer(model, function, 3, **numbers)) == numbers


def test_the_checksum_is_crcchecks() -> None:
    rng = random.Random(26)
    for _ in range(2000):
        data = rng.randbytes(rng.randrange(20))
        assert CRC8_MAXIM(data) == Crc8Maxim.calc(data)


def test_an_answer_is_found_behind_noise_and_an_echo_and_never_for_another() -> None:
    asked, other = ds.encode("query", 1), ds.encode("query", 2)
    answer = ds.answer("DDSM115", 0x74, 1, mode=2, current=0, speed=0, temperature=30, coarse=0, error=0)
    finds = ds.FINDS["DDSM115"]
    for before in (b"", asked, b"\x01\x02", b"\x00" * 7, answer[:6]):
        assert finds(asked, before + answer + b"\xff") == (len(before), len(before) + ds.SIZE)
        assert finds(other, before + answer) is None
        assert finds(ds.encode("id query"), before + answer) == (len(before), len(before) + ds.SIZE)
    for bit in range(8 * ds.SIZE):
        wrong = bytearray(answer)
        wrong[bit // 8] ^= 1 << bit % 8
        assert finds(asked, bytes(wrong)) is None


def test_an_id_is_taken_when_it_came_five_times_in_a_row() -> None:
    memory = memory_of(device())
    new, between = ds.encode("set id", id=7), ds.encode("query", 1)
    for frame in (*4 * (new,), between, *5 * (new,)):
        assert memory.address == 1
        decoded = ds.ALL.in_frame(frame)[0][0]
        assert decoded is not None
        memory.obey(decoded)
    assert memory.address == 7


def test_commands_are_found_in_a_stream_however_it_is_cut() -> None:
    frames = [vector.frame for vector in VECTORS.values() if vector.direction == "to_device"]
    line = b"\x00\x17".join(frame for frame in frames if isinstance(frame, bytes))
    for size in (1, 3, 10, 1000):
        stream = Stream(ds.ALL.framing)
        cut = [line[at : at + size] for at in range(0, len(line), size)]
        found = [message for piece in cut for message in stream.messages(piece)]
        assert [ds.ALL.framing.frame(message) for message in found] == frames


def test_turns_are_counted_and_an_answer_to_another_question_moves_nothing() -> None:
    """Three turns at 200 rpm in steps of 10 ms, every seventh answer lost; then a late answer to `drive` is
    read as one to a query, whose °C and coarse angle stand where the angle is."""
    options, motor = Options(), Motor()
    speed, position = 200 * math.pi / 30, 0.0
    for step in range(90):
        position = speed * 0.01 * step
        angle = round(position % math.tau / ds.ANGLE)
        values = {"mode": 2, "current": 0, "speed": 200, "angle": angle, "error": 0}
        if step % 7:
            motor.see(step * 10 * MILLISECOND, values, options)
    assert motor.shaft.position == pytest.approx(position, abs=0.01)
    late = ds.answer("DDSM115", 0x64, 1, mode=2, current=0, speed=0, angle=0x1E80, error=0)
    still, doubted, positions = values | {"speed": 0}, list[bool](), list[float | None]()
    for step, seen in enumerate((still, ds.read("DDSM115", ds.QUERY, late), still), 90):
        motor.see(step * 10 * MILLISECOND, seen, options)
        doubted.append(motor.shaft.doubtful)
        positions.append(motor.shaft.position)
    assert doubted == [False, True, False]
    assert positions == pytest.approx([positions[0]] * 3, abs=0.01)
