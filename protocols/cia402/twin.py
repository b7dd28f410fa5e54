"""The twin: a CiA 402 drive (README, "The twin").

Rules. `Axis` decides what is obeyed, `MotorControl` what the motor then does, `tpdo_scheduler` when TPDOs are
sent; this file is the firmware around them: boot-up, heartbeats both ways, faults and their reaction, EMCY,
the statusword. The drive acts and responds at the step after it received a frame. Time is an argument; the
seed shifts the phase of the heartbeat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols.canopen import sdo
from protocols.canopen.services import Emcy, Heartbeat, NmtState, encode, sdo_rx_id, sdo_tx_id
from protocols.cia402 import objects as o
from protocols.cia402.axis import Axis, Signal
from protocols.cia402.faults import FAULTS, HEARTBEAT_LOST, NO_ERROR, RPDO_TIMEOUT, register_of
from protocols.cia402.motor_control import MotorControl
from protocols.cia402.objects import Type
from protocols.cia402.options import Settings
from protocols.cia402.profile import STATE_BITS, Mode, PowerState, Status
from protocols.cia402.tpdo_scheduler import Tpdo, tpdos
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Event, Feedback, Nanos, Torque, seconds
from protocols.plugin import Device

FAULTY = (PowerState.FAULT, PowerState.FAULT_REACTION)
LOST_STATES = {0: NmtState.PRE_OPERATIONAL, 2: NmtState.STOPPED}
"""By object 1029:01: the NMT state after the host is lost."""


class Cia402Twin:
    """One drive. Its state is plain data."""

    def __init__(self, device: Device, seed: int) -> None:
        self.settings: Settings = device.settings
        self.name = device.name
        self.axis = Axis(device, instant=False)
        self.motor = MotorControl(self.settings)
        self.tpdos: list[Tpdo] = tpdos()
        self.silent_until: Nanos = 0
        """It boots until then, and sends nothing."""
        self._sdo_rx = sdo_rx_id(device.address)
        self._phase = (seed * 7919 + device.address * 31) % 1000
        self._booted = False
        """Its boot-up message is sent."""
        self._now: Nanos | None = None
        self._shaft = (0.0, 0.0)
        self._out: list[CanFrame] = []
        """To be sent at the next step."""
        self._responses: list[tuple[Nanos, CanFrame]] = []
        """SDO responses, and when each is due."""
        self._beat: Nanos | None = None
        """When its next heartbeat is due."""
        self._period: Nanos = 0

    # -- receiving ----------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Handle a frame; one that is not for the device changes nothing."""
        if not self._booted:
            return
        axis = self.axis
        before, nmt = axis.state, axis.nmt
        if isinstance(frame, CanFrame) and frame.id == self._sdo_rx:
            self._update_measurements()
        axis.receive(t, frame)
        if not (axis.signals or axis.responses or axis.state is not before or axis.nmt is not nmt):
            return
        if nmt is not axis.nmt and axis.nmt is NmtState.OPERATIONAL:
            self.tpdos = tpdos()
        self._queue_responses(t)
        if before is PowerState.FAULT and axis.state is PowerState.SWITCH_ON_DISABLED:
            self._clear_fault()
        for signal in axis.signals:
            if signal is Signal.RESET_NODE:
                self._restart(t)
            elif signal is Signal.RESET_COMMUNICATION:
                self._booted, self._beat = False, None
            elif signal is Signal.CONNECTION_LOST and self._loss_is_a_fault():
                self.trip(HEARTBEAT_LOST)
        axis.signals[:] = [signal for signal in axis.signals if signal is Signal.SYNC]

    def _loss_is_a_fault(self) -> bool:
        return self.axis.dictionary.values[o.ABORT_CONNECTION] == 1

    def _queue_responses(self, t: Nanos) -> None:
        responses, self.axis.responses = self.axis.responses, []
        for response in responses:
            frame = CanFrame(sdo_tx_id(self.axis.node), sdo.encode(response))
            self._responses.append((t + self.settings.sdo_delay_ms * MILLISECOND, frame))

    def _restart(self, t: Nanos) -> None:
        """Reset node: boot anew, without what was written and without home."""
        self.silent_until = t + self.settings.boot_ms * MILLISECOND
        self._booted, self._beat = False, None
        self.motor = MotorControl(self.settings)
        self._out.clear()
        self._responses.clear()

    # -- faults -------------------------------------------------------------------------------

    def provoke(self, code: int) -> None:
        """Trip a fault as if the firmware had detected it. ValueError if there is none of this code."""
        if code not in FAULTS:
            raise ValueError(f"no fault {code:#06x}")
        self.trip(code)

    def trip(self, code: int) -> None:
        """Enter a fault: send EMCY, react by 605E, and stay in FAULT until it is reset."""
        axis, values = self.axis, self.axis.dictionary.values
        values[o.ERROR_CODE] = code
        values[o.ERROR_REGISTER] = register_of(code)
        self._send_emcy(code)
        if axis.state in FAULTY:
            return
        powered = axis.state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP)
        axis.state = PowerState.FAULT_REACTION if powered else PowerState.FAULT
        axis.goal = axis.next_goal = None

    def _send_emcy(self, code: int) -> None:
        if self.axis.nmt is not NmtState.STOPPED:
            self._out.append(encode(Emcy(self.axis.node, code, register_of(code))))

    def _clear_fault(self) -> None:
        values = self.axis.dictionary.values
        values[o.ERROR_CODE] = values[o.ERROR_REGISTER] = 0
        self._send_emcy(NO_ERROR)

    def _monitor_host(self, now: Nanos) -> None:
        """Check the heartbeat consumer time (1016) and the deadlines of RPDOs (140x:05)."""
        axis, values = self.axis, self.axis.dictionary.values
        timeout = (values[o.CONSUMER_HEARTBEAT] & 0xFFFF) * MILLISECOND
        if timeout and axis.host_beat is not None and now - axis.host_beat > timeout:
            axis.host_beat = None
            self._lose_host(HEARTBEAT_LOST)
        for index, received in sorted(axis.received.items()):
            deadline = values[index, o.EVENT_TIMER] * MILLISECOND
            if deadline and now - received > deadline:
                del axis.received[index]
                self._lose_host(RPDO_TIMEOUT)

    def _lose_host(self, code: int) -> None:
        """React to a lost host: EMCY, the reaction of 6007, and the NMT state of 1029."""
        axis = self.axis
        axis.lose_connection()
        lost = Signal.CONNECTION_LOST in axis.signals
        axis.signals[:] = [signal for signal in axis.signals if signal is Signal.SYNC]
        if lost and self._loss_is_a_fault():
            self.trip(code)
        else:
            self._send_emcy(code)
        if axis.nmt is NmtState.OPERATIONAL:
            axis.nmt = LOST_STATES.get(axis.dictionary.values[o.ERROR_BEHAVIOUR], axis.nmt)
            axis.latched.clear()

    # -- time ---------------------------------------------------------------------------------

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`; the encoder measures the shaft's Feedback [rad, rad/s]."""
        for event in truth:
            self._measure(event)
        dt = 0.0 if self._now is None else seconds(max(0, now - self._now))
        first, self._now = self._now is None, now
        if first or dt > 0.0:
            self.motor.measure(dt or 1.0, *self._shaft, self.axis.units.gear)
        if now < self.silent_until:
            return (Torque(self.name, 0.0),), ()
        if not self._booted:
            self._boot(now)
        self._monitor_host(now)
        if dt > 0.0:
            code = self.motor.step(dt, self.axis)
            if code:
                self.trip(code)
        if not self.axis.enabled:
            self.axis.position = self._position()
        return (Torque(self.name, self.motor.torque),), self._frames(now)

    def _measure(self, event: Event) -> None:
        if isinstance(event, Feedback) and event.motor == self.name:
            position = self._shaft[0] if event.position is None else event.position
            velocity = self._shaft[1] if event.velocity is None else event.velocity
            if math.isfinite(position) and math.isfinite(velocity):
                self._shaft = (position, velocity)

    def _boot(self, now: Nanos) -> None:
        """Send the boot-up message; then be pre-operational."""
        self._booted = True
        self._out.append(encode(Heartbeat(self.axis.node, NmtState.INITIALISING)))
        self._beat = None
        self.axis.nmt = NmtState.PRE_OPERATIONAL
        self._schedule_heartbeat(now)

    def _schedule_heartbeat(self, now: Nanos) -> None:
        """Start the heartbeat with the producer time of 1017."""
        self._period = self.axis.dictionary.values[o.PRODUCER_HEARTBEAT] * MILLISECOND
        self._beat = now + self._period * self._phase // 1000 if self._period else None

    def _frames(self, now: Nanos) -> Sequence[CanFrame]:
        axis, frames = self.axis, self._out
        self._out = []
        frames += [frame for due, frame in self._responses if due <= now]
        self._responses = [(due, frame) for due, frame in self._responses if due > now]
        syncs, axis.signals = len(axis.signals), []
        if axis.nmt is NmtState.OPERATIONAL and (
            syncs or any(tpdo.is_timed(axis.dictionary) for tpdo in self.tpdos)
        ):
            self._update_measurements()
            for tpdo in self.tpdos:
                for _ in range(syncs):
                    frames += tpdo.on_sync(now, axis.dictionary)
                frames += tpdo.on_time(now, axis.dictionary)
        if self._period != axis.dictionary.values[o.PRODUCER_HEARTBEAT] * MILLISECOND:
            self._schedule_heartbeat(now)
        if self._beat is not None and now >= self._beat:
            self._beat += self._period * (1 + (now - self._beat) // self._period)
            frames.append(encode(Heartbeat(axis.node, axis.nmt)))
        return frames

    def due(self) -> Nanos | None:
        """Return when the device next has something to send by itself."""
        if self._now is not None and self._now < self.silent_until:
            return self.silent_until
        times = [due for due, _ in self._responses]
        times += [self._beat] if self._beat is not None else []
        if self.axis.nmt is NmtState.OPERATIONAL:
            times += [due for tpdo in self.tpdos if (due := tpdo.due(self.axis.dictionary)) is not None]
        timeout = (self.axis.dictionary.values[o.CONSUMER_HEARTBEAT] & 0xFFFF) * MILLISECOND
        if timeout and self.axis.host_beat is not None:
            times.append(self.axis.host_beat + timeout + 1)
        return min(times, default=None)

    # -- measured objects -------------------------------------------------------------------------

    def _position(self) -> int:
        """Return the position actual value (6064)."""
        return _fit(Type.I32, self.motor.position * self.axis.units.per_turn / math.tau)

    def _update_measurements(self) -> None:
        """Update the measured values of the dictionary."""
        axis, motor = self.axis, self.motor
        values, units = axis.dictionary.values, axis.units
        per_radian = units.per_turn / math.tau
        values[o.POSITION] = self._position()
        per_speed = units.velocity_per_turn / math.tau
        values[o.VELOCITY] = _fit(Type.I32, motor.velocity * per_speed)
        values[o.POSITION_DEMAND] = _fit(Type.I32, motor.ramp.position * per_radian)
        values[o.VELOCITY_DEMAND] = _fit(Type.I32, motor.ramp.velocity * per_speed)
        permille = 1000.0 / (units.rated_torque * units.gear)
        values[o.TORQUE] = _fit(Type.I16, motor.torque * permille)
        values[o.CURRENT] = values[o.TORQUE]
        values[o.TORQUE_DEMAND] = _fit(Type.I16, motor.demanded_torque * permille)
        values[o.DC_VOLTAGE] = round(self.settings.dc_voltage * 1000.0)
        values[o.MODE_DISPLAY] = values[o.MODE]
        values[o.STATUSWORD] = self._statusword()

    def _statusword(self) -> int:
        axis, motor = self.axis, self.motor
        status = STATE_BITS[axis.state][1] | ALWAYS
        if motor.limited:
            status |= LIMITED
        if axis.state is PowerState.QUICK_STOP:
            return status | (REACHED if motor.at_standstill() else 0)
        if axis.mode is Mode.HM:  # the homing state is shown also while it is not enabled
            return status | self._homing_bits()
        return status | self._mode_bits() if axis.enabled else status

    def _homing_bits(self) -> int:
        motor = self.motor
        if motor.homing or self.axis.homing_requested:
            return 0
        return REACHED | (BIT_12 if motor.homed else 0)

    def _mode_bits(self) -> int:
        axis, motor, values = self.axis, self.motor, self.axis.dictionary.values
        error = BIT_13 if motor.following_error else 0
        match axis.mode:
            case Mode.CSP:
                return BIT_12 | error
            case Mode.CSV | Mode.CST:
                return BIT_12
            case Mode.PP:
                acknowledged = BIT_12 if axis.acknowledged else 0
                return error | acknowledged | self._reached(values[o.POSITION_WINDOW_TIME])
            case Mode.PV:
                slow = abs(motor.velocity) <= axis.units.velocity(values[o.VELOCITY_THRESHOLD])
                return (BIT_12 if slow else 0) | self._reached(values[o.VELOCITY_WINDOW_TIME])
            case Mode.PT:
                return self._reached(0)
        return 0

    def _reached(self, milliseconds: int) -> int:
        return REACHED if self.motor.arrived.lasts(milliseconds) else 0


ALWAYS = int(Status.VOLTAGE_ENABLED | Status.REMOTE)
LIMITED = int(Status.INTERNAL_LIMIT)
REACHED = int(Status.TARGET_REACHED)
BIT_12 = int(Status.FOLLOWS_COMMAND)
"""Also set-point acknowledged, zero speed, homing attained."""
BIT_13 = int(Status.FOLLOWING_ERROR)


def _fit(type_: Type, value: float) -> int:
    """Round a measured value, saturated to the range of its object."""
    return max(type_.low, min(type_.high, round(value)))
