"""`Options` of the driver, `Settings` of the motor itself. SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, check
from protocols.robstride import table as rs
from protocols.toolkit.mit import ImpedanceGains, gains_of
from protocols.toolkit.table import Table

Model = Literal["RS00", "RS01", "RS02", "RS03", "RS04", "RS05", "RS06", "EL05", "cybergear"]


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: Model = "RS02"
    """Decides the ends of all ranges, and the dialect."""
    mode: Literal["mit", "speed", "position"] = "mit"
    """run_mode, written before the motor is enabled: five numbers, or the motor's own loops."""
    stiffness: Annotated[float, Bounds(0.1, 5000.0)] = 20.0
    """N·m/rad of Position and Hold (mode mit)"""
    damping: Annotated[float, Bounds(0.01, 100.0)] = 1.0
    """N·m·s/rad of Position, Hold and Velocity (mode mit)"""
    max_velocity: Annotated[float, Bounds(0.01, 50.0)] = 5.0
    """rad/s on the way to a Position (mode position): limit_spd"""
    max_acceleration: Annotated[float, Bounds(1.0, 1000.0)] = 200.0
    """rad/s² of the motor's own ramp (mode speed): acc_rad. It must not be slower than the joint's limit, or
    Velocity is not followed, and not braked; as delivered it is 20. A CyberGear has none."""
    position_end: Annotated[float, Bounds(0.0, 13.0)] = 0.0
    """rad; 0: the model's. Uncertain: 12.57, 12.5 in firmware before 0.0.2.6 (RS00)."""
    velocity_end: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """rad/s; 0: the model's, from its manual. Uncertain: the vendor's Python package has others (README)."""
    torque_end: Annotated[float, Bounds(0.0, 200.0)] = 0.0
    """N·m; 0: the model's. Uncertain likewise."""
    scan: bool = True
    """A scan may ask all addresses, in 29-bit ids that motors of other makes obey. Set it to false for all
    RobStride motors on a bus that they share with such."""
    timeout_ms: Annotated[float, Bounds(0.0, 5000.0)] = 100.0
    """Of the motor's watchdog, written before it is enabled; 0: not written, and it counts as having none. A
    CyberGear has none, whatever is written here."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Period of questions to a motor that is not commanded."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 100
    """Time without an answer after which the motor is offline."""

    def __post_init__(self) -> None:
        most = rs.MODELS[self.model]
        given = (("stiffness", self.stiffness, most.stiffness), ("damping", self.damping, most.damping))
        text = "{} is {:g}: at most {:g} for " + self.model
        check(self, *((each[0], text.format(*each)) for each in given if each[1] > each[2]))

    @property
    def timeout(self) -> float:
        """ms of the watchdog; 0: none"""
        return self.timeout_ms if rs.MODELS[self.model].timeout else 0.0

    @property
    def run_mode(self) -> int:
        """The value of run_mode."""
        return {"mit": 0, "speed": 2, "position": rs.MODELS[self.model].goto}[self.mode]

    @property
    def table(self) -> Table:
        """The messages of the model."""
        return rs.table_of(self.model, self.position_end, self.velocity_end, self.torque_end)

    @property
    def gains(self) -> ImpedanceGains:
        """The gains of Position, Hold and Velocity."""
        return gains_of(self.table, "control", self.stiffness, self.damping)


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the motor; its model is that of the options."""

    timeout_ms: Annotated[float, Bounds(0.0, 100_000.0)] = 0.0
    """canTimeout as saved; 0: no watchdog, which a CyberGear never has"""
    serial: Annotated[int, Bounds(0, 0xFFFF_FFFF)] = 0
    """Lower half of its unique identifier; 0: the address"""
    # Registers of the same name: A, N·m, rad/s, rad/s² … 0.0 of the limits: the model's largest.
    limit_torque: Annotated[float, Bounds(0.0, 200.0)] = 0.0
    limit_cur: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    limit_spd: Annotated[float, Bounds(0.0, 100.0)] = 2.0
    cur_kp: Annotated[float, Bounds(0.0, 200.0)] = 0.17
    cur_ki: Annotated[float, Bounds(0.0, 200.0)] = 0.012
    cur_filt_gain: Annotated[float, Bounds(0.0, 1.0)] = 0.1
    loc_kp: Annotated[float, Bounds(0.0, 200.0)] = 40.0
    spd_kp: Annotated[float, Bounds(0.0, 200.0)] = 6.0
    spd_ki: Annotated[float, Bounds(0.0, 200.0)] = 0.02
    spd_filt_gain: Annotated[float, Bounds(0.0, 1.0)] = 0.1
    acc_rad: Annotated[float, Bounds(0.0, 10_000.0)] = 20.0
    vel_max: Annotated[float, Bounds(0.0, 100.0)] = 10.0
    acc_set: Annotated[float, Bounds(0.0, 10_000.0)] = 10.0
    zero_sta: Annotated[int, Bounds(0, 1)] = 0

    def __post_init__(self) -> None:
        check(self)


STORED = tuple(name for name in Settings.__slots__ if name in rs.REGISTERS.by_name)
"""The settings that are registers of the same name."""
