"""What a device obeys and replies, register by register; decoder and twin hold the same registers."""

from __future__ import annotations

from math import tau

import numpy as np
import pytest

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Obeyed, Request
from protocols.moteus.codec import write
from protocols.moteus.decoder import MoteusDecoder
from protocols.moteus.messages import names
from protocols.moteus.options import Options, Settings, serial_of
from protocols.moteus.twin import MoteusTwin
from tests.protocols.moteus.from_package import UUID
from tests.protocols.moteus.helpers import device, frame, obeyed

KT = 8.27 / 304
SERIAL = serial_of(UUID)


def parameter(name: str, value: float) -> msg.WriteParameter:
    return msg.WriteParameter("m", name, value)


def line(text: str) -> str:
    """A console's line, as bytes of a frame."""
    return f"4001{len(text) + 1:02x}" + text.encode("ascii").hex() + "0a"


OBEYED: list[tuple[str, list[Command | Request], tuple[str, ...]]] = [
    # data → what a device would do (but for Arm: see `obeyed`), and the names of its messages
    ("010000", [msg.Idle("m")], ("stop",)),
    ("0d0000000000", [msg.Idle("m")], ("stop",)),
    ("05000a00", [msg.Position("m", 0.0)], ("position",)),
    ("09000a000000", [msg.Position("m", 0.0)], ("position",)),
    ("0d0000002041", [msg.Position("m", 0.0)], ("position",)),
    ("01000a" + "0d20" + "0000003f", [msg.Position("m", 0.5 * tau)], ("position 020",)),
    ("01000a" + "0120" + "32", [msg.Position("m", 0.5 * tau)], ("position 020",)),
    ("01000a" + "0520" + "8813", [msg.Position("m", 0.5 * tau)], ("position 020",)),
    ("01000a" + "0920" + "50c30000", [msg.Position("m", 0.5 * tau)], ("position 020",)),
    ("01000a" + "0120" + "80", [msg.Velocity("m", 0.0)], ("velocity 020",)),
    ("01000a" + "0520" + "0080", [msg.Velocity("m", 0.0)], ("velocity 020",)),
    ("01000a" + "0920" + "00000080", [msg.Velocity("m", 0.0)], ("velocity 020",)),
    ("01000a" + "0d20" + "0000807f", [msg.Velocity("m", 0.0)], ("velocity 020",)),
    ("01000a" + "0e20" + "0000003f" + "0000c07f", [msg.Position("m", 0.5 * tau)], ("position 020 021",)),
    ("01000a" + "0d22" + "0000c07f", [msg.Position("m", 0.0)], ("position 022",)),
    ("01000a" + "0d22" + "0000803f", [msg.Position("m", 0.0, 0.0, 1.0)], ("position 022",)),
    ("01000a" + "0d42" + "0000803f", [msg.Position("m", 0.0, 0.0, 1.0)], ("position 042",)),
    ("01000a" + "0d23" + "00000000", [msg.Position("m", 0.0)], ("position 023",)),
    ("01000a" + "0d24" + "00000000", [msg.Position("m", 0.0)], ("position 024",)),
    ("01000a" + "0e23" + "00000000" + "00000000", [msg.Position("m", 0.0)], ("torque 023 024",)),
    ("01000a0e23" + "00000000" * 2 + "0d2b00000000", [msg.Torque("m", 0.0)], ("torque 023 024 02B",)),
    ("01000a" + "0d2b" + "00000000", [msg.Position("m", 0.0)], ("position 02B",)),
    ("01000a" + "0e23" + "00000000" + "0000803f", [msg.Position("m", 0.0)], ("position 023 024",)),
    ("01000a" + "0e23" + "0000803f" + "00000000", [msg.Position("m", 0.0)], ("position 023 024",)),
    ("01000a" + "0e43" + "00000000" + "00000000", [msg.Position("m", 0.0)], ("position 043 044",)),
    ("01000a0e43" + "00000000" * 2 + "0d4700000000", [msg.Torque("m", 0.0)], ("position 043 044 047",)),
    ("01000a" + "0d20" + "0000003f" + "01000a", [msg.Position("m", 0.0)], ("position 020",)),
    ("0d20" + "0000003f" + "01000a", [msg.Position("m", 0.0)], ("position 020",)),
    ("01000a0d200000003f" + "010000", [msg.Idle("m")], ("stop 020",)),
    # a stop position and a limit together: fault 45, no torque; a negative limit is none
    ("01000a0d200000003f0d260000803e0d280000803f", [msg.Idle("m")], ("position 020 026 028",)),
    ("01000a0d200000003f0d260000803e0d2900000000", [msg.Idle("m")], ("position 020 026 029",)),
    ("01000a0d200000003f0d260000803e0d28000080bf", [msg.Position("m", 0.5 * tau)], ("position 020 026 028",)),
    ("010009" + "0d1c" + "00000040", [msg.Torque("m", 2.0 * KT)], ("current 01C",)),
    ("010009", [msg.Torque("m", 0.0)], ("current",)),
    ("010009" + "0d1c" + "0000c07f", [msg.Torque("m", 0.0)], ("current 01C",)),
    ("01000c", [msg.Velocity("m", 0.0)], ("zero velocity",)),
    ("01000f", [msg.Velocity("m", 0.0)], ("brake",)),
    ("01000d" + "0d42" + "0000003f", [msg.Torque("m", 0.5)], ("stay within 042",)),
    ("01000d" + "0d22" + "0000003f", [msg.Torque("m", 0.5)], ("stay within 022",)),
    ("010005", [parameter("mode", 5.0)], ("pwm",)),
    ("010006", [parameter("mode", 6.0)], ("voltage",)),
    ("010007", [parameter("mode", 7.0)], ("voltage foc",)),
    ("010008", [parameter("mode", 8.0)], ("voltage dq",)),
    ("01000e", [parameter("mode", 14.0)], ("measure ind",)),
    ("010001", [], ("fault",)),
    ("010002", [], ("enabling",)),
    ("010003", [], ("calibrating",)),
    ("010004", [], ("calibration complete",)),
    ("01000b", [], ("timeout",)),
    ("010010", [], ("mode 16",)),
    ("0100ff", [], ("mode -1",)),
    ("010080", [], ("stop",)),  # "not given"
    ("0d20" + "0000003f", [], ("write 020",)),
    ("0d01" + "0000003f", [], ("write 001",)),
    ("0db002" + "00000000", [msg.Zero("m")], ("write 130",)),
    ("0db102" + "00000000", [msg.Zero("m")], ("write 131",)),
    ("0db102" + "5f708930", [msg.Zero("m")], ("write 131",)),  # just less than 1e-9
    ("0db102" + "5f7089b0", [msg.Zero("m")], ("write 131",)),
    ("0db102" + "ad708930", [parameter("set_output_exact", 1.0000070e-09)], ("write 131",)),
    ("0db102" + "0000c0bf", [parameter("set_output_exact", -1.5)], ("write 131",)),
    ("0db002" + "0000c0bf", [parameter("set_output_nearest", -1.5)], ("write 130",)),
    ("0db002" + "0000c07f", [], ("write 130",)),
    ("0db102" + "0000c07f", [], ("write 131",)),
    ("01b20201", [parameter("require_reindex", 1.0)], ("write 132",)),
    ("01b20280", [parameter("require_reindex", 0.0)], ("write 132",)),
    ("01b30202", [parameter("recapture_position_velocity", 2.0)], ("write 133",)),
    ("0eb102000000000000803f", [msg.Zero("m"), parameter("require_reindex", 1.0)], ("write 131 132",)),
    ("010000" + "0db102" + "00000000", [msg.Idle("m"), msg.Zero("m")], ("stop 131",)),
    ("0db102" + "00000000" + "010000", [msg.Idle("m"), msg.Zero("m")], ("stop 131",)),
    ("11001f0111", [], ()),  # cut off
    ("11001f01110f", [], ("read",)),
    ("210000", [], ()),
    ("420130", [], ("console: read",)),
    ("410101" + "0a", [], ("console: read",)),
    (line("conf write"), [parameter("conf_write", 1.0)], ("console: conf write",)),
    (line("conf write x"), [], ("console: conf write",)),
    (line("conf get id.id"), [], ("console: conf get",)),
    (line("conf set id.id 9"), [msg.SetId("", SERIAL, 9)], ("console: conf set id.id",)),
    (line("  conf   set id.id 9 "), [msg.SetId("", SERIAL, 9)], ("console: conf set id.id",)),
    (line("conf set id.id 1"), [msg.SetId("", SERIAL, 1)], ("console: conf set id.id",)),
    (line("conf set id.id 126"), [msg.SetId("", SERIAL, 126)], ("console: conf set id.id",)),
    (line("conf set id.id 0"), [], ("console: conf set id.id",)),
    (line("conf set id.id 127"), [], ("console: conf set id.id",)),
    (line("conf set id.id x"), [], ("console: conf set id.id",)),
    (line("conf set id.id"), [], ("console: conf set id.id",)),
    (line("conf set id.id 9 9"), [], ("console: conf set id.id",)),
    (line("conf set can.prefix 9"), [], ("console: conf set can.prefix",)),
    (line("tel stop"), [], ("console: tel stop",)),
    ("40020b" + b"conf write\n".hex(), [], ("console: conf write",)),  # another channel
    (
        line("conf write\rconf set id.id 9"),
        [parameter("conf_write", 1.0), msg.SetId("", SERIAL, 9)],
        ("console: conf write",),
    ),
    (line("conf set id.id 9") + line("conf write"), [msg.SetId("", SERIAL, 9), parameter("conf_write", 1.0)],
     ("console: conf set id.id", "console: conf write")),
    (
        "010000" + line("conf write") + "0db102" + "00000000",
        [msg.Idle("m"), parameter("conf_write", 1.0), msg.Zero("m")],
        ("stop 131", "console: conf write"),
    ),
    ("010000" + "60", [msg.Idle("m")], ()),  # what stands before the flaw is obeyed
    ("010000" + "0d200000", [msg.Idle("m")], ()),
    ("01000a" + "0e20" + "0000003f" + "0000", [msg.Position("m", 0.5 * tau)], ()),
    ("60" + "010000", [], ()),
    ("50" + "010000" + "5050", [msg.Idle("m")], ("stop",)),
    ("210000" + "010000", [msg.Idle("m")], ()),
    (
        "0db102" + "00000000" + line("conf write"),
        [msg.Zero("m"), parameter("conf_write", 1.0)],
        ("write 131", "console: conf write"),
    ),
]  # fmt: skip


