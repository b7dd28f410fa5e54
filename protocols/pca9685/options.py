"""`Options` of the driver and of what is on an output, and `Settings` of that as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from protocols import messages as msg
from protocols.bounds import Bounds, check
from protocols.pca9685 import table as pt
from protocols.plugin import Range
from protocols.toolkit.pulses import ServoOptions, ServoSettings

MICRO = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Options(ServoOptions):
    """Configuration of the driver."""

    kind: Literal["servo", "pwm"] = "servo"
    """"pwm": the driver of a motor, which turns by the share of time for which the output is on"""
    frequency: Annotated[float, Bounds(24.0, 1500.0, "Hz")] = 50.0
    """Hz of all outputs of a chip: 50 for servos (digital ones up to 330), hundreds for motors"""
    oscillator: Annotated[float, Bounds(20e6, 50e6, "Hz")] = 25e6
    """Hz of the chip's clock: its own is off by some per cent; what is measured of a frequency corrects it"""
    full_scale: Annotated[float, Bounds(1e-3, 1e4)] = 20.0
    """rad/s of a motor at full power under its usual load: nothing checks it"""
    reversible: bool = False
    """The next output drives the same motor backwards"""

    offline_ms: ClassVar[int] = 250

    def __post_init__(self) -> None:
        period = 1e6 / self.frequency
        wrong = self.kind == "servo" and self.high_us > 0.95 * period
        self.check(("high_us", f"high_us must be less than a period, {period:.0f} µs" if wrong else ""))

    @property
    def scale(self) -> int:
        """The value of the prescaler"""
        return pt.prescale(self.oscillator, self.frequency)

    @property
    def count_us(self) -> float:
        """µs of a count"""
        return (self.scale + 1) / self.oscillator / MICRO

    @property
    def of_kind(self) -> dict[str, Any]:
        """The fields of its spec that are those of a servo, or of a motor."""
        servo = self.spec(2.0 * self.count_us)  # at the ends only counts that are inside of the range
        if self.kind == "servo":
            return servo
        low, step = -self.full_scale if self.reversible else 0.0, 0.501 * self.full_scale / pt.COUNTS
        return servo | {
            "commands": frozenset({msg.Idle, msg.Velocity}),
            "ranges": {"Velocity.velocity": Range(low, self.full_scale, step)},
            "scales": {"full_scale": ""},
            "caution": "open loop: a motor on PWM reports nothing, and what it turns is not measured",
        }

    def counts(self, pulse: float) -> int:
        """Return a pulse [µs] in counts, of which none is outside the servo's range."""
        least, most = -(-self.low_us // self.count_us), self.high_us // self.count_us
        return int(max(least, min(most, round(pulse / self.count_us))))


@dataclass(frozen=True, slots=True)
class Settings(ServoSettings):
    """What the servo or the motor truly is, and the chip's clock."""

    clock: Annotated[float, Bounds(0.9, 1.1)] = 1.0
    """Of the chip's clock, of what `oscillator` says"""
    resistance: Annotated[float, Bounds(1e-3, 100.0)] = 0.5
    """Ω of a motor"""
    torque_constant: Annotated[float, Bounds(1e-4, 100.0)] = 0.5
    """N·m/A"""

    def __post_init__(self) -> None:
        check(self)
