"""The twin's firmware 0.6.x: arming and its verdicts, errors that stay, watchdog, addresses, reboot.

Rules as in `twin`; sources of each habit in the README.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from protocols.messages import MILLISECOND, Nanos
from protocols.odrive_can.codec import BROADCAST, AnyMessage, cmd_of
from protocols.odrive_can.decoder import addressed, assign, obey
from protocols.odrive_can.faults import FAULT_TABLE06, Error, Result
from protocols.odrive_can.messages import (
    Address,
    AxisState,
    ClearErrors,
    EnterDfuMode,
    Estop,
    GetBusVoltageCurrent,
    GetEncoderEstimates,
    GetError,
    GetIq,
    GetPowers,
    GetTemperature,
    GetTorques,
    GetVersion,
    Heartbeat,
    Reboot,
    RebootAction,
    SetAbsolutePosition,
    SetAxisState,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
)
from protocols.odrive_can.options import Settings, firmware_of
from protocols.odrive_can.servo import Gains, gains_of
from protocols.odrive_can.twin import NEVER, OdriveTwin
from protocols.plugin import Device

PROTOCOL_VERSION = 2
FEEDS = (SetInputPos, SetInputVel, SetInputTorque, SetAxisState)
"""What feeds the watchdog (odriverobotics/ODriveResources@fdb25dd `examples/can_watchdog.py`)."""


class Twin06(OdriveTwin):
    """One device of firmware 0.6.x."""

    watchdog_sleeps = True

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.errors = Error(0)
        self.disarm_reason = Error(0)
        self.result: int = Result.SUCCESS
        self.identify = False
        self.initializing_until: Nanos = 0
        self._flash: tuple[int, Gains] = (self.axis.node, gains_of(self.settings))
        """Node id and gains as saved."""

    def rates(self) -> Sequence[tuple[int, int]]:
        """See the base."""
        s = self.settings
        return (
            (cmd_of(GetVersion), s.version_msg_rate_ms),
            (cmd_of(Heartbeat), s.heartbeat_msg_rate_ms),
            (cmd_of(GetEncoderEstimates), s.encoder_msg_rate_ms),
            (cmd_of(GetIq), s.iq_msg_rate_ms),
            (cmd_of(GetError), s.error_msg_rate_ms),
            (cmd_of(GetTemperature), s.temperature_msg_rate_ms),
            (cmd_of(GetBusVoltageCurrent), s.bus_voltage_msg_rate_ms),
            (cmd_of(GetTorques), s.torques_msg_rate_ms),
        )

    def answer(self, node: int, cmd: int) -> None:
        """Discovery goes to the broadcast node; a device without an address answers nothing else."""
        discovery = node == BROADCAST and cmd == cmd_of(Address)
        if discovery or (node == self.axis.node and node != BROADCAST):
            self.reply(self.report(cmd))

    def handle(self, t: Nanos, node: int, message: AnyMessage) -> None:
        """See the base."""
        if isinstance(message, Address):
            if assign(self.axis, node, message):
                self.reply(Address(self.axis.node, self.axis.serial, 0))
        elif addressed(self.axis, node, message):
            self._handle(t, message)

    def _handle(self, t: Nanos, message: AnyMessage) -> None:
        if isinstance(message, FEEDS):
            self._fed = t
        match message:
            case SetAxisState(state):
                self._request_state(state)
                return
            case Estop():
                self.trip(Error.ESTOP_REQUESTED)
            case ClearErrors(identify):
                self.errors &= Error.INITIALIZING
                self.disarm_reason = Error(0)
                self.identify = identify == 1
            case Reboot(action):
                self._reboot(t, action)
            case EnterDfuMode():
                self.silent_until = NEVER
            case SetAbsolutePosition(position):
                self.servo.call_position(position)
            case _:
                self.configure(message)
        obey(self.axis, message)

    def _request_state(self, state: int) -> None:
        was_armed = self.axis.armed
        if state == AxisState.CLOSED_LOOP_CONTROL:
            if was_armed:
                return
            if self.errors:
                self.result, self.disarm_reason = Result.DISARMED, self.errors
                return
            if not self.settings.calibrated:
                self.result = Result.NOT_CALIBRATED
                return
            self.servo.start()
            self.result, self.disarm_reason = Result.BUSY, Error(0)
        elif state == AxisState.IDLE:
            self.result = Result.SUCCESS if was_armed else self.result
        elif state == AxisState.HOMING:
            self.result = Result.HOMING_WITHOUT_ENDSTOP
        elif state != AxisState.UNDEFINED:
            self.result = Result.INVALID_STATE
        obey(self.axis, SetAxisState(state))

    def trip(self, errors: Error) -> None:
        """Errors stay active until Clear_Errors; an armed axis disarms."""
        self.errors |= errors
        if self.axis.armed:
            self.axis.armed = False
            self.disarm_reason = self.errors
            self.result = Result.DISARMED

    def provoke(self, code: int) -> None:
        """See the base."""
        if code not in FAULT_TABLE06:
            raise ValueError(f"firmware 0.6.x has no fault {code:#x}")
        self.trip(Error(code))

    def _reboot(self, t: Nanos, action: int) -> None:
        if action == RebootAction.SAVE:
            self._flash = (self.axis.node, self.servo.gains)
        elif action == RebootAction.ERASE:
            self._flash = (BROADCAST, gains_of(Settings()))
        self.restart(t, *self._flash)
        self.initializing_until = self.silent_until + self.settings.initializing_ms * MILLISECOND
        self.errors, self.disarm_reason, self.result = Error.INITIALIZING, Error(0), Result.SUCCESS

    def boot(self, now: Nanos) -> None:
        """See the base."""
        if self.errors & Error.INITIALIZING and now >= self.initializing_until:
            self.errors &= ~Error.INITIALIZING

    def report(self, cmd: int) -> AnyMessage | None:
        """See the base."""
        reports = _REPORTS.get(cmd)
        return reports(self) if reports is not None else None

    def due(self) -> Nanos | None:
        """See the base."""
        time = super().due()
        if self._now is None or self._now >= self.initializing_until:
            return time
        return self.initializing_until if time is None else min(time, self.initializing_until)


def _version(twin: Twin06) -> GetVersion:
    major, minor, revision = (int(part) for part in firmware_of(twin.device).split("."))
    return GetVersion(PROTOCOL_VERSION, twin.settings.hw_line, 1, 0, major, minor, revision, 0)


def _heartbeat(twin: Twin06) -> Heartbeat:
    state = AxisState.CLOSED_LOOP_CONTROL if twin.axis.armed else AxisState.IDLE
    return Heartbeat(twin.errors, state, twin.result, int(twin.servo.trajectory_done))


_REPORTS: dict[int, Callable[[Twin06], AnyMessage]] = {
    cmd_of(GetVersion): _version,
    cmd_of(Heartbeat): _heartbeat,
    cmd_of(GetError): lambda twin: GetError(twin.errors, twin.disarm_reason),
    cmd_of(Address): lambda twin: Address(twin.axis.node, twin.axis.serial, 0),
    cmd_of(GetEncoderEstimates): lambda twin: GetEncoderEstimates(twin.servo.position, twin.servo.velocity),
    cmd_of(GetIq): lambda twin: GetIq(twin.servo.iq_setpoint, twin.servo.iq),
    cmd_of(GetTemperature): lambda twin: GetTemperature(
        twin.servo.fet_temperature, twin.servo.motor_temperature
    ),
    cmd_of(GetBusVoltageCurrent): lambda twin: GetBusVoltageCurrent(
        twin.servo.bus_voltage, twin.servo.bus_current
    ),
    cmd_of(GetTorques): lambda twin: GetTorques(twin.servo.torque_target, twin.servo.torque()),
    cmd_of(GetPowers): lambda twin: GetPowers(twin.servo.electrical, twin.servo.mechanical),
}