@pytest.mark.parametrize(("data", "messages", "named"), OBEYED, ids=[row[0] for row in OBEYED])
def test_what_a_device_obeys(data: str, messages: list[Command | Request], named: tuple[str, ...]) -> None:
    for identifier in (5, 0x8005, 0x8305, 0x7F):
        decoder = MoteusDecoder([device("m", 5, Settings(uuid=UUID.hex()))])
        received = decoder.decode(0, frame(data, identifier))
        assert [_texts(message) for message in received] == [_texts(message) for message in obeyed(messages)]
        expected = [number for message in messages for number in _numbers(message)]
        reported = [number for message in received for number in _numbers(message)]
        assert reported == pytest.approx(expected, rel=1e-6, abs=1e-12)
        assert names(frame(data, identifier)) == named


def _values(message: Obeyed) -> list[str | float]:
    return [getattr(message, name) for name in message.__slots__]


def _texts(message: Obeyed) -> list[str]:
    return [type(message).__name__, *(value for value in _values(message) if isinstance(value, str))]


def _numbers(message: Obeyed) -> list[float]:
    return [value for value in _values(message) if not isinstance(value, str)]


OTHERS: list[Frame] = [
    bytes.fromhex("010000"),
    CanFrame(5, bytes.fromhex("010000"), False, True, True),
    frame("010000", 6),
    frame("010000", 0x85),
    frame("010000", 0x0500),
    frame("010000", 0x1_0005),
    frame("010000", 0x1ABC_8005),
]


