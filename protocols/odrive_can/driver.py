"""The host's end of CANSimple, for all ODrives of one bus, of firmware 0.5.x and 0.6.x side by side.

Rules. Only remote frames go to a device that was never commanded, or whose firmware line is not known. The
arming sequence is mode → set-point that does not move the shaft → Set_Axis_State 8 → wait for a heartbeat in
state 8; set-points are sent only while heartbeats report closed loop. What CANSimple does not confirm counts
as sent once a heartbeat shows that the device is alive, and its Done states that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

from protocols import messages as msg
from protocols.frames import EXTENDED_BIT, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Feedback, Mode, Nanos, Request
from protocols.odrive_can import errors, requests, table
from protocols.odrive_can.axis import Axis
from protocols.odrive_can.line import NO_DISCOVERY
from protocols.odrive_can.options import Options
from protocols.odrive_can.table import AxisState, ControlMode, InputMode
from protocols.plugin import Device
from protocols.toolkit.driver import NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.duplicates import IDENTIFY_PERIOD
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.table import Decoded

OdriveHost: TypeAlias = Host[Axis]
OdriveDriver: TypeAlias = MotorDriver[Axis]
OdriveReport: TypeAlias = Report[Axis]


class OdriveAdapter(Adapter[Axis]):
    """What ODrives are sent, and what they report."""

    name = "odrive_can"
    faults = errors.FAULTS
    duplicate = errors.DUPLICATE_NODE
    needs_idle = (msg.Zero, msg.Reboot)
    zero_tolerance = 0.05 * math.tau
    set_id_detail = f"not saved yet: write {requests.SAVE} 1 to keep it after power-off"
    unaddressed = table.BROADCAST

    def __init__(self, devices: Sequence[Device]) -> None:
        self._names = {_node(device): device.name for device in devices}
        # An axis of 0.5.x would take a remote frame of Address for Set_Axis_Node_ID, were its node id 63.
        discovers = any(device.options.firmware != "0.5" for device in devices)
        self._discovery = (table.DISCOVERY,) if discovers else ()
        self._next_discovery: Nanos = 0 if discovers else NEVER

    def own(self, device: Device) -> Axis:
        return Axis(device.address, device.options)

    def timing(self, options: Options) -> Timing:
        return Timing(options.offline_ms * MILLISECOND, release=50 * MILLISECOND)

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: OdriveDriver) -> Sequence[OdriveReport | Rx]:
        if not isinstance(frame, CanFrame) or frame.remote or not frame.data:
            return (Rx.IGNORED,)
        number = frame.id | EXTENDED_BIT if frame.extended else frame.id
        name = self._names.get(number >> table.CMD_BITS)
        if name is None:
            return (self._on_stranger(t, frame, driver),)
        host = driver.hosts[name]
        decoded = host.own.identity.table.decode(frame, "from_device")
        if decoded is None:
            return (Rx.IGNORED,)
        if not decoded.name:
            return (Rx.MALFORMED,)
        return (self._report(t, host, frame, decoded, driver),)

    def _report(
        self, t: Nanos, host: OdriveHost, frame: CanFrame, decoded: Decoded, driver: OdriveDriver
    ) -> OdriveReport | Rx:
        axis, address, values = host.own, host.address, decoded.values
        feedback, faults = None, None
        match decoded.name:
            case "Get_Encoder_Estimates":
                position, velocity = values["Pos_Estimate"], values["Vel_Estimate"]
                twice = self._twice(t, host, driver, axis.on_estimates(t, position, velocity))
                feedback = Feedback(host.name, t, position * math.tau, velocity * math.tau)
                return Report(host, address, feedback=feedback, duplicate=twice, content=decoded)
            case "Heartbeat":
                return self._on_heartbeat(t, host, frame, decoded, driver)
            case "Get_Iq":
                feedback = Feedback(host.name, t, current=values["Iq_Measured"])
            case "Get_Torques":
                feedback = Feedback(host.name, t, torque=values["Torque_Estimate"])
            case "Get_Temperature":
                known = [value for value in values.values() if value is not None]
                feedback = Feedback(host.name, t, temperature=max(known)) if known else None
            case "Get_Bus_Voltage_Current":
                feedback = Feedback(host.name, t, voltage=values["Bus_Voltage"])
                axis.on_supply()
            case "Get_Version":
                axis.on_version(t, values)
            case "Address reply":
                # A node id that a host assigns differs from the node that it is assigned on.
                if values["Node_ID"] != address:
                    return Rx.IGNORED
                axis.identity.on_discovery_reply()
                serial, note = values["Serial_Number"], axis.identity.text()
                return Report(host, address, serial=serial, note=note, content=decoded)
            case "Get_Error":
                faults = axis.on_errors(values["Active_Errors"], values["Disarm_Reason"])
            case "Get_Motor_Error" | "Get_Encoder_Error" | "Get_Controller_Error" | "Get_Sensorless_Error":
                faults = axis.on_word(decoded.name, *values.values())
        axis.on_polled(t, decoded.name)
        if axis.identity.wrong:
            return Report(host, address, Mode.FAULT, axis.detail(), axis.codes(), feedback, content=decoded)
        return Report(host, address, faults=faults, feedback=feedback, content=decoded)

    def _on_heartbeat(
        self, t: Nanos, host: OdriveHost, frame: CanFrame, decoded: Decoded, driver: OdriveDriver
    ) -> OdriveReport:
        axis = host.own
        if not axis.identity.dialect.line:
            axis.identity.on_heartbeat(decoded.values)
            better = axis.identity.table.decode(frame, "from_device")
            decoded = better if better is not None and better.name else decoded
        if axis.starts(decoded.values):
            host.forget(t)
            axis.forget(t)
        # After a state request the last heartbeat may be from before it: what it obeyed is no fall.
        closed_loop = decoded.values["Axis_State"] == AxisState.CLOSED_LOOP_CONTROL
        fell = host.phase is Phase.ARMED and not closed_loop and axis.heartbeat_at > axis.requested_at
        twice = axis.on_heartbeat(t, decoded.values, fell, releasing=host.phase is Phase.RELEASING)
        twice = self._twice(t, host, driver, twice)
        mode, detail, codes = axis.mode(), axis.detail(fell), axis.codes()
        return Report(host, host.address, mode, detail, codes, duplicate=twice, content=decoded)

    def _twice(self, t: Nanos, host: OdriveHost, driver: OdriveDriver, cause: str) -> str:
        """Ask for serial numbers at once where there must be two devices; return the cause."""
        if cause and host.address not in driver.serials.reported:
            self._next_discovery = t
        return cause

    def _on_stranger(self, t: Nanos, frame: CanFrame, driver: OdriveDriver) -> OdriveReport | Rx:
        """Return what a frame reports of a device that is not in the robot file."""
        decoded = table.table_of("", frame.extended).decode(frame, "from_device")
        if decoded is None or not decoded.name:
            return Rx.IGNORED
        if decoded.name == "Address reply":
            if frame.extended or decoded.values["Node_ID"] != decoded.address:
                return Rx.IGNORED
            note = "has no node id yet" if decoded.address == table.BROADCAST else ""
            return Report(None, decoded.address, serial=decoded.values["Serial_Number"], note=note)
        if decoded.name == "Heartbeat":  # a scan finds it at its end: 0.5.x answers no discovery
            note = NO_DISCOVERY + ", extended identifiers" * frame.extended
            for pending in driver.queue:
                if isinstance(pending.request, msg.Scan):
                    pending.notes.update({str(frame.id): Report(None, decoded.address, note=note)})
        return Rx.IGNORED

    def heard(self, pending: Pending[Axis], driver: OdriveDriver) -> Sequence[OdriveReport]:
        online = [host for host in driver.hosts.values() if host.received_at is not None and not host.offline]
        known = [Report(host, host.address, note=host.own.identity.found()) for host in online]
        return [*known, *pending.notes.values()]

    # -- sent -----------------------------------------------------------------------------------------

    def refuse(self, host: OdriveHost, command: Command) -> str:
        return "the device has no impedance control" if isinstance(command, msg.Impedance) else ""

    def ready(self, host: OdriveHost) -> bool:
        return host.own.commandable

    def arm(self, now: Nanos, host: OdriveHost, command: Command) -> Sequence[Frame]:
        axis, name = host.own, host.name
        mode, _ = self._set_point(host, command)
        still: dict[ControlMode, Command] = {
            ControlMode.VELOCITY: msg.Velocity(name, 0.0),
            ControlMode.TORQUE: msg.Torque(name, 0.0),
            ControlMode.POSITION: msg.Position(name, host.position or 0.0),
        }
        frames = [axis.encode("Set_Controller_Mode", **_mode(mode))] if axis.set_mode(mode) else []
        frames.append(self._set_point(host, still[mode])[1])
        if axis.attempt(now):
            frames.append(axis.encode("Set_Axis_State", Axis_Requested_State=AxisState.CLOSED_LOOP_CONTROL))
        return frames

    def command(self, now: Nanos, host: OdriveHost, command: Command) -> Sequence[Frame]:
        mode, frame = self._set_point(host, command)
        if not host.own.set_mode(mode):
            return (frame,)
        # The set-point is sent before the mode changes, so that no stale input is obeyed in between;
        # and after it, since entering position control may replace the input by the present position.
        return (frame, host.own.encode("Set_Controller_Mode", **_mode(mode)), frame)

    def release(self, now: Nanos, host: OdriveHost) -> Sequence[Frame]:
        host.own.release(now)
        return (host.own.encode("Set_Axis_State", Axis_Requested_State=AxisState.IDLE),)

    def _set_point(self, host: OdriveHost, command: Command) -> tuple[ControlMode, CanFrame]:
        encode = host.own.encode
        match command:
            case msg.Velocity(_, velocity, torque):
                frame = encode("Set_Input_Vel", Input_Vel=velocity / math.tau, Input_Torque_FF=torque)
                return ControlMode.VELOCITY, frame
            case msg.Torque(_, torque):
                return ControlMode.TORQUE, encode("Set_Input_Torque", Input_Torque=torque)
            case msg.Position(_, position, velocity, torque):
                turns = {"Input_Pos": position / math.tau, "Vel_FF": velocity / math.tau}
                return ControlMode.POSITION, encode("Set_Input_Pos", **turns, Torque_FF=torque)
        return self._set_point(host, msg.Position(host.name, host.held or 0.0))

    # -- by itself ------------------------------------------------------------------------------------

    def poll(self, now: Nanos, host: OdriveHost) -> Sequence[Frame]:
        axis = host.own
        if now < axis.due and now < axis.polls_due:
            return ()
        return [axis.requests[name] for name in axis.plan(now)]

    def poll_due(self, host: OdriveHost) -> Nanos:
        return host.own.due

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        if now < self._next_discovery or not self._discovery:
            return ()
        self._next_discovery = now + IDENTIFY_PERIOD
        return self._discovery

    def poll_bus_due(self) -> Nanos:
        return self._next_discovery if self._discovery else NEVER

    def forget(self, now: Nanos, host: OdriveHost) -> None:
        host.own.forget(now)

    def resend(self, host: OdriveHost) -> None:
        host.own.resend()

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: OdriveHost | None, driver: OdriveDriver
    ) -> Pending[Axis] | str:
        if isinstance(request, msg.Scan):
            return requests.for_all(now, request, requests.SCAN, *self._discovery)
        if isinstance(request, msg.SetId):
            if self._discovery:
                return requests.begin_set_id(now, request, driver)
            return "firmware 0.5.x reports no serial numbers over CAN: set the node id with the vendor's tool"
        return requests.begin(now, request, host, driver) if host is not None else "no such motor"

    def frames(self, now: Nanos, pending: Pending[Axis]) -> Sequence[Frame]:
        return requests.frames_of(pending)

    def answer(self, t: Nanos, pending: Pending[Axis], report: OdriveReport) -> Event | None:
        if isinstance(pending.request, msg.Zero) or pending.host is None:
            return super().answer(t, pending, report)
        return requests.answer(t, pending, pending.host.own, report.content)

    def give_up(self, now: Nanos, pending: Pending[Axis]) -> str:
        return requests.give_up(pending) or super().give_up(now, pending)


def _mode(mode: ControlMode) -> dict[str, int]:
    return {"Control_Mode": mode, "Input_Mode": InputMode.PASSTHROUGH}


def _node(device: Device) -> int:
    """Return the bits of a device's identifiers that are not the message's number."""
    marked: int = device.address | device.options.is_extended * EXTENDED_BIT >> table.CMD_BITS
    return marked
