"""Hobby servos: what a pulse means, which pulses one may get, and the servo behind its wire. It reports
nothing.

Rules. Position 0 is the pulse `centre_us`; a longer pulse turns it forward. The first pulse that a servo gets
turns it there at once, from wherever it stood: nobody knows where that was. A pulse outside `low_us` to
`high_us` is never made: what lies beyond them is against the servo's end stop.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from protocols import messages as msg
from protocols.bounds import Bounds, Wrong, check, ordered
from protocols.messages import Mode, Nanos, Obeyed
from protocols.plugin import FeedbackKind, Range
from protocols.toolkit.firmware import ServoFirmware
from protocols.toolkit.servo import Gains

Pulse = Annotated[float, Bounds(400.0, 2600.0, "µs")]
COMMANDS = frozenset({msg.Idle, msg.Hold, msg.Position})
CAUTION = (
    "open loop: a hobby servo reports nothing. It is taken to be where its last pulse sends it; the first "
    "pulse turns it to where that is, at once; without pulses most let go of their load"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """What is the same for all that make pulses."""

    low_us: Pulse = 1000.0
    """µs: the shortest pulse that the servo may get: by its data sheet, or found by hand where it hums,"""
    high_us: Pulse = 2000.0
    """and the longest one"""
    centre_us: Pulse = 1500.0
    """µs: the pulse of position 0, to which its first pulse turns it"""
    travel: Annotated[float, Bounds(0.1, 12.0, "rad")] = 1.5708
    """rad that it turns from the shortest to the longest pulse: measure it, nothing checks it"""

    feedback_ms: ClassVar[int] = 20
    """Period in which what makes the pulses is asked for them"""

    def __post_init__(self) -> None:
        self.check()

    def check(self, *others: Wrong) -> None:
        """Raise Invalid with all that is wrong."""
        check(self, *others)
        ordered(self, "low_us", "centre_us")
        ordered(self, "centre_us", "high_us")
        if self.high_us - self.low_us < 50.0:
            check(self, ("high_us", f"high_us must be at least 50 µs above low_us, {self.low_us:g}"))

    @property
    def rate(self) -> float:
        """µs/rad"""
        return (self.high_us - self.low_us) / self.travel

    def pulse(self, position: float) -> float:
        """Return the pulse [µs] of a position [rad]; never one outside the servo's range."""
        return self.within(self.pulse_of(position))

    def pulse_of(self, position: float) -> float:
        """Return the pulse [µs] of a position [rad], any."""
        return self.centre_us + position * self.rate

    def within(self, pulse: float) -> float:
        """Return the nearest pulse [µs] that the servo may get."""
        return max(self.low_us, min(self.high_us, pulse))

    def position(self, pulse: float) -> float:
        """Return the position [rad] of a pulse [µs], any."""
        return (pulse - self.centre_us) / self.rate or 0.0

    def spec(self, step: float) -> dict[str, Any]:
        """Return the fields of a spec that are those of every servo; `step`: one count of its pulses [µs]."""
        low, high = self.position(self.low_us), self.position(self.high_us)
        return {
            "feedback": FeedbackKind.NONE,
            "commands": COMMANDS,
            "requests": frozenset[type[msg.Request]](),
            "ranges": {"Position.position": Range(low, high, 0.501 * step / self.rate)},
            "scales": dict.fromkeys(("low_us", "high_us", "centre_us", "travel"), ""),
            "caution": CAUTION,
        }


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """What the servo truly is."""

    speed: Annotated[float, Bounds(0.1, 100.0)] = 6.0
    """rad/s at most: 0.17 s for 60°"""
    torque: Annotated[float, Bounds(1e-3, 1000.0)] = 1.0
    """N·m at most"""
    scale: Annotated[float, Bounds(0.5, 2.0)] = 1.0
    """What it turns, of what `travel` says"""
    offset: Annotated[float, Bounds(-1.0, 1.0)] = 0.0
    """rad where it stands at `centre_us`: a horn that is fitted a tooth off"""
    without_signal: Literal["limp", "holds"] = "limp"
    """What it does when its pulses end: some digital ones keep their place"""

    def __post_init__(self) -> None:
        check(self)


class HobbyServo(ServoFirmware):
    """A servo on a wire; a protocol says which pulses are on that."""

    def __init__(self, device: Any, seed: int) -> None:  # noqa: ANN401 -- as of every firmware
        settings: ServoSettings = device.settings
        super().__init__(device, seed, Gains(torque_limit=settings.torque))
        self.fastest = settings.speed

    def turns_to(self, position: float) -> float:
        """Return where it truly turns [rad] for a position that is meant."""
        settings: ServoSettings = self.settings
        return position * settings.scale + settings.offset

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        """Obey: a pulse arms it."""
        if isinstance(obeyed, msg.Position):
            obeyed = msg.Position(obeyed.motor, self.turns_to(obeyed.position))
        super().obey(t, obeyed)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        """Turn to where the pulse is; without one as it is built."""
        armed, self.mode = self.mode, self._driven()
        torque = super().cycle(now, dt, position, velocity)
        self.mode = armed
        return torque

    def _driven(self) -> Mode:
        holds = self.settings.without_signal == "holds" and isinstance(self.goal, msg.Position)
        return Mode.ARMED if holds else self.mode
