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

S, D = PowerState, Demand
TRANSITIONS: dict[tuple[PowerState, Demand], PowerState] = {
    (S.SWITCH_ON_DISABLED, D.SHUTDOWN): S.READY,  # 2
    (S.READY, D.SWITCH_ON): S.SWITCHED_ON,  # 3
    (S.READY, D.ENABLE_OPERATION): S.OPERATION_ENABLED,  # 3 and 4
    (S.READY, D.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 7
    (S.READY, D.QUICK_STOP): S.SWITCH_ON_DISABLED,  # 7
    (S.SWITCHED_ON, D.ENABLE_OPERATION): S.OPERATION_ENABLED,  # 4
    (S.SWITCHED_ON, D.SHUTDOWN): S.READY,  # 6
    (S.SWITCHED_ON, D.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 10
    (S.SWITCHED_ON, D.QUICK_STOP): S.SWITCH_ON_DISABLED,  # 10
    (S.OPERATION_ENABLED, D.SWITCH_ON): S.SWITCHED_ON,  # 5
    (S.OPERATION_ENABLED, D.SHUTDOWN): S.READY,  # 8
    (S.OPERATION_ENABLED, D.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 9
    (S.OPERATION_ENABLED, D.QUICK_STOP): S.QUICK_STOP,  # 11
    (S.QUICK_STOP, D.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 12
    (S.FAULT, D.FAULT_RESET): S.SWITCH_ON_DISABLED,  # 15
}
del S, D


def next_state(state: PowerState, demand: Demand | None, quick_stop_option: int) -> PowerState:
    """Return the state of a drive after a demand; the same if the state does not obey it."""
    if demand is None:
        return state
    if (state, demand) == (PowerState.QUICK_STOP, Demand.ENABLE_OPERATION):  # 16
        return PowerState.OPERATION_ENABLED if quick_stop_option in HOLDING_QUICK_STOPS else state
    return TRANSITIONS.get((state, demand), state)
