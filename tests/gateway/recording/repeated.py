"""A recording of any size: a short one, again and again, at later times and with later numbers."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from gateway.core.tick import Tick
from gateway.recording import read_recording
from gateway.recording.ros_views import ViewMessage, Views
from gateway.recording.tick_writer import TickWriter
from protocols.frames import Packet
from protocols.messages import MILLISECOND, Nanos


def repeat(source: Path, path: Path, size: int) -> None:
    """Write a recording of at least so many bytes."""
    recording = read_recording(source)
    steps = list(recording.steps)
    lasts = steps[-1].tick.now - steps[0].tick.now + 5 * MILLISECOND
    writer = TickWriter(path, recording.robot_text, recording.facts, Views())
    times = 0
    while writer.size < size:
        by = times * lasts
        for step in steps:
            writer.put(_later(step.tick, times * len(steps), by), partial(_later_views, step.views, by))
        times += 1
    writer.finish()


def _later(tick: Tick, numbers: int, by: Nanos) -> Tick:
    inputs = replace(tick.inputs, packets=_later_packets(tick.inputs.packets, by))
    outputs = replace(tick.outputs, packets=_later_packets(tick.outputs.packets, by), notes=())
    return replace(tick, number=tick.number + numbers, now=tick.now + by, inputs=inputs, outputs=outputs)


def _later_packets(packets: tuple[Packet, ...], by: Nanos) -> tuple[Packet, ...]:
    return tuple(replace(packet, t=packet.t + by) for packet in packets)


def _later_views(views: tuple[ViewMessage, ...], by: Nanos) -> list[ViewMessage]:
    return [view._replace(t=view.t + by) for view in views]
