"""The twin's firmware 0.5.x: states without verdicts, errors by parts, a watchdog that any frame feeds.

Rules as in `twin`; sources of each habit in the README. One twin is one axis: of a board with two, each is a
node of its own, and hears what is said to the other where that concerns the board.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from protocols.messages import Nanos
from protocols.odrive_can.codec import AnyMessage, cmd_of
from protocols.odrive_can.decoder import addressed, decode, obey
from protocols.odrive_can.faults import Error
from protocols.odrive_can.faults05 import (
    AXIS_BASE,
    BASE_SHIFT,
    CONTROLLER_BASE,
    ENCODER_BASE,
    FAULT_TABLE05,
    MOTOR_BASE,
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    SensorlessError,
)
from protocols.odrive_can.messages import (
    AxisState,
    Estop,
    GetBusVoltageCurrent,
    GetEncoderEstimates,
    GetIq,
    SetAxisState,
)
from protocols.odrive_can.messages05 import (
    AskAdcVoltage,
    ClearErrors05,
    GetAdcVoltage,
    GetControllerError,
    GetEncoderCount,
    GetEncoderError,
    GetMotorError,
    GetSensorlessError,
    GetSensorlessEstimates,
    Heartbeat05,
    Reboot05,
    SetLinearCount,
)
from protocols.odrive_can.options import node_of_device
from protocols.odrive_can.servo import gains_of
from protocols.odrive_can.twin import OdriveTwin
from protocols.plugin import Device

GPIO_COUNT = 17

MOTOR_TRIPS: dict[Error, MotorError] = {
    Error.CURRENT_LIMIT_VIOLATION: MotorError.CURRENT_LIMIT_VIOLATION,
    Error.MOTOR_OVER_TEMP: MotorError.MOTOR_THERMISTOR_OVER_TEMP,
    Error.INVERTER_OVER_TEMP: MotorError.FET_THERMISTOR_OVER_TEMP,
    # What is wrong with the supply is the board's error, which CANSimple does not tell.
    Error.DC_BUS_UNDER_VOLTAGE: MotorError.SYSTEM_LEVEL,
    Error.DC_BUS_OVER_VOLTAGE: MotorError.SYSTEM_LEVEL,
    Error.DC_BUS_OVER_CURRENT: MotorError.SYSTEM_LEVEL,
    Error.DC_BUS_OVER_REGEN_CURRENT: MotorError.SYSTEM_LEVEL,
}
CONTROLLER_TRIPS: dict[Error, ControllerError] = {
    Error.VELOCITY_LIMIT_VIOLATION: ControllerError.OVERSPEED,
    Error.SPINOUT_DETECTED: ControllerError.SPINOUT_DETECTED,
}
AXIS_TRIPS: dict[Error, AxisError] = {
    Error.WATCHDOG_TIMER_EXPIRED: AxisError.WATCHDOG_TIMER_EXPIRED,
    Error.ESTOP_REQUESTED: AxisError.ESTOP_REQUESTED,
}


class Twin05(OdriveTwin):
    """One axis of firmware 0.5.x."""

    watchdog_sleeps = False

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.errors = AxisError(0)
        self.motor_errors = MotorError(0)
        self.encoder_errors = EncoderError(0)
        self.controller_errors = ControllerError(0)
        self.sensorless_errors = SensorlessError(0)

    def rates(self) -> Sequence[tuple[int, int]]:
        """See the base."""
        s = self.settings
        return (
            (cmd_of(Heartbeat05), s.heartbeat_msg_rate_ms),
            (cmd_of(GetEncoderEstimates), s.encoder_msg_rate_ms),
            (cmd_of(GetMotorError), s.motor_error_rate_ms),
            (cmd_of(GetEncoderError), s.encoder_error_rate_ms),
            (cmd_of(GetControllerError), s.controller_error_rate_ms),
            (cmd_of(GetSensorlessError), s.sensorless_error_rate_ms),
            (cmd_of(GetEncoderCount), s.encoder_count_rate_ms),
            (cmd_of(GetIq), s.iq_msg_rate_ms),
            (cmd_of(GetSensorlessEstimates), s.sensorless_rate_ms),
            (cmd_of(GetBusVoltageCurrent), s.bus_voltage_msg_rate_ms),
        )

    def feed(self, t: Nanos, node: int) -> None:
        """Any frame to the axis feeds its watchdog, also one that says nothing."""
        if node == self.axis.node:
            self._fed = t

    def handle(self, t: Nanos, node: int, message: AnyMessage) -> None:
        """See the base."""
        if not addressed(self.axis, node, message):
            decode(self.axis, node, message)
            return
        match message:
            case SetAxisState(state):
                self._request_state(t, state)
                return
            case Estop():
                self.trip(Error.ESTOP_REQUESTED)
            case ClearErrors05():
                self._clear()
            case Reboot05():
                self._clear()
                # What was set over CAN cannot be saved over CAN: the node id, too, is as configured again.
                home = node_of_device(self.device, self.device.address)
                self.restart(t, home, gains_of(self.settings))
                return
            case SetLinearCount(count):
                self.servo.call_position(count / self.settings.encoder_cpr)
            case AskAdcVoltage(gpio):
                self.reply(GetAdcVoltage(0.0) if gpio < GPIO_COUNT else None)
            case _:
                self.configure(message)
        obey(self.axis, message)

    def _clear(self) -> None:
        self.errors, self.motor_errors, self.encoder_errors = AxisError(0), MotorError(0), EncoderError(0)
        self.controller_errors, self.sensorless_errors = ControllerError(0), SensorlessError(0)

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
        obey(self.axis, SetAxisState(AxisState.CLOSED_LOOP_CONTROL if arms else AxisState.IDLE))

    def trip(self, errors: Error) -> None:
        """An axis with errors disarms; they stay until Clear_Errors."""
        for error in errors:
            self.errors |= AXIS_TRIPS.get(error, AxisError(0))
            self.motor_errors |= MOTOR_TRIPS.get(error, MotorError(0))
            self.controller_errors |= CONTROLLER_TRIPS.get(error, ControllerError(0))
        self._fail()

    def provoke(self, code: int) -> None:
        """See the base."""
        if code not in FAULT_TABLE05:
            raise ValueError(f"firmware 0.5.x has no fault {code:#x}")
        base, bit = code >> BASE_SHIFT << BASE_SHIFT, code % (1 << BASE_SHIFT)
        if base == AXIS_BASE:
            self.errors |= AxisError(bit)
        elif base == MOTOR_BASE:
            self.motor_errors |= MotorError(bit)
        elif base == ENCODER_BASE:
            self.encoder_errors |= EncoderError(bit)
        elif base == CONTROLLER_BASE:
            self.controller_errors |= ControllerError(bit)
        else:
            self.sensorless_errors |= SensorlessError(bit)
        self._fail()

    def _fail(self) -> None:
        """A part's error is the axis' too, and an axis with errors disarms."""
        for part, bit in (
            (self.motor_errors, AxisError.MOTOR_FAILED),
            (self.encoder_errors, AxisError.ENCODER_FAILED),
            (self.controller_errors, AxisError.CONTROLLER_FAILED),
            (self.sensorless_errors, AxisError.SENSORLESS_ESTIMATOR_FAILED),
        ):
            self.errors |= bit if part else AxisError(0)
        if self.errors:
            self.axis.armed = False

    def report(self, cmd: int) -> AnyMessage | None:
        """See the base."""
        reports = _REPORTS.get(cmd)
        return reports(self) if reports is not None else None


def _heartbeat(twin: Twin05) -> Heartbeat05:
    state = AxisState.CLOSED_LOOP_CONTROL if twin.axis.armed else AxisState.IDLE
    return Heartbeat05(
        twin.errors,
        state,
        int(bool(twin.motor_errors)),
        int(bool(twin.encoder_errors)),
        int(bool(twin.controller_errors)),
        int(twin.servo.trajectory_done),
    )


def _counts(twin: Twin05) -> GetEncoderCount:
    cpr = twin.settings.encoder_cpr
    shadow = math.floor(twin.servo.position * cpr + 0.5)
    return GetEncoderCount((shadow + 2**31) % 2**32 - 2**31, math.floor(twin.servo.shaft * cpr + 0.5) % cpr)


_REPORTS: dict[int, Callable[[Twin05], AnyMessage]] = {
    cmd_of(Heartbeat05): _heartbeat,
    cmd_of(GetMotorError): lambda twin: GetMotorError(twin.motor_errors),
    cmd_of(GetEncoderError): lambda twin: GetEncoderError(twin.encoder_errors),
    cmd_of(GetControllerError): lambda twin: GetControllerError(twin.controller_errors),
    cmd_of(GetSensorlessError): lambda twin: GetSensorlessError(twin.sensorless_errors),
    cmd_of(GetEncoderEstimates): lambda twin: GetEncoderEstimates(twin.servo.position, twin.servo.velocity),
    cmd_of(GetEncoderCount): _counts,
    cmd_of(GetIq): lambda twin: GetIq(twin.servo.iq_setpoint, twin.servo.iq),
    cmd_of(GetSensorlessEstimates): lambda _: GetSensorlessEstimates(0.0, 0.0),
    cmd_of(GetBusVoltageCurrent): lambda twin: GetBusVoltageCurrent(
        twin.servo.bus_voltage, twin.servo.bus_current
    ),
}
