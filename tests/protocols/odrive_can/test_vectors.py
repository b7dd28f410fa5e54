"""Vectors are what their sources say: cantools encodes each anew from its meaning, with the vendor's DBC.

(Those of the vendor's client are regenerated in `test_codec`; discovery and what the DBCs have wrong is from
source code, which no package runs.)
"""

from __future__ import annotations

import re
import struct
from typing import Any

import pytest

from protocols.frames import CanFrame
from protocols.odrive_can import plugin
from protocols.odrive_can.table import COMMON, LINE05, LINE06, table_of
from protocols.reference_vectors import Vector, vectors_of
from protocols.toolkit.table import Row
from tests.protocols.odrive_can.dbc import DBCS

VECTORS = vectors_of(plugin)
SOURCE = re.compile(
    r"cantools 45\.1\.0 encode with odrive-cansimple-([\d.]+)\.dbc shipped in odrive-can 2\.1\.0"
)
OF_CANTOOLS = [vector for vector in VECTORS if SOURCE.fullmatch(vector.source)]
SIGNALS = {
    "protocol": "Protocol_Version",
    "hw_line": "Hw_Version_Major",
    "hw_version": "Hw_Version_Minor",
    "hw_variant": "Hw_Version_Variant",
    "fw_major": "Fw_Version_Major",
    "fw_minor": "Fw_Version_Minor",
    "fw_revision": "Fw_Version_Revision",
    "fw_unreleased": "Fw_Version_Unreleased",
    "trajectory_done": "Trajectory_Done_Flag",
    "endpoint_id": "Endpoint_ID",
    "position_turns": "Sensorless_Pos_Estimate",
    "velocity_turns_s": "Sensorless_Vel_Estimate",
    "voltage_v": "ADC_Voltage",
}
"""Names of ours whose signal is not the same name in capitals."""


def signals_of(vector: Vector) -> dict[str, Any]:
    """The values of the DBC's signals that a vector means; what it does not name is 0."""
    meaning = vector.meaning
    if "decoded_by_cantools" in meaning:
        return dict(meaning["decoded_by_cantools"])
    if "value_f32" in meaning:
        return {
            "Endpoint_ID": meaning["endpoint_id"],
            "Value": struct.unpack("<I", struct.pack("<f", meaning["value_f32"]))[0],
        }
    return {
        SIGNALS.get(name, name.title()): value
        for name, value in meaning.items()
        if name not in ("msg", "node_id")
    }


@pytest.mark.parametrize("vector", OF_CANTOOLS, ids=lambda vector: str(vector.name))
def test_cantools_encodes_it_anew(vector: Vector) -> None:
    source = SOURCE.fullmatch(vector.source)
    assert source is not None
    node, name = vector.meaning["node_id"], vector.meaning["msg"]
    message = DBCS[source[1][:3]].get_message_by_name(f"Axis{node}_{name}")
    values = signals_of(vector)
    known = {signal.name for signal in message.signals}
    assert set(values) <= known
    data = message.encode(dict.fromkeys(known, 0) | values, scaling=True, strict=True)
    assert CanFrame(message.frame_id, data, bool(message.is_extended_frame)) == vector.frame


def test_every_vector_names_a_source_and_most_are_regenerated() -> None:
    client = [vector for vector in VECTORS if vector.source.startswith("odrive-can 2.1.0 ODriveCAN")]
    by_hand = [vector for vector in VECTORS if re.match(r"odriverobotics/\w+@[0-9a-f]{7} ", vector.source)]
    assert len(OF_CANTOOLS) + len(client) + len(by_hand) == len(VECTORS)
    assert len(by_hand) == 5
    assert all("by hand" in vector.source or "get_address_msg" in vector.source for vector in by_hand)


@pytest.mark.parametrize(("line", "rows"), [("0.5", LINE05), ("0.6", (*COMMON, *LINE06))])
def test_every_message_has_a_vector(line: str, rows: tuple[Row, ...]) -> None:
    wanted = {
        (row.name, row.direction)
        for row in rows
        if row.name not in (("Get_Version",) if line == "0.5" else ("RxSdo read",))
    }
    table = table_of(line)
    covered = set()
    for vector in VECTORS:
        if str(vector.entry.get("fw", "0.6.10")).startswith(line):
            decoded = table.decode(vector.frame, vector.direction)
            covered |= {(decoded.name, vector.direction)} if decoded else set()
    assert wanted <= covered
