"""Homing: the device's own procedure, begun by bit 4 of the controlword, until its statusword ends it.

Rules. Functions on a `Node` that is armed and holds. The end is believed of a statusword that came after the
beginning. Then the device holds where it is measured anew, for its zero may have moved.

Source: CiA 402-2 "homing mode"; package canopen 2.4.1 `profiles/p402.py` for the bits.
"""

from __future__ import annotations

from protocols.cia402 import objects as o
from protocols.cia402.node import Homing, Node
from protocols.cia402.profile import Control, Demand, PowerState, homing_of
from protocols.cia402.profile import Homing as Outcome
from protocols.cia402.profile import Mode as Operation
from protocols.cia402.setpoint import Values, standstill
from protocols.messages import MILLISECOND, Nanos

HOMED = 3
"""Statuswords after the start of homing before one is believed."""


def begin(node: Node, now: Nanos, token: int, *, zero: bool) -> None:
    """Home, or call the present position zero; the device is armed, and holds."""
    node.homing = Homing(token, now, zero=zero)


def set_points(node: Node, now: Nanos, homing: Homing) -> Values:
    """What it is told meanwhile; bit 4 begins it, once the device shows the mode."""
    control = int(Demand.ENABLE_OPERATION)
    if node.has_mode(Operation.HM):
        if homing.started is None:
            homing.started, homing.seen = now, node.statuses
        control |= Control.START_HOMING
    return standstill(node.position or 0) | {o.CONTROLWORD: control, o.MODE: int(Operation.HM)}


def outcome(node: Node, now: Nanos) -> tuple[bool, str] | None:
    """Whether homing has ended: (well, or not; why). None while it goes on."""
    homing = node.homing
    if homing is None:
        return None
    if node.power is not PowerState.OPERATION_ENABLED:
        return False, "it was disarmed meanwhile"
    if now >= homing.since + node.options.home_timeout_ms * MILLISECOND:
        return False, "it did not end in time"
    if homing.started is None or node.statuses < homing.seen + HOMED or node.status is None:
        return None
    match homing_of(node.status):
        case Outcome.DONE:
            return True, "home is found" if not homing.zero else "the present position is zero"
        case Outcome.ERROR_MOVING | Outcome.ERROR_STOPPED:
            return False, "it reports a homing error (bit 13 of its statusword)"
    return None


def end(node: Node) -> None:
    """Back to holding, where the shaft is measured from now on."""
    node.homing, node.hold, node.position, node.rounds = None, None, None, 0
    node.polls.again(o.POSITION)
