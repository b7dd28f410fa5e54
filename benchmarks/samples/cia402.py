"""Benchmark samples of cia402, measured beside package canopen.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame, and ends with what its user needs: our codec with a whole frame or values, canopen with the data of a
`PdoMap` whose variables are set or read by `.raw`, or an SDO transfer by `.raw`, answered at once. Bare
`struct` knows its message beforehand, checks nothing and makes no frame: it is the lower bound.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from protocols.canopen import objects as co
from protocols.canopen import sdo
from protocols.canopen.client import Job, Outcome, Purpose, SdoClient
from protocols.canopen.objects import Key, from_bytes, to_bytes
from protocols.canopen.pdo import mapping, packing
from protocols.canopen.services import rpdo_id, sdo_rx_id, sdo_tx_id, tpdo_id
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS
from protocols.frames import CanFrame
from protocols.messages import SECOND

RIVAL = ("canopen", "canopen", "canopen's PdoMap and SDO client")
NODE = 3
RPDO = (o.CONTROLWORD, o.MODE, o.TARGET_POSITION)
TPDO = (o.STATUSWORD, o.MODE_DISPLAY, o.POSITION)
COMMAND, STATE = (0x0F, 8, -123_456), (0x0637, 8, 654_321)


@dataclass(frozen=True, slots=True)
class Prepared:
    """The objects that canopen's calls need."""

    rpdo: Any
    tpdo: Any
    sdo: Any
    """SDO client; each request is answered at once."""
    sent: list[bytes]
    """The last request."""


def prepared(canopen: Any) -> Prepared:  # noqa: ANN401 -- canopen has no types
    """Return a remote node with a small dictionary and two mapped PDOs, on a network without a bus."""
    dictionary = canopen.ObjectDictionary()
    for key in (*RPDO, *TPDO, o.TARGET_VELOCITY):
        dictionary.add_object(_variable(canopen, key))
    for index in (co.RPDO_COMMUNICATION, co.RPDO_MAPPING, co.TPDO_COMMUNICATION, co.TPDO_MAPPING):
        dictionary.add_object(canopen.objectdictionary.ODRecord(f"{index:04X}", index))
    network, node, sent = canopen.Network(), canopen.RemoteNode(NODE, dictionary), [b""]
    network.add_node(node)

    def answer(_: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG001 -- canopen's signature
        sent[0] = bytes(data)
        response = _UPLOADED if data[0] == 0x40 else _DOWNLOADED
        node.sdo.on_response(response.id, response.data, 0.0)

    network.send_message = answer
    maps = []
    for side, keys, cob in ((node.rpdo, RPDO, rpdo_id(1, NODE)), (node.tpdo, TPDO, tpdo_id(1, NODE))):
        known = side[1]
        known.clear()
        known.cob_id = cob
        for index, _ in keys:
            known.add_variable(index)
        maps.append(known)
    return Prepared(maps[0], maps[1], node.sdo, sent)


def _variable(canopen: Any, key: Key) -> Any:  # noqa: ANN401 -- canopen has no types
    made = canopen.objectdictionary.ODVariable(OBJECTS[key].name, *key)
    made.data_type, made.access_type = OBJECTS[key].type.code, "rw"
    return made


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], object]
    struct: Callable[[], object]
    other: Callable[[Prepared], Callable[[], object]]
    encodes: bool

    def theirs(self, known: Prepared) -> Callable[[], object]:
        """Return the same operation in canopen."""
        return self.other(known)

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or values
        """True if encoding gave the same bytes, or decoding the same values in order."""
        if self.encodes:
            return bool(bytes(theirs) == struct == ours.data)
        return tuple(ours)[-len(struct) :] == tuple(theirs) == tuple(struct)


_PDO = struct.Struct("<Hbi")
_SDO = struct.Struct("<BHBi")
_RPDO, _TPDO = (packing(OBJECTS, mapping(OBJECTS, *keys)) for keys in (RPDO, TPDO))
_REPORTED = CanFrame(tpdo_id(1, NODE), _PDO.pack(*STATE))
_UPLOADED = CanFrame(sdo_tx_id(NODE), _SDO.pack(0x43, *o.POSITION, -123_456))
_DOWNLOADED = CanFrame(sdo_tx_id(NODE), _SDO.pack(0x60, *o.TARGET_VELOCITY, 0))


def _set(known: Prepared) -> Callable[[], object]:
    variables = list(zip(known.rpdo.map, COMMAND, strict=True))

    def call() -> object:
        for variable, value in variables:
            variable.raw = value
        return known.rpdo.data

    return call


def _read(known: Prepared) -> Callable[[], object]:
    def call() -> object:
        known.tpdo.on_message(_REPORTED.id, _REPORTED.data, 0.0)
        return [variable.raw for variable in known.tpdo.map]

    return call


def _download(known: Prepared) -> Callable[[], object]:
    variable = known.sdo[o.TARGET_VELOCITY[0]]

    def call() -> object:
        variable.raw = -1000
        return known.sent[0]

    return call


def _upload(known: Prepared) -> Callable[[], object]:
    variable = known.sdo[o.POSITION[0]]
    return lambda: (variable.raw,)


def _our_download() -> CanFrame:
    data = to_bytes(OBJECTS[o.TARGET_VELOCITY].type, -1000)
    return _ours(Job(Purpose.SETPOINT, o.TARGET_VELOCITY, data), _DOWNLOADED)[0]


def _our_upload() -> tuple[CanFrame, int | None]:
    frame, outcome = _ours(Job(Purpose.POLL, o.POSITION), _UPLOADED)
    return frame, from_bytes(OBJECTS[o.POSITION].type, outcome.value)


def _ours(job: Job, frame: CanFrame) -> tuple[CanFrame, Outcome]:
    """Return the request of a job, and its end by this response."""
    client = SdoClient(SECOND)
    client.put(job)
    request, _ = client.poll(0)
    response = sdo.decode_response(frame.data)
    outcome = None if response is None else client.handle(0, response)
    if request is None or outcome is None:
        raise ValueError(f"{frame} does not end the transfer")
    return CanFrame(sdo_rx_id(NODE), sdo.encode(request)), outcome


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
