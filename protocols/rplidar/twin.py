"""The device's end: what a lidar obeys, and its firmware, which streams what its rays see of the world."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import ceil

from protocols.frames import Frame
from protocols.messages import MILLISECOND, Event, Idle, Kept, LaserScan, Nanos, Obeyed, Reboot, Torque
from protocols.plugin import Device
from protocols.rplidar import capsules
from protocols.rplidar import table as rp
from protocols.rplidar.capsules import Capsule
from protocols.rplidar.options import Settings
from protocols.rplidar.table import Node
from protocols.toolkit.rays import clockwise
from protocols.toolkit.serial import Stream

FAR = 1 << 20
"""mm, where a ray of an ultra scan is as far behind its place as it can be"""
LEADS = 12.0
"""Degrees by which a near ray of an ultra scan may be before one that is far"""
COARSE = 2.0
"""Degrees from ray to ray: where a plant has fewer, each is measured several times"""
QUALITY = 47
"""Of every return"""
SERIAL = bytes.fromhex("EBB399F6C9E59AD2C5E59CF717613412")
BOOT: Nanos = 500 * MILLISECOND
BANNER = b"RP LIDAR System.\r\nFirmware Ver %d.%02d - rtm, HW Ver %d\r\nModel: %02X\r\n"


@dataclass(slots=True)
class Memory:
    """What a lidar keeps of the requests that it received."""

    settings: Settings
    scan: int = 0
    """Type of what it streams; 0: nothing"""
    since: Nanos = 0
    """When it was asked for that, or its motor was started"""
    pwm: int = 0
    stream: Stream = field(default_factory=lambda: Stream(rp.REQUESTS))

    def obey(self, t: Nanos, frame: Frame, *, failed: bool = False) -> Iterator[bytes]:
        """Obey the requests that these bytes complete, and yield them. In its protection stop it only answers
        and restarts."""
        for message in self.stream.messages(frame) if isinstance(frame, bytes) else ():
            command = message[0]
            if command == rp.SET_PWM:
                self.pwm, self.since = int.from_bytes(message[2:], "little"), t
            elif command not in (rp.SCAN, rp.FORCE_SCAN, rp.EXPRESS_SCAN):
                self.scan = 0
            elif not failed:
                asked = self._modes().get(message[2], rp.EXPRESS) if command == rp.EXPRESS_SCAN else rp.NODES
                self.scan, self.since = asked, t
            yield message

    def _modes(self) -> dict[int, int]:
        settings = self.settings
        return {settings.hq_mode: rp.HQ, settings.ultra_mode: rp.ULTRA, settings.dense_mode: rp.DENSE}

    def stop(self) -> None:
        """End its scan."""
        self.scan = 0

    def streams(self, now: Nanos) -> bool:
        """True if it scans, and its turn is stable."""
        turns = self.settings.motor == "turns" or self.pwm > 0
        return bool(self.scan) and turns and now - self.since >= self.settings.spin_up_ms * MILLISECOND


class RplidarDecoder:
    """What lidars would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = [(device.name, Memory(device.settings)) for device in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what each would obey; what only asks is nothing."""
        found = [(name, each) for name, memory in self._devices for each in memory.obey(t, frame)]
        return [_obeyed(name, each) for name, each in found if each[0] not in rp.READS]


def _obeyed(name: str, message: bytes) -> Obeyed:
    match message[0]:
        case rp.STOP:
            return Idle(name)
        case rp.RESET:
            return Reboot(name)
        case rp.SET_PWM:
            return Kept(name, "SET_MOTOR_PWM", float(int.from_bytes(message[2:], "little")))
        case rp.EXPRESS_SCAN:
            return Kept(name, "EXPRESS_SCAN", float(message[2]))
    return Kept(name, rp.NAMES[message[0]], 1.0)


class RplidarTwin:
    """One lidar."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self.memory = Memory(device.settings)
        self.failed = False
        """It is in its protection stop."""
        self.boots: Nanos | None = None
        """When it has restarted"""
        self._replies: list[bytes] = []
        self._rays: list[tuple[float, float]] = []
        """That nothing has taken yet: degrees clockwise, m"""
        self._first = True
        """The next capsule is the first of its stream."""
        self._last = 360.0
        """Degrees, of the last node"""
        self._turn = 0

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey it; answer with the next step."""
        if self.boots is not None:
            return
        for message in self.memory.obey(t, frame, failed=self.failed):
            if message[0] != rp.SET_PWM:
                self._rays, self._first, self._last = [], True, 360.0
            self._replies += self._answers(t, message)

    def _answers(self, t: Nanos, message: bytes) -> Sequence[bytes]:
        settings = self.device.settings
        match message[0]:
            case rp.GET_INFO:
                head = struct.pack("<BHB", settings.model, settings.firmware, settings.hardware)
                return (rp.answer(rp.INFO, head + SERIAL),)
            case rp.GET_HEALTH:
                health = (rp.ERROR, 0x8001) if self.failed else (0, 0)
                return (rp.answer(rp.HEALTH, struct.pack("<BH", *health)),)
            case rp.GET_RATE:
                return (rp.answer(rp.RATE, struct.pack("<HH", settings.standard_us, settings.express_us)),)
            case rp.GET_BOARD:
                return (rp.answer(rp.BOARD, struct.pack("<I", settings.motor == "pwm")),)
            case rp.RESET:
                self.boots = t + BOOT
            case rp.SCAN | rp.FORCE_SCAN | rp.EXPRESS_SCAN if self.memory.scan:
                return (rp.descriptor(self.memory.scan),)
        return ()

    def due(self) -> Nanos | None:
        """Return None: it sends when it was asked, or its rays have been measured."""
        return None

    def provoke(self, code: int) -> None:
        """Stop for its own protection. Raises ValueError if there is no such fault."""
        if code != rp.PROTECTION:
            raise ValueError(f"no fault {code}")
        self.failed = True
        self.memory.stop()

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Answer; take what the rays have seen; send what is full."""
        replies, self._replies = self._replies, []
        if self.boots is not None and now >= self.boots:
            self.boots, self.failed, self.memory = None, False, Memory(self.device.settings)
            settings = self.device.settings
            version = settings.firmware >> 8, settings.firmware & 0xFF, settings.hardware, settings.model
            replies.append(BANNER % version)
        if self.boots is None and self.memory.streams(now):
            for event in truth:
                if isinstance(event, LaserScan) and event.sensor == self.device.name:
                    self._look(event)
            senders = {rp.NODES: self._nodes, rp.HQ: self._packets, rp.ULTRA: self._ultra}
            replies += senders.get(self.memory.scan, self._capsules)(now)
        return (), replies

    def _look(self, scan: LaserScan) -> None:
        """Take the rays of a part of a turn: of a standard scan, as many as it has in that time."""
        steps = max(len(scan.ranges) - 1, 1)
        apart = -scan.duration / steps if scan.duration < 0 else 0.0
        every = 1
        if self.memory.scan == rp.NODES and apart:
            every = max(1, round(self.device.settings.standard_us * 1000.0 / apart))
        width = abs(scan.angle_increment) * 180.0 / 3.141592653589793
        more = min(ceil(width / COARSE), 360) if 0.0 < width < 360.0 else 1
        for angle, found, _ in clockwise(scan):
            self._turn += 1
            if self._turn % every == 0:
                for part in range(more):
                    off = width * ((part + 0.5) / more - 0.5)
                    self._rays.append(((angle + off) % 360.0, found))

    def _nodes(self, _: Nanos) -> Iterator[bytes]:
        rays, self._rays = self._rays, []
        yield from map(rp.encode_node, self._told(rays))

    def _told(self, rays: Sequence[tuple[float, float]]) -> Iterator[Node]:
        for angle, found in rays:
            first, self._last = angle < self._last - 180.0, angle
            yield Node(first, QUALITY if found else 0, angle, found * 1000.0)

    def _packets(self, now: Nanos) -> Iterator[bytes]:
        count = capsules.RAYS[rp.HQ]
        while len(self._rays) >= count:
            rays, self._rays = self._rays[:count], self._rays[count:]
            yield capsules.encode_packet(now // 1000, [*self._told(rays)])

    def _ultra(self, _: Nanos) -> Iterator[bytes]:
        """Yield ultra capsules: of each place, what is seen where its ray goes, which is known of what is
        near only when later rays have been measured."""
        count, step = capsules.RAYS[rp.ULTRA], 0.0
        if len(self._rays) > count:
            step = (self._rays[count][0] - self._rays[0][0]) % 360.0 / count
        ahead = ceil(LEADS / step) if step > 0.01 else 1
        while len(self._rays) > count + ahead:
            found = [self._reached(at, step, ahead) for at in range(count + 1)]
            start = (self._rays[0][0] + capsules.behind(FAR)) % 360.0
            self._rays = self._rays[count:]
            capsule = Capsule(self._first, start, tuple(found[:count]), ())
            self._first = False
            yield capsules.encode_capsule(capsule, rp.ULTRA, found[count])

    def _reached(self, at: int, step: float, ahead: int) -> int:
        """Return what the ray at a place meets [mm]: it goes the farther ahead, the nearer that is."""
        found = round(self._rays[at][1] * 1000.0)
        for _ in range(3):
            leads = capsules.behind(FAR) - capsules.behind(found) if found >= capsules.NEAREST_ULTRA else 0.0
            found = round(self._rays[at + min(round(leads / step) if step > 0.01 else 0, ahead)][1] * 1000.0)
        return found

    def _capsules(self, _: Nanos) -> Iterator[bytes]:
        count = capsules.RAYS[self.memory.scan]
        while len(self._rays) >= count:
            rays, self._rays = self._rays[:count], self._rays[count:]
            found = tuple(round(each * 1000.0) for _, each in rays)
            capsule = Capsule(self._first, rays[0][0], found, (0.0,) * count)
            self._first = False
            yield capsules.encode_capsule(capsule, self.memory.scan)
