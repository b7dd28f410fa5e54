"""The notation of CiA 402's transcripts: frames by what stands in them, their bytes made by package canopen.

`N` is a node id. Objects are written as `6040` or `608F:01`, values as decimal or 0x… numbers, `*` for any.

    N:read 6041          N:value 6041=0x0250      SDO upload, and its response
    N:write 6040=6       N:wrote 6040             SDO download, and its response; without a value: of any
    N:abort 6041 0x06010002   N:refuse 6041 …     SDO abort of a host, of a device
    N:rpdo1 6040=15 607A=-4096    N:tpdo1 …       PDOs, values in the order in which they lie in the frame
    N:beat operational   N:boot   N:emcy 0x2310   heartbeat, boot-up, emergency (with error register 1)
    nmt operational N    sync                     stopped, pre-operational, reset, reset-communication
"""

from __future__ import annotations

from functools import cache
from typing import Any

from canopen.nmt import NMT_COMMANDS, NMT_STATES
from canopen.objectdictionary import ODVariable

from tests.protocols.cia402.stack import dictionary

SIZED = {1: "2F", 2: "2B", 3: "27", 4: "23"}
"""Expedited downloads by their length; responses of uploads are 0x20 more."""
PDOS = {
    f"{kind}pdo{n}": first + 0x100 * n for n in range(1, 5) for kind, first in (("t", 0x80), ("r", 0x100))
}
BEATS = {name.lower(): number for number, name in NMT_STATES.items()}
NMT = {name.lower().replace(" ", "-"): number for name, number in NMT_COMMANDS.items()}


@cache
def _dictionary() -> Any:
    return dictionary(1)


def variable(index: int, sub: int) -> Any:
    """Return an object of canopen's dictionary."""
    known = _dictionary().indices[index]
    return known if isinstance(known, ODVariable) else known[sub]


def address(text: str) -> tuple[int, int]:
    """Return (index, subindex) of `608F:01`."""
    index, _, sub = text.partition(":")
    return int(index, 16), int(sub or "0", 16)


def value(text: str) -> str:
    """Return the bytes of `6040=15` by canopen, as hexadecimal digits; `?` where any may stand."""
    name, _, number = text.partition("=")
    known = variable(*address(name))
    return "?" * (len(known) // 4) if number == "*" else known.encode_raw(int(number, 0)).hex()


def _multiplexer(name: str) -> str:
    index, sub = address(name)
    return index.to_bytes(2, "little").hex() + f"{sub:02x}"


def _sdo(what: str, rest: list[str]) -> str:
    """Return the data of an SDO message."""
    if rest == ["*"]:
        return {"read": "4", "write": "2"}[what] + "*"
    name, equals, _ = rest[0].partition("=")
    key = _multiplexer(name)
    if what in ("write", "value") and not equals:
        return f"2?{key}*"
    data = value(rest[0]) if equals else ""
    command = {
        "read": "40",
        "wrote": "60",
        "abort": "80",
        "refuse": "80",
        "write": SIZED.get(len(data) // 2, ""),
        "value": f"{int(SIZED.get(len(data) // 2, '0'), 16) + 0x20:02x}",
    }[what]
    data += int(rest[1], 0).to_bytes(4, "little").hex() if len(rest) > 1 else ""
    return f"{command}{key}{data:0<8}"


def notation(text: str) -> str:
    """Return a frame in candump's notation."""
    first, *rest = text.split()
    if first == "sync":
        return "080#"
    if first == "nmt":
        return f"000#{NMT[rest[0]]:02X}{int(rest[1]):02X}"
    node, _, what = first.partition(":")
    identifier, data = _of_node(what, rest)
    return f"{identifier + int(node):03X}#{data.upper()}"


def _of_node(what: str, rest: list[str]) -> tuple[int, str]:
    if what in PDOS:
        return PDOS[what], "*" if rest == ["*"] else "".join(map(value, rest))
    if what == "emcy":
        return 0x80, int(rest[0], 0).to_bytes(2, "little").hex() + (
            "01" if int(rest[0], 0) else "00"
        ) + "0" * 10
    if what in ("beat", "boot"):
        return 0x700, "00" if what == "boot" else f"{BEATS[rest[0]]:02x}"
    return (0x600 if what in ("read", "write", "abort") else 0x580), _sdo(what, rest)
