"""The ear alone: what each frame would make a device do, and that it agrees with the twin."""

from __future__ import annotations

from math import tau

import numpy as np
import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Request
from protocols.moteus import plugin
from protocols.moteus.codec import F32, INT8, REPLY, Query, Values, command_id, encode, make_frame, write
from protocols.moteus.decoder import MoteusDecoder
from protocols.moteus.messages import (
    DISCOVER,
    STOP,
    Limits,
    console,
    masked,
    position_command,
    torque_command,
)
from protocols.moteus.options import Options, Settings, serial_of
from protocols.moteus.registers import Mode, Register
from protocols.moteus.twin import MoteusTwin
from protocols.reference_vectors import vectors_of
from tests.protocols.moteus.helpers import device, rev

UUID = "0123456789abcdeffedcba9876543210"
KT = 8.27 / 304
LIMITS = Limits(0.1)


def handle(data: bytes, to: int = 1, settings: Settings | None = None) -> list[Command | Request]:
    return list(MoteusDecoder([device(settings=settings)]).decode(0, make_frame(command_id(to), data)))


def mode(value: Mode, *rest: bytes) -> bytes:
    return write(Register.MODE, float(value), resolution=INT8) + b"".join(rest)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (STOP, [msg.Idle("left")]),
        (position_command(0.5, 0.25, -0.5, LIMITS), [msg.Position("left", rev(0.5), rev(0.25), -0.5)]),
        (position_command(None, 0.25, 0.125, LIMITS), [msg.Velocity("left", rev(0.25), 0.125)]),
        (torque_command(7.0, 0.25, LIMITS), [msg.Torque("left", 0.25)]),
        (torque_command(7.0, 0.25, Limits(0.1, 1.0, 2.0, 3.0)), [msg.Torque("left", 0.25)]),
        (mode(Mode.POSITION), [msg.Position("left", 0.0, 0.0, 0.0)]),
        (mode(Mode.POSITION, write(0x20, None), write(0x23, 0.0)), [msg.Velocity("left", 0.0, 0.0)]),
        # a stop position and a limit together: fault 45, no torque; a negative limit is none
        (mode(Mode.POSITION, write(0x20, 0.5), write(0x26, 0.25), write(0x28, 1.0)), [msg.Idle("left")]),
        (mode(Mode.POSITION, write(0x20, 0.5), write(0x26, 0.25), write(0x29, 0.0)), [msg.Idle("left")]),
        (
            mode(Mode.POSITION, write(0x20, 0.5), write(0x26, 0.25), write(0x28, -1.0)),
            [msg.Position("left", rev(0.5), 0.0, 0.0)],
        ),
        (mode(Mode.CURRENT, write(0x1C, 2.0)), [msg.Torque("left", 2.0 * KT)]),
        (mode(Mode.BRAKE), [msg.Velocity("left", 0.0)]),
        (mode(Mode.ZERO_VELOCITY), [msg.Velocity("left", 0.0)]),
        (mode(Mode.STAY_WITHIN, write(0x40, -1.0, 1.0), write(0x42, 0.5)), [msg.Torque("left", 0.5)]),
        (mode(Mode.VOLTAGE_FOC), [msg.WriteParameter("left", "mode", 7.0)]),
        (mode(Mode.FAULT), []),
        (write(0x20, 1.0), []),
        (write(Register.POSITION, 1.0), []),
        (encode(Query(0, F32, 3)), []),
        (encode(Values(REPLY, 0, INT8, (0,))), []),
        (write(Register.SET_OUTPUT_EXACT, 0.0), [msg.Zero("left")]),
        (write(Register.SET_OUTPUT_NEAREST, 0.5), [msg.WriteParameter("left", "set_output_nearest", 0.5)]),
        (write(Register.SET_OUTPUT_EXACT, None), []),
        (write(Register.REQUIRE_REINDEX, 1.0), [msg.WriteParameter("left", "require_reindex", 1.0)]),
        (console("conf set id.id 9"), [msg.SetId("", serial_of(bytes.fromhex(UUID)), 9)]),
        (console("conf write"), [msg.WriteParameter("left", "conf_write", 1.0)]),
        (console("conf set servo.max_current_A 3"), []),
        (STOP + write(Register.SET_OUTPUT_EXACT, 0.0), [msg.Idle("left"), msg.Zero("left")]),
        (b"", []),
        (b"\x60\x01\x00\x00", []),
        (b"\x50" + STOP, [msg.Idle("left")]),
    ],
)
def test_what_a_frame_makes_a_device_do(data: bytes, words: list[Command | Request]) -> None:
    assert handle(data, settings=Settings(uuid=UUID)) == words


def test_two_commands_in_a_frame_are_one() -> None:
    assert handle(position_command(0.5, 0.0, 0.0, LIMITS) + STOP) == [msg.Idle("left")]


