"""The host's end of CANSimple, for all ODrives of one bus, of firmware 0.5.x and 0.6.x side by side.

Rules. Only remote frames go to a device that was never commanded, or whose firmware line is not known. The
arming sequence is mode → set-point that does not move the shaft → Set_Axis_State 8 → wait for a heartbeat in
state 8; set-points are sent only while heartbeats report closed loop. A request that is impossible is refused
at once with the reason. What CANSimple does not confirm counts as sent once a heartbeat shows that the device
is alive, and its Done states that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from protocols import messages as msg
from protocols.frames import EXTENDED_BIT, CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Mode, Nanos, Request
from protocols.odrive_can import errors, table
from protocols.odrive_can.axis import NO_DISCOVERY, Axis
from protocols.odrive_can.setpoints import armed_of, control_mode, inputs, outcome, refusal
from protocols.odrive_can.table import CLOSED_LOOP, SAVE, WRITABLE, ControlMode
from protocols.plugin import Device
from protocols.toolkit.duplicates import IDENTIFY_PERIOD
from protocols.toolkit.host import Host, Phase, Report
from protocols.toolkit.motor_driver import ARMED, NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.requests import subject
from protocols.toolkit.table import FLOAT_MAX, Decoded

Times: TypeAlias = tuple[Nanos, Nanos]  # Timeout of a request, and period in which its frames are sent again.
USUAL: Times = (600 * MILLISECOND, 120 * MILLISECOND)
RESTART: Times = (8000 * MILLISECOND, 2000 * MILLISECOND)
SET_ID: Times = (1500 * MILLISECOND, 240 * MILLISECOND)
SCAN: Times = (1800 * MILLISECOND, 600 * MILLISECOND)  # (ODriveResources@06dc846 `examples/can_enumerate.py`)
PROCEDURE: Times = (120 * SECOND, 500 * MILLISECOND)
REBOOT_GAP = 400 * MILLISECOND
"""A pause between heartbeats that shows a restart: a late heartbeat is requested after 250 ms."""
STATE, POSITION = "Axis_Requested_State", "Position"
"""Parameters: a procedure that is begun, and what the present position is called."""
TIMES: Mapping[object, Times] = {
    msg.Scan: SCAN,
    msg.SetId: SET_ID,
    msg.Reboot: RESTART,
    SAVE: RESTART,
    msg.Home: PROCEDURE,
    STATE: PROCEDURE,
}
"""By what is requested."""
MEASURED = {
    "Get_Iq": ("Iq_Measured", "current"),
    "Get_Torques": ("Torque_Estimate", "torque"),
    "Get_Bus_Voltage_Current": ("Bus_Voltage", "voltage"),
}
"""By message: a signal that is a measurement, and of what."""

OdriveHost: TypeAlias = Host[Axis]
OdriveDriver: TypeAlias = MotorDriver[Axis]
OdriveReport: TypeAlias = Report[Axis]
OdrivePending: TypeAlias = Pending[Axis]


class OdriveAdapter(Adapter[Axis]):
    """What ODrives are sent, and what they report."""

    name = "odrive_can"
    faults = errors.FAULTS
    duplicate = errors.DUPLICATE_NODE
    releasing = 50 * MILLISECOND
    needs_idle = (msg.Zero, msg.Reboot, msg.Home)
    zero_tolerance = 0.05 * math.tau
    set_id_detail = f"not saved yet: write {SAVE} 1 to keep it after power-off"
    set_address_detail = "until it is switched off: the vendor's tool saves it, over USB"
    unaddressed = table.BROADCAST
    addresses = range(table.MAX_NODE + 1)

    def __init__(self, devices: Sequence[Device]) -> None:
        self._names = {_node(device): device.name for device in devices}
        # An axis of 0.5.x would take a remote frame of Address for Set_Axis_Node_ID, were its node id 63.
        discovers = any(device.options.firmware != "0.5" for device in devices)
        self._discovery = (table.DISCOVERY,) if discovers else ()
        self._next_discovery: Nanos = 0

    def own(self, device: Device) -> Axis:
        return Axis(device.address, device.options)

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: OdriveDriver) -> Sequence[OdriveReport | Rx]:
        if not isinstance(frame, CanFrame) or frame.remote or not frame.data:
            return (Rx.IGNORED,)
        number = frame.id | EXTENDED_BIT if frame.extended else frame.id
        name = self._names.get(number >> table.CMD_BITS)
        if name is None:
            return (self._on_stranger(frame, driver),)
        host = driver.hosts[name]
        decoded = host.own.identity.table.decode(frame, "from_device")
        if decoded is None:
            return (Rx.IGNORED,)
        report = self._report(t, host, frame, decoded) if decoded.name else Rx.MALFORMED
        if isinstance(report, Report) and report.duplicate and host.address not in driver.serials.reported:
            self._next_discovery = t  # serial numbers may show who it is
        return (report,)

    def _report(self, t: Nanos, host: OdriveHost, frame: CanFrame, decoded: Decoded) -> OdriveReport | Rx:
        axis, address, name, values = host.own, host.address, decoded.name, decoded.values
        if name == "Get_Encoder_Estimates":
            position, velocity = values["Pos_Estimate"], values["Vel_Estimate"]
            twice = axis.on_estimates(t, position, velocity)
            motion = Feedback(host.name, t, position * math.tau, velocity * math.tau)
            # By place, since a call by name takes twice as long.
            return Report(host, address, None, "", None, motion, twice, decoded)
        if name == "Heartbeat":
            return self._on_heartbeat(t, host, frame, decoded)
        read: dict[str, float] = {}
        feedback, faults = None, None
        if name in MEASURED:
            signal, quantity = MEASURED[name]
            feedback = Feedback(host.name, t, **{quantity: values[signal]})
        axis.on_message(t, name, values)
        if name == "Get_Temperature":
            known = [value for value in values.values() if value is not None]
            feedback = Feedback(host.name, t, temperature=max(known)) if known else None
        elif name == "Address reply":
            if values["Node_ID"] != address:  # a host assigns one
                return Rx.IGNORED
            axis.identity.on_discovery_reply()
            serial, note = values["Serial_Number"], axis.identity.text()
            return Report(host, address, serial=serial, note=note, content=decoded)
        elif name == "TxSdo":
            parameter, value = axis.registers.value(values["Endpoint_ID"], values["Value"])
            read |= {} if value is None else {parameter: value}
        elif name == "Get_Error":
            faults = axis.on_errors(values["Active_Errors"], values["Disarm_Reason"])
        elif name in axis.identity.dialect.components:
            faults = axis.on_word(name, *values.values())
        if axis.identity.wrong:
            return Report(host, address, Mode.FAULT, axis.detail(), axis.codes(), feedback, content=decoded)
        return Report(host, address, faults=faults, feedback=feedback, parameters=read, content=decoded)

    def _on_heartbeat(self, t: Nanos, host: OdriveHost, frame: CanFrame, decoded: Decoded) -> OdriveReport:
        axis = host.own
        if not axis.identity.dialect.line:
            decoded = axis.identity.decode_by_form(frame, decoded)
        if decoded.values["Axis_Error"] & ~axis.errors & axis.identity.dialect.starting:
            host.forget(t)
            axis.forget(t)
        # After a state request the last heartbeat may be from before it: what it obeyed is no fall.
        closed_loop = decoded.values["Axis_State"] == CLOSED_LOOP
        fell = host.phase is Phase.ARMED and not closed_loop and axis.heartbeat_at > axis.requested_at
        twice = axis.on_heartbeat(t, decoded.values, fell, releasing=host.phase is Phase.RELEASING)
        mode, detail, codes = axis.mode(), axis.detail(fell), axis.codes()
        return Report(host, host.address, mode, detail, codes, duplicate=twice, content=decoded)

    def _on_stranger(self, frame: CanFrame, driver: OdriveDriver) -> OdriveReport | Rx:
        """Return what a frame reports of a device that is not in the robot file."""
        decoded = table.table_of("", frame.extended).decode(frame, "from_device")
        if decoded is None:
            return Rx.IGNORED
        address, values = decoded.address, decoded.values
        if decoded.name == "Address reply" and values["Node_ID"] == address and not frame.extended:
            note = "has no node id yet" if address == table.BROADCAST else ""
            return Report(None, address, serial=values["Serial_Number"], note=note)
        if decoded.name == "Heartbeat":  # a scan finds it at its end: 0.5.x answers no discovery
            report: OdriveReport = Report(
                None, address, note=NO_DISCOVERY + ", extended identifiers" * frame.extended
            )
            for pending in driver.queue.waiting:
                if getattr(pending.request, "address", None) == address:
                    return report
                if isinstance(pending.request, msg.Scan):
                    pending.notes.update({str(frame.id): report})
        return Rx.IGNORED

    def collected(self, pending: OdrivePending, driver: OdriveDriver) -> Sequence[OdriveReport]:
        online = [host for host in driver.hosts.values() if host.received_at is not None and not host.offline]
        known = [Report(host, host.address, note=host.own.identity.found()) for host in online]
        return [*known, *pending.notes.values()]

    # -- sent -----------------------------------------------------------------------------------------

    def refuse(self, host: OdriveHost, command: Command) -> str:
        return refusal(command)

    def ready(self, host: OdriveHost) -> bool:
        return host.own.commandable

    def arm(self, now: Nanos, host: OdriveHost, command: Command) -> Sequence[Frame]:
        axis, mode = host.own, control_mode(command)
        still: dict[ControlMode, Command] = {
            ControlMode.VELOCITY: msg.Velocity(host.name, 0.0),
            ControlMode.TORQUE: msg.Torque(host.name, 0.0),
            ControlMode.POSITION: msg.Position(host.name, host.position or 0.0),
        }
        frames = [*axis.set_mode(now, mode), self._set_point(host, still[mode])]
        if axis.attempt(now):
            frames.append(axis.encode("Set_Axis_State", Axis_Requested_State=CLOSED_LOOP))
        return frames

    def command(self, now: Nanos, host: OdriveHost, command: Command) -> Sequence[Frame]:
        mode = control_mode(command)
        again = frame = self._set_point(host, command)
        other = mode is not host.own.control_mode
        set_mode = host.own.set_mode(now, mode)
        if set_mode and isinstance(command, msg.Torque):
            # The same, and leaves no velocity for another mode.
            again = self._set_point(host, msg.Velocity(host.name, 0.0, command.torque))
        # The set-point is sent before the mode changes, so that no stale input is obeyed in between;
        # and after it, since position control takes the present position as its input.
        return (frame, *set_mode, again) if other else (*set_mode, again)

    def release(self, now: Nanos, host: OdriveHost) -> Sequence[Frame]:
        host.own.release(now)
        # Firmware keeps its inputs: what arms it later must not find a velocity or torque there.
        still = self._set_point(host, msg.Velocity(host.name, 0.0))
        return (still, host.own.encode("Set_Axis_State", Axis_Requested_State=table.IDLE))

    def _set_point(self, host: OdriveHost, command: Command) -> CanFrame:
        name, values = inputs(command, host.held)
        return host.own.identity.table.encoder(name)(host.address, **values)

    # -- by itself ------------------------------------------------------------------------------------

    def poll(self, now: Nanos, host: OdriveHost) -> Sequence[Frame]:
        axis = host.own
        if now < axis.due and now < axis.polls_due:
            return ()
        return [axis.requests[name] for name in axis.plan(now)]

    def poll_due(self, host: OdriveHost) -> Nanos:
        return host.own.due

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        if now < self._next_discovery:
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

    def readdress(self, host: OdriveHost, address: int) -> Sequence[Frame]:
        """0.5.x alone, which then sends its heartbeats from there."""
        boards = host.own.identity.dialect.boards
        return (host.own.encode("Set_Axis_Node_ID", Axis_Node_ID=address),) if boards else ()

    def begin(
        self, now: Nanos, request: Request, host: OdriveHost | None, driver: OdriveDriver
    ) -> OdrivePending | str:
        if isinstance(request, msg.SetId):
            without = (
                "firmware 0.5.x reports no serial numbers over CAN: set the node id with the vendor's tool"
            )
            frames = _assignment(request, driver) if self._discovery else without
        else:
            frames = self._discovery if host is None else _first_frames(now, request, host, driver)
        if isinstance(frames, str):
            return frames
        timeout, period = TIMES.get(_key(request), USUAL)
        # What is only sent cyclically needs no frame to be read.
        reads = isinstance(request, msg.ReadParameter)
        frames = tuple(frames)
        return Pending(request, subject(request), now, now + timeout, now, host, frames, period, sent=reads)

    def frames(self, now: Nanos, pending: OdrivePending) -> Sequence[Frame]:
        if pending.notes.get("ran"):  # a procedure that has begun would begin anew
            return ()
        if not isinstance(pending.request, msg.ClearFault) or pending.host is None:
            return pending.frames
        axis = pending.host.own
        return axis.action(msg.ClearFault) if axis.identity.line else ()

    def answer(self, t: Nanos, pending: OdrivePending, report: OdriveReport) -> Event | None:
        if isinstance(pending.request, msg.Zero) or pending.host is None or report.parameters:
            return super().answer(t, pending, report)
        axis, identity, content = pending.host.own, pending.host.own.identity, report.content
        beat = content.name == "Heartbeat"
        board = "and every axis of its board" if identity.dialect.boards else ""
        match pending.request:
            case msg.ClearFault() if beat and identity.line and not axis.faulty:
                return pending.done(t, board)
            case msg.Estop() if beat and axis.errors & (identity.dialect.bit("ESTOP_REQUESTED") or -1):
                return pending.done(t, "it stays in fault until cleared")
            case msg.Reboot() | msg.WriteParameter(_, "save_configuration") if beat:
                # After a restart the device is identified anew, and its bits mean nothing before.
                up = bool(identity.line) and not axis.errors & identity.dialect.starting
                gap = t - pending.notes.get("heartbeat", pending.began)
                seen = pending.notes.get("seen") or not up or gap >= REBOOT_GAP
                pending.notes.update(heartbeat=t, seen=seen)
                text = ", ".join(filter(None, ("it has restarted", board)))
                return pending.done(t, text) if seen and up else None
            case msg.Home() | msg.WriteParameter(_, "Axis_Requested_State") if beat:
                text = ", ".join((axis.detail(), *(self.faults[each].name for each in axis.codes())))
                return outcome(t, pending, axis.state, axis.result, text, faulty=axis.faulty)
            case msg.WriteParameter(_, "Position", value) if not board:
                turns = content.values.get("Pos_Estimate", math.inf)
                return pending.done(t) if abs(turns - value) * math.tau < self.zero_tolerance else None
            case msg.WriteParameter(_, name) if beat and name not in axis.registers.by_name:
                return pending.done(t, "sent; the device does not confirm it")
            case msg.ReadParameter(_, name) if identity.dialect.readable().get(name) == content.name:
                value = content.values.get(name)
                if value is None:
                    return pending.refuse(t, "the device has no sensor for it")
                return msg.Parameter(pending.name, t, name, float(value))
        return None

    def give_up(self, now: Nanos, pending: OdrivePending) -> str:
        host, request = pending.host, pending.request
        if host is not None and not host.offline and (host.received_at or 0) > pending.began:
            if TIMES.get(_key(request)) is RESTART:
                return "it showed no sign of a restart"
            if TIMES.get(_key(request)) is PROCEDURE:
                return "it did not end" if pending.notes.get("ran") else "it did not begin"
            if isinstance(request, msg.ClearFault) and not host.own.identity.line:
                return "its firmware is not known"
            host.own.report_again()
        return super().give_up(now, pending)


def _key(request: Request) -> object:
    """Return what is requested: the parameter's name, or the type."""
    return getattr(request, "parameter", type(request))


