"""The twin's firmware 0.5.x: states without results, errors by component, a watchdog that any frame feeds.

Rules as in `twin`; the sources of each behaviour are in the README. One twin is one axis: of a board with
two, each is a node of its own, and also obeys those messages to the other that concern the board.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from protocols.messages import Nanos
from protocols.odrive_can import faults05
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import cmd_of
from protocols.odrive_can.decoder import addressed, obey, receive
from protocols.odrive_can.faults import Error
from protocols.odrive_can.faults05 import (
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    SensorlessError,
)
from protocols.odrive_can.messages import AxisState
from protocols.odrive_can.options import node_of_device
from protocols.odrive_can.servo import gains_of
from protocols.odrive_can.twin import COMMON_REPORTS, OdriveTwin, Reports
from protocols.plugin import Device

GPIO_COUNT = 17

MOTOR_ERRORS: dict[Error, MotorError] = {
    Error.CURRENT_LIMIT_VIOLATION: MotorError.CURRENT_LIMIT_VIOLATION,
    Error.MOTOR_OVER_TEMP: MotorError.MOTOR_THERMISTOR_OVER_TEMP,
    Error.INVERTER_OVER_TEMP: MotorError.FET_THERMISTOR_OVER_TEMP,
    # A fault of the supply is the board's error, which CANSimple does not report.
    Error.DC_BUS_UNDER_VOLTAGE: MotorError.SYSTEM_LEVEL,
    Error.DC_BUS_OVER_VOLTAGE: MotorError.SYSTEM_LEVEL,
    Error.DC_BUS_OVER_CURRENT: MotorError.SYSTEM_LEVEL,
    Error.DC_BUS_OVER_REGEN_CURRENT: MotorError.SYSTEM_LEVEL,
}
CONTROLLER_ERRORS: dict[Error, ControllerError] = {
    Error.VELOCITY_LIMIT_VIOLATION: ControllerError.OVERSPEED,
    Error.SPINOUT_DETECTED: ControllerError.SPINOUT_DETECTED,
}
AXIS_ERRORS: dict[Error, AxisError] = {
    Error.WATCHDOG_TIMER_EXPIRED: AxisError.WATCHDOG_TIMER_EXPIRED,
    Error.ESTOP_REQUESTED: AxisError.ESTOP_REQUESTED,
}


class Twin05(OdriveTwin):
    """One axis of firmware 0.5.x."""

    cyclic: ClassVar[Mapping[type[m.Message], str]] = {
        m.Heartbeat05: "heartbeat_msg_rate_ms",
        m.GetEncoderEstimates: "encoder_msg_rate_ms",
        m.GetMotorError: "motor_error_rate_ms",
        m.GetEncoderError: "encoder_error_rate_ms",
        m.GetControllerError: "controller_error_rate_ms",
        m.GetSensorlessError: "sensorless_error_rate_ms",
        m.GetEncoderCount: "encoder_count_rate_ms",
        m.GetIq: "iq_msg_rate_ms",
        m.GetSensorlessEstimates: "sensorless_rate_ms",
        m.GetBusVoltageCurrent: "bus_voltage_msg_rate_ms",
    }
    watchdog_needs_arming = False

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self._clear()

    def _clear(self) -> None:
        self.errors, self.motor_errors, self.encoder_errors = AxisError(0), MotorError(0), EncoderError(0)
        self.controller_errors, self.sensorless_errors = ControllerError(0), SensorlessError(0)

    def feed(self, t: Nanos, node: int) -> None:
        """Feed the watchdog by any frame to the axis, also one that is ignored otherwise."""
        if node == self.axis.node:
            self._fed = t

    def on_message(self, t: Nanos, node: int, message: m.Message) -> None:
        """See the base."""
        if not addressed(self.axis, node, message):
            receive(self.axis, node, message)
            return
        match message:
            case m.SetAxisState(state):
                self._request_state(t, state)
                return
            case m.Estop():
                self.trip(Error.ESTOP_REQUESTED)
            case m.ClearErrors05():
                self._clear()
            case m.Reboot05():
                self._clear()
                # What was set over CAN cannot be saved over CAN: the node id, too, is as configured again.
                node = node_of_device(self.device, self.device.address)
                self.restart(t, node, gains_of(self.settings))
                return
            case m.SetLinearCount(count):
                self.servo.set_position(count / self.settings.encoder_cpr)
            case m.RequestAdcVoltage(gpio):
                self.reply(m.GetAdcVoltage(0.0) if gpio < GPIO_COUNT else None)
            case _:
                self.configure(message)
        obey(self.axis, message)

    def _request_state(self, t: Nanos, state: int) -> None:
        if state == AxisState.UNDEFINED:
            return
        self.errors &= ~AxisError.INVALID_STATE
        wrong = AxisError(0)
        if state == AxisState.CLOSED_LOOP_CONTROL:
            if self.settings.calibrated:
                self._fed = t
            else:
                wrong = AxisError.INVALID_STATE
        elif state == AxisState.HOMING:
            wrong = AxisError.HOMING_WITHOUT_ENDSTOP
        elif state not in (AxisState.IDLE, AxisState.STARTUP_SEQUENCE):
            wrong = AxisError.INVALID_STATE
        self.errors |= wrong
        arms = state == AxisState.CLOSED_LOOP_CONTROL and not self.errors
        if arms:
            self.servo.start()
        obey(self.axis, m.SetAxisState(AxisState.CLOSED_LOOP_CONTROL if arms else AxisState.IDLE))

    def trip(self, errors: Error) -> None:
        """Raise errors, which stay until Clear_Errors; an axis with errors disarms."""
        for error in errors:
            self.errors |= AXIS_ERRORS.get(error, AxisError(0))
            self.motor_errors |= MOTOR_ERRORS.get(error, MotorError(0))
            self.controller_errors |= CONTROLLER_ERRORS.get(error, ControllerError(0))
        self._fail()

    def provoke(self, code: int) -> None:
        """See the base."""
        if code not in faults05.FAULT_TABLE05:
            raise ValueError(f"firmware 0.5.x has no fault {code:#x}")
        base, bit = code >> faults05.BASE_SHIFT << faults05.BASE_SHIFT, code % (1 << faults05.BASE_SHIFT)
        if base == faults05.AXIS_BASE:
            self.errors |= AxisError(bit)
        elif base == faults05.MOTOR_BASE:
            self.motor_errors |= MotorError(bit)
        elif base == faults05.ENCODER_BASE:
            self.encoder_errors |= EncoderError(bit)
        elif base == faults05.CONTROLLER_BASE:
            self.controller_errors |= ControllerError(bit)
        else:
            self.sensorless_errors |= SensorlessError(bit)
        self._fail()

    def _fail(self) -> None:
        """Add the errors of components to the axis' errors, and disarm if there are any."""
        for component, bit in (
            (self.motor_errors, AxisError.MOTOR_FAILED),
            (self.encoder_errors, AxisError.ENCODER_FAILED),
            (self.controller_errors, AxisError.CONTROLLER_FAILED),
            (self.sensorless_errors, AxisError.SENSORLESS_ESTIMATOR_FAILED),
        ):
            self.errors |= bit if component else AxisError(0)
        if self.errors:
            self.axis.armed = False

    def _heartbeat(self) -> m.Heartbeat05:
        state = AxisState.CLOSED_LOOP_CONTROL if self.axis.armed else AxisState.IDLE
        components = (self.motor_errors, self.encoder_errors, self.controller_errors)
        motor, encoder, controller = (int(bool(errors)) for errors in components)
        done = int(self.servo.trajectory_done)
        return m.Heartbeat05(self.errors, state, motor, encoder, controller, done)

    def _encoder_count(self) -> m.GetEncoderCount:
        cpr = self.settings.encoder_cpr
        shadow = math.floor(self.servo.position * cpr + 0.5)
        in_cpr = math.floor(self.servo.shaft * cpr + 0.5) % cpr
        return m.GetEncoderCount((shadow + 2**31) % 2**32 - 2**31, in_cpr)

    reports: ClassVar[Reports] = {
        **COMMON_REPORTS,
        cmd_of(m.Heartbeat05): _heartbeat,
        cmd_of(m.GetMotorError): lambda twin: m.GetMotorError(twin.motor_errors),
        cmd_of(m.GetEncoderError): lambda twin: m.GetEncoderError(twin.encoder_errors),
        cmd_of(m.GetControllerError): lambda twin: m.GetControllerError(twin.controller_errors),
        cmd_of(m.GetSensorlessError): lambda twin: m.GetSensorlessError(twin.sensorless_errors),
        cmd_of(m.GetEncoderCount): _encoder_count,
        cmd_of(m.GetSensorlessEstimates): lambda _: m.GetSensorlessEstimates(0.0, 0.0),
    }
