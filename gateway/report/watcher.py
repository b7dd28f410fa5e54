"""What is counted of a run to judge it: figures with a tolerance each, and digests of the bytes sent."""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

from brain.belief import Belief
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.report.collect import Collector
from protocols.frames import CanFrame, Packet
from protocols.messages import MILLISECOND, SECOND, Fault, Nanos

LATE = 1.5
"""Periods between two steps, from which a tick counts as missed"""


class Figure(NamedTuple):
    """A figure of a recording, with the tolerance that it has unless another was edited."""

    value: float
    tolerance: float
    unit: str = ""


class Watcher:
    """What is counted of a run: `take` each tick, then ask."""

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._collector = Collector(gateway, signals=False)
        self._late = LATE * gateway.robot.period
        self._before: Nanos | None = None
        self._missed = self._faults = 0
        self._oldest: Nanos = 0
        self._hashes: dict[str, list[Any]] = {name: [] for name in gateway.robot.buses}

    def take(self, tick: Tick, belief: Belief) -> None:
        """Take a tick of today, and the belief after it."""
        self._collector.take(tick, belief)
        if self._before is not None and tick.now - self._before > self._late:
            self._missed += 1
        self._before = tick.now
        self._faults += sum(isinstance(event, Fault) for event in tick.outputs.events)
        ages = [joint.feedback_age(tick.now) or 0 for joint in self._gateway.joints.values()]
        self._oldest = max(self._oldest, *ages)
        second = (tick.now - self._collector.start) // SECOND
        for packet in tick.outputs.packets:
            if (hashes := self._hashes.get(packet.bus)) is not None:
                hashes += (hashlib.blake2b(digest_size=4) for _ in range(len(hashes), second + 1))
                hashes[-1].update(bytes_of(packet))

    def digests(self) -> dict[str, list[str]]:
        """Return the digests by bus and second."""
        return {bus: [one.hexdigest() for one in hashes] for bus, hashes in self._hashes.items()}

    def figures(self) -> dict[str, Figure]:
        """Return the figures of the whole run."""
        seen, belief = self._collector, self._collector.belief
        took = max(1, seen.end - seen.start)
        found = {
            "ticks": Figure(seen.ticks, 0),
            "ticks missed": Figure(self._missed, 0),
            "goals reached": Figure(belief.reached, 0),
            "faults": Figure(self._faults, 0),
            "rejected measurements": Figure(sum(belief.rejected.values()), 5),
            "oldest feedback": Figure(self._oldest / MILLISECOND, 1.0, "ms"),
        }
        if belief.estimate is not None:
            pose = belief.estimate.pose
            found |= {
                "final x": Figure(pose.x, 0.02, "m"),
                "final y": Figure(pose.y, 0.02, "m"),
                "final yaw": Figure(pose.yaw, 0.02, "rad"),
                "path driven": Figure(seen.driven.length, 0.05, "m"),
                "off the path, RMS": Figure(seen.off_rms or 0.0, 0.005, "m"),
            }
        for name, joint in self._gateway.joints.items():
            if joint.feedback.position is not None:
                found[f"{name}: final position"] = Figure(joint.feedback.position, 0.1, "rad")
        for bus, busy in seen.busy.items():
            found[f"{bus}: busy"] = Figure(100.0 * busy / took, 0.5, "%")
        for sensor, nis in self._gateway.brain.nis.items():
            found[f"{sensor}: NIS per degree of freedom"] = Figure(nis.mean, 0.1)
        return found


def bytes_of(packet: Packet) -> bytes:
    """Return all of a packet as bytes, for a digest."""
    frame = packet.frame
    head = packet.t.to_bytes(8, "little")
    if isinstance(frame, CanFrame):
        kind = frame.extended | frame.remote << 1 | frame.fd << 2 | frame.brs << 3
        return head + frame.id.to_bytes(4, "little") + bytes([kind, len(frame.data)]) + frame.data
    return head + frame
