"""The device's end: a lidar's firmware, which answers, and streams what its rays see. The world turns it."""

from __future__ import annotations

import math
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
RPM, PWM = 600, 660
"""What it tells of its rotation: the desired one, and the duty for it"""
FARTHEST = 40.0
"""m, of a model of which only the number is known"""
QUALITY = 47
"""Of every return"""
SERIAL = bytes.fromhex("EBB399F6C9E59AD2C5E59CF717613412")
BOOT: Nanos = 500 * MILLISECOND
BANNER = b"RP LIDAR System.\r\nFirmware Ver %d.%02d - rtm, HW Ver %d\r\nModel: %02X\r\n"


@dataclass(slots=True)
class Memory:
    """What a lidar keeps of the requests that it received."""

    settings: Settings
    scan: str = ""
    """What it streams; "": nothing"""
    since: Nanos = 0
    """When it was asked for that, or its motor was started"""
    pwm: int = 0
    stream: Stream = field(default_factory=lambda: Stream(rp.REQUESTS))

    def obey(self, t: Nanos, frame: Frame, *, failed: bool = False) -> Iterator[tuple[str, bytes]]:
        """Obey the requests that these bytes complete, and yield their names and payloads. In its protection
        stop it only answers and restarts."""
        for message in self.stream.messages(frame) if isinstance(frame, bytes) else ():
            name, payload = rp.NAMES[message[0]], message[2:]
            if name == "SET_MOTOR_PWM":
                self.pwm, self.since = int.from_bytes(payload, "little"), t
            elif not name.endswith("SCAN"):
                self.scan = ""
            elif not failed:
                self.scan, self.since = self._asked(payload), t
            yield name, payload

    def _asked(self, payload: bytes) -> str:
        """Return the scan of its number; of a request without one, the standard scan."""
        return self.numbered.get(payload[0], "express") if payload else "standard"

    @property
    def numbered(self) -> dict[int, rp.Scan]:
        """Return its scans other than express ones, by number."""
        settings = self.settings
        return {settings.hq_mode: "hq", settings.ultra_mode: "ultra", settings.dense_mode: "dense"}

    def conf(self, payload: bytes) -> bytes:
        """Return what is answered to GET_LIDAR_CONF, without the number of what was asked for; b"": nothing.
        Slamtec's SDK asks before it scans (from firmware 1.24 on)."""
        settings, asked, mode = self.settings, payload[:4], int.from_bytes(payload[4:6], "little")
        scan = self.numbered.get(mode, "express") if mode else "standard"
        q8 = 256.0 * (settings.express_us if mode else settings.standard_us)
        high = settings.model >> 4
        far = next((most for most, _, each, _ in rp.FILE["models"].values() if each == high), FARTHEST)
        known = {
            "DESIRED_ROTATION": struct.pack("<HH", RPM, PWM),
            "LEAST_ROTATION": struct.pack("<H", RPM // 2),
            "MOST_ROTATION": struct.pack("<H", RPM * 2),
            "SCANS": struct.pack("<H", max(self.numbered) + 1),
            "SAMPLE_TIME": struct.pack("<I", round(q8)),
            "MOST_DISTANCE": struct.pack("<I", round(256.0 * far)),
            "SCAN_TYPE": bytes((rp.TYPES[scan],)),
            "TYPICAL_SCAN": struct.pack("<H", settings.typical_mode),
            "SCAN_NAME": rp.SCAN_NAMES[scan].encode() + b"\0",
        }
        numbers = {number: name for name, number in rp.CONF.items()}
        return known.get(numbers.get(int.from_bytes(asked, "little"), ""), b"")

    def stop(self) -> None:
        """End its scan."""
        self.scan = ""

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
        found = [(name, *each) for name, memory in self._devices for each in memory.obey(t, frame)]
        return [_obeyed(*each) for each in found if not each[1].startswith(rp.READS)]


def _obeyed(device: str, name: str, payload: bytes) -> Obeyed:
    if name == "STOP":
        return Idle(device)
    if name == "RESET":
        return Reboot(device)
    # Of an express scan the number, of the motor the duty.
    value = payload if name == "SET_MOTOR_PWM" else payload[:1]
    return Kept(device, name, float(int.from_bytes(value, "little")) if payload else 1.0)


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
        """That nothing has taken yet: degrees clockwise, mm"""
        self._first = True
        """The next capsule is the first of its stream."""
        self._last = 360.0
        """Degrees, of the last node"""
        self._turn = 0

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey it; answer with the next step."""
        if self.boots is not None:
            return
        for name, payload in self.memory.obey(t, frame, failed=self.failed):
            if name != "SET_MOTOR_PWM":
                self._rays, self._first, self._last = [], True, 360.0
            if name == "RESET":
                self.boots = t + BOOT
            elif name.endswith("SCAN") and self.memory.scan:
                self._replies.append(rp.descriptor(self.memory.scan))
            elif name.startswith(rp.READS):
                self._replies += self._answers(name, payload)

    def _answers(self, name: str, payload: bytes) -> Iterator[bytes]:
        settings = self.device.settings
        if name == "GET_INFO":
            head = struct.pack("<BHB", settings.model, settings.firmware, settings.hardware)
            yield rp.answer("info", head + SERIAL)
        elif name == "GET_HEALTH":
            yield rp.answer("health", struct.pack("<BH", *((rp.ERROR, 0x8001) if self.failed else (0, 0))))
        elif name == "GET_SAMPLERATE":
            yield rp.answer("rate", struct.pack("<HH", settings.standard_us, settings.express_us))
        elif name == "GET_ACC_BOARD_FLAG":
            yield rp.answer("board", struct.pack("<I", settings.motor == "pwm"))
        elif name == "GET_LIDAR_CONF" and (told := self.memory.conf(payload)):
            yield rp.answer("conf", payload[:4] + told)

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
            replies += self._sent(now, self.memory.scan)
        return (), replies

    def _look(self, scan: LaserScan) -> None:
        """Take the rays of a part of a turn: of a standard scan, as many as it has in that time."""
        steps = max(len(scan.ranges) - 1, 1)
        apart = -scan.duration / steps if scan.duration < 0 else 0.0
        every = 1
        if self.memory.scan == "standard" and apart:
            every = max(1, round(self.device.settings.standard_us * 1000.0 / apart))
        width = math.degrees(abs(scan.angle_increment))
        more = min(ceil(width / COARSE), 360) if 0.0 < width < 360.0 else 1
        for angle, found, _ in clockwise(scan):
            self._turn += 1
            for part in range(more) if self._turn % every == 0 else ():
                off = width * ((part + 0.5) / more - 0.5)
                self._rays.append(((angle + off) % 360.0, found * 1000.0))

    def _sent(self, now: Nanos, scan: str) -> Iterator[bytes]:
        """Yield what is full of a scan."""
        count, ahead, step = rp.RAYS[scan], 0, 0.0
        if scan == "ultra" and len(self._rays) > count:
            step = (self._rays[count][0] - self._rays[0][0]) % 360.0 / count
            ahead = ceil(LEADS / step) if step > 0.01 else 1
        while len(self._rays) >= count + ahead + (scan == "ultra"):
            rays = self._rays[:count]
            start, after, found = rays[0][0], 0, [round(mm) for _, mm in rays]
            if scan == "ultra":
                # Of each place, what is seen where its ray goes: of what is near, that is known only when
                # later rays have been measured.
                *found, after = [self._reached(at, step, ahead) for at in range(count + 1)]
                start = (start + capsules.behind(FAR)) % 360.0
            self._rays = self._rays[count:]
            if scan == "standard":
                yield from map(rp.encode_node, self._told(rays))
            elif scan == "hq":
                yield capsules.encode_packet(now // 1000, [*self._told(rays)])
            else:
                yield capsules.encode_capsule(Capsule(self._first, start, found, ()), scan, after)
                self._first = False

    def _told(self, rays: Sequence[tuple[float, float]]) -> Iterator[Node]:
        for angle, found in rays:
            first, self._last = angle < self._last - 180.0, angle
            yield Node(first, QUALITY if found else 0, angle, found)

    def _reached(self, at: int, step: float, ahead: int) -> int:
        """Return what the ray at a place meets [mm]: it goes the farther ahead, the nearer that is."""
        found = round(self._rays[at][1])
        for _ in range(3):
            leads = capsules.behind(FAR) - capsules.behind(found) if found >= capsules.NEAREST_ULTRA else 0.0
            found = round(self._rays[at + min(round(leads / step) if step > 0.01 else 0, ahead)][1])
        return found