@pytest.mark.parametrize("frame", OTHERS, ids=str)
def test_frames_to_others(frame: Frame) -> None:
    decoder = MoteusDecoder([device("m", 5)])
    assert decoder.decode(0, frame) == []


def test_who_obeys() -> None:
    far = device("far", 5, options=Options(can_prefix=0x1ABC))
    decoder = MoteusDecoder([device("m", 5), device("n", 6), far])
    assert decoder.decode(0, frame("010000", 0x7F)) == [msg.Idle("m"), msg.Idle("n")]
    assert decoder.decode(0, frame("010000", 0x1ABC_807F)) == [msg.Idle("far")]
    assert decoder.decode(0, CanFrame(6, bytes.fromhex("010000"), True, False, False)) == [msg.Idle("n")]


def test_pieces_of_a_console_line() -> None:
    whole = b"x" * 300 + b"\nconf write\r\nconf set id.id 7\n"
    decoder = MoteusDecoder([device("m", 5, Settings(uuid=UUID.hex()))])
    received = [w for byte in whole for w in decoder.decode(0, frame(f"400101{byte:02x}", 5))]
    assert received == [parameter("conf_write", 1.0), msg.SetId("", SERIAL, 7)]
    assert decoder.decode(0, frame("010000", 5)) == []
    assert decoder.decode(0, frame("010000", 7)) == [msg.Idle("m")]
    long = b"conf write" + b" " * 246 + b"conf write"
    again = [w for byte in long for w in decoder.decode(0, frame(f"400101{byte:02x}", 7))]
    assert again == []
    assert decoder.decode(0, frame("4001010a", 7)) == [parameter("conf_write", 1.0)]  # of 256 bytes, the last


