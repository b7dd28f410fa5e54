"""The twin's firmware 0.6.x: arming and its results, latched errors, watchdog, addresses, reboot.

Rules as in `twin`; the sources of each behaviour are in the README.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from protocols.messages import MILLISECOND, Nanos
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import BROADCAST, cmd_of
from protocols.odrive_can.decoder import addressed, assign, obey
from protocols.odrive_can.faults import FAULT_TABLE06, Error, Result
from protocols.odrive_can.messages import AxisState, RebootAction
from protocols.odrive_can.options import Settings, firmware_of
from protocols.odrive_can.servo import Gains, gains_of
from protocols.odrive_can.twin import COMMON_REPORTS, NEVER, OdriveTwin, Reports
from protocols.plugin import Device

PROTOCOL_VERSION = 2
FEEDS = (m.SetInputPos, m.SetInputVel, m.SetInputTorque, m.SetAxisState)
"""The messages that feed the watchdog (odriverobotics/ODriveResources@fdb25dd `examples/can_watchdog.py`)."""


class Twin06(OdriveTwin):
    """One device of firmware 0.6.x."""

    cyclic: ClassVar[Mapping[type[m.Message], str]] = {
        m.GetVersion: "version_msg_rate_ms",
        m.Heartbeat: "heartbeat_msg_rate_ms",
        m.GetEncoderEstimates: "encoder_msg_rate_ms",
        m.GetIq: "iq_msg_rate_ms",
        m.GetError: "error_msg_rate_ms",
        m.GetTemperature: "temperature_msg_rate_ms",
        m.GetBusVoltageCurrent: "bus_voltage_msg_rate_ms",
        m.GetTorques: "torques_msg_rate_ms",
    }
    watchdog_needs_arming = True

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.errors = Error(0)
        self.disarm_reason = Error(0)
        self.result: int = Result.SUCCESS
        self.identify = False
        self.initializing_until: Nanos = 0
        self._flash: tuple[int, Gains] = (self.axis.node, gains_of(self.settings))
        """Node id and gains as saved."""

    def on_request(self, node: int, cmd: int) -> None:
        """Reply; discovery is on the broadcast node, and all that a device without an address answers."""
        discovery = node == BROADCAST and cmd == cmd_of(m.Address)
        if discovery or (node == self.axis.node and node != BROADCAST):
            self.reply(self.report(cmd))

    def on_message(self, t: Nanos, node: int, message: m.Message) -> None:
        """See the base."""
        if isinstance(message, m.Address):
            if assign(self.axis, node, message):
                self.reply(self._address())
        elif addressed(self.axis, node, message):
            self._on_own_message(t, message)

    def _on_own_message(self, t: Nanos, message: m.Message) -> None:
        if isinstance(message, FEEDS):
            self._fed = t
        match message:
            case m.SetAxisState(state):
                self._request_state(state)
                return
            case m.Estop():
                self.trip(Error.ESTOP_REQUESTED)
            case m.ClearErrors(identify):
                self.errors &= Error.INITIALIZING
                self.disarm_reason = Error(0)
                self.identify = identify == 1
            case m.Reboot(action):
                self._reboot(t, action)
            case m.EnterDfuMode():
                self.silent_until = NEVER
            case m.SetAbsolutePosition(position):
                self.servo.set_position(position)
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
        obey(self.axis, m.SetAxisState(state))

    def trip(self, errors: Error) -> None:
        """Raise errors, which stay active until Clear_Errors; an armed axis disarms."""
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

    def due(self) -> Nanos | None:
        """See the base."""
        time = super().due()
        if self._now is None or self._now >= self.initializing_until:
            return time
        return self.initializing_until if time is None else min(time, self.initializing_until)

    def _version(self) -> m.GetVersion:
        major, minor, revision = (int(part) for part in firmware_of(self.device).split("."))
        return m.GetVersion(PROTOCOL_VERSION, self.settings.hw_line, 1, 0, major, minor, revision, 0)

    def _heartbeat(self) -> m.Heartbeat:
        state = AxisState.CLOSED_LOOP_CONTROL if self.axis.armed else AxisState.IDLE
        return m.Heartbeat(self.errors, state, self.result, int(self.servo.trajectory_done))

    def _address(self) -> m.Address | None:
        # The message has one byte for a node id of 6 bits. Extended identifiers, which this line does not
        # have, make the node of an axis larger than that: then there is nothing that it could reply.
        if self.axis.node > BROADCAST:
            return None
        return m.Address(self.axis.node, self.axis.serial, 0)

    def _temperature(self) -> m.GetTemperature:
        return m.GetTemperature(self.servo.fet_temperature, self.servo.motor_temperature)

    reports: ClassVar[Reports] = {
        **COMMON_REPORTS,
        cmd_of(m.GetVersion): _version,
        cmd_of(m.Heartbeat): _heartbeat,
        cmd_of(m.GetError): lambda twin: m.GetError(twin.errors, twin.disarm_reason),
        cmd_of(m.Address): _address,
        cmd_of(m.GetTemperature): _temperature,
        cmd_of(m.GetTorques): lambda twin: m.GetTorques(twin.servo.torque_target, twin.servo.torque()),
        cmd_of(m.GetPowers): lambda twin: m.GetPowers(twin.servo.electrical, twin.servo.mechanical),
    }
