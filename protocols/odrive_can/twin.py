"""The twin: what an ODrive of either firmware line does alike (README, "the twin").

Rules. The ear's `Axis` decides what is obeyed, `Servo` what the motor then does; `twin06` and `twin05` are
the firmware: arming, errors, watchdog, what is told. Here is the rest: the clock of cyclic messages, answers,
gains and the silence of a reboot. A device answers at the step after it was asked. Time is an argument;
phases of cyclic messages come from the seed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Nanos, Torque, seconds
from protocols.odrive_can.codec import BROADCAST, AnyMessage, decode_to_device, encode, node_of, turns
from protocols.odrive_can.decoder import Axis, axis_of
from protocols.odrive_can.faults import Error
from protocols.odrive_can.messages import (
    Ask,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajInertia,
    SetTrajVelLimit,
    SetVelGains,
)
from protocols.odrive_can.options import Settings
from protocols.odrive_can.servo import Gains, Servo
from protocols.plugin import Device

NEVER: Nanos = 1 << 62


class OdriveTwin:
    """One axis. Its state is plain data. What the firmware lines do differently, they override."""

    watchdog_sleeps: bool
    """Whether the watchdog runs in closed loop only."""

    def __init__(self, device: Device, seed: int) -> None:
        settings: Settings = device.settings
        self.device = device
        self.settings = settings
        self.axis: Axis = axis_of(device)
        self.servo = Servo(settings)
        self.silent_until: Nanos = 0
        """The boot loader runs until then."""
        self._fed: Nanos = 0
        self._now: Nanos | None = None
        self._shaft = (0.0, 0.0)
        self._replies: list[CanFrame] = []
        self._phase = (seed * 7919 + self.axis.serial * 31) % 1000
        self._next: dict[int, Nanos] = {}
        self._periods = {cmd: rate * MILLISECOND for cmd, rate in self.rates() if rate}

    # -- the firmware's own ---------------------------------------------------------------------

    def rates(self) -> Sequence[tuple[int, int]]:
        """The commands of cyclic messages, and their periods in ms."""
        raise NotImplementedError

    def handle(self, t: Nanos, node: int, message: AnyMessage) -> None:
        """A message to some node."""
        raise NotImplementedError

    def report(self, cmd: int) -> AnyMessage | None:
        """The message of a command, as it is now."""
        raise NotImplementedError

    def trip(self, errors: Error) -> None:
        """Something went wrong (in the terms of 0.6.x); an armed axis disarms."""
        raise NotImplementedError

    def provoke(self, code: int) -> None:
        """Trip a fault. ValueError if this firmware line does not have it."""
        raise NotImplementedError

    def boot(self, now: Nanos) -> None:
        """A step is taken: what the firmware does on its way up."""

    def feed(self, t: Nanos, node: int) -> None:
        """A frame came for some node, whatever it says."""

    # -- the wire -----------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        """A wire reached the device; what is not for it changes nothing."""
        if not isinstance(frame, CanFrame) or frame.fd or t < self.silent_until:
            return
        node = node_of(frame)
        self.feed(t, node)
        message = decode_to_device(frame, self.axis.line)
        if isinstance(message, Ask):
            self.answer(node, message.cmd)
        elif message is not None:
            self.handle(t, node, message)

    def answer(self, node: int, cmd: int) -> None:
        """A node was asked for a message."""
        if node == self.axis.node:
            self.reply(self.report(cmd))

    def reply(self, message: AnyMessage | None) -> None:
        """To be said at the next step."""
        if message is not None:
            self._replies.append(encode(self.axis.node, message))

    def configure(self, message: AnyMessage) -> None:
        """Gains and limits, which both lines take alike."""
        gains = self.servo.gains
        match message:
            case SetLimits(velocity, current):
                gains.vel_limit = abs(velocity)
                gains.current_soft_max = min(abs(current), self.settings.current_hard_max)
            case SetPosGain(gain):
                gains.pos_gain = gain
            case SetVelGains(gain, integrator):
                gains.vel_gain, gains.vel_integrator_gain = gain, integrator
            case SetTrajVelLimit(velocity):
                gains.trap_vel_limit = abs(velocity)
            case SetTrajAccelLimits(acceleration, deceleration):
                gains.trap_accel_limit, gains.trap_decel_limit = abs(acceleration), abs(deceleration)
            case SetTrajInertia(inertia):
                gains.inertia = inertia

    def restart(self, t: Nanos, node: int, gains: Gains) -> None:
        """The processor starts again, with what was saved: silent at first, and disarmed."""
        self.silent_until = t + self.settings.reboot_ms * MILLISECOND
        serial = self.axis.serial
        self.axis = axis_of(self.device)
        self.axis.node, self.axis.serial = node, serial
        whole_turns = math.floor(self.servo.shaft)
        self.servo = Servo(self.settings)
        self.servo.gains = Gains(**{name: getattr(gains, name) for name in Gains.__slots__})
        self.servo.offset = whole_turns  # an absolute encoder knows its place within one turn only
        self._replies.clear()
        self._next.clear()

    # -- time ---------------------------------------------------------------------------------

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`; the shaft's Feedback [rad, rad/s] is what the encoder sees."""
        for event in truth:
            self._see(event)
        dt = 0.0 if self._now is None else seconds(max(0, now - self._now))
        first, self._now = self._now is None, now
        shaft, velocity = turns(self._shaft[0]), turns(self._shaft[1])
        if first:
            self.servo.measure(1.0, shaft, velocity)
            self._fed = now
        elif dt > 0.0:
            self.servo.measure(dt, shaft, velocity)
        if now < self.silent_until:
            self._fed = now
            return (Torque(self.device.name, 0.0),), ()
        self.boot(now)
        if dt > 0.0:
            errors = self.servo.step(dt, self.axis)
            if errors:
                self.trip(errors)
        if self._watching() and now - self._fed > self._timeout():
            self.trip(Error.WATCHDOG_TIMER_EXPIRED)
        torque = self.servo.torque() if self.axis.armed else 0.0
        replies, self._replies = self._replies, []
        return (Torque(self.device.name, torque),), (*replies, *self._cyclic(now))

    def _see(self, event: Event) -> None:
        if isinstance(event, Feedback) and event.motor == self.device.name:
            position = self._shaft[0] if event.position is None else event.position
            velocity = self._shaft[1] if event.velocity is None else event.velocity
            if math.isfinite(position) and math.isfinite(velocity):
                self._shaft = (position, velocity)

    def _watching(self) -> bool:
        return self.settings.enable_watchdog and (self.axis.armed or not self.watchdog_sleeps)

    def _timeout(self) -> Nanos:
        return round(self.settings.watchdog_timeout * SECOND)

    def _cyclic(self, now: Nanos) -> Sequence[CanFrame]:
        if self.axis.line == "0.6" and self.axis.node == BROADCAST:  # it has no address yet
            return ()
        if not self._next:
            self._next = {cmd: now + period * self._phase // 1000 for cmd, period in self._periods.items()}
        frames = []
        for cmd, period in self._periods.items():
            if now >= self._next[cmd]:
                self._next[cmd] += period * (1 + (now - self._next[cmd]) // period)
                message = self.report(cmd)
                if message is not None:
                    frames.append(encode(self.axis.node, message))
        return frames

    def due(self) -> Nanos | None:
        """When the device next says something by itself, or leaves a state by itself."""
        times = list(self._next.values())
        if self._now is not None and self._now < self.silent_until < NEVER:
            times = [self.silent_until]
        if self._watching() and self._fed + self._timeout() >= (self._now or 0):
            times.append(self._fed + self._timeout() + 1)
        return min(times, default=None)
