"""Adapters by their USB identity: "serial:usb-0483:5740:3A5F", "socketcan:usb-1D50:606F:0012/1".

Rules. The kernel numbers ports and interfaces in the order in which it finds them, which may be another one
after the next start; vendor, product and serial number stay. A name is looked up each time that an interface
is opened, also when it has come back. Of an adapter with several channels, /N is one of them, from 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from serial.tools.list_ports import comports
from serial.tools.list_ports_common import ListPortInfo

from gateway.core.robot import USB_NAME, BusSettings
from gateway.errors import BusError

NET = Path("/sys/class/net")
ARPHRD_CAN = "280"
"""The type of a network interface that is a CAN bus (Linux, if_arp.h)."""


def can_interfaces(net: Path = NET) -> list[str]:
    """Return the names of this machine's CAN interfaces, as the kernel lists them."""
    types = {path.parent.name: path.read_text().strip() for path in sorted(net.glob("*/type"))}
    return [name for name, kind in types.items() if kind == ARPHRD_CAN]


def port_names(ports: Iterable[ListPortInfo] | None = None) -> dict[str, str]:
    """Return the paths of serial ports, each with its USB name; "" if it is on no USB adapter."""
    found = sorted(comports() if ports is None else ports, key=lambda one: (one.location or "", one.device))
    made = ((one.device, _name(one.vid, one.pid, one.serial_number)) for one in found)
    return dict(_numbered(made))


def can_names(net: Path = NET) -> dict[str, str]:
    """Return the CAN interfaces, each with its USB name; "" if it is on no USB adapter."""
    found = sorted(can_interfaces(net), key=lambda name: (int(_read(net / name / "dev_port") or 0), name))
    made: list[tuple[str, str]] = []
    for name in found:
        adapter = (net / name / "device").resolve().parent
        vid, pid, serial = (_read(adapter / key) for key in ("idVendor", "idProduct", "serial"))
        known = vid and pid
        made.append((name, _name(int(vid, 16), int(pid, 16), serial) if known else ""))
    return dict(_numbered(made))


def resolved(settings: BusSettings, names: Mapping[str, str] | None = None) -> BusSettings:
    """Return the settings with the present name of an adapter that is given by its USB name.

    `names`: by port or interface; None: those of this machine. Raises BusError if it is not there."""
    kind, _, channel = settings.interface.partition(":")
    wanted, at, rate = channel.partition("@")
    if not USB_NAME.fullmatch(wanted):
        return settings
    if names is None:
        names = can_names() if kind == "socketcan" else port_names()
    either = wanted.lower(), f"{wanted.lower()}/0"
    same = [name for name, usb in names.items() if usb.lower() in either]
    if not same:
        head = f"bus {settings.name!r} cannot be opened as {settings.interface!r}"
        raise BusError(f"{head}: that adapter is not there. There is {listed(names)}.")
    return replace(settings, interface=f"{kind}:{same[0]}{at}{rate}")


def listed(names: Mapping[str, str]) -> str:
    """Return ports or interfaces as a text, each with its USB name."""
    texts = (f"{name} ({usb})" if usb else name for name, usb in sorted(names.items()))
    return ", ".join(texts) or "none"


def _name(vid: int | None, pid: int | None, serial: str | None) -> str:
    return f"usb-{vid:04X}:{pid:04X}:{serial}" if vid is not None and pid is not None and serial else ""


def _numbered(found: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Add /N to the names that several have."""
    pairs = list(found)
    names, seen = [usb for _, usb in pairs], dict[str, int]()
    for name, usb in pairs:
        number = seen[usb] = seen.get(usb, -1) + 1
        yield name, f"{usb}/{number}" if usb and names.count(usb) > 1 else usb


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
