"""The twin: a CiA 402 drive (README, "The twin").

Rules. `Memory` decides what is obeyed, `Motor` what the motor then does, `Sender` when frames are sent; this
file is the firmware around them: faults and their reaction, the measured objects, the statusword.
The drive acts and responds at the step after it received a frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols.canopen import objects as co
from protocols.canopen.eds import data_sheet
from protocols.canopen.node import HEARTBEAT_LOST, Sender
from protocols.canopen.objects import Type
from protocols.canopen.services import NmtCommand, sdo_rx_id
from protocols.cia402 import objects as o
from protocols.cia402.faults import FAULTS, register_of
from protocols.cia402.memory import DISCONNECTS, Memory, dictionary_of
from protocols.cia402.motor import Motor
from protocols.cia402.profile import POWERED, STATE_BITS, Mode, PowerState, Status
from protocols.cia402.settings import Settings
from protocols.frames import CanFrame, Frame
from protocols.messages import Event, Nanos, Torque
from protocols.plugin import Device
from protocols.toolkit.firmware import Firmware, milliseconds

STATE_OBJECTS = frozenset({o.STATUSWORD, o.MODE_DISPLAY, o.ERROR_CODE, co.ERROR_REGISTER})
RECORDS = {
    0x607D: "Software position limit",
    0x608F: "Position encoder resolution",
    0x6091: "Gear ratio",
    0x6092: "Feed constant",
    0x6096: "Velocity factor",
    0x6097: "Acceleration factor",
    0x6099: "Homing speeds",
    0x60C2: "Interpolation time period",
    0x60FE: "Digital outputs",
}
"""Names of the objects with subindices."""


def eds() -> str:
    """Return the data sheet `twin.eds`: of the twin with default settings."""
    return data_sheet(
        "A CiA 402 drive", "twin", RECORDS, *(dictionary_of(Settings(), node) for node in (1, 2))
    )


class Cia402Twin(Firmware):
    """One drive. Its state is plain data."""

    faults = FAULTS

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        settings = self.settings
        self.memory = Memory(device, instant=False)
        self.motor = Motor(settings, self.memory)
        delay = milliseconds(settings.sdo_delay_ms)
        self.sender = Sender(self.memory.node, seed, STATE_OBJECTS, delay, settings.sdo_waiting)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        memory, sender = self.memory, self.sender
        if sender.loses(frame):
            return
        if isinstance(frame, CanFrame) and frame.id == sdo_rx_id(memory.node.address):
            self._measure()
        before, received = memory.state, memory.node.receive(t, frame)
        if received is None:
            return
        memory.obey(received)
        sender.note(t, received)
        if received.command is NmtCommand.RESET_NODE:
            self.restart(t, milliseconds(self.settings.boot_ms))
            self.motor = Motor(self.settings, memory)  # where home was is forgotten
            sender.restart()
        elif received.command in DISCONNECTS and before in POWERED and self._loss_is_a_fault:
            self.trip(HEARTBEAT_LOST)
        elif before is PowerState.FAULT and memory.state is PowerState.SWITCH_ON_DISABLED:
            self._report(0)

    @property
    def _loss_is_a_fault(self) -> bool:
        return self.memory.values[o.ABORT_CONNECTION] == 1

    def trip(self, code: int) -> None:
        """Enter a fault: send EMCY, react by 605E, and stay in FAULT until it is reset."""
        self._report(code)
        if self.memory.state not in (PowerState.FAULT, PowerState.FAULT_REACTION):
            powered = self.memory.state in POWERED
            self.memory.enter(PowerState.FAULT_REACTION if powered else PowerState.FAULT)

    def _report(self, code: int) -> None:
        """Send EMCY; 0: there is no error any more."""
        self.memory.node.dictionary.measure({o.ERROR_CODE: code})
        self.sender.error(code, register_of(code))

    def _on_overdue(self, code: int) -> None:
        """React to a lost host: EMCY, the reaction of 6007, and the NMT state of 1029."""
        if self.memory.lose_connection() and self._loss_is_a_fault:
            self.trip(code)
        else:
            self.sender.error(code, register_of(code))
        self.memory.node.lose_host()

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        memory, motor = self.memory, self.motor
        for code in memory.node.overdue(now):
            self._on_overdue(code)
        if dt > 0.0 or not self.sender.booted:
            motor.measure(dt or 1.0, position, velocity)
        error = motor.step(dt) if dt > 0.0 else 0
        if error:
            self.trip(error)
        if not memory.enabled:
            memory.settle(self._position(motor.encoder.position))
        return motor.torque

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        torques, frames = super().step(now, truth)
        return torques, frames if now < self.silent_until else self.sender.frames(now, self._measure)

    def due(self) -> Nanos | None:
        restarted = super().due()
        return self.sender.due() if restarted is None else restarted

    # -- measured objects -------------------------------------------------------------------------

    def _position(self, radians: float) -> int:
        return _fit(Type.I32, radians * self.memory.units.per_turn / math.tau)

    def _measure(self) -> None:
        """Update the measured values of the dictionary."""
        memory, motor, units = self.memory, self.motor, self.memory.units
        permille = 1000.0 / (units.rated_torque * units.gear)
        speed = units.velocity_per_turn / math.tau
        torque = _fit(Type.I16, motor.torque * permille)
        memory.node.dictionary.measure(
            {
                o.POSITION: self._position(motor.encoder.position),
                o.POSITION_DEMAND: self._position(motor.ramp.position),
                o.FOLLOWING_ERROR: self._position(motor.ramp.position - motor.encoder.position),
                o.VELOCITY: _fit(Type.I32, motor.encoder.velocity * speed),
                o.VELOCITY_DEMAND: _fit(Type.I32, motor.ramp.velocity * speed),
                o.TORQUE: torque,
                o.CURRENT: torque,
                o.TORQUE_DEMAND: _fit(Type.I16, motor.demanded_torque * permille),
                o.DC_VOLTAGE: round(self.settings.dc_voltage * 1000.0),
                o.MODE_DISPLAY: memory.mode,
                o.STATUSWORD: self._statusword(),
            }
        )

    def _statusword(self) -> int:
        memory, motor = self.memory, self.motor
        status = STATE_BITS[memory.state][1] | Status.VOLTAGE_ENABLED | Status.REMOTE
        status |= Status.LIMITED if motor.limited else 0
        if memory.state is PowerState.QUICK_STOP:
            return status | (Status.REACHED if motor.at_standstill else 0)
        if memory.mode is Mode.HM:  # the homing state is shown also while it is not enabled
            under_way = motor.homing or memory.homing_requested
            return status | (0 if under_way else Status.REACHED | (Status.BIT_12 if motor.homed else 0))
        return status | self._mode_bits() if memory.enabled else status

    def _mode_bits(self) -> int:
        memory, motor, values = self.memory, self.motor, self.memory.values
        error = Status.BIT_13 if motor.following_error else 0
        match memory.mode:
            case Mode.CSP:
                return Status.BIT_12 | error
            case Mode.CSV | Mode.CST:
                return Status.BIT_12
            case Mode.PP:
                acknowledged = Status.BIT_12 if memory.acknowledged else 0
                return error | acknowledged | self._reached(values[o.POSITION_WINDOW_TIME])
            case Mode.PV:
                slow = abs(motor.encoder.velocity) <= memory.units.velocity(values[o.VELOCITY_THRESHOLD])
                return (Status.BIT_12 if slow else 0) | self._reached(values[o.VELOCITY_WINDOW_TIME])
            case Mode.PT:
                return self._reached(0)
        return 0

    def _reached(self, after_ms: int) -> int:
        return Status.REACHED if self.motor.has_arrived(after_ms) else 0


def _fit(type_: Type, value: float) -> int:
    """Round a measured value, saturated to the range of its object."""
    return round(max(type_.low, min(type_.high, value)))