def test_who_is_addressed() -> None:
    decoder = MoteusDecoder(
        [device("left", 1), device("right", 2), device("far", 2, options=Options(can_prefix=3))]
    )
    assert decoder.decode(0, make_frame(command_id(2), STOP)) == [msg.Idle("right")]
    assert decoder.decode(0, make_frame(command_id(2, 5, 3), STOP)) == [msg.Idle("far")]
    assert decoder.decode(0, make_frame(command_id(0x7F), STOP)) == [msg.Idle("left"), msg.Idle("right")]
    assert decoder.decode(0, make_frame(2, STOP)) == [msg.Idle("right")]
    assert decoder.decode(0, CanFrame(2, STOP, extended=True)) == [msg.Idle("right")]
    for frame in (b"\x01\x00\x00", CanFrame(0x82, STOP, fd=True), CanFrame(2, b"", remote=True)):
        assert decoder.decode(0, frame) == []


def test_a_mask_chooses_by_uuid() -> None:
    decoder = MoteusDecoder(
        [device("left", 1, Settings(uuid=UUID)), device("right", 2, Settings(uuid="f" * 32))]
    )
    uuid = bytes.fromhex(UUID)
    assert decoder.decode(0, make_frame(0x7F, masked(uuid[:8], STOP))) == [msg.Idle("left")]
    assert decoder.decode(0, make_frame(0x7F, masked(uuid, console("conf set id.id 9")))) == [
        msg.SetId("", serial_of(uuid), 9)
    ]
    assert decoder.decode(0, make_frame(9, STOP)) == [msg.Idle("left")]
    assert decoder.decode(0, make_frame(1, STOP)) == []


def test_an_ear_without_uuids_tells_what_one_of_them_would_do() -> None:
    decoder = MoteusDecoder([device("left", 1)])
    uuid = bytes.fromhex(UUID)
    assert decoder.decode(0, make_frame(0x7F, masked(uuid[:8], console("conf set id.id 9")))) == [
        msg.SetId("", serial_of(uuid), 9)
    ]
    assert decoder.decode(0, make_frame(0x7F, masked(uuid[:8], DISCOVER))) == []
    assert decoder.decode(0, make_frame(1, STOP)) == [msg.Idle("left")]  # whose id it was, is not known


def test_a_console_line_may_come_in_pieces() -> None:
    decoder = MoteusDecoder([device(settings=Settings(uuid=UUID))])
    line = b"conf set id.id 7\n"
    pieces = [make_frame(1, b"\x40\x01" + bytes((len(p),)) + p) for p in (line[:7], line[7:])]
    assert [len(decoder.decode(0, piece)) for piece in pieces] == [0, 1]
    assert decoder.decode(0, make_frame(7, b"\x40\x02\x05conf\n" + STOP)) == [msg.Idle("left")]


def test_vectors_of_commands_are_heard_as_they_are_meant() -> None:
    received = {
        vector.name: MoteusDecoder([device(address=5)]).decode(0, vector.frame)
        for vector in vectors_of(plugin)
        if vector.direction == "to_device"
    }
    (position,) = received["position_0.5rev_vel0.2_tq1.5_query"]
    assert isinstance(position, msg.Position)
    assert (position.position, position.velocity) == pytest.approx((0.5 * tau, 0.2 * tau))
    (push_,) = received["current_q2A"]
    assert isinstance(push_, msg.Torque)
    assert push_.torque == pytest.approx(2.0 * KT)
    (left_on,) = received["torque_only_kp0_kd0_ff0.3"]
    assert isinstance(left_on, msg.Velocity)
    assert left_on.torque == pytest.approx(0.3)
    assert received["stop_no_reply"] == [msg.Idle("left")]
    assert received["brake"] == [msg.Velocity("left", 0.0)]
    assert received["rezero_nearest_0"] == [msg.Zero("left")]
    assert received["query_default"] == []
    assert received["discover_broadcast_0x7f"] == []


def test_ear_and_twin_hear_the_same_registers() -> None:
    """Random frames of random registers: the command that the ear has is the one that the firmware runs."""
    generator = np.random.Generator(np.random.PCG64(3))
    for _ in range(200):
        decoder, twin = MoteusDecoder([device()]), MoteusTwin(device(), 0)
        twin.step(0, [msg.Feedback("left", 0, 0.0, 0.0)])
        frame = make_frame(command_id(1), _random_frame(generator))
        words = decoder.decode(MILLISECOND, frame)
        twin.receive(MILLISECOND, frame)
        assert repr(decoder.states[0].command) == repr(twin.state.command)
        assert decoder.states[0].mode == twin.state.mode
        if any(isinstance(word, Command) for word in words):
            assert repr(twin.servo.command) == repr(decoder.states[0].command)
            assert twin.servo.commanded_mode == decoder.states[0].mode


def _random_frame(generator: np.random.Generator) -> bytes:
    data = b""
    for _ in range(int(generator.integers(1, 4))):
        start = int(generator.choice([0, 0, 0x1C, 0x20, 0x23, 0x27, 0x40, 0x42, 0x130, 0x3F0]))
        values = [float(np.float32(v)) for v in generator.uniform(-9, 16, int(generator.integers(1, 4)))]
        data += write(start, *values, resolution=int(generator.integers(4)))
    return data[: int(generator.integers(len(data) // 2, min(len(data), 64) + 1))]
