"""The twin's dictionary as an electronic data sheet (CiA 306), for commissioning tools.

Rules. The text follows from `objects` and a dictionary with default settings, and nothing else: `twin.eds`
beside this is the output of `eds()`, which a test checks. Values that depend on the node id are written as
$NODEID plus an offset.
"""

from __future__ import annotations

from protocols.cia402 import objects as o
from protocols.cia402.dictionary import Dictionary
from protocols.cia402.objects import OBJECTS, Object, Type
from protocols.cia402.options import Settings

VARIABLE, ARRAY, RECORD = 0x7, 0x8, 0x9
MANDATORY = (0x1000, 0x1001, 0x1018)
ARRAYS = frozenset({0x1016, 0x1029, 0x607D, 0x608F, 0x6091, 0x6092, 0x6099})
"""Objects whose subindices have one type; the others with subindices are records."""
RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
NAMES = {
    0x1016: "Consumer heartbeat time",
    0x1018: "Identity object",
    0x1029: "Error behaviour",
    0x607D: "Software position limit",
    0x608F: "Position encoder resolution",
    0x6091: "Gear ratio",
    0x6092: "Feed constant",
    0x6099: "Homing speeds",
    0x60C2: "Interpolation time period",
}
"""Names of objects with subindices."""


def eds(settings: Settings | None = None) -> str:
    """Return the data sheet of a twin with these settings."""
    settings = settings or Settings()
    one, two = Dictionary(settings, 1), Dictionary(settings, 2)
    indices = sorted({index for index, _ in OBJECTS})
    lines = [*_head(settings), "", *_lists(indices)]
    for index in indices:
        subs = [row for row in OBJECTS.values() if row.key[0] == index]
        lines.append("")
        if len(subs) == 1:
            lines += _variable(f"{index:04X}", subs[0], one, two)
            continue
        kind = ARRAY if index in ARRAYS else RECORD
        lines += [f"[{index:04X}]", f"ParameterName={_name(index)}", f"ObjectType={kind:#x}"]
        lines.append(f"SubNumber={len(subs):#x}")
        for row in subs:
            lines += ["", *_variable(f"{index:04X}sub{row.key[1]:X}", row, one, two)]
    return "\n".join(lines) + "\n"


def _head(settings: Settings) -> list[str]:
    rates = [f"BaudRate_{rate}=1" for rate in RATES]
    return [
        "[FileInfo]",
        "FileName=twin.eds",
        "FileVersion=1",
        "FileRevision=1",
        "EDSVersion=4.0",
        "Description=A CiA 402 drive of motor-gateway: the twin",
        "CreatedBy=motor-gateway",
        "",
        "[DeviceInfo]",
        "VendorName=motor-gateway",
        f"VendorNumber={settings.vendor_id:#x}",
        f"ProductName={settings.device_name}",
        f"ProductNumber={settings.product_code:#x}",
        f"RevisionNumber={settings.revision:#x}",
        *rates,
        "SimpleBootUpMaster=0",
        "SimpleBootUpSlave=1",
        "Granularity=8",
        "DynamicChannelsSupported=0",
        "GroupMessaging=0",
        f"NrOfRXPDO={len(o.PDO_NUMBERS)}",
        f"NrOfTXPDO={len(o.PDO_NUMBERS)}",
        "LSS_Supported=0",
        "",
        "[DummyUsage]",
        *[f"Dummy{number:04d}=0" for number in range(1, 8)],
        "",
        "[Comments]",
        "Lines=0",
    ]


def _lists(indices: list[int]) -> list[str]:
    optional = [index for index in indices if index not in MANDATORY]
    lines: list[str] = []
    for title, listed in (("Mandatory", list(MANDATORY)), ("Optional", optional), ("Manufacturer", [])):
        lines += [f"[{title}Objects]", f"SupportedObjects={len(listed)}"]
        lines += [f"{number}={index:#06x}" for number, index in enumerate(listed, 1)]
        lines.append("")
    return lines[:-1]


def _variable(section: str, row: Object, one: Dictionary, two: Dictionary) -> list[str]:
    return [
        f"[{section}]",
        f"ParameterName={row.name}",
        f"ObjectType={VARIABLE:#x}",
        f"DataType={row.type.code:#06x}",
        f"AccessType={row.access}",
        f"DefaultValue={_default(row, one, two)}",
        f"PDOMapping={int(row.mappable)}",
    ]


def _default(row: Object, one: Dictionary, two: Dictionary) -> str:
    if row.type is Type.TEXT:
        return one.texts[row.key]
    value = one.values[row.key]
    if two.values[row.key] - value == 1:  # it grows with the node id
        return f"$NODEID+{value - 1:#x}"
    return str(value) if row.type.signed else f"{value:#x}"


def _is_mapping(index: int) -> bool:
    return any(first <= index < first + 0x200 for first in (o.RPDO_MAPPING, o.TPDO_MAPPING))


def _name(index: int) -> str:
    if index in NAMES:
        return NAMES[index]
    number = index % 0x100 + 1
    receives = index < o.TPDO_COMMUNICATION
    what = "mapping" if _is_mapping(index) else "communication"
    return f"{'Receive' if receives else 'Transmit'} PDO {number} {what} parameter"
