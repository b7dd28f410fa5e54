"""The twin: what an ODrive of either firmware line does alike (README, "The twin of 0.6").

Rules. The decoder's `Axis` decides what is obeyed, `Servo` what the motor then does; `twin06` and `twin05`
are the firmware: arming, errors, watchdog, reported values. Here is the rest: cyclic messages, replies, gains
and the silence during a reboot. A device replies at the step after a request. Time is an argument; the phases
of cyclic messages come from the seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Nanos, Torque, seconds
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import BROADCAST, cmd_of, decode_to_device, encode, node_of, turns
from protocols.odrive_can.decoder import Axis, axis_of
from protocols.odrive_can.faults import Error
from protocols.odrive_can.options import Settings
from protocols.odrive_can.servo import Gains, Servo, gains_of
from protocols.plugin import Device

NEVER: Nanos = 1 << 62

Reports = Mapping[int, Callable[[Any], m.Message | None]]
"""By command: the message of a twin as it is now; None if there is none."""
COMMON_REPORTS: Reports = {
    cmd_of(m.GetEncoderEstimates): lambda twin: m.GetEncoderEstimates(
        twin.servo.position, twin.servo.velocity
    ),
    cmd_of(m.GetIq): lambda twin: m.GetIq(twin.servo.iq_setpoint, twin.servo.iq),
    cmd_of(m.GetBusVoltageCurrent): lambda twin: m.GetBusVoltageCurrent(
        twin.servo.bus_voltage, twin.servo.bus_current
    ),
}


class OdriveTwin:
    """One axis. Its state is plain data. What the firmware lines do differently, they override."""

    watchdog_needs_arming: bool
    """Whether the watchdog runs in closed loop only."""
    cyclic: ClassVar[Mapping[type[m.Message], str]]
    """The cyclic messages, and the settings that hold their periods [ms], in the order of sending."""
    reports: ClassVar[Reports]

    def __init__(self, device: Device, seed: int) -> None:
        settings: Settings = device.settings
        self.device = device
        self.settings = settings
        self.axis: Axis = axis_of(device)
        self.servo = Servo(settings)
        self.silent_until: Nanos = 0
        """The boot loader runs until then."""
        self._fed: Nanos = 0
        """When the watchdog was last fed."""
        self._now: Nanos | None = None
        self._shaft = (0.0, 0.0)
        """Position [rad] and velocity [rad/s] in the world."""
        self._replies: list[CanFrame] = []
        self._phase = (seed * 7919 + self.axis.serial * 31) % 1000
        self._next: dict[int, Nanos] = {}
        """When each cyclic message is due."""
        periods = {cmd_of(kind): getattr(settings, name) for kind, name in self.cyclic.items()}
        self._periods: dict[int, Nanos] = {cmd: ms * MILLISECOND for cmd, ms in periods.items() if ms}

    # -- the firmware's own ---------------------------------------------------------------------

    def on_message(self, t: Nanos, node: int, message: m.Message) -> None:
        """Handle a message to any node."""
        raise NotImplementedError

    def trip(self, errors: Error) -> None:
        """Raise errors (in the terms of 0.6.x); an armed axis disarms."""
        raise NotImplementedError

    def provoke(self, code: int) -> None:
        """Trip a fault. ValueError if this firmware line does not have it."""
        raise NotImplementedError

    def boot(self, now: Nanos) -> None:
        """Run the part of a step that belongs to starting up."""

    def feed(self, t: Nanos, node: int) -> None:
        """Note a frame to any node, whatever its content."""

    # -- frames -------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Handle a received frame; a foreign one changes nothing."""
        if not isinstance(frame, CanFrame) or frame.fd or t < self.silent_until:
            return
        node = node_of(frame)
        self.feed(t, node)
        message = decode_to_device(frame, self.axis.line)
        if isinstance(message, m.RemoteRequest):
            self.on_request(node, message.cmd)
        elif message is not None:
            self.on_message(t, node, message)

    def on_request(self, node: int, cmd: int) -> None:
        """Handle a request of a message of any node."""
        if node == self.axis.node:
            self.reply(self.report(cmd))

    def report(self, cmd: int) -> m.Message | None:
        """Return the message of a command as it is now; None if there is none."""
        report = self.reports.get(cmd)
        return report(self) if report is not None else None

    def reply(self, message: m.Message | None) -> None:
        """Send a message at the next step."""
        if message is not None:
            self._replies.append(encode(self.axis.node, message))

    def configure(self, message: m.Message) -> None:
        """Set gains and limits, which is the same in both lines."""
        gains = self.servo.gains
        match message:
            case m.SetLimits(velocity, current):
                gains.vel_limit = abs(velocity)
                gains.current_soft_max = min(abs(current), self.settings.current_hard_max)
            case m.SetPosGain(gain):
                gains.pos_gain = gain
            case m.SetVelGains(gain, integrator):
                gains.vel_gain, gains.vel_integrator_gain = gain, integrator
            case m.SetTrajVelLimit(velocity):
                gains.trap_vel_limit = abs(velocity)
            case m.SetTrajAccelLimits(acceleration, deceleration):
                gains.trap_accel_limit, gains.trap_decel_limit = abs(acceleration), abs(deceleration)
            case m.SetTrajInertia(inertia):
                gains.inertia = inertia

    def restart(self, t: Nanos, node: int, gains: Gains) -> None:
        """Restart the processor with the saved node id and gains: silent at first, and disarmed."""
        self.silent_until = t + self.settings.reboot_ms * MILLISECOND
        serial = self.axis.serial
        self.axis = axis_of(self.device)
        self.axis.node, self.axis.serial = node, serial
        whole_turns = math.floor(self.servo.shaft)
        self.servo = Servo(self.settings)
        self.servo.gains = gains_of(gains)
        self.servo.offset = whole_turns  # an absolute encoder knows its position within one turn only
        self._replies.clear()
        self._next.clear()

    # -- time ---------------------------------------------------------------------------------

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`; the shaft's Feedback [rad, rad/s] is what the encoder measures."""
        for event in truth:
            self._on_truth(event)
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
        if self._watchdog_runs() and now - self._fed > self._timeout():
            self.trip(Error.WATCHDOG_TIMER_EXPIRED)
        torque = self.servo.torque() if self.axis.armed else 0.0
        replies, self._replies = self._replies, []
        return (Torque(self.device.name, torque),), (*replies, *self._cyclic_frames(now))

    def _on_truth(self, event: Event) -> None:
        if isinstance(event, Feedback) and event.motor == self.device.name:
            position = self._shaft[0] if event.position is None else event.position
            velocity = self._shaft[1] if event.velocity is None else event.velocity
            if math.isfinite(position) and math.isfinite(velocity):
                self._shaft = (position, velocity)

    def _watchdog_runs(self) -> bool:
        return self.settings.enable_watchdog and (self.axis.armed or not self.watchdog_needs_arming)

    def _timeout(self) -> Nanos:
        return round(self.settings.watchdog_timeout * SECOND)

    def _cyclic_frames(self, now: Nanos) -> Sequence[CanFrame]:
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
        """Return when the device next sends a cyclic message, or leaves a state by itself."""
        times = list(self._next.values())
        if self._now is not None and self._now < self.silent_until < NEVER:
            times = [self.silent_until]
        if self._watchdog_runs() and self._fed + self._timeout() >= (self._now or 0):
            times.append(self._fed + self._timeout() + 1)
        return min(times, default=None)
