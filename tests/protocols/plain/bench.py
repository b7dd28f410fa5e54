"""A plain line on a bench: a driver, its twins and their shafts, stepped a millisecond at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from protocols.conformance.bench import Bench, Shaft, StepResult
from protocols.messages import Command, Event, Request
from protocols.plain import plugin
from protocols.plain.driver import Options
from protocols.plain.twin import Settings
from protocols.plugin import Device

MOTOR = Options("motor")
SENSOR = Options("sensor")


def bench(*, sensors: Sequence[str] = (), motors: Sequence[str] = ("m",), **settings: Any) -> Bench:
    """Motors from address 1 on, sensors from address 101 on; serial numbers are ten times the address."""
    named = [(name, 1 + at, MOTOR) for at, name in enumerate(motors)]
    named += [(name, 101 + at, SENSOR) for at, name in enumerate(sensors)]
    devices = tuple(
        Device(name, address, options, Settings(serial=10 * address, **settings))
        for name, address, options in named
    )
    return Bench(
        tuple(plugin.spec(device) for device in devices),
        devices,
        plugin.driver(devices),
        plugin.decoder(devices),
        [plugin.twin(device, 0) for device in devices],
        {device.name: Shaft() for device in devices},
    )


def reported(steps: Sequence[StepResult], kind: type[Event] | tuple[type[Event], ...]) -> list[Any]:
    """All events of a kind, in order."""
    return [event for step in steps for event in step.events if isinstance(event, kind)]


def ask(stage: Bench, *messages: Command | Request, steps: int = 10) -> list[StepResult]:
    """Say messages once, then listen."""
    return [stage.step(messages), *stage.steps(steps)]