def _assignment(request: msg.SetId, driver: OdriveDriver) -> Sequence[Frame] | str:
    """Assign a node id to the device with a serial number, and repeat discovery."""
    if wrong := driver.wrong_id(request, range(table.MAX_NODE + 1), 48):
        return wrong
    node, serial = request.address, request.serial
    return (table.table_of("0.6").encode("Address", Node_ID=node, Serial_Number=serial), table.DISCOVERY)


def _first_frames(
    now: Nanos, request: Request, host: OdriveHost, driver: OdriveDriver
) -> Sequence[Frame] | str:
    """Return what a request sends to one device, or why it is refused."""
    axis, identity = host.own, host.own.identity
    match request:
        case msg.ClearFault():  # its frame follows as soon as the firmware line is known
            if axis.clear(now):
                host.report_again()
            return ()
        case msg.Estop():
            return axis.action(msg.Estop)
        case _ if not identity.known:
            return "its firmware is not known, or not the one in the robot file"
        case msg.WriteParameter(_, parameter) if host.running and parameter in (SAVE, STATE, POSITION):
            return ARMED
        case msg.WriteParameter(_, "save_configuration", value) if value != 1:
            return f"{SAVE} takes 1"
        case msg.ReadParameter(_, name) | msg.WriteParameter(_, name) if name in axis.registers.by_name:
            return _about_endpoint(request, host, name)
        case msg.ReadParameter(_, name):
            return _read(axis, name)
        case msg.WriteParameter(_, name, value) if name != SAVE:
            return _write(axis, name, value)
        case msg.Reboot() if identity.dialect.boards:
            boards = [each for each in driver.hosts.values() if each.own.identity.dialect.boards]
            beside = armed_of(boards)
            if beside:
                reason = f"it restarts its whole board, and {beside}, which is armed, may be on it"
                return f"{reason}: command Idle first"
    return axis.action(_key(request)) or f"{identity.text()} cannot do this over CAN: use the vendor's tool"


