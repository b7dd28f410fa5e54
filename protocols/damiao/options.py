"""`Options` of the driver, `Settings` of the motor itself. SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from protocols.damiao import table as dm
from protocols.toolkit.mit import KD_MAX, KP_MAX, ImpedanceGains, gains_of
from protocols.toolkit.options import bounded, check_bounds
from protocols.toolkit.table import FLOAT_MAX, Table

# fmt: off
Model = Literal[
    "4310", "4310P", "4340", "4340P", "3507", "6006", "6248P", "8006", "8009", "10010L", "10010", "H3510",
    "G6215", "H6220", "JH11",
]
# fmt: on


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: Model = "4310"
    """Decides the ranges of all numbers; the motor is asked for them before it is enabled."""
    mode: Literal["mit", "pos_vel", "vel", "force_pos"] = "mit"
    """CTRL_MODE, written before the motor is enabled."""
    reply_id: int = bounded(0, -1, 0x7FE)
    """MST_ID of the motor; 0: its address and 16. −1: it is 0, as many are delivered, and answers by id 0."""
    position_end: float = bounded(0.0, 0.0, 1000.0)
    """rad; 0: PMAX of the model. The ends are those that the motor has; it is asked for them."""
    velocity_end: float = bounded(0.0, 0.0, 1000.0)
    """rad/s; 0: VMAX of the model"""
    torque_end: float = bounded(0.0, 0.0, 1000.0)
    """N·m; 0: TMAX of the model"""
    stiffness: float = bounded(20.0, 0.2, KP_MAX)
    """N·m/rad of Position and Hold (mode mit)"""
    damping: float = bounded(1.0, 0.01, KD_MAX)
    """N·m·s/rad of Position, Hold and Velocity (mode mit)"""
    max_velocity: float = bounded(5.0, 0.01, 300.0)
    """rad/s on the way to a Position (modes pos_vel, force_pos)"""
    max_force: float = bounded(0.5, 0.001, 1.0)
    """Current on the way to a Position, as a share of the motor's largest (mode force_pos)"""
    position: Literal["feedback", "xout"] = "feedback"
    """Where the position is from: the feedback, which ends at ±PMAX, or register xout, which counts turns
    (one more frame for each command)."""
    timeout_ms: float = bounded(100.0, 10.0, 10_000.0)
    """TIMEOUT of the motor's watchdog, written before it is enabled."""
    feedback_ms: int = bounded(10, 1, 1000)
    """Period of questions to a motor that is not commanded."""
    offline_ms: int = bounded(100, 20, 10_000)
    """Time without an answer after which the motor is offline."""

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def ends(self) -> dict[str, float]:
        """The registers that hold the ends of its ranges."""
        own = (getattr(self, name) for name in dm.RANGES.values())
        pairs = zip(dm.RANGES, own, dm.MODELS[self.model], strict=True)
        return {register: end or model for register, end, model in pairs}

    @property
    def table(self) -> Table:
        """The messages with these ends."""
        return dm.table_of(self.model, self.position_end, self.velocity_end, self.torque_end)

    @property
    def gains(self) -> ImpedanceGains:
        """The gains of Position, Hold and Velocity."""
        return gains_of(self.table, "MIT", self.stiffness, self.damping)

    def reply(self, address: int) -> int:
        """Return the id of a motor's answers."""
        return max(0, self.reply_id or dm.REPLY_BASE + address)


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the motor; its model is that of the options."""

    mode: int = bounded(1, 1, 4)
    """CTRL_MODE as saved"""
    timeout_ms: float = bounded(0.0, 0.0, 100_000.0)
    """TIMEOUT as saved; 0: no watchdog"""
    serial: int = bounded(0, 0, 0xFFFF_FFFF)
    """SN; 0: derived from the address"""
    temperature: int = bounded(30, 0, 255)
    """°C"""
    # Registers; bounds as damiao-motor documents them. V, °C, share of the largest current, rad/s², rad/s …
    UV_Value: float = bounded(15.0, 10.0, FLOAT_MAX)
    OV_Value: float = bounded(32.0, 0.0, FLOAT_MAX)
    OT_Value: float = bounded(100.0, 80.0, 200.0)
    OC_Value: float = bounded(0.98, 0.0, 1.0)
    ACC: float = bounded(500.0, 0.0, FLOAT_MAX)
    DEC: float = bounded(-500.0, -FLOAT_MAX, 0.0)
    MAX_SPD: float = bounded(300.0, 0.0, FLOAT_MAX)
    KT_Value: float = bounded(0.0, 0.0, FLOAT_MAX)
    I_BW: float = bounded(1000.0, 100.0, 10_000.0)
    V_BW: float = bounded(100.0, 0.0, 500.0)
    KP_ASR: float = bounded(0.004, 0.0, FLOAT_MAX)
    KI_ASR: float = bounded(0.002, 0.0, FLOAT_MAX)
    KP_APR: float = bounded(50.0, 0.0, FLOAT_MAX)
    KI_APR: float = bounded(1.0, 0.0, FLOAT_MAX)
    GREF: float = bounded(1.0, 0.0, 1.0)
    Deta: float = bounded(4.0, 1.0, 30.0)
    IQ_c1: float = bounded(1000.0, 100.0, 10_000.0)
    VL_c1: float = bounded(1000.0, 0.0, 10_000.0)

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def registers(self) -> dict[str, float]:
        """The registers as saved."""
        stored = {name: getattr(self, name) for name in REGISTERS}
        return stored | {"TIMEOUT": round(self.timeout_ms / dm.TIMEOUT_UNIT_MS), "CTRL_MODE": self.mode}


REGISTERS = tuple(name for name in Settings.__slots__ if name in dm.REGISTERS.by_name)
"""The settings that are registers of the same name."""
