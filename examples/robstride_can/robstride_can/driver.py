"""The host's end: what a RobStride motor is sent in each phase, and what its answers report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.frames import Frame
from protocols.messages import Command, Feedback, Mode, Nanos
from protocols.toolkit.host import Host, Report
from protocols.toolkit.mit import NUMBERS, ImpedanceGains
from protocols.toolkit.motor_driver import MotorDriver, Rx
from protocols.toolkit.register_motor import Motor, RegisterAdapter

from . import table as rs

MODES = {0: (Mode.READY, "reset"), 1: (Mode.INITIALISING, "calibration"), 2: (Mode.ARMED, "running")}


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    stiffness: Annotated[float, Bounds(0.1, 500.0)] = 20.0
    """N·m/rad of Position and Hold"""
    damping: Annotated[float, Bounds(0.01, 5.0)] = 1.0
    """N·m·s/rad of Position, Hold and Velocity"""
    timeout_ms: Annotated[float, Bounds(10.0, 10_000.0)] = 100.0
    """Of the motor's watchdog."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Period of questions to a motor that is not commanded."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 100
    """Time without an answer after which a motor is offline."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def gains(self) -> ImpedanceGains:
        """The gains of Position, Hold and Velocity."""
        return ImpedanceGains(self.stiffness, self.damping, rs.TABLE.row("control"))


class RobStride(RegisterAdapter):
    """What motors are sent, and what they report."""

    name = "robstride_can"
    faults, not_armed = rs.ALL_FAULTS, rs.NOT_ENABLED
    registers, actions = rs.REGISTERS, rs.REQUESTS
    turns, blind = "mechPos", True

    def written(self, options: Options) -> Mapping[str, float]:
        return {"run_mode": rs.IMPEDANCE, "canTimeout": round(options.timeout_ms / rs.TIMEOUT_UNIT_MS)}

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        decoded = rs.TABLE.decode(frame, "from_device")
        host = driver.at.get(decoded.address) if decoded is not None else None
        if decoded is None or host is None:
            return (Rx.IGNORED,)
        values = decoded.values
        if decoded.name == "register":
            name, value = rs.REGISTERS.value(values["number"], values["value"])
            if value is not None:
                return (self.register_report(t, host, name, value),)
        elif decoded.name == "status" and values["mode"] in MODES:
            mode, detail = MODES[values["mode"]]
            faults = [bit for bit in rs.FAULTS if values["faults"] & bit]
            velocity, torque, temperature = (values[name] for name in ("velocity", "torque", "temperature"))
            feedback = Feedback(host.name, t, None, velocity, torque, temperature=temperature)
            mode, many = Mode.FAULT if faults else mode, host.own.answers.add(t)
            return (Report(host, host.address, mode, detail, faults, feedback, duplicate=many),)
        return (Rx.MALFORMED,)

    # -- sent -----------------------------------------------------------------------------------------

    def message(self, name: str, address: int) -> Frame:
        return rs.TABLE.encode(name, address)

    def about(self, operation: str, address: int, name: str, value: float = 0.0) -> Sequence[Frame]:
        number = rs.REGISTERS.by_name[name].number
        read = rs.TABLE.encode("read", address, number=number, value=0)
        if operation == "read":
            return (read,)
        return rs.TABLE.encode("write", address, number=number, value=rs.REGISTERS.raw(name, value)), read

    def set_point(self, host: Host[Motor], command: Command) -> Frame:
        goal = host.options.gains.impedance(command, host.held)
        return rs.TABLE.encode("control", host.address, **{name: getattr(goal, name) for name in NUMBERS})
