"""CiA 402's power state machine: what a drive does with a controlword, and which controlword the host sends
next.

Rules. Pure functions; `TRANSITIONS` is the table of the controlword. What takes time (slowing down) or
happens by itself (faults) is not in it. ENABLE OPERATION in READY TO SWITCH ON goes through SWITCHED ON at
once, as CiA 402 allows. Leaving OPERATION ENABLED by SHUTDOWN or DISABLE OPERATION may slow down first (605B,
605C); the table has the final state.

The host waits for the statusword after each step. It never clears a fault here. A quick stop that holds is
left by ENABLE OPERATION, so that a load does not drop; any other by DISABLE VOLTAGE.

Source: CiA 402-2 "finite state automaton", transitions 2 to 16; package canopen 2.4.1 `profiles/p402.py`
`TRANSITIONTABLE`.
"""

from __future__ import annotations

from protocols.cia402.profile import Control, Demand, PowerState

HOLDING_QUICK_STOPS = (5, 6, 7)
"""Option codes 605A with which a drive stays in QUICK STOP ACTIVE, and holds."""

_SOD = PowerState.SWITCH_ON_DISABLED
_READY = PowerState.READY
_ON = PowerState.SWITCHED_ON
_ENABLED = PowerState.OPERATION_ENABLED
_QUICK = PowerState.QUICK_STOP
_FAULT = PowerState.FAULT

TRANSITIONS: dict[tuple[PowerState, Demand], PowerState] = {
    (_SOD, Demand.SHUTDOWN): _READY,  # 2
    (_READY, Demand.SWITCH_ON): _ON,  # 3
    (_READY, Demand.ENABLE_OPERATION): _ENABLED,  # 3 and 4
    (_READY, Demand.DISABLE_VOLTAGE): _SOD,  # 7
    (_READY, Demand.QUICK_STOP): _SOD,  # 7
    (_ON, Demand.ENABLE_OPERATION): _ENABLED,  # 4
    (_ON, Demand.SHUTDOWN): _READY,  # 6
    (_ON, Demand.DISABLE_VOLTAGE): _SOD,  # 10
    (_ON, Demand.QUICK_STOP): _SOD,  # 10
    (_ENABLED, Demand.SWITCH_ON): _ON,  # 5
    (_ENABLED, Demand.SHUTDOWN): _READY,  # 8
    (_ENABLED, Demand.DISABLE_VOLTAGE): _SOD,  # 9
    (_ENABLED, Demand.QUICK_STOP): _QUICK,  # 11
    (_QUICK, Demand.DISABLE_VOLTAGE): _SOD,  # 12
    (_FAULT, Demand.FAULT_RESET): _SOD,  # 15
}


def next_state(state: PowerState, demand: Demand | None, quick_stop_option: int) -> PowerState:
    """Return the state of a drive after a demand; the same if the state does not obey it."""
    if demand is None:
        return state
    if (state, demand) == (_QUICK, Demand.ENABLE_OPERATION):  # 16
        return _ENABLED if quick_stop_option in HOLDING_QUICK_STOPS else state
    return TRANSITIONS.get((state, demand), state)


def arming_demand(state: PowerState, quick_stop_option: int, *, prepared: bool) -> Demand | None:
    """Return the demand towards OPERATION ENABLED; None if the host can only wait.

    `prepared`: mode and set-points are in the drive, and do not move the shaft."""
    match state:
        case PowerState.SWITCH_ON_DISABLED:
            return Demand.SHUTDOWN
        case PowerState.READY:
            return Demand.SWITCH_ON
        case PowerState.SWITCHED_ON:
            return Demand.ENABLE_OPERATION if prepared else Demand.SWITCH_ON
        case PowerState.OPERATION_ENABLED:
            return Demand.ENABLE_OPERATION
        case PowerState.QUICK_STOP if quick_stop_option in HOLDING_QUICK_STOPS:
            return Demand.ENABLE_OPERATION if prepared else Demand.QUICK_STOP
        case PowerState.QUICK_STOP:
            return Demand.DISABLE_VOLTAGE
    return None


def pp_handshake(
    acknowledged: bool, new_setpoint: bool, target: int, given: int | None
) -> tuple[int, int, bool]:
    """Return the next step of PP's set-point handshake: (controlword, target position, new set-point bit).

    `new_setpoint`: the bit as it was sent last, `given`: with which target. The bit rises while the drive
    shows no acknowledgement, stays until it does, and falls until the acknowledgement is gone; meanwhile the
    target stays. The newest target wins."""
    if new_setpoint:
        new_setpoint = not acknowledged
    elif not acknowledged and target != given:
        new_setpoint, given = True, target
    control = Demand.ENABLE_OPERATION | Control.CHANGE_IMMEDIATELY
    control |= Control.NEW_SETPOINT if new_setpoint else 0
    return int(control), target if given is None else given, new_setpoint
