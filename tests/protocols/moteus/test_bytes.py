"""The vendor's package against decoder, driver and twin: vectors made again, registers, widths of numbers."""

from __future__ import annotations

import json
from importlib.resources import files
from math import tau
from types import ModuleType
from typing import Any

import moteus
import numpy as np
import pytest
from moteus import multiplex as mp
from moteus import protocol as theirs

from benchmarks.codec import theirs as both_sides
from benchmarks.samples import moteus as samples
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback, Position, ReadParameter, Refused
from protocols.moteus import plugin
from protocols.plugin import Device
from tests.protocols.helpers import acts
from tests.protocols.moteus.from_package import entries

RESOLUTIONS = (mp.INT8, mp.INT16, mp.INT32, mp.F32)
DEVICE = Device("m", 5, plugin.options(), plugin.settings())
GENERATOR = np.random.Generator(np.random.PCG64(11))


def to_device(data: bytes) -> CanFrame:
    return CanFrame(0x8005, bytes(data), extended=True, fd=True, brs=True)


def test_the_vectors_of_the_package_are_made_again() -> None:
    stored = json.loads((files("protocols.moteus") / "vectors.json").read_text("utf-8"))
    again = {entry["name"]: entry for entry in entries()}
    assert {entry["name"]: entry for entry in stored if entry["name"] in again} == again


def test_names_of_registers_are_the_package_s() -> None:
    driver = plugin.driver([DEVICE])
    ours = {"set_output_nearest": "rezero", "home_state": "rezero_state", "serial_number1": "serial_number"}
    (refused,), _ = driver.send(0, [ReadParameter("m", "no such register")])
    assert isinstance(refused, Refused)
    for at, name in enumerate(refused.reason.partition("one of ")[2].split(", "), 1):
        frames = plugin.driver([DEVICE]).send(at, [ReadParameter("m", name)])[1]
        read = [theirs.parse_registers(f.data).query for f in frames if isinstance(f, CanFrame)]
        number = theirs.Register[ours.get(name, name).upper()]
        assert [number] in [[register for register, _ in query] for query in read]


@pytest.mark.parametrize("register", [0x001, 0x002, 0x003, 0x004, 0x00D, 0x020, 0x027, 0x038])
def test_a_register_means_the_same_to_the_package_in_any_width(register: int) -> None:
    twin = plugin.twin(DEVICE, 0)
    values = []
    controller: Any = moteus.Controller(id=5, transport=object())
    command = controller.make_position(
        position=0.3, velocity=0.25, watchdog_timeout=0.9, feedforward_torque=0.5
    )
    for at, resolution in enumerate(RESOLUTIONS):
        query = controller.make_custom_query({register: resolution})
        for step in range(20):
            now = (20 * at + step) * MILLISECOND
            twin.receive(now, to_device((command if step < 19 else query).data))
            frames = twin.step(now, [Feedback("m", now, 0.5 * tau, 0.25 * tau)])[1]
        (reply,) = (frame for frame in frames if isinstance(frame, CanFrame))
        values.append(theirs.parse_registers(reply.data).response[register])
    for resolution, value in zip(RESOLUTIONS, values, strict=True):
        assert value == pytest.approx(values[-1], abs=theirs.scale_register(register, resolution, 1) or 0.0)


def test_commands_of_the_package_in_any_width_are_obeyed_within_a_count() -> None:
    for _ in range(300):
        resolution = moteus.PositionResolution()
        scales = {"position": 0x20, "velocity": 0x21, "feedforward_torque": 0x22}
        chosen = {name: RESOLUTIONS[int(GENERATOR.integers(4))] for name in scales}
        for name, width in chosen.items():
            setattr(resolution, name, width)
        values = {name: float(np.float32(GENERATOR.uniform(-1.2, 1.2))) for name in scales}
        controller: Any = moteus.Controller(id=5, transport=object(), position_resolution=resolution)
        frame = to_device(controller.make_position(**values).data)
        _, obeyed = acts(plugin.decoder([DEVICE]).decode(0, frame))
        assert isinstance(obeyed, Position)
        found = (obeyed.position / tau, obeyed.velocity / tau, obeyed.torque)
        for (name, register), value in zip(scales.items(), found, strict=True):
            step = 1e-6 if chosen[name] == mp.F32 else theirs.scale_register(register, chosen[name], 1)
            assert value == pytest.approx(values[name], abs=step)


@pytest.mark.parametrize("sample", samples.SAMPLES, ids=lambda sample: sample.what)
def test_both_sides_of_a_sample_come_to_the_same(sample: samples.Sample) -> None:
    package: ModuleType = moteus
    both_sides(sample, samples.prepared(package))
