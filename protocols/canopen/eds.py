"""The electronic data sheet of a device (CiA 306), for commissioning tools.

Rules. The text follows from two dictionaries of the device, with node ids 1 and 2, and nothing else: values
that grow with the node id are written as $NODEID plus an offset.
"""

from __future__ import annotations

from collections.abc import Mapping

from protocols.canopen import objects as o
from protocols.canopen.dictionary import Dictionary
from protocols.canopen.objects import Object, Type

VARIABLE, ARRAY, RECORD = 0x7, 0x8, 0x9
MANDATORY = (0x1000, 0x1001, 0x1018)
RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
RECORDS = {
    0x1003: "Pre-defined error field",
    0x1010: "Store parameters",
    0x1011: "Restore default parameters",
    0x1016: "Consumer heartbeat time",
    0x1018: "Identity object",
    0x1029: "Error behaviour",
}
"""Names of communication objects with subindices."""
HEAD = """\
[FileInfo]
FileName={file}.eds
FileVersion=1
FileRevision=1
EDSVersion=4.0
Description={description} of motor-gateway: the twin
CreatedBy=motor-gateway

[DeviceInfo]
VendorName=motor-gateway
VendorNumber={vendor:#x}
ProductName={name}
ProductNumber={product:#x}
RevisionNumber={revision:#x}
{rates}
SimpleBootUpMaster=0
SimpleBootUpSlave=1
Granularity=8
DynamicChannelsSupported=0
GroupMessaging=0
NrOfRXPDO={pdos}
NrOfTXPDO={pdos}
LSS_Supported=0

[DummyUsage]
{dummies}

[Comments]
Lines=0
"""


def data_sheet(
    description: str, file: str, records: Mapping[int, str], one: Dictionary, two: Dictionary
) -> str:
    """Return the data sheet; `records`: names of the device's own objects with subindices."""
    head = HEAD.format(
        file=file,
        description=description,
        vendor=one.values[o.VENDOR_ID],
        name=one.texts[o.DEVICE_NAME],
        product=one.values[o.PRODUCT_CODE],
        revision=one.values[o.REVISION],
        rates="\n".join(f"BaudRate_{rate}=1" for rate in RATES),
        pdos=len(o.PDO_NUMBERS),
        dummies="\n".join(f"Dummy{number:04d}=0" for number in range(1, 8)),
    )
    indices = sorted(one.objects.indices)
    groups = {
        "Mandatory": [index for index in indices if index in MANDATORY],
        "Optional": [index for index in indices if index not in MANDATORY and not 0x2000 <= index < 0x6000],
        "Manufacturer": [index for index in indices if 0x2000 <= index < 0x6000],
    }
    lines = []
    for title, listed in groups.items():
        lines += ["", f"[{title}Objects]", f"SupportedObjects={len(listed)}"]
        lines += [f"{number}={index:#06x}" for number, index in enumerate(listed, 1)]
    for index in indices:
        rows = [row for row in one.objects.values() if row.key[0] == index]
        if len(rows) == 1:
            lines += _variable(f"{index:04X}", rows[0], one, two)
            continue
        uniform = len({row.type for row in rows if row.key[1]}) == 1
        is_array = uniform and index != o.VENDOR_ID[0] and index not in o.PDO_PARAMETERS
        name = (RECORDS | dict(records)).get(index) or _pdo_name(index)
        lines += ["", f"[{index:04X}]", f"ParameterName={name}"]
        lines += [f"ObjectType={ARRAY if is_array else RECORD:#x}", f"SubNumber={len(rows):#x}"]
        for row in rows:
            lines += _variable(f"{index:04X}sub{row.key[1]:X}", row, one, two)
    return head + "\n".join(lines) + "\n"


def _variable(section: str, row: Object, one: Dictionary, two: Dictionary) -> list[str]:
    if row.type is Type.TEXT:
        default = one.texts[row.key]
    elif two.values[row.key] - one.values[row.key] == 1:  # it grows with the node id
        default = f"$NODEID+{one.values[row.key] - 1:#x}"
    else:
        default = f"{one.values[row.key]:{'d' if row.type.signed else '#x'}}"
    return [
        "",
        f"[{section}]",
        f"ParameterName={row.name}",
        f"ObjectType={VARIABLE:#x}",
        f"DataType={row.type.code:#06x}",
        f"AccessType={row.access}",
        f"DefaultValue={default}",
        f"PDOMapping={int(row.mappable)}",
    ]


def _pdo_name(index: int) -> str:
    what = "mapping" if index & o.MAPPING_OFFSET else "communication"
    way = "Receive" if index < o.TPDO_COMMUNICATION else "Transmit"
    return f"{way} PDO {index % 0x100 + 1} {what} parameter"
