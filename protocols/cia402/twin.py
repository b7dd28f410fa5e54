"""The twin: a CiA 402 drive (README, "The twin").

Rules. The `Axis` decides what is obeyed, `Drive` what the motor then does, `telling` what goes out when;
this file is the firmware that ties them: boot-up, heartbeats both ways, faults and their reaction, EMCY, the
statusword. The drive acts and answers at the step after it heard. Time is an argument; the seed shifts the
phase of the heartbeat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols.cia402 import objects as o
from protocols.cia402 import sdo
from protocols.cia402.axis import Axis, Signal
from protocols.cia402.codec import Emcy, Heartbeat, NmtState, encode, sdo_rx_id, sdo_tx_id
from protocols.cia402.drive import Drive
from protocols.cia402.faults import FAULTS, HEARTBEAT_LOST, NO_ERROR, RPDO_TIMEOUT, register_of
from protocols.cia402.objects import Type
from protocols.cia402.options import Settings
from protocols.cia402.profile import STATE_BITS, Mode, PowerState, Status
from protocols.cia402.tpdo_scheduler import Tpdo, tpdos
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Event, Feedback, Nanos, Torque, seconds
from protocols.plugin import Device

FAULTY = (PowerState.FAULT, PowerState.FAULT_REACTION)
LOST_STATES = {0: NmtState.PRE_OPERATIONAL, 2: NmtState.STOPPED}
"""By object 1029:01: the NMT state after the host fell silent."""


class Cia402Twin:
    """One drive. Its state is plain data."""

    def __init__(self, device: Device, seed: int) -> None:
        self.settings: Settings = device.settings
        self.name = device.name
        self.axis = Axis(device, instant=False)
        self.drive = Drive(self.settings)
        self.tpdos: list[Tpdo] = tpdos()
        self.silent_until: Nanos = 0
        """It boots until then."""
        self._asked = sdo_rx_id(device.address)
        self._phase = (seed * 7919 + device.address * 31) % 1000
        self._booted = False
        """Its boot-up message is out."""
        self._now: Nanos | None = None
        self._shaft = (0.0, 0.0)
        self._out: list[CanFrame] = []
        """What is said at the next step."""
        self._answers: list[tuple[Nanos, CanFrame]] = []
        self._beat: Nanos | None = None
        """When its heartbeat goes next."""
        self._period: Nanos = 0
        self._lost_connection = False
        """The reaction to it (6007) made the fault that is told next."""

    # -- hearing ------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        """A wire reached the device; what is not for it changes nothing."""
        if not self._booted:
            return
        axis = self.axis
        before, nmt = axis.state, axis.nmt
        if isinstance(frame, CanFrame) and frame.id == self._asked:
            self._report()
        axis.handle(t, frame)
        if not (axis.signals or axis.answers or axis.state is not before or axis.nmt is not nmt):
            return
        if nmt is not axis.nmt and axis.nmt is NmtState.OPERATIONAL:
            self.tpdos = tpdos()
        self._serve(t)
        if before is PowerState.FAULT and axis.state is PowerState.SWITCH_ON_DISABLED:
            self._clear()
        for signal in axis.signals:
            if signal is Signal.RESET_NODE:
                self._restart(t)
            elif signal is Signal.RESET_COMMUNICATION:
                self._booted, self._beat = False, None
            elif signal is Signal.CONNECTION_LOST and self._is_a_fault():
                self.trip(HEARTBEAT_LOST)
        axis.signals[:] = [signal for signal in axis.signals if signal is Signal.SYNC]

    def _is_a_fault(self) -> bool:
        return self.axis.dictionary.values[o.ABORT_CONNECTION] == 1

    def _serve(self, t: Nanos) -> None:
        answers, self.axis.answers = self.axis.answers, []
        for answer in answers:
            frame = CanFrame(sdo_tx_id(self.axis.node), sdo.encode(answer))
            self._answers.append((t + self.settings.sdo_delay_ms * MILLISECOND, frame))

    def _restart(self, t: Nanos) -> None:
        """Reset node: it boots anew, and has forgotten what was written and where home was."""
        self.silent_until = t + self.settings.boot_ms * MILLISECOND
        self._booted, self._beat = False, None
        self.drive = Drive(self.settings)
        self._out.clear()
        self._answers.clear()

    # -- faults -------------------------------------------------------------------------------

    def provoke(self, code: int) -> None:
        """Trip a fault as if the firmware had found it. ValueError if there is none of this code."""
        if code not in FAULTS:
            raise ValueError(f"no fault {code:#06x}")
        self.trip(code)

    def trip(self, code: int) -> None:
        """A fault: EMCY goes out, the drive reacts by 605E and stays in FAULT until it is reset."""
        axis, values = self.axis, self.axis.dictionary.values
        values[o.ERROR_CODE] = code
        values[o.ERROR_REGISTER] = register_of(code)
        self._emergency(code)
        if axis.state in FAULTY:
            return
        powered = axis.state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP)
        axis.state = PowerState.FAULT_REACTION if powered else PowerState.FAULT
        axis.goal = axis.next_goal = None

    def _emergency(self, code: int) -> None:
        if self.axis.nmt is not NmtState.STOPPED:
            self._out.append(encode(Emcy(self.axis.node, code, register_of(code))))

    def _clear(self) -> None:
        values = self.axis.dictionary.values
        values[o.ERROR_CODE] = values[o.ERROR_REGISTER] = 0
        self._emergency(NO_ERROR)

    def _watch_host(self, now: Nanos) -> None:
        """Heartbeat consumer (1016) and the deadlines of RPDOs (140x:05)."""
        axis, values = self.axis, self.axis.dictionary.values
        timeout = (values[o.CONSUMER_HEARTBEAT] & 0xFFFF) * MILLISECOND
        if timeout and axis.host_beat is not None and now - axis.host_beat > timeout:
            axis.host_beat = None
            self._lose(HEARTBEAT_LOST)
        for index, received in sorted(axis.received.items()):
            deadline = values[index, o.EVENT_TIMER] * MILLISECOND
            if deadline and now - received > deadline:
                del axis.received[index]
                self._lose(RPDO_TIMEOUT)

    def _lose(self, code: int) -> None:
        """The host fell silent: EMCY, the reaction of 6007, and the NMT state of 1029."""
        axis = self.axis
        axis.lose_connection()
        lost = Signal.CONNECTION_LOST in axis.signals
        axis.signals[:] = [signal for signal in axis.signals if signal is Signal.SYNC]
        if lost and self._is_a_fault():
            self.trip(code)
        else:
            self._emergency(code)
        if axis.nmt is NmtState.OPERATIONAL:
            axis.nmt = LOST_STATES.get(axis.dictionary.values[o.ERROR_BEHAVIOUR], axis.nmt)
            axis.latched.clear()

    # -- time ---------------------------------------------------------------------------------

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`; the shaft's Feedback [rad, rad/s] is what the encoder sees."""
        for event in truth:
            self._see(event)
        dt = 0.0 if self._now is None else seconds(max(0, now - self._now))
        first, self._now = self._now is None, now
        if first or dt > 0.0:
            self.drive.measure(dt or 1.0, *self._shaft, self.axis.units.gear)
        if now < self.silent_until:
            return (Torque(self.name, 0.0),), ()
        if not self._booted:
            self._boot(now)
        self._watch_host(now)
        if dt > 0.0:
            code = self.drive.step(dt, self.axis)
            if code:
                self.trip(code)
        if not self.axis.enabled:
            self.axis.position = self._counted()
        return (Torque(self.name, self.drive.torque),), self._say(now)

    def _see(self, event: Event) -> None:
        if isinstance(event, Feedback) and event.motor == self.name:
            position = self._shaft[0] if event.position is None else event.position
            velocity = self._shaft[1] if event.velocity is None else event.velocity
            if math.isfinite(position) and math.isfinite(velocity):
                self._shaft = (position, velocity)

    def _boot(self, now: Nanos) -> None:
        """The boot-up message; then pre-operational."""
        self._booted = True
        self._out.append(encode(Heartbeat(self.axis.node, NmtState.INITIALISING)))
        self._beat = None
        self.axis.nmt = NmtState.PRE_OPERATIONAL
        self._schedule(now)

    def _schedule(self, now: Nanos) -> None:
        """The heartbeat's period was set, or is seen for the first time."""
        self._period = self.axis.dictionary.values[o.PRODUCER_HEARTBEAT] * MILLISECOND
        self._beat = now + self._period * self._phase // 1000 if self._period else None

    def _say(self, now: Nanos) -> Sequence[CanFrame]:
        axis, said = self.axis, self._out
        self._out = []
        said += [frame for due, frame in self._answers if due <= now]
        self._answers = [(due, frame) for due, frame in self._answers if due > now]
        syncs, axis.signals = len(axis.signals), []
        if axis.nmt is NmtState.OPERATIONAL and (
            syncs or any(tpdo.is_timed(axis.dictionary) for tpdo in self.tpdos)
        ):
            self._report()
            for tpdo in self.tpdos:
                for _ in range(syncs):
                    said += tpdo.on_sync(now, axis.dictionary)
                said += tpdo.on_time(now, axis.dictionary)
        if self._period != axis.dictionary.values[o.PRODUCER_HEARTBEAT] * MILLISECOND:
            self._schedule(now)
        if self._beat is not None and now >= self._beat:
            self._beat += self._period * (1 + (now - self._beat) // self._period)
            said.append(encode(Heartbeat(axis.node, axis.nmt)))
        return said

    def due(self) -> Nanos | None:
        """When the device next has something to say by itself."""
        if self._now is not None and self._now < self.silent_until:
            return self.silent_until
        times = [due for due, _ in self._answers]
        times += [self._beat] if self._beat is not None else []
        if self.axis.nmt is NmtState.OPERATIONAL:
            times += [due for tpdo in self.tpdos if (due := tpdo.due(self.axis.dictionary)) is not None]
        timeout = (self.axis.dictionary.values[o.CONSUMER_HEARTBEAT] & 0xFFFF) * MILLISECOND
        if timeout and self.axis.host_beat is not None:
            times.append(self.axis.host_beat + timeout + 1)
        return min(times, default=None)

    # -- what it tells of itself ------------------------------------------------------------------

    def _counted(self) -> int:
        """The position as 6064 has it."""
        return _fit(Type.I32, self.drive.position * self.axis.units.per_turn / math.tau)

    def _report(self) -> None:
        """Bring the dictionary's measured values up to date."""
        axis, drive = self.axis, self.drive
        values, units = axis.dictionary.values, axis.units
        per_radian = units.per_turn / math.tau
        values[o.POSITION] = self._counted()
        values[o.VELOCITY] = _fit(Type.I32, drive.velocity * per_radian)
        values[o.POSITION_DEMAND] = _fit(Type.I32, drive.ramp.position * per_radian)
        values[o.VELOCITY_DEMAND] = _fit(Type.I32, drive.ramp.velocity * per_radian)
        permille = 1000.0 / (units.rated_torque * units.gear)
        values[o.TORQUE] = _fit(Type.I16, drive.torque * permille)
        values[o.CURRENT] = values[o.TORQUE]
        values[o.TORQUE_DEMAND] = _fit(Type.I16, drive.wanted * permille)
        values[o.DC_VOLTAGE] = round(self.settings.dc_voltage * 1000.0)
        values[o.MODE_DISPLAY] = values[o.MODE]
        values[o.STATUSWORD] = self._statusword()

    def _statusword(self) -> int:
        axis, drive = self.axis, self.drive
        word = STATE_BITS[axis.state][1] | ALWAYS
        if drive.limited:
            word |= LIMITED
        if axis.state is PowerState.QUICK_STOP:
            return word | (REACHED if drive.standing() else 0)
        if axis.mode is Mode.HM:  # also while it is not enabled: whether home is known
            return word | self._homing_bits()
        return word | self._mode_bits() if axis.enabled else word

    def _homing_bits(self) -> int:
        drive = self.drive
        if drive.homing or self.axis.homing_asked:
            return 0
        return REACHED | (BIT_12 if drive.homed else 0)

    def _mode_bits(self) -> int:
        axis, drive, values = self.axis, self.drive, self.axis.dictionary.values
        error = BIT_13 if drive.following_error else 0
        match axis.mode:
            case Mode.CSP:
                return BIT_12 | error
            case Mode.CSV | Mode.CST:
                return BIT_12
            case Mode.PP:
                acknowledged = BIT_12 if axis.acknowledged else 0
                return error | acknowledged | self._reached(values[o.POSITION_WINDOW_TIME])
            case Mode.PV:
                slow = abs(drive.velocity) <= axis.units.velocity(values[o.VELOCITY_THRESHOLD])
                return (BIT_12 if slow else 0) | self._reached(values[o.VELOCITY_WINDOW_TIME])
            case Mode.PT:
                return self._reached(0)
        return 0

    def _reached(self, milliseconds: int) -> int:
        return REACHED if self.drive.arrived.lasts(milliseconds) else 0


ALWAYS = int(Status.VOLTAGE_ENABLED | Status.REMOTE)
LIMITED = int(Status.INTERNAL_LIMIT)
REACHED = int(Status.TARGET_REACHED)
BIT_12 = int(Status.FOLLOWS_COMMAND)
"""Also set-point acknowledged, speed zero, homing attained."""
BIT_13 = int(Status.FOLLOWING_ERROR)


def _fit(type_: Type, value: float) -> int:
    """A measured value as its object holds it: it stays at the end of its range."""
    return max(type_.low, min(type_.high, round(value)))
