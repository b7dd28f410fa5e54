"""The conversation with a lidar: what it is asked for, one thing after the other, and what it has told.

Rules. Each stage is sent when the one before was answered, or else STOP and from the beginning. A request
ends a scan, so none is made while it goes on; one that stops by itself begins anew, by way of its health.
Only what was told twice is believed to be a fault, since answers have no checksum.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos
from protocols.rplidar import table as rp
from protocols.rplidar.options import MODELS, Options
from protocols.rplidar.turn import Turn


class Stage(Enum):
    """What the lidar is asked for."""

    STOPS = "is to stop what it does"
    INFO = "is asked who it is"
    HEALTH = "is asked how it is"
    RATE = "is asked how long a ray takes"
    MOTOR = "its motor starts"
    BEGINS = "is to scan"
    SCANS = "scans"
    RESTS = "is to rest"


S = Stage
WAITS: Mapping[Stage, tuple[Nanos, Stage]] = {
    S.STOPS: (30 * MILLISECOND, S.INFO),
    S.INFO: (200 * MILLISECOND, S.STOPS),
    S.HEALTH: (200 * MILLISECOND, S.STOPS),
    S.RATE: (200 * MILLISECOND, S.MOTOR),
    S.MOTOR: (0, S.HEALTH),
    S.BEGINS: (0, S.STOPS),
    S.SCANS: (400 * MILLISECOND, S.STOPS),
}
"""How long an answer is waited for, and what is done without one; that of BEGINS is the model's"""
QUESTIONS: Mapping[Stage, bytes] = {
    S.STOPS: rp.request("STOP"),
    S.INFO: rp.request("GET_INFO"),
    S.HEALTH: rp.request("GET_HEALTH"),
    S.RATE: rp.request("GET_SAMPLERATE"),
}
del S
AGAIN: Nanos = SECOND
"""Period in which a lidar in fault is asked how it is,"""
SPINNING: Nanos = 200 * MILLISECOND
"""and one whose motor starts."""
RESTS_AGAIN: Nanos = 20 * MILLISECOND
"""Period of STOP while it is to rest"""


@dataclass(slots=True)
class Lidar:
    """What is known of a lidar, and what it is asked for. Plain data."""

    turn: Turn
    stage: Stage = Stage.SCANS
    then: Stage = Stage.STOPS
    """What follows, if nothing comes,"""
    due: Nanos = 0
    """and when"""
    started: bool = False
    """It was sent what makes it scan, or turn."""
    spun: Nanos | None = None
    """When its motor turns as it should; None: it was not started"""
    rested: Nanos = -1
    """When it was last given Idle"""
    doubted: bool = False
    """It has told of a fault once."""
    fault: bool = False
    model: str = ""
    """That it is another one than stated,"""
    health: str = ""
    """how it is, if not well,"""
    unread: str = ""
    """and that what it sends is not read."""
    scan: str = ""
    """What it streams"""

    def forget(self) -> None:
        """Begin anew: it may have restarted."""
        self.stage, self.then, self.due, self.scan = Stage.SCANS, Stage.STOPS, 0, ""
        self.doubted, self.fault, self.spun = False, False, None

    def text(self, options: Options) -> str:
        """Return how it is, for a person."""
        stage = self.stage.value if options.start else "is listened to (start = false)"
        lost = f"{self.turn.lost} capsules lost" if self.turn.lost else ""
        return ", ".join(filter(None, (stage, self.model, self.health, self.unread, lost)))

    # -- received -------------------------------------------------------------------------------------

    def see(self, t: Nanos, data: bytes, scan: str) -> LaserScan | None:
        """Take a node or capsule of a scan that came at t; return the scan that it completes."""
        if scan != self.scan:
            self.scan = scan
            self.turn.begin(scan)
        if self.stage is Stage.STOPS:
            self.due = t + WAITS[Stage.STOPS][0]  # until it is quiet
        elif self.stage in (Stage.BEGINS, Stage.SCANS) and self.due:
            self.stage, self.due = Stage.SCANS, t + WAITS[Stage.SCANS][0]
        return self.turn.add(t, data, scan)

    def hear(self, t: Nanos, message: bytes, options: Options) -> None:
        """Take an answer; go on to what follows."""
        kind, data = message[6], message[rp.HEAD :]
        if kind in rp.SCANS:
            self.scan = ""
            other = f"answers {kind:#x}, which is not read: another scan_mode"
            self.unread = "" if rp.SCANS[kind] in rp.RAYS else other
        elif kind == rp.TYPES["info"]:
            stated, told = MODELS[options.model].major, data[0] >> 4
            wrong = stated and told <= 3 and told != stated
            self.model = f"is no {options.model}: model {data[0]:#04x}" if wrong else ""
            self._go(t, Stage.INFO, Stage.HEALTH)
        elif kind == rp.TYPES["health"]:
            self._on_health(t, data[0], int.from_bytes(data[1:], "little"))
        elif kind == rp.TYPES["rate"]:
            self.turn.tell(*(1000.0 * each for each in struct.unpack("<HH", data)))
            self._go(t, Stage.RATE, Stage.MOTOR)

    def _go(self, t: Nanos, stage: Stage, then: Stage) -> None:
        """Go on from a stage to another one, if it is in that."""
        if self.stage is stage:
            self.then, self.due = then, t

    def _on_health(self, t: Nanos, status: int, error: int) -> None:
        failed = status == rp.ERROR
        sure, self.doubted = failed and self.doubted, failed
        self.fault = sure or (self.fault and failed)
        self.health = f"health {status}, error {error:#06x}" if status else ""
        if failed:
            self._go(t + (AGAIN if sure else 0), Stage.HEALTH, Stage.HEALTH)
        elif self.spun is None:
            self._go(t, Stage.HEALTH, Stage.RATE)
        elif t < self.spun:
            self._go(t + SPINNING, Stage.HEALTH, Stage.HEALTH)
        else:
            self._go(t, Stage.HEALTH, Stage.BEGINS)

    # -- sent -----------------------------------------------------------------------------------------

    def ask(self, now: Nanos, options: Options) -> Sequence[bytes]:
        """Return what is due, if anything is."""
        if not options.start or now < self.due or self.rested == now:
            return ()
        if self.stage is Stage.BEGINS:
            self.spun = None  # it did not: as after a restart
        self.stage = self.then
        wait, self.then = WAITS[self.stage]
        frames: Sequence[bytes] = (QUESTIONS[self.stage],) if self.stage in QUESTIONS else ()
        if self.stage is Stage.MOTOR:
            pwm = options.motor == "pwm"
            self.started = self.started or pwm
            self.spun = now + round(pwm * options.spin_up_ms * MILLISECOND)
            frames = (rp.pwm(options.pwm),) if pwm else ()
        elif self.stage is Stage.BEGINS:
            self.started, wait = True, round(MODELS[options.model].begins_ms * MILLISECOND)
            standard = options.scan == "standard"
            frames = (rp.request("SCAN") if standard else rp.express_scan(options.mode),)
        self.due = now + wait
        return frames

    def rest(self, now: Nanos, options: Options) -> Sequence[bytes]:
        """Return what stops it, if it was started: again and again, since it does not tell."""
        self.rested = now
        if not self.started or (self.stage is Stage.RESTS and now < self.due):
            return ()
        self.stage, self.then, self.due, self.spun = Stage.RESTS, Stage.STOPS, now + RESTS_AGAIN, None
        return (QUESTIONS[Stage.STOPS], *((rp.pwm(0),) if options.motor == "pwm" else ()))
