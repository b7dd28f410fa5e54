"""Values ↔ bytes, both ways: those of damiao-motor 1.0.6, for a 4310."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest

from protocols.damiao import plugin
from protocols.damiao.table import MODELS, REGISTERS, register_in, table_of
from protocols.frames import CanFrame
from protocols.reference_vectors import Vector, vectors_of

TABLE = table_of("4310")
VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
MIT = {"position": 1.0, "velocity": -2.0, "stiffness": 50.0, "damping": 1.5, "torque": 3.0}
SENT: dict[str, tuple[str, dict[str, Any]]] = {
    "enable": ("enable", {}),
    "disable": ("disable", {}),
    "set_zero": ("zero", {}),
    "clear_error": ("clear", {}),
    "mit_p1_v-2_kp50_kd1.5_t3": ("MIT", MIT),
    "pos_vel_1.5rad_3": ("POS_VEL", {"position": 1.5, "fastest": 3.0}),
    "vel_-4": ("VEL", {"velocity": -4.0}),
    "force_pos": ("FORCE_POS", {"position": 0.75, "fastest": 5.0, "force": 0.5}),
    "read_reg_10": ("read", {"motor": 1, "number": 10, "value": 0}),
    "set_can_timeout_500ms": ("write", {"motor": 1, "number": 9, "value": 10000}),
    "store": ("save", {"motor": 1, "number": 1, "value": 0}),
    "request_feedback": ("refresh", {"motor": 1, "number": 0, "value": 0}),
}
RECEIVED = [name for name, v in VECTORS.items() if {"position_rad", "status"} <= v.meaning.keys()]


def test_no_vector_is_left_out() -> None:
    answers = {"read_reg_10_reply", "write_reg_10_vel_reply"}
    assert VECTORS.keys() == {*SENT, *RECEIVED, *answers}
    assert len(RECEIVED) >= 4


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends(name: str) -> None:
    message, values = SENT[name]
    frame = VECTORS[name].frame
    assert TABLE.encode(message, 1, **values) == frame
    decoded = TABLE.decode(frame, "to_device")
    assert decoded is not None
    assert decoded.name == message
    for field, value in values.items():
        assert decoded.values[field] == pytest.approx(value, abs=TABLE.row(message).field(field).step)


@pytest.mark.parametrize("name", RECEIVED)
def test_what_a_motor_reports(name: str) -> None:
    vector: Vector = VECTORS[name]
    assert isinstance(vector.frame, CanFrame)
    values = TABLE.read("feedback", vector.frame.data)
    assert values is not None
    package = vector.meaning["decoded"]
    assert values["status"] == package["status_code"]
    for field, theirs in {"position": "pos", "velocity": "vel", "torque": "torq", "mos": "t_mos"}.items():
        assert values[field] == pytest.approx(package[theirs], abs=1e-9)
    address = values.pop("motor")
    assert TABLE.encode("feedback", vector.frame.id, motor=address, **values) == vector.frame


def test_answers_about_registers() -> None:
    expected = {
        "read_reg_10_reply": ("CTRL_MODE", 1.0, False),
        "write_reg_10_vel_reply": ("CTRL_MODE", 3.0, True),
    }
    for name, content in expected.items():
        frame = VECTORS[name].frame
        assert isinstance(frame, CanFrame)
        assert register_in(frame) == content


def test_no_feedback_but_that_of_a_disabled_motor_at_one_end_looks_like_an_answer() -> None:
    alike = set()
    for status, high, low in product((0x0, 0x1, 0xA), range(256), (0x33, 0x55, 0xAA)):
        for velocity in (0x7F, 0x51):  # at rest; the number of a register
            frame = CanFrame(0x11, bytes((status << 4 | 1, high, low, velocity, 0xF8, 0x0E, 30, 30)))
            decoded = TABLE.decode(frame, "from_device")
            assert decoded is not None
            assert (register_in(frame)[0] != "") <= (decoded.name != "feedback")
            alike |= {(status, high)} if decoded.name != "feedback" else set()
    assert alike == {(0x0, 0x00)}


def test_models_and_registers_are_those_of_the_package() -> None:
    motor = pytest.importorskip("damiao_motor.core.motor")
    presets = {name: (p["p_max"], p["v_max"], p["t_max"]) for name, p in motor.MOTOR_TYPE_PRESETS.items()}
    assert presets == MODELS
    types = {"float": "f32", "uint32": "u32"}
    for number, register in REGISTERS.by_number.items():
        theirs = motor.REGISTER_TABLE[number]
        assert (theirs.variable, types[theirs.data_type]) == (register.name, register.type)
        assert theirs.access == "RW" or not register.writable
