"""The frames of a host by name, and which of them only read: for every device of CANopen alike.

Rules. Read-only are SDO uploads, their segments, and a client's abort. SYNC is not: it makes every host's
synchronous RPDOs take effect. A host's heartbeat is not, since it feeds watchdogs; NMT is not, in any form.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.canopen import lss, sdo, services
from protocols.canopen.objects import PDO_NUMBERS
from protocols.canopen.services import NODE_MASK, NmtCommand
from protocols.frames import CanFrame, Frame

_NMT = {command: f"NMT {command.name.lower().replace('_', ' ')}" for command in NmtCommand}
_RPDOS = {services.rpdo_id(number, 0): f"RPDO{number}" for number in PDO_NUMBERS}
_SDO = ("SDO download segment", "", "SDO upload", "SDO upload segment", "SDO abort")
"""By the command of the request; that of 1 has the index, too."""
READING = (2, 3, 4)


def _request(frame: Frame) -> bytes:
    """Return the SDO request in a frame; b"" if there is none."""
    if not services.is_classic(frame) or frame.id & ~NODE_MASK != services.SDO_RX_BASE:
        return b""
    return frame.data if len(frame.data) == sdo.SIZE else b""


def read_only(frame: Frame) -> bool:
    """True if a frame only reads."""
    request = _request(frame)
    if lss.is_message(frame):
        return isinstance(frame, CanFrame) and frame.data[0] in lss.ASKS
    return bool(request) and request[0] >> 5 in READING


def messages(frame: Frame) -> Sequence[str]:
    """Return the name of the message to a device in a frame: "NMT start", "SDO download 6040", "RPDO1" …"""
    if request := _request(frame):
        command = request[0] >> 5
        if command == 1:
            kind = "download" if request[0] & 2 else "segmented download"
            return (f"SDO {kind} {int.from_bytes(request[1:3], 'little'):04X}",)
        return _SDO[command : command + 1]
    if isinstance(frame, CanFrame) and lss.is_message(frame):
        return (lss.NAMES[frame.data[0]],) if frame.data[0] in lss.NAMES else ()
    match services.decode(frame):
        case services.Nmt(command, _):
            return (_NMT[command],)
        case services.Sync():
            return ("SYNC",)
        case services.Heartbeat():
            return ("heartbeat",)
    if services.is_classic(frame) and frame.id & NODE_MASK and frame.id & ~NODE_MASK in _RPDOS:
        return (_RPDOS[frame.id & ~NODE_MASK],)
    return ()