def _about_endpoint(request: Request, host: OdriveHost, name: str) -> Sequence[Frame] | str:
    """Read an endpoint; written, it is read back: before 0.6.11 no device confirms a write."""
    axis, registers, version = host.own, host.own.registers, host.options.endpoints_version
    if axis.identity.version != version:
        return f"it has {axis.identity.text()}, and the endpoints are those of {version}"
    value = getattr(request, "value", None)
    if wrong := registers.wrong(name, value):
        return wrong
    number = registers.by_name[name].number
    read = axis.encode("RxSdo read", Endpoint_ID=number)
    if value is None:
        return (read,)
    return (axis.encode("RxSdo", Endpoint_ID=number, Value=registers.raw(name, value)), read)


def _read(axis: Axis, parameter: str) -> Sequence[Frame] | str:
    """Request the message that carries the parameter, or wait for it where it is only sent cyclically."""
    readable = axis.identity.dialect.readable()
    if parameter not in readable:
        known = ", ".join([*readable, *axis.registers.by_name])
        return f"CANSimple does not report {parameter!r}; it reports {known}"
    cyclic = readable[parameter] == "Heartbeat" and axis.identity.dialect.boards
    return () if cyclic else (axis.requests[readable[parameter]],)


def _write(axis: Axis, parameter: str, value: float) -> Sequence[Frame] | str:
    """Send the message that writes the parameter; the other parameter of that message must be known."""
    writable = axis.identity.dialect.writable()
    if parameter not in writable:
        known = ", ".join([*writable, SAVE, *axis.registers.by_name])
        return f"CANSimple cannot set {parameter!r}; it can set {known}"
    if parameter == STATE and value not in table.PROCEDURES:
        names = (f"{state} {table.STATE_NAMES[state]}" for state in sorted(table.PROCEDURES))
        return f"{value:g} is no procedure; there are {', '.join(names)}"
    if (value < 0.0 and parameter != POSITION) or abs(value) > FLOAT_MAX:
        return f"{value} is not a number of at least 0"
    message, written = writable[parameter], axis.write(parameter, value)
    pair = WRITABLE[message]
    missing = [name for name in pair if name not in written]
    if missing:
        reason = f"{message} sets {' and '.join(pair)} together, and the device does not report them over CAN"
        return f"{reason}: write {missing[0]} too; {parameter} is kept for it"
    return (axis.encode(message, **{name: written[name] for name in pair}),)


def _node(device: Device) -> int:
    """Return the bits of a device's identifiers that are not the message's number."""
    marked: int = device.address | device.options.is_extended * EXTENDED_BIT >> table.CMD_BITS
    return marked
