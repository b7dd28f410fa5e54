"""CiA 402's power state machine: what a drive does with a controlword.

Rules. Pure functions; `TRANSITIONS` is the table of the controlword. What takes time (slowing down) or
happens by itself (faults) is not in it. ENABLE OPERATION in READY TO SWITCH ON goes through SWITCHED ON at
once, as CiA 402 allows. Leaving OPERATION ENABLED by SHUTDOWN or DISABLE OPERATION may slow down first (605B,
605C); the table has the final state.

Source: CiA 402-2 "finite state automaton", transitions 2 to 16; package canopen 2.4.1 `profiles/p402.py`
`TRANSITIONTABLE`.
"""

from __future__ import annotations

from protocols.cia402.profile import Demand, PowerState

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
