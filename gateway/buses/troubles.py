"""What an open bus, or this machine, says of itself that hinders the devices behind it, and what to type.

Rules. Nothing is sent and nothing is changed: counters, and the files in which the kernel shows its state.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

USB = Path("/sys/bus/usb/devices")
MODULES: dict[str, str] = {
    "1D50:606F": "gs_usb",
    "1209:2323": "gs_usb",
    "1CD2:606F": "gs_usb",
    "16D0:10B8": "gs_usb",
    "0C72:000C": "peak_usb",
    "0C72:0012": "peak_usb",
    "0403:6001": "ftdi_sio",
    "0403:6010": "ftdi_sio",
    "0403:6011": "ftdi_sio",
    "0403:6014": "ftdi_sio",
    "0403:6015": "ftdi_sio",
    "10C4:EA60": "cp210x",
    "10C4:EA70": "cp210x",
    "1A86:7523": "ch341",
    "1A86:5523": "ch341",
    "067B:2303": "pl2303",
    "0483:5740": "cdc_acm",
    "2E8A:000A": "cdc_acm",
}
"""Adapters by vendor and product, and the kernel's driver of each (Linux 6: the tables of devices in
drivers/net/can/usb, drivers/usb/serial, drivers/usb/class/cdc-acm.c)"""
FEW = 8
"""Error counters of a CAN controller below which nothing is said: an error in sending adds 8, each frame that
went well takes 1 off (ISO 11898-1, fault confinement)"""
WARNING = 96
"""From which on the controller warns"""
_WRITES: Mapping[int, tuple[str, str]] = {
    errno.ENOBUFS: (
        "the kernel's transmit queue is full",
        "nobody acknowledges: supply, cable, bit rate; or busy: sudo ip link set {channel} txqueuelen 100",
    ),
    errno.EAGAIN: ("nothing takes what is sent", "check supply, cable and bit rate"),
    errno.ENETDOWN: ("the interface is down", "sudo ip link set {channel} up"),
    errno.ENODEV: ("the adapter is gone", "plug it in again, then: gateway scan"),
    errno.ENXIO: ("the adapter is gone", "plug it in again, then: gateway scan"),
    errno.EIO: ("the adapter does not answer", "unplug it and plug it in again; dmesg | tail"),
    errno.EINVAL: (
        "the interface takes no such frame",
        "CAN FD needs it set up so: ip -details link show {channel}",
    ),
    errno.EMSGSIZE: ("the interface takes no frame so long", "ip -details link show {channel}"),
    errno.EPERM: (
        "the interface does not allow it",
        "ip -details link show {channel}  (listen-only? a firewall of a container?)",
    ),
    errno.ETIMEDOUT: ("the adapter took too long", "unplug it and plug it in again; dmesg | tail"),
}

TOO_FAST = "%s: %d frames were lost: they came faster than they were read"
"""In the log: bus, and how many"""


@dataclass(frozen=True, slots=True)
class Trouble:
    """One thing."""

    grave: bool
    """Whether what hangs on it cannot be used."""
    seen: str
    matters: str
    todo: str


def of_writes(failures: Mapping[int, int], channel: str) -> Iterator[Trouble]:
    """Yield what writes have failed with, by errno and how often."""
    for code, count in failures.items():
        name, why = errno.errorcode.get(code, "?"), os.strerror(code)
        what, todo = _WRITES.get(code, (why, "dmesg | tail"))
        text = f"{count} writes failed with errno {code} ({name}: {why}): {what}"
        lost = "what is sent comes late or never, and commands with it"
        yield Trouble(True, text, lost, todo.format(channel=channel))


def of_counters(
    counters: tuple[int, int] | None, errors: Mapping[str, int], channel: str
) -> Iterator[Trouble]:
    """Yield what a CAN controller has counted: its error counters (sending, receiving), and its errors by
    kind."""
    total, most = sum(errors.values()), max(counters or (0, 0))
    if not total and most < FEW:
        return
    at = (
        f"error counters: {counters[0]} sending, {counters[1]} receiving" if counters else "no error counters"
    )
    alone = sum(count for kind, count in errors.items() if "no acknowledgement" in kind)
    kinds = ", ".join(
        f"{count} × {kind}" for kind, count in sorted(errors.items(), key=lambda one: -one[1])[:3]
    )
    look = f"ip -details -statistics link show {channel}"
    if (total and alone > total / 2) or (not total and counters and counters[0] > 2 * counters[1]):
        text = f"no other node acknowledges what is sent ({kinds + '; ' if kinds else ''}{at})"
        lost = "every frame is repeated until somebody does: nothing arrives"
        yield Trouble(True, text, lost, f"check supply and cable of the devices, and the bit rate; {look}")
        return
    text = f"frames are damaged on the wire ({kinds + '; ' if kinds else ''}{at})"
    lost = "damaged frames are sent again and again, until a controller takes itself off the bus"
    todo = (
        "measure between CANH and CANL without supply: 60 ohms (120: a termination is missing, 40: there "
        f"are three); then stubs, ground, and the same bit rate everywhere; {look}"
    )
    yield Trouble(most >= WARNING, text, lost, todo)


def of_usb(devices: Path = USB) -> Iterator[Trouble]:
    """Yield the adapters that are plugged in, and that no driver of the kernel has taken."""
    for place in sorted(devices.glob("*:*")):
        folder = devices / place.name.partition(":")[0]
        vendor, product = (_read(folder / key).upper() for key in ("idVendor", "idProduct"))
        module = MODULES.get(f"{vendor}:{product}")
        if module is None or (place / "driver").exists() or _read(place / "bInterfaceClass") == "0a":
            continue  # 0a: the data of a communications device, which belongs to its first interface
        name = _read(folder / "product") or "an adapter"
        text = f"{name} (usb {vendor}:{product}) is plugged in, and no driver of the kernel has taken it"
        lost = "it is neither a serial port nor a CAN interface without it"
        yield Trouble(True, text, lost, f"sudo modprobe {module}")
        return


def _read(path: Path) -> str:
    with suppress(OSError):
        return path.read_text().strip()
    return ""
