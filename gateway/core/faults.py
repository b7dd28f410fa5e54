"""Faults of a joint: they latch until they are cleared, whatever the device forgets; our own, by code."""

from __future__ import annotations

from typing import TypeAlias

from protocols import messages as msg
from protocols.messages import Nanos

FEEDBACK_LOST, DISARMED_ITSELF, ARMED_AGAINST_IDLE, STILL_ARMED = -1, -2, -3, -6
NOT_FOLLOWED, RUNS_AWAY, INCONSISTENT, NO_TORQUE = -7, -8, -9, -10
UNREFERENCED, BEYOND_TRAVEL, ANOTHER_DEVICE = -20, -21, -22
"""Our own fault codes, by which a joint judges its device."""
FRAME_BLOCKED, DRIVER_FAILED = -4, -5
"""Our own codes of its driver: the guard has held back a frame, it has raised an exception."""
OTHER_HOST, BRAIN_FAILED = -11, -12
"""Our own codes: another host commands the device, a brain of another distribution has failed."""
_OWN_FAULTS: dict[int, tuple[str, str, str]] = {
    FEEDBACK_LOST: (
        "silent: no feedback for more than {}",
        "cable, supply, termination, the device's cyclic messages, or the device itself",
        "it was armed when last reported: cut its supply; repair it",
    ),
    DISARMED_ITSELF: (
        "disarmed itself: {}",
        "a restart, its watchdog, another host, or a second device at the same address",
        "find the cause",
    ),
    ARMED_AGAINST_IDLE: (
        "armed without being commanded",
        "a frame that an adapter delivered late, another host, or a device that does not obey Idle",
        "find the cause",
    ),
    STILL_ARMED: (
        "{}: cut its supply",
        "nothing that is sent reaches it (cable, bus), it does not obey, or another motor turns it",
        "cut its supply; find the cause",
    ),
    NOT_FOLLOWED: (
        "does not follow its set-points: {}",
        "blocked, no torque (supply, phases), a stuck encoder, or a slower ramp of the device's own",
        "find the cause",
    ),
    RUNS_AWAY: (
        "runs away: {}",
        "a reversed or defective encoder, wrong phases, gains, or an outer force",
        "find the cause before anything moves",
    ),
    INCONSISTENT: (
        "reports a position and a velocity that do not agree: {}",
        "a frozen, jumping or slipping encoder, a wrong resolution, or a second device at the same address",
        "check the encoder and its settings",
    ),
    NO_TORQUE: (
        "does not give its torque: {}",
        "supply, phases, a limit of the device's own that is lower than limits.torque",
        "find the cause",
    ),
    UNREFERENCED: (
        "its position is not known: {}",
        "a turn that was lost with the supply, a restart, an encoder that starts at zero, or it was turned",
        "zero it or home it, or look where it stands and confirm it",
    ),
    BEYOND_TRAVEL: (
        "is beyond its end of travel: {}",
        "a torque or a load drove it there, a slipping coupling, or wrong limits",
        "bring it back within its range",
    ),
    ANOTHER_DEVICE: (
        "is another device: {}",
        "adapters or cables that were exchanged, ports that the machine has numbered anew, or a new device",
        "put the wires right, or give the robot file the new serial number",
    ),
}
"""By code: name (with a detail), cause, remedy."""
_NOT_OBEYING = frozenset(_OWN_FAULTS) - {
    *(FEEDBACK_LOST, DISARMED_ITSELF, UNREFERENCED, BEYOND_TRAVEL, ANOTHER_DEVICE)
}
"""With such a fault a device is sent Idle, whatever its stop action."""
MAX_FAULTS = 64
"""Faults that latch, whatever a device reports; our own find room beside them."""

Finding: TypeAlias = tuple[int, str]
"""One of our own codes, and what was found, in numbers."""


class LatchedFaults:
    """What has latched in one joint. State is plain data."""

    def __init__(self, motor: str) -> None:
        self._motor = motor
        self.latched: dict[tuple[int, str], msg.Fault] = {}
        """By code and name, in the order in which they came."""
        self._unreported: list[msg.Fault] = []

    def latch(self, fault: msg.Fault) -> None:
        """Keep a fault until it is cleared."""
        key, most = (fault.code, fault.name), MAX_FAULTS if fault.code > 0 else 2 * MAX_FAULTS
        if key not in self.latched and len(self.latched) < most:
            self.latched[key] = fault
            self._unreported.append(fault)

    def find(self, now: Nanos, code: int, detail: str) -> None:
        """Latch one of our own."""
        name, cause, remedy = _OWN_FAULTS[code]
        motor = self._motor
        self.latch(msg.Fault(motor, now, code, name.format(detail), cause, f"{remedy}, then clear {motor}"))

    def take_unreported(self) -> list[msg.Fault]:
        """Return the faults that have latched since the last call."""
        unreported, self._unreported = self._unreported, []
        return unreported

    def forget(self, code: int) -> None:
        """Clear those of one code: its cause is gone."""
        for key in [key for key in self.latched if key[0] == code]:
            del self.latched[key]

    @property
    def turned_on(self) -> bool:
        """Whether one is that it turned otherwise than commanded, before it was let go."""
        return any(code in (NOT_FOLLOWED, RUNS_AWAY) for code, _ in self.latched)

    @property
    def disobeyed(self) -> bool:
        """Whether one is that it does not do what it is commanded."""
        return any(code in _NOT_OBEYING for code, _ in self.latched)
