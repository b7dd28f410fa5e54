"""The driver and independent drives on a bus that is a for-loop, in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from protocols.cia402 import plugin
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Event, Request
from protocols.plugin import Device
from protocols.transcripts.runner import Peer

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
