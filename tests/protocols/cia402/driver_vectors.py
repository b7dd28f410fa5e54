"""Independent bytes of the driver's messages: made by package canopen 2.4.1, kept in the vectors.

Run as a program, it writes the entries of SOURCE in protocols/cia402/vectors.json anew and leaves the others.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from protocols import cia402
from protocols.canopen import objects as co
from protocols.canopen.mapping import Pdo
from protocols.canopen.objects import Key
from protocols.canopen.pdo import EVENT, encode_entry
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS
from protocols.cia402.options import Options
from protocols.cia402.setpoints import Values
from protocols.cia402.setup import Known
from protocols.frames import CanFrame
from tests.protocols.cia402.stack import PACKAGE, Joined, master

NODE = 2
SOURCE = f"{PACKAGE} (RemoteNode: SdoClient, PdoMap, NmtMaster; LocalNode as its slave)"
FILE = Path(cia402.__file__).parent / "vectors.json"
DOWNLOADS: tuple[tuple[Key, int], ...] = (
    (co.CONSUMER_HEARTBEAT, 0x7F01F4),
    (co.PRODUCER_HEARTBEAT, 100),
    (o.TARGET_POSITION, -123_456),
    (o.VELOCITY_OFFSET, -1000),
    (o.TORQUE_OFFSET, -250),
    (o.HOMING_METHOD, 37),
)
PDO_VALUES: Values = {
    o.CONTROLWORD: 0x0F,
    o.MODE: 8,
    o.TARGET_POSITION: -123_456,
    o.TARGET_VELOCITY: 654_321,
    o.TARGET_TORQUE: -250,
    o.TORQUE_OFFSET: 125,
    o.VELOCITY_OFFSET: -1000,
}


def pdos() -> list[Pdo]:
    """Return the PDOs as the driver writes them with its default options."""
    return Known(Options(), NODE).wanted()


def made() -> list[dict[str, Any]]:
    """Return every entry of SOURCE, in order."""
    entries: list[dict[str, Any]] = []
    for name, meaning, frames in [*_nmt(), *_downloads(), *_configurations(), *_rpdos()]:
        for at, frame in enumerate(frames):
            entries.append(_entry(f"{name}#{at}" if len(frames) > 1 else name, meaning, frame))
    return entries


def _entry(name: str, meaning: dict[str, Any], frame: CanFrame) -> dict[str, Any]:
    return {
        "name": name,
        "direction": "to_device",
        "bus": "can",
        "id": frame.id,
        "extended": False,
        "data": frame.data.hex(),
        "meaning": meaning,
        "source": SOURCE,
    }


def _sent(network: Joined) -> list[CanFrame]:
    sent, network.sent = network.sent, []
    return sent


def _nmt() -> list[tuple[str, dict[str, Any], list[CanFrame]]]:
    network, node = master(NODE)
    node.nmt.send_command(0x81)
    reset = _sent(network)
    local = network.create_node(127, node.object_dictionary)
    _sent(network)
    local.nmt.start_heartbeat(125)
    local.nmt.state = "OPERATIONAL"
    beat = CanFrame(0x77F, network.cyclic[0x77F])
    return [
        ("nmt_reset_node", {"msg": "NMT", "command": 0x81, "node_id": NODE}, reset),
        ("host_heartbeat", {"msg": "heartbeat", "node_id": 127, "nmt_state": 5}, [beat]),
    ]


def _downloads() -> list[tuple[str, dict[str, Any], list[CanFrame]]]:
    network, node = master(NODE)
    rows = []
    for (index, sub), value in DOWNLOADS:
        variable = node.sdo[index][sub] if sub else node.sdo[index]
        variable.raw = value
        meaning = {"msg": "SDO download", "index": index, "sub": sub, "value": value}
        rows.append((f"sdo_write_{index:04X}", meaning, _sent(network)))
    return rows


def saved(pdo: Pdo) -> list[CanFrame]:
    """Return the frames with which `PdoMap.save()` configures this PDO."""
    network, node = master(NODE)
    known = (node.rpdo if pdo.kind == "RPDO" else node.tpdo)[pdo.number]
    known.read()
    known.clear()
    for one in pdo.entries:
        known.add_variable(one.index, one.sub, one.bits)
    known.trans_type, known.enabled = pdo.transmission, True
    timed = pdo.kind == "TPDO" and pdo.transmission >= EVENT
    known.inhibit_time = 10 * pdo.event_ms if timed else None
    known.event_timer = pdo.event_ms if timed else None
    _sent(network)
    known.save()
    return _sent(network)


def _configurations() -> list[tuple[str, dict[str, Any], list[CanFrame]]]:
    return [
        (
            f"configure_{pdo.kind}{pdo.number}",
            {
                "msg": "PDO configuration by PdoMap.save()",
                "entries": [encode_entry(one) for one in pdo.entries],
            },
            saved(pdo),
        )
        for pdo in pdos()
    ]


def _rpdos() -> list[tuple[str, dict[str, Any], list[CanFrame]]]:
    rows = []
    for pdo in [pdo for pdo in pdos() if pdo.kind == "RPDO"]:
        network, node = master(NODE)
        known = node.rpdo[pdo.number]
        known.clear()
        known.cob_id = pdo.id
        for one in pdo.entries:
            known.add_variable(one.index, one.sub, one.bits)
        for variable, key in zip(known.map, pdo.keys, strict=True):
            variable.raw = PDO_VALUES[key]
        known.transmit()
        values = {OBJECTS[key].name: PDO_VALUES[key] for key in pdo.keys}
        rows.append((f"rpdo{pdo.number}_as_mapped", {"msg": f"RPDO{pdo.number}", **values}, _sent(network)))
    return rows


if __name__ == "__main__":
    kept = [entry for entry in json.loads(FILE.read_text("utf-8")) if entry["source"] != SOURCE]
    lines = [json.dumps(entry, ensure_ascii=False) for entry in [*kept, *made()]]
    FILE.write_text("[\n" + ",\n".join(lines) + "\n]\n", "utf-8")
