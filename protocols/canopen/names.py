"""The frames of a host by name, and which of them only read: for every device of CANopen alike.

Rules. Read-only are SDO uploads, their segments, and a client's abort. SYNC is not: it makes every host's
synchronous RPDOs take effect. A host's heartbeat is not, since it feeds watchdogs; NMT is not, in any form.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.canopen import sdo, services
from protocols.canopen.objects import PDO_NUMBERS
from protocols.canopen.services import NODE_MASK, NmtCommand
from protocols.frames import CanFrame, Frame

_NMT = {command: f"NMT {command.name.lower().replace('_', ' ')}" for command in NmtCommand}
_RPDOS = {services.rpdo_id(number, 0): f"RPDO{number}" for number in PDO_NUMBERS}
_SDO = {
    sdo.DownloadSegment: "SDO download segment",
    sdo.Upload: "SDO upload",
    sdo.UploadSegment: "SDO upload segment",
    sdo.Abort: "SDO abort",
}


def request_in(frame: Frame) -> sdo.Request | None:
    """Return the SDO request in a frame."""
    if not isinstance(frame, CanFrame) or not services.is_classic(frame):
        return None
    return sdo.decode_request(frame.data) if frame.id & ~NODE_MASK == services.SDO_RX_BASE else None


def read_only(frame: Frame) -> bool:
    """True if a frame only reads."""
    return isinstance(request_in(frame), sdo.Upload | sdo.UploadSegment | sdo.Abort)


def messages(frame: Frame) -> Sequence[str]:
    """Return the name of the message to a device in a frame: "NMT start", "SDO download 6040", "RPDO1" …"""
    request = request_in(frame)
    match request or services.decode(frame):
        case sdo.Download(index, _, _):
            return (f"SDO download {index:04X}",)
        case sdo.DownloadStart(index, _, _):
            return (f"SDO segmented download {index:04X}",)
        case services.Nmt(command, _):
            return (_NMT[command],)
        case services.Sync():
            return ("SYNC",)
        case services.Heartbeat():
            return ("heartbeat",)
    if isinstance(frame, CanFrame) and services.is_classic(frame) and frame.id & NODE_MASK:
        rpdo = _RPDOS.get(frame.id & ~NODE_MASK)
        return (rpdo,) if rpdo else (_SDO[type(request)],) if type(request) in _SDO else ()
    return ()