MASK = "0ad402" + UUID[:8].hex()
"""The first half of a UUID, as two int32."""


@pytest.mark.parametrize(
    ("data", "messages"),
    [
        (MASK + "010000", [msg.Idle("m")]),
        ("09d402" + UUID[:4].hex() + "010000", [msg.Idle("m")]),
        ("09d702" + UUID[12:].hex() + "010000", [msg.Idle("m")]),
        ("0804d402" + UUID.hex() + "010000", [msg.Idle("m")]),
        ("0ad602" + UUID[8:].hex() + "010000", [msg.Idle("m")]),
        ("0ad402" + UUID[:4].hex() + "ffffffff" + "010000", []),
        ("09d702" + "ffffffff" + "010000", []),
        ("010000" + "09d702" + "ffffffff" + "0db102" + "00000000", [msg.Idle("m")]),  # up to the mask
        ("0dd402" + "00000000" + "010000", []),  # a mask is int32
        ("01d402" + "01" + "010000", []),
        ("09d302" + "ffffffff" + "010000", [msg.Idle("m")]),
        ("09d802" + "ffffffff" + "010000", [msg.Idle("m")]),
        (MASK + line("conf set id.id 9"), [msg.SetId("", SERIAL, 9)]),
    ],
)
def test_masks_of_uuids(data: str, messages: list[Command | Request]) -> None:
    decoder = MoteusDecoder(
        [device("m", 5, Settings(uuid=UUID.hex())), device("n", 6, Settings(uuid="f" * 32))]
    )
    assert [
        message for message in decoder.decode(0, frame(data, 0x7F)) if "n" not in _texts(message)
    ] == messages


@pytest.mark.parametrize(
    ("data", "messages"),
    [
        (MASK + line("conf set id.id 9"), [msg.SetId("", SERIAL, 9)]),
        ("09d402" + UUID[:4].hex() + line("conf set id.id 9"), [msg.SetId("", SERIAL >> 32 << 32, 9)]),
        ("0804d402" + UUID.hex() + line("conf set id.id 9"), [msg.SetId("", SERIAL, 9)]),
        (MASK + line("conf set id.id 127"), []),
        (MASK + line("conf write"), [parameter("conf_write", 1.0)]),
        (line("conf set id.id 9"), [msg.SetId("", 0, 9)]),
    ],
)
def test_an_id_set_by_uuid_where_no_uuid_is_known(data: str, messages: list[Command | Request]) -> None:
    decoder = MoteusDecoder([device("m", 5)])
    assert decoder.decode(0, frame(data, 0x7F)) == messages
    renamed = 9 if not data.startswith(("0ad4", "09d4", "0804")) else 5
    assert decoder.decode(0, frame("010000", renamed)) == [msg.Idle("m")]


