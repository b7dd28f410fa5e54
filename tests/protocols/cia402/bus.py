"""The driver and independent drives on a bus that is a for-loop, in virtual time; the twin and its shaft."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import canopen

from protocols.cia402 import plugin
from protocols.cia402.settings import Settings
from protocols.conformance.bench import Shaft
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Feedback, Request
from protocols.plugin import Device
from protocols.transcripts.runner import Peer
from tests.protocols.cia402.stack import Joined, dictionary

BEGIN = 1_000_000
"""ms: the clock's zero lies anywhere."""


def motor(name: str = "m", node: int = 2, **options: Any) -> Device:
    """Return a device with default settings."""
    return Device(name, node, plugin.options(**options), plugin.settings())


class Bus:
    """A driver, its drives, and what went to and fro."""

    def __init__(self, devices: Sequence[Device], drives: Sequence[Peer]) -> None:
        self.driver = plugin.driver(devices)
        self.drives = drives
        self.ms = BEGIN
        self.events: list[Event] = []
        self.frames: list[Frame] = []
        """Of the driver."""

    def run(self, ms: int, *messages: Command | Request) -> None:
        """Advance. Commands are given every 10 ms, requests once."""
        commands = [each for each in messages if isinstance(each, Command)]
        given: Sequence[Command | Request] = messages
        for _ in range(ms):
            now = self.ms * MILLISECOND
            for frame in [frame for drive in self.drives for frame in drive.step()]:
                self.events += self.driver.receive(now, frame)
            due = self.driver.due()
            if given or self.ms % 10 == 0 or (due is not None and due <= now):
                self._send(now, given or (commands if self.ms % 10 == 0 else ()))
                given = ()
            self.ms += 1

    def _send(self, now: int, messages: Sequence[Command | Request]) -> None:
        events, frames = self.driver.send(now, messages)
        self.events += events
        self.frames += frames
        for frame in frames:
            for drive in self.drives:
                drive.receive(frame)


class TwinOnShaft:
    """The twin, and the shaft that it turns."""

    def __init__(self, settings: Settings | None = None, node: int = 2, seed: int = 0) -> None:
        device = Device("m", node, plugin.options(), settings or plugin.settings())
        self.node, self.twin = node, plugin.twin(device, seed)
        self.shaft = Shaft()
        self.torque = 0.0
        self.now = BEGIN * MILLISECOND
        self.run(2)

    def run(self, ms: int, *frames: CanFrame) -> list[CanFrame]:
        """Advance; the frames reach it in the first millisecond. Returns what it sends."""
        sent: list[CanFrame] = []
        for _ in range(ms):
            self.now += MILLISECOND
            for frame in frames:
                self.twin.receive(self.now, frame)
            frames = ()
            measured = Feedback("m", self.now, self.shaft.position, self.shaft.velocity)
            torques, reports = self.twin.step(self.now, [measured])
            self.torque = sum(torque.torque for torque in torques)
            self.shaft.turn(self.torque, MILLISECOND)
            sent += [frame for frame in reports if isinstance(frame, CanFrame)]
        return sent

    def answer(self, request: bytes) -> bytes | None:
        """Return the response to an SDO request; None: there is none."""
        sent = self.run(1, CanFrame(0x600 + self.node, request))
        return next((frame.data for frame in sent if frame.id == 0x580 + self.node), None)


def remote(drive: TwinOnShaft) -> Any:
    """Return package canopen's node of a twin: each of its frames is a millisecond of the twin."""
    network, node = Joined(), canopen.RemoteNode(drive.node, dictionary(drive.node))
    network.add_node(node)

    def on_sent(frame: CanFrame) -> None:
        for answer in drive.run(1, frame):
            network.handle(answer)

    network.on_sent = on_sent
    return node
