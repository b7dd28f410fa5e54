"""What `gateway bench` measures of this language, and how package canopen does the same.

Rules. Data and calls only: nothing here is used by the robot. Everybody starts from plain values, or from a
frame, and ends with what its user would have: ours a whole frame or values, canopen the data of a `PdoMap`
with its variables set or read by `.raw`, or an SDO transfer by `.raw`, whose answer is there at once.
Bare `struct` knows its message beforehand, checks nothing and makes no frame: it is the floor.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from protocols.cia402 import objects as o
from protocols.cia402 import sdo
from protocols.cia402.codec import rpdo_id, sdo_rx_id, sdo_tx_id, tpdo_id
from protocols.cia402.objects import OBJECTS, Key, from_bytes, to_bytes
from protocols.cia402.pdo import mapping, packing
from protocols.cia402.transfer import Transfer
from protocols.frames import CanFrame

RIVAL = ("canopen", "canopen", "canopen's PdoMap and SDO client")
NODE = 3
RPDO = (o.CONTROLWORD, o.MODE, o.TARGET_POSITION)
TPDO = (o.STATUSWORD, o.MODE_DISPLAY, o.POSITION)
COMMAND, STATE = (0x0F, 8, -123_456), (0x0637, 8, 654_321)


@dataclass(frozen=True, slots=True)
class Known:
    """What canopen needs, made once."""

    rpdo: Any
    tpdo: Any
    sdo: Any
    """Its SDO client; each request is answered at once."""
    sent: list[bytes]
    """The last request."""


def prepared(canopen: Any) -> Known:  # noqa: ANN401 -- canopen has no types
    """A remote node with a small dictionary and two mapped PDOs, on a network without a bus."""
    dictionary = canopen.ObjectDictionary()
    for key in (*RPDO, *TPDO, o.TARGET_VELOCITY):
        dictionary.add_object(_variable(canopen, key))
    for index in (o.RPDO_COMMUNICATION, o.RPDO_MAPPING, o.TPDO_COMMUNICATION, o.TPDO_MAPPING):
        dictionary.add_object(canopen.objectdictionary.ODRecord(f"{index:04X}", index))
    network, node, sent = canopen.Network(), canopen.RemoteNode(NODE, dictionary), [b""]
    network.add_node(node)

    def answer(_: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG001 -- canopen's signature
        sent[0] = bytes(data)
        said = _UPLOADED if data[0] == 0x40 else _DOWNLOADED
        node.sdo.on_response(said.id, said.data, 0.0)

    network.send_message = answer
    maps = []
    for side, keys, cob in ((node.rpdo, RPDO, rpdo_id(1, NODE)), (node.tpdo, TPDO, tpdo_id(1, NODE))):
        known = side[1]
        known.clear()
        known.cob_id = cob
        for index, _ in keys:
            known.add_variable(index)
        maps.append(known)
    return Known(maps[0], maps[1], node.sdo, sent)


def _variable(canopen: Any, key: Key) -> Any:  # noqa: ANN401 -- canopen has no types
    made = canopen.objectdictionary.ODVariable(OBJECTS[key].name, *key)
    made.data_type, made.access_type = OBJECTS[key].type.value[0], "rw"
    return made


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], object]
    struct: Callable[[], object]
    other: Callable[[Known], Callable[[], object]]
    encodes: bool

    def theirs(self, known: Known) -> Callable[[], object]:
        """What canopen does for it."""
        return self.other(known)

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or values
        """Encoding gives the same bytes, decoding the same values in order."""
        if self.encodes:
            return bool(bytes(theirs) == struct == ours.data)
        return tuple(ours)[-len(struct) :] == tuple(theirs) == tuple(struct)


_PDO = struct.Struct("<Hbi")
_SDO = struct.Struct("<BHBi")
_RPDO, _TPDO = packing(mapping(*RPDO)), packing(mapping(*TPDO))
_REPORTED = CanFrame(tpdo_id(1, NODE), _PDO.pack(*STATE))
_UPLOADED = CanFrame(sdo_tx_id(NODE), _SDO.pack(0x43, *o.POSITION, -123_456))
_DOWNLOADED = CanFrame(sdo_tx_id(NODE), _SDO.pack(0x60, *o.TARGET_VELOCITY, 0))


def _set(known: Known) -> Callable[[], object]:
    variables = list(zip(known.rpdo.map, COMMAND, strict=True))

    def call() -> object:
        for variable, value in variables:
            variable.raw = value
        return known.rpdo.data

    return call


def _read(known: Known) -> Callable[[], object]:
    def call() -> object:
        known.tpdo.on_message(_REPORTED.id, _REPORTED.data, 0.0)
        return [variable.raw for variable in known.tpdo.map]

    return call


def _download(known: Known) -> Callable[[], object]:
    variable = known.sdo[o.TARGET_VELOCITY[0]]

    def call() -> object:
        variable.raw = -1000
        return known.sent[0]

    return call


def _upload(known: Known) -> Callable[[], object]:
    variable = known.sdo[o.POSITION[0]]
    return lambda: (variable.raw,)


def _our_download() -> CanFrame:
    transfer = Transfer(*o.TARGET_VELOCITY, to_bytes(OBJECTS[o.TARGET_VELOCITY].type, -1000))
    frame = CanFrame(sdo_rx_id(NODE), sdo.encode(transfer.first()))
    _handle(transfer, _DOWNLOADED)
    return frame


def _our_upload() -> tuple[CanFrame, int | None]:
    transfer = Transfer(*o.POSITION)
    frame = CanFrame(sdo_rx_id(NODE), sdo.encode(transfer.first()))
    _handle(transfer, _UPLOADED)
    return frame, from_bytes(OBJECTS[o.POSITION].type, transfer.value)


def _handle(transfer: Transfer, frame: CanFrame) -> None:
    answer = sdo.decode_response(frame.data)
    if answer is None or transfer.handle(answer) is not None or not transfer.done:
        raise ValueError(f"{frame} does not end the transfer")


def _bare_download() -> bytes:
    data = _SDO.pack(0x23, *o.TARGET_VELOCITY, -1000)
    _SDO.unpack(_DOWNLOADED.data)
    return data


def _bare_upload() -> tuple[int, ...]:
    _SDO.pack(0x40, *o.POSITION, 0)
    return _SDO.unpack(_UPLOADED.data)[3:]


SAMPLES = (
    Sample(
        "encode RPDO: controlword, mode, target position",
        lambda: CanFrame(rpdo_id(1, NODE), _RPDO.pack(COMMAND)),
        lambda: _PDO.pack(*COMMAND),
        _set,
        encodes=True,
    ),
    Sample(
        "decode TPDO: statusword, mode, position",
        lambda: _TPDO.unpack(_REPORTED.data) or (),
        lambda: _PDO.unpack(_REPORTED.data),
        _read,
        encodes=False,
    ),
    Sample(
        "SDO download of 60FF: request and answer", _our_download, _bare_download, _download, encodes=True
    ),
    Sample("SDO upload of 6064: request and answer", _our_upload, _bare_upload, _upload, encodes=False),
)
