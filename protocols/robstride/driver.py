"""The host's end: what a motor is sent in each phase, and what its answers report.

Rules. A motor that is not commanded is only read: where it stands, its registers, who it is. Whether it runs
is in the answers to commands alone (or in its own reports, if these are switched on). Before it is enabled,
the run mode, the watchdog and the set-point that it will obey at once are written until they read back so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.robstride import table as rs
from protocols.robstride.options import Options
from protocols.toolkit.duplicates import IDENTIFY_PERIOD
from protocols.toolkit.host import Host, Report
from protocols.toolkit.mit import NUMBERS
from protocols.toolkit.motor_driver import MotorDriver, Pending, Rx
from protocols.toolkit.register_motor import ANSWER, Motor, RegisterAdapter
from protocols.toolkit.table import Table, Values

MODES = {0: (Mode.READY, "reset"), 1: (Mode.INITIALISING, "calibration"), 2: (Mode.ARMED, "running")}
SCAN_SLICE, SCAN_PERIOD = 8, 10 * MILLISECOND
"""Questions of a scan that are sent at once (a queue of ten holds them), and how often."""
NEAR = 0.02
"""rad between the shaft and the set-point that a motor is enabled with"""


@dataclass(slots=True)
class Own(Motor):
    """What is known of one motor beyond its phase."""

    in_status: frozenset[int] = frozenset()
    """Codes of the faults in its last status,"""
    in_message: frozenset[int] = frozenset()
    """and in its fault messages since ClearFault: a status has fewer."""
    identify_at: Nanos = 0

    def faults(self, status: frozenset[int] | None = None, message: frozenset[int] = frozenset()) -> set[int]:
        """Record faults; return all that are active."""
        self.in_status = self.in_status if status is None else status
        self.in_message |= message
        return {*self.in_status, *self.in_message}

    def forget(self) -> None:
        """Forget everything."""
        Motor.forget(self)
        self.in_status, self.identify_at = frozenset(), 0
        self.clear()

    def clear(self) -> None:
        """Forget the faults of messages: none says that they are gone."""
        self.in_message = frozenset()

    def identify(self, now: Nanos) -> bool:
        """True if it must be asked now who it is."""
        due = now >= self.identify_at
        self.identify_at = now + IDENTIFY_PERIOD if due else self.identify_at
        return due


class RobStrideAdapter(RegisterAdapter):
    """What motors are sent, and what they report."""

    name = "robstride"
    faults, latch = rs.ALL_FAULTS, True
    not_armed, duplicate = rs.NOT_ENABLED, rs.DUPLICATE
    registers, addresses, actions, save = rs.REGISTERS, rs.ADDRESSES, rs.REQUESTS, rs.SAVE
    turns, blind = "mechPos", True

    def own(self, device: Device) -> Own:
        return Own()

    @staticmethod
    def _own(host: Host[Motor]) -> Own:
        assert isinstance(host.own, Own)
        return host.own

    def written(self, options: Options) -> Mapping[str, float]:
        wanted: dict[str, float] = {"run_mode": rs.run_modes_of(options.model)[options.mode]}
        if options.timeout_ms:
            wanted[rs.timeout_of(options.model)] = round(options.timeout_ms / rs.TIMEOUT_UNIT_MS)
        match options.mode:
            case "speed":
                wanted |= {"spd_ref": 0.0}
            case "position":
                wanted |= {"loc_ref": 0.0, "limit_spd": options.max_velocity}
        if options.max_current and options.mode != "mit":
            wanted["limit_cur"] = options.max_current
        return wanted

    def wanted(self, host: Host[Motor]) -> Mapping[str, float]:
        wanted = self.written(host.options)
        if "loc_ref" not in wanted or host.position is None:
            return wanted
        known = host.own.known.get("loc_ref", 0.0)
        return {**wanted, "loc_ref": known if abs(known - host.position) < NEAR else host.position}

    def ready(self, host: Host[Motor]) -> bool:
        return host.position is not None

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        decoded = rs.ANY.decode(frame, "from_device")
        host = driver.at.get(decoded.address) if decoded is not None else None
        if decoded is None or not isinstance(frame, CanFrame):
            return (Rx.IGNORED,)
        values, address = decoded.values, decoded.address
        if decoded.name == "id" and (host is not None or driver.scanning()):
            note = f"identifier {values['serial']:016X}"
            return (Report(host, address, serial=values["serial"], note=note),)
        if host is None:
            return (Rx.IGNORED,)
        match decoded.name:
            case "status" | "report":
                return (self._state(t, frame, host, values) or Rx.MALFORMED,)
            case "register" if not values["failed"]:
                name, value = rs.REGISTERS.value(values["number"], values["value"])
                if value is None:
                    return (Rx.MALFORMED,)
                report = self.register_report(t, host, name, value)
                still = host.tripped and host.mode is None  # it is back, and reports no state by itself
                return (replace(report, mode=Mode.FAULT, detail="not cleared yet") if still else report,)
            case "fault":
                found = rs.faults_in_message(host.options.model, values["faults"])
                mode = Mode.FAULT if found else None
                return (Report(host, address, mode, "fault", self._own(host).faults(message=found)),)
            case "register" | "version":
                return (Report(host, address),)
        return (Rx.MALFORMED,)

    def _state(self, t: Nanos, frame: CanFrame, host: Host[Motor], id_: Values) -> Report[Motor] | None:
        values = host.options.table.read("status", frame.data)
        if values is None or id_["mode"] not in MODES:
            return None
        host.own.reported(t)
        mode, detail = MODES[id_["mode"]]
        faults = self._own(host).faults(rs.faults_in_status(host.options.model, id_["faults"]))
        mode = Mode.FAULT if faults else mode
        # Its position loops at ±4π, or ends there: mechPos has it.
        velocity, torque, temperature = (values[name] for name in ("velocity", "torque", "temperature"))
        feedback = Feedback(host.name, t, None, velocity, torque, temperature=temperature)
        return Report(host, host.address, mode, detail, faults, feedback)

    # -- sent -----------------------------------------------------------------------------------------

    def message(self, name: str, address: int) -> Frame:
        return rs.ANY.encode(name, address)

    def about(self, operation: str, address: int, name: str, value: float = 0.0) -> Sequence[Frame]:
        if operation == "save":
            return (self.message("save", address),)
        number = rs.REGISTERS.by_name[name].number
        read = rs.ANY.encode("read", address, number=number, value=0)
        if operation == "read":
            return (read,)
        if name in rs.SET_POINTS:
            return rs.ANY.encode(name, address, value=value), read
        return rs.ANY.encode("write", address, number=number, value=rs.REGISTERS.raw(name, value)), read

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        known = self.wanted(host).keys() <= host.own.known.keys()  # else `poll` asks
        return super().arm(now, host, command) if known else ()

    def set_point(self, host: Host[Motor], command: Command) -> Frame:
        if host.options.mode == "mit":
            goal = host.options.gains.impedance(command, host.held)
            table: Table = host.options.table
            return table.encode("control", host.address, **{name: getattr(goal, name) for name in NUMBERS})
        name, value = "loc_ref", host.held or 0.0  # of Hold: `ready` sees to it that it is known
        match command:
            case msg.Position(position=position):
                value = position
            case msg.Velocity(velocity=velocity):
                name, value = "spd_ref", velocity
        host.own.put(host.own.sent_at, name, value)  # what it is enabled with, unless it is written before
        return rs.ANY.encode(name, host.address, value=value)

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        frames = [*super().poll(now, host)]
        return [*frames, self.message("get_id", host.address)] if self._own(host).identify(now) else frames

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if isinstance(request, msg.Scan):
            asks = tuple(self.message("get_id", at) for _ in range(2) for at in self.addresses)
            end = now + SCAN_PERIOD * (1 + len(asks) // SCAN_SLICE) + ANSWER
            return Pending(request, request.bus, now, end, now, None, asks, SCAN_PERIOD)
        name = getattr(request, "name", "")
        if host is not None and name in (*rs.REGISTERS.by_name, self.save):
            model = host.options.model
            has = rs.registers_of(model) if model == rs.CYBERGEAR else (*rs.registers_of(model), self.save)
            if name not in has:
                return f"a {model} has no {name}"
        if host is not None and isinstance(request, msg.ClearFault):
            self._own(host).clear()
        return super().begin(now, request, host, driver)

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        if isinstance(pending.request, msg.Scan):
            return pending.frames[pending.sent : pending.sent + SCAN_SLICE]
        return super().frames(now, pending)
