"""Values ↔ bytes, both ways: those of the vendor's SDK."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.roboclaw import plugin
from protocols.roboclaw import table as rt
from protocols.roboclaw.options import Options, Settings
from protocols.toolkit.table import Values

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
SENT: dict[str, tuple[str, Values]] = {
    "duty_m1_-16384": ("M1DUTY", {"duty": -16384}),
    "speed_m1_-2500qpps": ("M1SPEED", {"speed": -2500}),
    "speed_m1m2": ("MIXEDSPEED", {"speed1": 1000, "speed2": -1000}),
    "speed_accel_m1": ("M1SPEEDACCEL", {"accel": 12000, "speed": 3000}),
    "position_full_m1": (
        "M1SPEEDACCELDECCELPOS",
        {"accel": 1000, "speed": 2000, "deccel": 1000, "position": -4096, "buffer": 1},
    ),
    "position_m1_cmd119": ("M1POS", {"position": 8192, "buffer": 0}),
    "duty_accel_m1": ("M1DUTYACCEL", {"duty": 8192, "accel": 1000}),
    "set_timeout_1.0s": ("SETTIMEOUT", {"timeout": 10}),
    "reset_encoders": ("RESETENC", {}),
}
"""What is acknowledged: message and numbers."""
ASKED: dict[str, tuple[str, Values]] = {
    "read_enc_m1": ("GETM1ENC", {"count": (1 << 32) - 12345, "status": 130}),
    "read_encoders_78": ("GETENCODERS", {"count1": (1 << 32) - 12345, "count2": 67890}),
    "read_speed_m1": ("GETM1SPEED", {"speed": -2500, "backwards": 1}),
    "read_main_batt": ("GETMBATT", {"voltage": 24.3}),
    "read_currents": ("GETCURRENTS", {"current1": 1.25, "current2": -3.0}),
    "read_pwms": ("GETPWMS", {"duty1": -16384, "duty2": 8192}),
    "read_temp": ("GETTEMP", {"temperature": 36.5}),
    "read_error": ("GETERROR", {"status": 0x11002}),
    "read_m1_velocity_pid": (
        "READM1PID",
        {"velocity_p": 98304, "velocity_i": 32768, "velocity_d": 16384, "qpps": 44000},
    ),
}
"""What is answered: question, and the numbers of the answer."""


def bytes_of(name: str) -> bytes:
    """The bytes of a vector."""
    frame = VECTORS[name].frame
    assert isinstance(frame, bytes)
    return frame


def test_every_question_and_all_that_is_written_is_here() -> None:
    names = {*SENT, *ASKED, "read_version"}
    extra = {name for name in VECTORS if name.startswith("also_")}
    assert VECTORS.keys() == names | {f"{name}_reply" for name in names} | extra


@pytest.mark.parametrize("name", SENT)
def test_what_is_written(name: str) -> None:
    message, values = SENT[name]
    assert rt.PACKETS.encode(message, 0x80, **values) == bytes_of(name)
    assert rt.PACKETS.in_frame(bytes_of(name))[0] == [(message, 0x80, values)]
    assert rt.find_answer(bytes_of(name), bytes_of(f"{name}_reply")) == (0, 1)


@pytest.mark.parametrize("name", ASKED)
def test_what_is_asked(name: str) -> None:
    message, values = ASKED[name]
    question, answer = bytes_of(name), bytes_of(f"{name}_reply")
    assert rt.PACKETS.encode(message, 0x80) == question
    assert rt.answer(question, message, **values) == answer
    assert rt.find_answer(question, b"\x80\xff" + answer + b"\0") == (2, 2 + len(answer))
    told, numbers = rt.read_answer(question, answer)
    assert told == message
    assert numbers == pytest.approx(values)
    elsewhere = bytes((0x81,)) + question[1:]
    assert rt.find_answer(elsewhere, answer) is None  # its checksum covers whom it answers


@pytest.mark.parametrize("name", [name for name in VECTORS if name.startswith("also_")])
def test_what_else_the_sdk_sends_is_made_the_same_way(name: str) -> None:
    meaning = VECTORS[name].meaning
    assert rt.PACKETS.encode(meaning["name"], 0x80, **meaning["values"]) == bytes_of(name)


@pytest.mark.parametrize(
    ("name", "value", "share"),
    [
        *(("M1FORWARD", 32, 32 / 127), ("M1BACKWARD", 32, -32 / 127), ("M1FORWARD", 127, 1.0)),
        *(("M17BIT", 127, 1.0), ("M17BIT", 1, -1.0), ("M17BIT", 64, 0.0), ("M1BACKWARD", 0, 0.0)),
        *(("M2BACKWARD", 127, -1.0), ("M27BIT", 96, 32 / 63)),
    ],
)
def test_a_set_point_of_7_bits_is_a_duty(name: str, value: int, share: float) -> None:
    """The names, and "forward with 0 to 127", are the vendor's; 64 is the middle of the others."""
    left, right = (Device(name, at, Options(), Settings()) for name, at in (("left", 128), ("right", 136)))
    mine, other = (left, right) if name[1] == "1" else (right, left)
    (field,) = rt.PACKETS.row(name).fields
    sent = rt.PACKETS.encode(name, 0x80, **{field.name: value})
    same = rt.PACKETS.encode(f"M{name[1]}DUTY", 0x80, duty=round(share * rt.FULL))
    obeyed = [each for each in plugin.decoder([mine]).decode(0, sent) if not isinstance(each, msg.Kept)]
    alike = [each for each in plugin.decoder([mine]).decode(0, same) if not isinstance(each, msg.Kept)]
    assert obeyed == alike
    assert bool(share) == any(isinstance(each, msg.Arm) for each in obeyed)
    assert plugin.decoder([other]).decode(0, sent) == []
    twin = plugin.twin(mine, 0)
    twin.step(0, [])
    twin.receive(1, sent)
    (torque,), answers = twin.step(rt.GAP + 10 * msg.MILLISECOND, [])
    assert (torque.torque > 0.0, torque.torque < 0.0) == (share > 0.0, share < 0.0)
    assert list(answers) == [rt.ACK]


def test_the_version_is_a_text() -> None:
    question, answer = bytes_of("read_version"), bytes_of("read_version_reply")
    assert rt.version(question, "USB Roboclaw 2x15a v4.2.3\n") == answer
    assert rt.find_answer(question, b"\0\0" + answer) == (2, 2 + len(answer))
    assert rt.read_answer(question, answer)[1] == {"version": "USB Roboclaw 2x15a v4.2.3"}


@pytest.mark.parametrize(
    ("older", "faults1", "faults2", "warnings1"),
    [
        (0x0001, [], [], ["current"]),
        (0x0004, [rt.ESTOP], [rt.ESTOP], []),
        (0x0100, [rt.DRIVER], [], []),
        (0x0200, [], [rt.DRIVER], []),
        (0x0800, [], [], ["main battery low"]),
    ],
)
def test_the_status_of_older_firmware(
    older: int, faults1: list[int], faults2: list[int], warnings1: list[str]
) -> None:
    question = bytes_of("read_error")
    answer = rt.older_status(question, older)
    assert rt.find_answer(question, answer) == (0, 4)
    status = rt.read_answer(question, answer)[1]["status"]
    assert rt.of_side(status, 1) == (faults1, warnings1)
    assert rt.of_side(status, 2)[0] == faults2
    assert rt.older(status) == older
