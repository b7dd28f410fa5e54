"""The device's side of a protocol: the base of twins. The shaft belongs to the world.

Rules. A protocol gives a subclass with `on_frame` (what it obeys), `cycle` (the torque that it applies) and
`report` (what it sends). Here are: what the world shows of the shaft, the watchdog, faults, replies, which go
out with the next step, and what is sent by the clock. Time is an argument; seed and address give the
phases.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Mode, Nanos, Obeyed, Torque
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.servo import Encoder, Gains, Servo, clamp

NEVER: Nanos = 1 << 62


class Firmware:
    """One device. Plain data. The phases of `Mode` are those of its power stage."""

    faults: Mapping[int, FaultInfo]
    lost: int = 0
    """Code of the fault that the watchdog trips; 0: it disarms without one."""
    passing: Nanos = 0
    """Time after which a fault that does not latch passes; 0: none does."""
    reply_delay: Nanos = 0

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self.settings: Any = device.settings
        self.mode = Mode.READY
        self.fault = 0
        """Code of the fault that it is in,"""
        self.tripped_at: Nanos = 0
        """and since when."""
        self.torque = 0.0
        """N·m on the shaft"""
        self.shaft = (0.0, 0.0)
        """True position [rad] and velocity [rad/s]."""
        self.now: Nanos | None = None
        self.silent_until: Nanos = 0
        """It restarts until then: it neither receives nor sends."""
        self.fed: Nanos = 0
        """When the watchdog was last fed."""
        self._phase = (seed * 7919 + (device.address - 1) * 619) % 1000
        self._replies: list[tuple[Nanos, Frame]] = []
        self._next: dict[str, Nanos] = {}
        """When each cyclic report is due,"""
        self._soonest: Nanos = 0
        """the first of them,"""
        self._cycles: Mapping[str, Nanos] = {}
        """and with which periods."""

    # -- the protocol's own ---------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        """Obey a received frame; a foreign one changes nothing."""
        raise NotImplementedError

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        """Run the control loop on the true shaft [rad, rad/s]; return the torque [N·m]. dt is 0 at first."""
        raise NotImplementedError

    def report(self, name: str) -> Frame | None:
        """Return a cyclic report as it is now."""
        raise NotImplementedError

    def cyclic(self) -> Mapping[str, Nanos]:
        """Return the period of each cyclic report."""
        return {}

    def timeout(self) -> Nanos:
        """Return the timeout of the watchdog; 0: it is off, or does not run now."""
        return 0

    # -- arming ---------------------------------------------------------------------------------------

    def arm(self, t: Nanos) -> bool:
        """Arm, from ready only. Returns whether it did."""
        if self.mode is not Mode.READY:
            return False
        self.mode, self.fed = Mode.ARMED, t
        return True

    def disarm(self) -> None:
        """Disarm; a fault stays."""
        if self.mode is Mode.ARMED:
            self.mode = Mode.READY

    def trip(self, code: int) -> None:
        """Enter fault."""
        self.mode, self.fault, self.tripped_at = Mode.FAULT, code, self.now or 0

    def clear(self) -> None:
        """Leave fault."""
        if self.mode is Mode.FAULT:
            self.mode, self.fault = Mode.READY, 0

    def provoke(self, code: int) -> None:
        """Trip a fault. Raises ValueError if the device has no such fault."""
        if code not in self.faults:
            raise ValueError(f"no fault {code}; there are {', '.join(map(str, sorted(self.faults)))}")
        self.trip(code)

    def feed(self, t: Nanos) -> None:
        """Feed the watchdog."""
        self.fed = t

    # -- the twin -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey a frame at once; before its first step the device has not started."""
        if self.now is not None and t >= self.silent_until:
            self._watch(t)
            self.on_frame(t, frame)

    def reply(self, t: Nanos, *frames: Frame) -> None:
        """Send frames with the next step, `reply_delay` after t at the earliest."""
        self._replies += [(t + self.reply_delay, frame) for frame in frames]

    def restart(self, t: Nanos, silent: Nanos) -> None:
        """Restart: disarmed, without a fault, and silent for a time."""
        self.mode, self.fault, self.torque, self.silent_until = Mode.READY, 0, 0.0, t + silent
        self._replies.clear()
        self._next.clear()
        self._soonest = 0

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Read the shaft, run the loops, send what is due."""
        name, before = self.device.name, self.now
        for event in truth:
            if isinstance(event, Feedback) and event.motor == name:
                position = self.shaft[0] if event.position is None else event.position
                velocity = self.shaft[1] if event.velocity is None else event.velocity
                if math.isfinite(position) and math.isfinite(velocity):
                    self.shaft = (position, velocity)
        dt = (now - before) / SECOND if before is not None and now > before else 0.0
        if before is None or now < self.silent_until:
            self.fed = now
        self.now = now
        if now < self.silent_until:
            return [Torque(name, 0.0)], []
        self._watch(now)
        passed = self.passing and now - self.tripped_at >= self.passing
        if passed and self.fault and not self.faults[self.fault].latching:
            self.clear()
        self.torque = self.cycle(now, dt, *self.shaft)
        due: list[Frame] = []
        if self._replies:
            due = [frame for at, frame in self._replies if at <= now]
            self._replies = [each for each in self._replies if each[0] > now]
        return [Torque(name, self.torque)], due + self._reports(now)

    def _watch(self, now: Nanos) -> None:
        timeout = self.timeout()
        if timeout and now - self.fed > timeout:
            self.on_timeout()

    def on_timeout(self) -> None:
        """Do what the watchdog does: trip `lost`, or disarm."""
        if self.lost:
            self.trip(self.lost)
        else:
            self.disarm()

    def _reports(self, now: Nanos) -> list[Frame]:
        periods, following = self.cyclic(), self._next
        if now < self._soonest and periods == self._cycles:
            return []
        frames = []
        for name, period in periods.items():
            at = following.get(name)
            if at is None:
                at = following[name] = now + period * self._phase // 1000
            if now >= at:
                following[name] = at + period * (1 + (now - at) // period)
                frame = self.report(name)
                frames += [] if frame is None else [frame]
        self._soonest, self._cycles = min((following[name] for name in periods), default=NEVER), dict(periods)
        return frames

    def due(self) -> Nanos | None:
        """Return when it next sends a report or reply, trips its watchdog, or has restarted."""
        if self.now is not None and self.now < self.silent_until < NEVER:
            return self.silent_until
        timeout = self.timeout()
        if not (timeout or self._next or self._replies):  # most that speak only when asked
            return None
        times = [self.fed + timeout + 1] if timeout else []
        times += [*self._next.values(), *(at for at, _ in self._replies)]
        return min(times)


def milliseconds(value: float) -> Nanos:
    """Return a setting in ms as time."""
    return round(value * MILLISECOND)


class ServoFirmware(Firmware):
    """A motor that does what it obeys with the loops of `Servo`: for devices whose firmware is known by its
    messages only."""

    def __init__(self, device: Device, seed: int, gains: Gains) -> None:
        super().__init__(device, seed)
        self.encoder = Encoder(counts=1e6, bandwidth=1000.0)
        self.servo = Servo(gains)
        self.goal: Command = msg.Idle(device.name)
        self.fastest = math.inf
        """rad/s on the way to a position"""
        self.strongest = math.inf
        """N·m"""
        self.speed_up = self.slow_down = math.inf
        """rad/s² by which the loop for velocity follows its set-point"""
        self._pace: float | None = None
        """rad/s, the set-point of this loop now; None: it begins at that of the shaft."""

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        """Do what a frame means to this device."""
        match obeyed:
            case msg.Arm() if self.arm(t):
                self.servo.reset()
                self._pace = None
            case msg.Idle():
                self.disarm()
            case msg.ClearFault():
                self.clear()
            case msg.Zero() if self.mode is not Mode.ARMED:
                self.encoder.set_position(0.0)
            case msg.Hold(motor):
                self.goal = msg.Position(motor, self.encoder.position)
            case msg.Position() | msg.Velocity() | msg.Torque() | msg.Impedance():
                self.goal = obeyed

    def measured(self) -> dict[str, float]:
        """Return what it measures of its motion."""
        encoder = self.encoder
        return {"position": encoder.position, "velocity": encoder.velocity, "torque": self.torque}

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        """Run the loops."""
        encoder, servo = self.encoder, self.servo
        encoder.measure(dt or 1.0, position, velocity)
        if self.mode is not Mode.ARMED:
            return 0.0
        match self.goal:
            case msg.Position(_, wanted, forward, torque):
                ahead = wanted - encoder.position
                speed = servo.towards(ahead, forward, self.fastest, self.slow_down)
                torque += servo.turn(dt, self._paced(dt, speed), encoder.velocity)
            case msg.Velocity(_, wanted, torque):
                speed = self._paced(dt, clamp(wanted, self.fastest))
                torque += servo.turn(dt, speed, encoder.velocity)
            case msg.Impedance() as goal:
                torque, self._pace = servo.spring(goal, encoder), None
            case msg.Torque(_, torque):
                self._pace = None
            case _:
                return 0.0
        return clamp(torque, min(self.strongest, servo.gains.torque_limit))

    def _paced(self, dt: float, wanted: float) -> float:
        """Return the set-point of the loop on the way to this velocity [rad/s]."""
        pace = self.encoder.velocity if self._pace is None else self._pace
        faster = abs(wanted) > abs(pace) and wanted * pace >= 0.0
        limit = self.speed_up if faster else self.slow_down
        self._pace = wanted if limit == math.inf else pace + clamp(wanted - pace, limit * dt)
        return self._pace
