"""The host's end: what a motor is sent in each phase, and what its answers report.

Rules. A motor that is not commanded is only read: where it stands, its registers, who it is. Whether it runs
is in the answers to commands alone (or in its own reports, if these are switched on). Before it is enabled,
the run mode, the watchdog and the set-point that it will obey at once are written until they read back so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Feedback, Mode, Nanos, Request
from protocols.robstride import table as rs
from protocols.robstride.options import Options
from protocols.toolkit.duplicates import IDENTIFY_PERIOD
from protocols.toolkit.host import Host, Report
from protocols.toolkit.mit import encoded
from protocols.toolkit.motor_driver import MotorDriver, Pending, Rx
from protocols.toolkit.register_motor import Motor, RegisterAdapter
from protocols.toolkit.table import Values

MODES = {0: (Mode.READY, "reset"), 1: (Mode.INITIALISING, "calibration"), 2: (Mode.ARMED, "running")}
MISSING, WARNINGS = "missing", "warnings"
"""Under what is known: the number of a register that it must have, and has not; the bits of its warnings."""
NEAR = 0.02
"""rad between the shaft and the set-point that a motor is enabled with"""


class RobStrideAdapter(RegisterAdapter):
    """What motors are sent, and what they report."""

    name = "robstride"
    faults, latch = rs.ALL_FAULTS, True
    not_armed, duplicate = rs.NOT_ENABLED, rs.DUPLICATE
    registers, addresses, save = rs.REGISTERS, range(1, 0x80), rs.SAVE
    turns, blind, actions = "mechPos", True, {msg.ClearFault: "clear", msg.Zero: "zero"}

    def written(self, options: Options) -> Mapping[str, float]:
        wanted: dict[str, float] = {"run_mode": options.run_mode}
        timeout = {rs.MODELS[options.model].timeout: round(options.timeout * rs.PER_MS)}
        wanted |= timeout if options.timeout else {}
        wanted |= {rs.SET_POINT[options.run_mode]: 0.0} if options.run_mode else {}
        if options.mode == "speed" and "acc_rad" in rs.parameters_of(options.model):
            wanted["acc_rad"] = options.max_acceleration
        return wanted | ({"limit_spd": options.max_velocity} if options.mode == "position" else {})

    def wanted(self, host: Host[Motor]) -> Mapping[str, float]:
        wanted = self.written(host.options)
        if "loc_ref" not in wanted or host.position is None:
            return wanted
        known = host.own.known.get("loc_ref", 0.0)
        return {**wanted, "loc_ref": known if abs(known - host.position) < NEAR else host.position}

    def refuse(self, host: Host[Motor], command: Command) -> str:
        number = int(host.own.known.get(MISSING, 0))
        return f"its firmware has no {rs.REGISTERS.by_number[number].name}" if number else ""

    def ready(self, host: Host[Motor]) -> bool:
        return host.position is not None

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        host = driver.at.get(frame.id >> 8 & 0xFF) if isinstance(frame, CanFrame) else None
        decoded = (rs.ANY if host is None else host.options.table).decode(frame, "from_device")
        if decoded is None:
            return (Rx.IGNORED,)
        values, address = decoded.values, decoded.address
        if decoded.name == "id" and (host is not None or driver.scanning(address)):
            return (Report(host, address, serial=values["serial"]),)
        if host is None:
            return (Rx.IGNORED,)
        match decoded.name:
            case "status" | "report" if values["mode"] in MODES:
                return (self._state(t, host, values, asked=decoded.name == "status"),)
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
                host.own.put(t, WARNINGS, values["warnings"])
                return (Report(host, address, mode, "fault", host.active | found),)
            case "register" | "version":
                name, _ = rs.REGISTERS.value(values.get("number", 0), 0)
                if name in (self.turns, *self.wanted(host)):
                    host.own.put(t, MISSING, values["number"])
                return (Report(host, address),)
        return (Rx.MALFORMED,)

    def _state(self, t: Nanos, host: Host[Motor], values: Values, *, asked: bool) -> Report[Motor]:
        host.own.reported(t)
        mode, detail = MODES[values["mode"]]
        detail += rs.warnings_in_message(int(host.own.known.get(WARNINGS, 0)))
        # A status has fewer faults than a fault message, and does not take those back.
        faults = rs.faults_in_status(host.options.model, values["faults"])
        faults = faults.union(code for code in host.active if code >= rs.DETAIL) if host.active else faults
        mode = Mode.FAULT if faults else mode
        # Its position loops at ±4π, or ends there: mechPos has it.
        motion = values["velocity"], values["torque"]
        feedback = Feedback(host.name, t, None, *motion, None, None, values["temperature"])
        return Report(host, host.address, mode, detail, faults, feedback, content=asked)

    # -- sent -----------------------------------------------------------------------------------------

    def message(self, name: str, address: int) -> Frame:
        return rs.ANY.encode(name, address)

    def ask_at(self, address: int) -> Sequence[Frame]:
        return (self.message("get_id", address),)

    def readdress(self, host: Host[Motor], address: int) -> Sequence[Frame]:
        return (rs.ANY.encode("set_id", host.address, id=address),)

    def about(self, operation: str, address: int, name: str, value: float = 0.0) -> Sequence[Frame]:
        if operation == "save":
            return (self.message("save", address),)
        number = rs.REGISTERS.by_name[name].number
        read = rs.ANY.encode("read", address, number=number, value=0)
        if operation == "read":
            return (read,)
        return rs.ANY.encode("write", address, number=number, value=rs.REGISTERS.raw(name, value)), read

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        frames, address = super().arm(now, host, command), host.address
        name = rs.SET_POINT.get(host.options.run_mode)
        if name is None or self.message(self.enable, address) not in frames:
            return frames
        # What it is enabled with is written just before: a restart may have changed it.
        first = self.about("write", address, name, self.wanted(host)[name])[:1]
        return [*host.own.answers.sent(now, first), *frames]

    def set_point(self, host: Host[Motor], command: Command) -> Frame:
        options: Options = host.options
        if options.mode == "mit":
            goal = options.gains.impedance(command, host.held)
            return encoded(options.table.encoder("control"), host.address, goal)
        held = host.position if host.held is None else host.held
        value: Any = getattr(command, "velocity" if options.mode == "speed" else "position", held)
        name = rs.SET_POINT[options.run_mode]
        # What it is enabled with, unless it is written before.
        host.own.put(host.own.answers.sent_at, name, value)
        return self.about("write", host.address, name, value)[0]

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        frames = [*super().poll(now, host)]
        if now - host.own.asked.get("id", -IDENTIFY_PERIOD) >= IDENTIFY_PERIOD:
            host.own.ask(now, "id")
            frames += self.ask_at(host.address)
        return frames

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        name, known = getattr(request, "parameter", ""), (*rs.REGISTERS.by_name, self.save)
        if host is not None and name in known and name not in rs.parameters_of(host.options.model):
            return f"a {host.options.model} has no {name}"
        if host is not None and isinstance(request, msg.ClearFault):
            host.report_again()  # what a fault message had: no other says that it is gone
        return super().begin(now, request, host, driver)

    def answer(self, t: Nanos, pending: Pending[Motor], report: Report[Motor]) -> msg.Event | None:
        # A save is answered by a status, as is nothing else that is sent to a motor that is not commanded.
        if getattr(pending.request, "parameter", "") == self.save and report.content is True:
            return pending.done(t)
        return super().answer(t, pending, report)
