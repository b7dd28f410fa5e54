"""The host's end: it asks, starts the scan, and stops what it has started.

Rules. Without the option `start` it sends nothing. With it, one thing follows the other (`Stage`), each when
the one before was answered, or else STOP and from the beginning. A request ends a scan, so none is made while
it goes on; one that stops by itself begins anew, by way of its health. Only what was told twice is believed
to be a fault, since answers have no checksum. Given Idle, it stops scan and motor, again and again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from protocols.frames import Frame
from protocols.messages import MILLISECOND, SECOND, Mode, Nanos
from protocols.plugin import Device, FaultInfo
from protocols.rplidar import table as rp
from protocols.rplidar.options import MODELS, NEAREST, Options
from protocols.rplidar.turn import Turn
from protocols.rplidar.wire import Wire
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.rays import Beams
from protocols.toolkit.sensors import SensorAdapter

PROTECTION = 2
FAULTS: Mapping[int, FaultInfo] = {
    PROTECTION: FaultInfo(
        "protection stop",
        "its motor is blocked, its laser or its supply failed",
        "free what turns, see that it gets 5 V with enough current, and switch it off and on",
        latching=False,
    )
}


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
    S.RESTS: (0, S.STOPS),
}
"""How long an answer is waited for, and what is done without one; that of BEGINS is the model's"""
del S
AGAIN: Nanos = SECOND
"""Period in which a lidar in fault is asked how it is,"""
SPINNING: Nanos = 200 * MILLISECOND
"""and one whose motor starts."""
RESTS_AGAIN: Nanos = 20 * MILLISECOND
QUESTIONS: Mapping[Stage, bytes] = {
    Stage.STOPS: rp.request(rp.STOP),
    Stage.INFO: rp.request(rp.GET_INFO),
    Stage.HEALTH: rp.request(rp.GET_HEALTH),
    Stage.RATE: rp.request(rp.GET_RATE),
}


@dataclass(slots=True)
class Lidar:
    """What is known of a lidar, and what it is asked for. Plain data."""

    turn: Turn
    stage: Stage = Stage.SCANS
    then: Stage = Stage.STOPS
    due: Nanos = 0
    """When `then` is next"""
    started: bool = False
    """It was sent what makes it scan, or turn."""
    spun: Nanos | None = None
    """When its motor turns as it should; None: it was not started"""
    rested: Nanos = -1
    """When it was last given Idle,"""
    stopped: Nanos = 0
    """and last told to stop."""
    doubted: bool = False
    """It has told of a fault once."""
    fault: bool = False
    said: str = ""
    """What else there is to say of it"""
    kind: int = 0
    """Of its stream"""

    def forget(self) -> None:
        """Begin anew: it may have restarted."""
        self.stage, self.then, self.due, self.kind = Stage.SCANS, Stage.STOPS, 0, 0
        self.doubted, self.fault, self.spun = False, False, None

    def go(self, t: Nanos, stage: Stage) -> None:
        """Go on to a stage in the next step."""
        self.then, self.due = stage, t

    def text(self, options: Options) -> str:
        """Return how it is, for a person."""
        told = [self.stage.value if options.start else "is listened to (start = false)", self.said]
        told += [f"{self.turn.lost} capsules lost"] if self.turn.lost else []
        return ", ".join(filter(None, told))