@pytest.mark.parametrize(
    ("data", "answer"),
    [
        # what is written to a device, and its write error: register, and 1 unknown, 2 read only, 3 bad value
        ("010001", "300003"),
        ("010002", "300003"),
        ("01000b", "300003"),
        ("010010", "300003"),
        ("010080", "300003"),
        ("0d0100000000", "300102"),
        ("0d0f00000000", "300f02"),
        ("0d900200000000", "30900202"),
        ("0d100000c07f", ""),
        ("0d3f00000000", "303f01"),
        ("0df03f00000000", "30f03f01"),
        ("0d6000000000", "306001"),
        ("0ad302000000000000000001b20201", "30d30202"),
        ("09d80200000000", "30d80202"),
        ("01b30201", ""),
        ("0d480000803f" + "1d48", "2d480000803f"),
        ("0d480000803f" + "1d2d", "2d2d0000803f"),
        ("0d420000803f" + "1d22", "2d220000803f"),
        ("0d430000003f" + "1d23", "2d230000003f"),
        ("0d440000003f" + "1d24", "2d240000003f"),
        ("0d450000003f" + "1d25", "2d250000003f"),
        ("0d460000003f" + "1d27", "2d270000003f"),
        ("0d470000003f" + "1d2b", "2d2b0000003f"),
        ("0d400000003f" + "1e40", "2e400000003f00000000"),
        ("1d24", "2d240000803f"),
        ("1d25", "2d250000c07f"),
        ("1d27", "2d2700000000"),
        ("0c0620" + "0000803f" * 6 + "01000a" + "1c0620",
         "2c0620" + "00000000" * 3 + "0000803f" * 2 + "0000c07f"),
        ("010000" + "1c0726", "2c0726" + "0000c07f" + "00000000" + "0000c07f" * 3 + "0000803f" + "0000c07f"),
        ("010000" + "1c0310" + "1c0314", "2f10" + "00000000" * 3 + "2f14" + "00000000" * 3),
        ("010000" + "1c0718", "2c0718" + "00000000" * 7),
    ],
)  # fmt: skip
def test_what_a_device_replies(data: str, answer: str) -> None:
    twin = MoteusTwin(device("m", 5, Settings(uuid="0" * 32)), 0)
    twin.step(0, [msg.Feedback("m", 0, 0.0, 0.0)])
    twin.receive(MILLISECOND, frame(data, 0x8005))
    _, (reply,) = twin.step(2 * MILLISECOND, [msg.Feedback("m", 0, 0.0, 0.0)])
    assert isinstance(reply, CanFrame)
    assert reply.data.rstrip(b"\x50") == bytes.fromhex(answer)
    assert reply.id == 0x500


def test_decoder_and_twin_hold_the_same_registers() -> None:
    """Random frames of random registers: the decoder has the command that the firmware runs."""
    generator = np.random.Generator(np.random.PCG64(3))
    for _ in range(200):
        decoder, twin = MoteusDecoder([device()]), MoteusTwin(device(), 0)
        twin.step(0, [msg.Feedback("left", 0, 0.0, 0.0)])
        sent = frame(_random_data(generator).hex(), 0x8001)
        messages = decoder.decode(MILLISECOND, sent)
        twin.receive(MILLISECOND, sent)
        assert repr(decoder.states[0].command) == repr(twin.state.command)
        assert decoder.states[0].mode == twin.state.mode
        if any(isinstance(message, Command) for message in messages):
            assert repr(twin.servo.command) == repr(decoder.states[0].command)
            assert twin.servo.commanded_mode == decoder.states[0].mode


def _random_data(generator: np.random.Generator) -> bytes:
    data = b""
    for _ in range(int(generator.integers(1, 4))):
        start = int(generator.choice([0, 0, 0x1C, 0x20, 0x23, 0x27, 0x40, 0x42, 0x130, 0x3F0]))
        values = [float(np.float32(v)) for v in generator.uniform(-9, 16, int(generator.integers(1, 4)))]
        data += write(start, *values, resolution=int(generator.integers(4)))
    return data[: int(generator.integers(len(data) // 2, min(len(data), 64) + 1))]
