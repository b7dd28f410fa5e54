"""What the vendor's bytes mean to our ear and our driver, in words: by name of the vector, in both
directions.

Rules. The words follow from each vector's `meaning` (turns, turns/s, ampere) and from the units of the words.
What a device makes of a set-point depends on its mode, so each is heard after the vectors that arm it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import pytest

from protocols.odrive_can import plugin
from protocols.odrive_can.options import Options, Settings
from protocols.plugin import Device
from protocols.vectors import Vector, vectors_of
from protocols.wire import CanFrame
from protocols.words import (
    MILLISECOND,
    ClearFault,
    Done,
    Estop,
    Fault,
    Feedback,
    Hold,
    Home,
    Idle,
    Mode,
    Position,
    Reboot,
    Request,
    SetId,
    State,
    Torque,
    Velocity,
    Word,
    WriteParameter,
    Zero,
)

BY_NAME: dict[str, Vector] = {vector.name: vector for vector in vectors_of(plugin)}
TURN = math.tau
SERIAL = 0x385F_3B72_0305
NOW = 5_000 * MILLISECOND
ARM = "set_axis_state_closed_loop"
POSITION, VELOCITY, TORQUE = (
    f"set_controller_mode_{m}_passthrough" for m in ("position", "velocity", "torque")
)


def wire(name: str) -> CanFrame:
    found = BY_NAME[name].wire
    assert isinstance(found, CanFrame)
    return found


def device(name: str, line: str, node: int | None = None) -> Device:
    """A device of a firmware line to which, or from which, a vector is."""
    options = Options(firmware="0.5" if line == "0.5" else "0.6")
    return Device("m", wire(name).id >> 5 if node is None else node, options, Settings(serial_number=SERIAL))


def alike(said: Sequence[Any], meant: Sequence[Word]) -> bool:
    """The same words, numbers to binary32."""
    return len(said) == len(meant) and all(map(_alike, said, meant))


def _alike(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for f in fields(b)]
    return all(math.isclose(x, y, rel_tol=1e-6) if type(y) is float else x == y for x, y in pairs)


def write(parameter: str, value: float) -> WriteParameter:
    return WriteParameter("m", parameter, value)


LIMITS = (write("Velocity_Limit", 10.0), write("Current_Limit", 20.0))
ACCELERATIONS = (write("Traj_Accel_Limit", 2.0), write("Traj_Decel_Limit", 3.0))
GAINS = (write("Vel_Gain", 0.16), write("Vel_Integrator_Gain", 0.32))
FEED = Position("m", 1.5 * TURN, 0.25 * TURN, -0.5)
EDGES = Position("m", -2.0 * TURN, 32.767 * TURN, -32.768)
BEYOND = Position("m", 0.5 * TURN, 0.128 * TURN, -0.129)

# Firmware line, the vectors that are heard before, the vector, the words that the ear hears in it.
HEARD: list[tuple[str, tuple[str, ...], str, tuple[Word, ...]]] = [
    ("", (), "set_input_pos_1.5turn_vff0.25_tff-0.5", ()),
    ("", (), "set_axis_state_idle", (Idle("m"),)),
    ("", (), ARM, (Velocity("m", 0.0),)),
    ("", (POSITION,), ARM, (Hold("m"),)),
    ("", (POSITION, ARM), "set_input_pos_1.5turn_vff0.25_tff-0.5", (FEED,)),
    ("", (POSITION, ARM), "set_input_pos_vff_edges", (EDGES,)),
    ("", (POSITION, ARM), "set_input_pos_vff_beyond_int8", (BEYOND,)),
    ("", (POSITION, ARM, "set_axis_state_idle"), "set_input_pos_vff_edges", ()),
    ("", (POSITION, ARM, "set_input_pos_vff_edges", "set_axis_state_idle"), ARM, (Hold("m"),)),
    ("", (POSITION, ARM, "set_input_pos_vff_edges", VELOCITY), POSITION, (Hold("m"),)),
    ("", (VELOCITY, ARM), "set_input_vel_-2.25tps_tff0.1", (Velocity("m", -2.25 * TURN, 0.1),)),
    ("", (TORQUE, ARM), "set_input_torque_0.75", (Torque("m", 0.75),)),
    ("", (TORQUE, ARM), VELOCITY, (Velocity("m", 0.0),)),
    ("", (ARM, "set_input_torque_0.75"), TORQUE, (Torque("m", 0.75),)),
    ("", (ARM, "set_input_vel_-2.25tps_tff0.1"), TORQUE, (Torque("m", 0.1),)),
    ("", (), "set_limits_10tps_20A", LIMITS),
    ("", (), "set_traj_vel_limit", (write("Traj_Vel_Limit", 5.0),)),
    ("", (), "set_traj_accel_limits", ACCELERATIONS),
    ("", (), "set_traj_inertia", (write("Traj_Inertia", 0.5),)),
    ("", (), "set_pos_gain", (write("Pos_Gain", 20.0),)),
    ("", (), "set_vel_gains", GAINS),
    ("", (), "rtr_get_bus_voltage_current", ()),
    ("", (), "clear_errors", (ClearFault("m"),)),
    ("", (), "reboot", (Reboot("m"),)),
    ("", (ARM,), "estop", (Estop("m"),)),
    ("", (ARM, "estop"), VELOCITY, ()),
    ("", (ARM, "reboot"), VELOCITY, ()),
    ("0.6", (ARM,), "enter_dfu_mode", (Reboot("m"),)),
    ("0.6", (), "set_absolute_position_1.25turn", (write("Position", 1.25 * TURN),)),
    ("0.6", (), "rxsdo_write_float_1.234", (write("endpoint 291", float(0x3F9DF3B6)),)),
    ("0.6", (ARM, "enter_dfu_mode"), VELOCITY, ()),
    ("0.5", (), "set_linear_count05", (write("Linear_Count", -8192.0),)),
    ("0.5", (), "set_axis_node_id05_5", (SetId("", SERIAL, 5),)),
    ("0.5", (), "clear_errors05", (ClearFault("m"),)),
    ("0.5", (ARM, "reboot05"), VELOCITY, ()),
    ("0.5", (), "start_anticogging05", (Home("m"),)),
    ("0.5", (), "ask_adc_voltage05_gpio3", ()),
    ("0.5", (), "rtr_get_motor_error05", ()),
]  # fmt: skip
LINES = [(line, *row[1:]) for row in HEARD for line in ([row[0]] if row[0] else ["0.6", "0.5"])]


@pytest.mark.parametrize(("line", "before", "name", "words"), LINES)
def test_what_the_ear_hears_in_a_vector(
    line: str, before: tuple[str, ...], name: str, words: tuple[Word, ...]
) -> None:
    ear = plugin.ear([device(name, line)])
    for each in before:
        ear.hear(0, CanFrame(wire(name).id & ~0x1F | wire(each).id & 0x1F, wire(each).data))
    assert alike(ear.hear(0, wire(name)), words)
    another = CanFrame(wire(name).id ^ 0x40, wire(name).data, remote=wire(name).remote)
    assert list(ear.hear(0, another)) == []  # it is for another node


def test_a_node_id_that_is_given_out_in_a_vector_is_taken_or_vacated() -> None:
    serial = int(BY_NAME["assign_node_id_5"].meaning["serial_number"])
    options, settings = Options(firmware="0.6"), Settings(serial_number=serial)
    taker, holder = Device("m", 3, options, settings), Device("h", 5, options, Settings(serial_number=SERIAL))
    ear = plugin.ear([taker, holder])
    words = ear.hear(0, wire("assign_node_id_5"))
    assert alike(words, [SetId("", serial, 5), SetId("", SERIAL, 63)])
    idle = wire("set_axis_state_idle")
    assert alike(ear.hear(0, CanFrame(5 << 5 | idle.id & 0x1F, idle.data)), [Idle("m")])
    assert list(ear.hear(0, CanFrame(3 << 5 | idle.id & 0x1F, idle.data))) == []
    assert list(ear.hear(0, wire("assign_node_id_5"))) == list(ear.hear(0, wire("assign_node_id_5")))


# -- the driver -----------------------------------------------------------------------------------------

WRITTEN: list[tuple[str, tuple[Request, ...]]] = [
    ("set_traj_vel_limit", (write("Traj_Vel_Limit", 5.0),)),
    ("set_traj_inertia", (write("Traj_Inertia", 0.5),)),
    ("set_pos_gain", (write("Pos_Gain", 20.0),)),
    ("set_limits_10tps_20A", LIMITS),
    ("set_traj_accel_limits", ACCELERATIONS),
    ("set_vel_gains", GAINS),
    ("clear_errors", (ClearFault("m"),)),
    ("reboot", (Reboot("m"),)),
    ("estop", (Estop("m"),)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "words"), WRITTEN)
def test_what_the_driver_says_is_the_vector(name: str, words: tuple[Request, ...]) -> None:
    driver = plugin.driver([device(name, "0.6")])
    identified(driver, name)
    said: list[Any] = []
    for at, word in enumerate(words):
        _, wires = driver.send(NOW + at * MILLISECOND, [word])
        said += wires
    assert wire(name) in said


def identified(driver: Any, name: str) -> None:
    """Let a driver hear that its device has firmware 0.6.10, and is idle."""
    node = wire(name).id & ~0x1F
    beat = wire("hb06_closed_loop_busy")
    idle = beat.data[:4] + b"\1" + beat.data[5:]
    driver.receive(NOW - 3, CanFrame(node, wire("get_version06").data))
    driver.receive(NOW - 2, CanFrame(node | beat.id & 0x1F, idle))


TOLD: list[tuple[str, str, tuple[type[Word], ...], dict[str, Any]]] = [
    ("0.6", "enc_estimates", (Feedback,), {"position": -12.375 * TURN, "velocity": 3.5 * TURN}),
    ("0.6", "get_iq", (Feedback,), {"current": 1.1875, "position": None}),
    ("0.6", "get_bus_vi", (Feedback,), {"voltage": 24.25, "current": None}),
    ("0.6", "hb06_watchdog_expired_disarmed", (Fault, State), {"code": 1 << 24, "mode": Mode.FAULT}),
]  # fmt: skip


@pytest.mark.parametrize(("line", "name", "kinds", "values"), TOLD)
def test_what_the_driver_tells_of_a_vector(
    line: str, name: str, kinds: tuple[type[Word], ...], values: dict[str, Any]
) -> None:
    driver = plugin.driver([device(name, line)])
    events = driver.receive(NOW, wire(name))
    assert tuple(type(event) for event in events) == kinds
    assert all(getattr(event, "motor", "") == "m" and getattr(event, "t", 0) == NOW for event in events)
    for key, value in values.items():
        (told,) = [getattr(event, key) for event in events if hasattr(event, key)]
        assert told == (pytest.approx(value, rel=1e-6) if isinstance(value, float) else value)


def test_no_vector_of_a_request_is_done_before_the_device_was_heard() -> None:
    driver = plugin.driver([device("clear_errors", "0.6")])
    events, _ = driver.send(NOW, [Zero("m")])
    assert not [event for event in events if isinstance(event, Done)]