class RplidarAdapter(SensorAdapter[Lidar]):
    """What lidars are sent, and what they report."""

    name, faults = rp.NAME, FAULTS

    def __init__(self) -> None:
        super().__init__()
        self._stream: Wire = Wire()

    def own(self, device: Device) -> Lidar:
        self._stream.kind = {"standard": rp.NODES, "express": rp.EXPRESS, "dense": rp.DENSE}[
            device.options.scan
        ]
        return Lidar(Turn(device.line_rate))

    # -- received -------------------------------------------------------------------------------------

    def measured(self, t: Nanos, message: bytes, host: Host[Lidar]) -> Report[Lidar] | Rx:
        own, options, scan = host.own, host.options, None
        beams = Beams(host.name, options.beams, NEAREST, options.farthest)
        if len(message) in (rp.NODE_BYTES, rp.CAPSULE_BYTES):
            if self._stream.kind != own.kind:
                own.kind = self._stream.kind
                own.turn.begin(own.kind)
            if own.kind == rp.NODES:
                scan = own.turn.node(t, message, beams)
            else:
                scan = own.turn.capsule(t, message, own.kind, beams)
            self._goes_on(t, own)
        else:
            self._told(t, message[6], message[rp.HEAD :], own, options)
        mode, faults = (Mode.FAULT, (PROTECTION,)) if own.fault else (Mode.READY, ())
        events = () if scan is None else (scan,)
        return Report(host, host.address, mode, own.text(options), faults, events=events)

    def _goes_on(self, t: Nanos, own: Lidar) -> None:
        """Note that what it measures comes."""
        if own.stage is Stage.STOPS:
            own.due = t + WAITS[Stage.STOPS][0]  # until it is quiet
        elif own.stage in (Stage.BEGINS, Stage.SCANS) and own.then is Stage.STOPS and own.due:
            own.stage, own.due = Stage.SCANS, t + WAITS[Stage.SCANS][0]

    def _told(self, t: Nanos, kind: int, data: bytes, own: Lidar, options: Options) -> None:
        """Take an answer; go on to what follows."""
        if kind in rp.REPEATS:
            own.kind = 0
            own.said = "" if kind in rp.SCANS else f"answers {kind:#x}, which is not read: another scan_mode"
        elif kind == rp.INFO:
            expected = MODELS[options.model].major
            other = expected and data[0] >> 4 <= 3 and data[0] >> 4 != expected
            own.said = f"is no {options.model}: model {data[0]:#04x}" if other else ""
            self._answered(t, own, Stage.INFO, Stage.HEALTH)
        elif kind == rp.HEALTH:
            failed = data[0] == rp.ERROR
            sure, own.doubted = failed and own.doubted, failed
            own.fault = sure or (own.fault and failed)
            if data[0]:
                own.said = f"health {data[0]}, error {int.from_bytes(data[1:], 'little'):#06x}"
            if own.stage is Stage.HEALTH:
                own.go(*self._after_health(t, own, failed, sure))
        elif kind == rp.RATE:
            standard, express = (int.from_bytes(data[at : at + 2], "little") * 1000.0 for at in (0, 2))
            own.turn.told = (standard or own.turn.told[0], express or own.turn.told[1])
            self._answered(t, own, Stage.RATE, Stage.MOTOR)

    def _after_health(self, t: Nanos, own: Lidar, failed: bool, sure: bool) -> tuple[Nanos, Stage]:
        """Return what is done next, and when."""
        if failed:
            return t + (AGAIN if sure else 0), Stage.HEALTH
        if own.spun is None:
            return t, Stage.RATE
        return (t + SPINNING, Stage.HEALTH) if t < own.spun else (t, Stage.BEGINS)

    def _answered(self, t: Nanos, own: Lidar, stage: Stage, then: Stage) -> None:
        if own.stage is stage:
            own.go(t, then)

    # -- sent -----------------------------------------------------------------------------------------

    def poll(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        own, options = host.own, host.options
        if not options.start or now < own.due or own.rested == now:
            return ()
        if own.stage is Stage.BEGINS:
            own.spun = None  # it did not: as after a restart
        own.stage = own.then
        wait, own.then = WAITS[own.stage]
        frames: Sequence[Frame] = (QUESTIONS[own.stage],) if own.stage in QUESTIONS else ()
        if own.stage is Stage.MOTOR:
            pwm = options.motor == "pwm"
            own.started, own.spun = own.started or pwm, now + round(pwm * options.spin_up_ms * MILLISECOND)
            frames = (rp.pwm(options.pwm),) if pwm else ()
        elif own.stage is Stage.BEGINS:
            own.started, wait = True, round(MODELS[options.model].begins_ms * MILLISECOND)
            standard = options.scan == "standard"
            frames = (rp.request(rp.SCAN) if standard else rp.express_scan(options.mode),)
        own.due = now + wait
        return frames

    def rest(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        own = host.own
        own.rested = now
        if not own.started or (own.stage is Stage.RESTS and now - own.stopped < RESTS_AGAIN):
            return ()
        own.stage, own.then, own.due, own.stopped = Stage.RESTS, Stage.STOPS, 0, now
        own.spun = None
        motor = (rp.pwm(0),) if host.options.motor == "pwm" else ()
        return (QUESTIONS[Stage.STOPS], *motor)

    def forget(self, now: Nanos, host: Host[Lidar]) -> None:
        host.own.forget()
