"""`Options` of the driver, `Settings` of the motor itself. SI units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, check
from protocols.damiao import table as dm
from protocols.toolkit.mit import KD_MAX, KP_MAX, ImpedanceGains, gains_of
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
    reply_id: Annotated[int, Bounds(-1, 0x7FE)] = 0
    """MST_ID of the motor; 0: its address and 16. −1: it is 0, as many are delivered, and answers by id 0."""
    position_end: Annotated[float, Bounds(0.0, 1000.0)] = 0.0
    """rad; 0: PMAX of the model. The ends are those that the motor has; it is asked for them."""
    velocity_end: Annotated[float, Bounds(0.0, 1000.0)] = 0.0
    """rad/s; 0: VMAX of the model"""
    torque_end: Annotated[float, Bounds(0.0, 1000.0)] = 0.0
    """N·m; 0: TMAX of the model"""
    stiffness: Annotated[float, Bounds(0.2, KP_MAX)] = 20.0
    """N·m/rad of Position and Hold (mode mit)"""
    damping: Annotated[float, Bounds(0.01, KD_MAX)] = 1.0
    """N·m·s/rad of Position, Hold and Velocity (mode mit)"""
    max_velocity: Annotated[float, Bounds(0.01, 300.0)] = 5.0
    """rad/s on the way to a Position (modes pos_vel, force_pos)"""
    max_force: Annotated[float, Bounds(0.001, 1.0)] = 0.5
    """Current on the way to a Position, as a share of the motor's largest (mode force_pos)"""
    position: Literal["feedback", "xout"] = "feedback"
    """Where the position is from: the feedback, which ends at ±PMAX, or register xout, which counts turns
    (one more frame for each command)."""
    timeout_ms: Annotated[float, Bounds(10.0, 10_000.0)] = 100.0
    """TIMEOUT of the motor's watchdog, written before it is enabled."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Period of questions to a motor that is not commanded."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 100
    """Time without an answer after which the motor is offline."""

    def __post_init__(self) -> None:
        check(self)

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

    mode: Annotated[int, Bounds(1, 4)] = 1
    """CTRL_MODE as saved"""
    timeout_ms: Annotated[float, Bounds(0.0, 100_000.0)] = 0.0
    """TIMEOUT as saved; 0: no watchdog"""
    serial: Annotated[int, Bounds(0, 0xFFFF_FFFF)] = 0
    """SN; 0: derived from the address"""
    temperature: Annotated[int, Bounds(0, 255)] = 30
    """°C"""
    # Registers; bounds as damiao-motor documents them. V, °C, share of the largest current, rad/s², rad/s …
    UV_Value: Annotated[float, Bounds(10.0, FLOAT_MAX)] = 15.0
    OV_Value: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 32.0
    OT_Value: Annotated[float, Bounds(80.0, 200.0)] = 100.0
    OC_Value: Annotated[float, Bounds(0.0, 1.0)] = 0.98
    ACC: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 500.0
    DEC: Annotated[float, Bounds(-FLOAT_MAX, 0.0)] = -500.0
    MAX_SPD: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 300.0
    KT_Value: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 0.0
    I_BW: Annotated[float, Bounds(100.0, 10_000.0)] = 1000.0
    V_BW: Annotated[float, Bounds(0.0, 500.0)] = 100.0
    KP_ASR: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 0.004
    KI_ASR: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 0.002
    KP_APR: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 50.0
    KI_APR: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 1.0
    GREF: Annotated[float, Bounds(0.0, 1.0)] = 1.0
    Deta: Annotated[float, Bounds(1.0, 30.0)] = 4.0
    IQ_c1: Annotated[float, Bounds(100.0, 10_000.0)] = 1000.0
    VL_c1: Annotated[float, Bounds(0.0, 10_000.0)] = 1000.0

    def __post_init__(self) -> None:
        check(self)

    @property
    def registers(self) -> dict[str, float]:
        """The registers as saved."""
        stored = {name: getattr(self, name) for name in REGISTERS}
        return stored | {"TIMEOUT": round(self.timeout_ms / dm.TIMEOUT_UNIT_MS), "CTRL_MODE": self.mode}


REGISTERS = tuple(name for name in Settings.__slots__ if name in dm.REGISTERS.by_name)
"""The settings that are registers of the same name."""
