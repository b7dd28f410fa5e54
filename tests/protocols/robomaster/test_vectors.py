"""Values ↔ bytes, both ways: those of the vendor's code, compiled, and of a public unit test."""

from __future__ import annotations

import math

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Feedback, Obeyed
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from protocols.robomaster import plugin
from protocols.robomaster.options import Options, Settings
from protocols.robomaster.table import SLOTS, TABLE

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
C620, C610, GM6020 = (Options(model, torque_constant=0.01) for model in ("C620", "C610", "GM6020"))
COMMANDS = {
    "c620_cmd_ids1to4": (1, C620, (8192, -8192, 1, -16384), (10.0, -10.0, 20.0 / 16384, -20.0)),
    "cmd_0x1FF_gm6020_v_or_c610_ids5to8": (5, C610, (25000, -25000, -10000, 0), (25.0, -25.0, -10.0, None)),
    "gm6020_current_ids1to4": (1, GM6020, (16384, -4096, 1, -16384), (3.0, -0.75, 3.0 / 16384, -3.0)),
    "gm6020_current_ids5to7": (
        5,
        GM6020,
        (100, -100, 16383, 0),
        (300 / 16384, -300 / 16384, 3.0 * 16383 / 16384),
    ),
}
"""First address, options, counts, and the A that each controller obeys; None: it lets go."""
FEEDBACK = {
    "gm6020_feedback_id7": Feedback("m", 0, math.pi / 2, -math.pi, 0.015, 1.5, temperature=255.0),
    "taproot_feedback_id1": Feedback(
        "m", 0, 0.7669903939428205, -100 * math.pi / 30, 20e-2 / 163.84, 20.0 / 163.84, temperature=43.0
    ),
    "feedback_id1_rpm480_-10A": Feedback(
        "m", 0, -math.tau / 8192, 16 * math.pi, -0.1, -10.0, temperature=55.0
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_currents_of_a_group(name: str) -> None:
    first, options, counts, amperes = COMMANDS[name]
    frame = VECTORS[name].frame
    assert isinstance(frame, CanFrame)
    (message,) = plugin.messages(frame)
    assert TABLE.encode(message, **dict(zip(SLOTS, counts, strict=True))) == frame
    devices = [Device(f"m{first + at}", first + at, options, Settings()) for at in range(len(amperes))]
    obeyed = plugin.decoder(devices).decode(0, frame)
    wanted: list[Obeyed] = []
    for device, ampere in zip(devices, amperes, strict=True):
        idle = ampere is None
        torque = 0.0 if ampere is None else ampere * 0.01
        wanted += [msg.Idle(device.name)] if idle else [msg.Arm(device.name), msg.Torque(device.name, torque)]
    assert [type(one) for one in obeyed] == [type(one) for one in wanted]
    torques = [one.torque for one in obeyed if isinstance(one, msg.Torque)]
    assert torques == pytest.approx([one.torque for one in wanted if isinstance(one, msg.Torque)])
    others = [Device("other", first + 4 if first == 1 else 1, options, Settings())]
    assert plugin.decoder(others).decode(0, frame) == []


@pytest.mark.parametrize("name", FEEDBACK)
def test_feedback(name: str) -> None:
    number, device = 1, Device("m", 1, C620, Settings())
    if name.startswith("gm6020"):
        number, device = 11, Device("m", 7, GM6020, Settings())
    driver = plugin.driver([device])
    (feedback,) = [e for e in driver.receive(0, VECTORS[name].frame) if isinstance(e, Feedback)]
    for field in ("position", "velocity", "torque", "current", "temperature"):
        assert getattr(feedback, field) == pytest.approx(getattr(FEEDBACK[name], field)), field
    raw = VECTORS[name].meaning
    angle, rpm, current = raw["encoder"], raw["rpm"], raw["torque_current_raw"]
    values = {"angle": angle, "velocity": rpm, "current": current, "temperature": raw["temperature_c"]}
    assert TABLE.encode("feedback", number=number, error=0, **values) == VECTORS[name].frame
