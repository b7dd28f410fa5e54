"""CANopen's short messages ↔ CAN frames: NMT, SYNC, heartbeat, EMCY; and the identifiers of all services.

Rules. A message is a frozen value; `encode` makes a frame of it, `decode` takes any frame and returns None
for one that is none of these messages, or malformed. All numbers are little-endian. SDO is in `sdo`, PDO in
`pdo`, the object dictionary in `objects`, statusword and controlword in `profile`. Only the 11-bit
identifiers of the predefined connection set are known here; a PDO may be given any other by its own
configuration.

Source: package canopen 2.4.1 (`nmt.py`, `emcy.py`, `sync.py`, `pdo/__init__.py`); CiA 301 "predefined
connection set".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias, TypeGuard

from protocols.frames import CanFrame, Frame

MAX_NODE = 127
"""Node ids are 1 to 127; 0 is every node in an NMT command."""
NODE_MASK = 0x7F

NMT_ID = 0x000
SYNC_ID = 0x080
EMCY_BASE = 0x080
SDO_TX_BASE = 0x580
"""From the device (server) to the host (client)."""
SDO_RX_BASE = 0x600
"""From the host to the device."""
HEARTBEAT_BASE = 0x700


def tpdo_id(number: int, node: int) -> int:
    """Return the identifier of TPDO 1 to 4, from the device."""
    return 0x80 + 0x100 * number + node


def rpdo_id(number: int, node: int) -> int:
    """Return the identifier of RPDO 1 to 4, to the device."""
    return 0x100 + 0x100 * number + node


def sdo_tx_id(node: int) -> int:
    """Return the identifier of a device's SDO responses."""
    return SDO_TX_BASE + node


def disable(node: int) -> CanFrame:
    """Return the frame that writes a drive's controlword (6040), by SDO: disable voltage."""
    return CanFrame(sdo_rx_id(node), bytes.fromhex("2B40600000000000"))


def sdo_rx_id(node: int) -> int:
    """Return the identifier of SDO requests to a device."""
    return SDO_RX_BASE + node


class NmtCommand(IntEnum):
    """Commands of an NMT master."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


NMT_STATE = "NMT state"
"""The parameter that an NMT command changes."""


class NmtState(IntEnum):
    """NMT states in a heartbeat. INITIALISING is the boot-up message."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


@dataclass(frozen=True, slots=True)
class Nmt:
    """An NMT command to one node, or to all (node 0)."""

    command: NmtCommand
    node: int


@dataclass(frozen=True, slots=True)
class Sync:
    """SYNC: sample and act now. Its counter (object 1019) is neither sent nor used."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A node's NMT state; INITIALISING: its boot-up message."""

    node: int
    state: NmtState


@dataclass(frozen=True, slots=True)
class Emcy:
    """An emergency: error code as in object 603F, error register 1001. The maker's bytes are not used."""

    node: int
    code: int
    register: int


Message: TypeAlias = Nmt | Sync | Heartbeat | Emcy
_EMCY = struct.Struct("<HB5x")
_STATES = {int(state): state for state in NmtState}
_COMMANDS = {int(command): command for command in NmtCommand}


def encode(message: Message) -> CanFrame:
    """Encode a message."""
    match message:
        case Nmt(command, node):
            return CanFrame(NMT_ID, bytes((command, node)))
        case Sync():
            return CanFrame(SYNC_ID, b"")
        case Heartbeat(node, state):
            return CanFrame(HEARTBEAT_BASE + node, bytes((state,)))
        case Emcy(node, code, register):
            return CanFrame(EMCY_BASE + node, _EMCY.pack(code, register))


def is_classic(frame: Frame) -> TypeGuard[CanFrame]:
    """True for the kind of CAN frame that CANopen uses: 11-bit identifier, not FD, no remote frame."""
    return isinstance(frame, CanFrame) and not (frame.extended or frame.fd or frame.remote)


def decode(frame: Frame) -> Message | None:
    """Decode a frame; None if it is none of these messages, or malformed."""
    if not is_classic(frame):
        return None
    data, function, node = frame.data, frame.id & ~NODE_MASK, frame.id & NODE_MASK
    if frame.id == NMT_ID:
        known = len(data) == 2 and data[1] <= MAX_NODE and data[0] in _COMMANDS
        return Nmt(_COMMANDS[data[0]], data[1]) if known else None
    if frame.id == SYNC_ID:
        return Sync() if len(data) <= 1 else None
    if function == HEARTBEAT_BASE and node:
        return Heartbeat(node, _STATES[data[0]]) if len(data) == 1 and data[0] in _STATES else None
    if function == EMCY_BASE and len(data) == 8:
        return Emcy(node, *_EMCY.unpack(data))
    return None
