"""The state machine of CiA 402 from our side: what controlword comes next, on the way up and on the way down.

Rules. Pure functions. Each step waits for the statusword that answers the one before. Nothing here clears a
fault. A quick stop that holds is left by ENABLE OPERATION, so that a load does not drop; any other by
DISABLE VOLTAGE.

Source: CiA 402-2 "finite state automaton"; package canopen 2.4.1 `profiles/p402.py`.
"""

from __future__ import annotations

from protocols.cia402.profile import Control, Demand, PowerState
from protocols.cia402.state_machine import HOLDING_QUICK_STOPS

UP: dict[PowerState, Demand] = {
    PowerState.SWITCH_ON_DISABLED: Demand.SHUTDOWN,
    PowerState.READY: Demand.SWITCH_ON,
    PowerState.SWITCHED_ON: Demand.ENABLE_OPERATION,
    PowerState.OPERATION_ENABLED: Demand.ENABLE_OPERATION,
}


def upward(power: PowerState, quick_stop_option: int, *, placed: bool) -> Demand | None:
    """What leads towards OPERATION ENABLED; None where only waiting helps, or an operator.

    `placed`: mode and set-points stand, and do not move the shaft."""
    if power is PowerState.QUICK_STOP:
        holds = quick_stop_option in HOLDING_QUICK_STOPS
        held = Demand.ENABLE_OPERATION if placed else Demand.QUICK_STOP
        return held if holds else Demand.DISABLE_VOLTAGE
    demand = UP.get(power)
    waiting = demand is Demand.ENABLE_OPERATION and power is PowerState.SWITCHED_ON and not placed
    return Demand.SWITCH_ON if waiting else demand


def downward(*, late: bool) -> Demand:
    """What disarms. `late`: it was told for a while, and did not help: then without any ramp."""
    return Demand.DISABLE_VOLTAGE if late else Demand.SHUTDOWN


def handshake(acknowledged: bool, handing: bool, target: int, given: int | None) -> tuple[int, int, bool]:
    """The set-point handshake of PP: (controlword, target position, whether the new set-point bit is set).

    The bit rises while the drive shows no acknowledgement, stays until it does, and falls until that has
    gone; meanwhile the target stays. The newest target wins."""
    if handing:
        handing = not acknowledged
    elif not acknowledged and target != given:
        handing, given = True, target
    word = Demand.ENABLE_OPERATION | Control.CHANGE_IMMEDIATELY
    word |= Control.NEW_SETPOINT if handing else 0
    return int(word), target if given is None else given, handing
