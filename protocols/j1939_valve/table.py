"""The messages of auxiliary valves on SAE J1939 and ISO 11783: flow by command, flow and position as
reported.

Rules. An id of 29 bits is priority, PGN and the sender's address. Commands are for every valve with that
number, by their PGN; who sends them must have claimed its address. A flow is a share of the valve's full
flow, in steps of 0.4 %, a reported one in whole per cent; what is not available is all ones.

Source: ISO 11783-7 by isobus.net (PGN 65072 and 65040, SPN 1907 to 1909, 1985, 1915), ISO 11783-5 and SAE
J1939-81 (PGN 60928), DanielMartensson/Open-SAE-J1939 (bytes; PGN 65312, the position, is not in the
standard).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from protocols.frames import exact
from protocols.plugin import FaultInfo
from protocols.toolkit.table import Row, Table, const, uint, unused

VALVES = range(16)
NODES = range(254)
"""Addresses that a controller can have"""
BLOCK, EXTEND, RETRACT, FLOAT = range(4)
ERROR = 14
"""States of a valve (SPN 1908, 1915)"""
FLOW, PERCENT, OFFSET = 0.004, 0.01, -1.25
"""Of a count: of a command, of a reported flow, which begins at −125 %"""
STROKE = 0.001
"""Of a count of the position, as a share of the stroke"""
MOST = 250
"""Counts of the full flow"""
MOST_POSITION = 0xFAFF
"""Counts of the position; what is above says that there is none"""
FAIL_SAFE_BLOCK = 0
GLOBAL = 0xFF


def _pgn(number: int, bits: int = 12) -> tuple[int, int]:
    """Return priority 3 and the beginning of a PGN, and their bits."""
    return 0x0C << bits | number, 5 + bits


_STATE = uint("state", 4), unused(2, 3), uint("fail_safe", 2)
ROWS = (
    Row(
        "command",
        (const(*_pgn(0xFE3)), uint("address", 4), uint("host")),
        (uint("flow"), unused(8, 0xFF), *_STATE, *(unused(8, 0xFF),) * 5),
    ),
    Row(
        "estimated flow",
        (const(*_pgn(0xFE1)), uint("address", 4), uint("ecu")),
        (uint("extend"), uint("retract"), *_STATE, unused(5), uint("limit", 3), *(unused(8, 0xFF),) * 4),
        "from_device",
    ),
    Row(
        "measured position",
        (const(*_pgn(0xFF2)), uint("address", 4), uint("ecu")),
        (uint("position", 16), uint("state", 4), unused(4, 15), *(unused(8, 0xFF),) * 5),
        "from_device",
    ),
    Row("address claimed", (const(0x18 << 16 | 0xEEFF, 21), uint("host")), (uint("name", 64),)),
    Row(
        "address claimed by another",
        (const(0x18 << 16 | 0xEEFF, 21), uint("ecu")),
        (uint("name", 64),),
        "from_device",
    ),
)
TABLE = Table(replace(row, extended=True) for row in ROWS)


def command_id(valve: int, host: int) -> tuple[int, int]:
    """Return the id by which a valve is commanded."""
    return exact(0x0CFE3000 | valve << 8 | host, extended=True)


def report_ids(valve: int, ecu: int) -> tuple[tuple[int, int], ...]:
    """Return the ids by which a valve reports."""
    return tuple(exact(pgn << 12 | valve << 8 | ecu, extended=True) for pgn in (0x0CFE1, 0x0CFF2))


def claim_id(node: int) -> tuple[int, int]:
    """Return the id by which a controller claims its address."""
    return exact(0x18EEFF00 | node, extended=True)


VALVE_ERROR, ADDRESS_LOST = 1, 2
FAULTS: Mapping[int, FaultInfo] = {
    VALVE_ERROR: FaultInfo(
        "the valve reports an error",
        "its spool sticks, its solenoid is open or shorted, or its supply is too low",
        "look at its controller's diagnosis; free the spool",
        latching=False,
    ),
}
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **FAULTS,
    ADDRESS_LOST: FaultInfo(
        "our address is another's",
        "a controller whose NAME is lower has claimed the address that the robot file gives this host",
        "host under options: a free address",
    ),
}
"""With those that the driver finds"""
