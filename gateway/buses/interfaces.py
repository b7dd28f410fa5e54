"""Opening a CAN interface by its name, and what to do where it cannot be opened."""

from __future__ import annotations

import errno
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import can
from can.typechecking import CanFilter

from gateway.buses.adapters.dm_serial_client import DmSerialInterface
from gateway.buses.adapters.fdcanusb_client import FdcanusbInterface
from gateway.buses.adapters.slcan_client import SlcanInterface
from gateway.buses.netlink import NetLink
from gateway.buses.threaded import ThreadedInterface
from gateway.buses.usb import NET, can_names, listed, resolved
from gateway.core.robot import TWIN, BusSettings
from gateway.errors import BusError
from protocols.frames import EXTENDED_BIT, IdMask
from protocols.suggest import did_you_mean

CANFD_MTU = 72
"""Size of the frames that an interface takes: 72 with CAN FD, 16 without (linux/can.h)."""
BITRATE_TOLERANCE = 0.01
"""A controller's clock cannot be divided to every rate; nodes agree to about this."""

NEVER_WAIT = ("dm-serial", "fdcanusb", "slcan", "socketcan", "udp_multicast", "virtual")
"""Back ends that return at once, measured (docs/adapters.md); all others get threads."""
REFUSED = {
    "socketcand": "it does not notice that its server has gone, and sends remote and CAN FD frames as others",
}
"""Back ends of python-can 4.6.1 that cannot be trusted, and why."""
INTERFACES = (can.VALID_INTERFACES | {"dm-serial", "fdcanusb"}) - REFUSED.keys()
"""The kinds of CAN interface: python-can's, and ours."""
LISTEN_ONLY: dict[str, dict[str, Any]] = {
    "vector": {"listen_only": True},
    "nixnet": {"listen_only": True},
    "kvaser": {"driver_mode": False},
    "pcan": {"state": can.BusState.PASSIVE},
    "seeedstudio": {"operation_mode": "silent"},
}
"""Arguments with which an interface does not even acknowledge (python-can 4.6.1, can/interfaces/*); the
others, SocketCAN among them, have none."""


def open_interface(settings: BusSettings, *, listen_only: bool = False) -> can.BusABC:
    """Open python-can's bus for these settings. Raises BusError with what is missing and how to get it.

    `listen_only`: the interface is opened so that it sends nothing, not even acknowledgements, if it can
    be."""
    settings = resolved(settings)
    kind, _, channel = settings.interface.partition(":")
    if why := REFUSED.get(kind):
        raise BusError(f"{_head(settings)}: {why}; use an interface of this machine")
    if kind == "socketcan" and (why := missing(settings, channel, kernel_has_can())):
        raise BusError(why)
    options: dict[str, Any] = {"bitrate": settings.bitrate, "fd": settings.kind == "canfd"}
    if settings.data_bitrate:
        options["data_bitrate"] = settings.data_bitrate
    if listen_only:
        options |= LISTEN_ONLY.get(kind, {})
    try:
        bus: can.BusABC
        if kind == "slcan":
            bus = SlcanInterface(channel, settings.bitrate, settings.data_bitrate, listen_only=listen_only)
        elif kind == "fdcanusb":
            bus = FdcanusbInterface(channel, settings.bitrate, settings.data_bitrate)
        elif kind == "dm-serial":
            bus = DmSerialInterface(channel)
        else:
            bus = can.Bus(channel=channel, interface=kind, ignore_config=True, **options)
        if settings.receive_filter and not listen_only:
            bus.set_filters(filters(settings.receive_filter))
    except Exception as error:  # a back end may raise anything
        raise BusError(_reason(settings, kind, error)) from error
    return ThreadedInterface(bus) if waits(settings) else bus


def waits(settings: BusSettings) -> bool:
    """True if the back end of a bus may wait: then it has threads of its own."""
    return settings.interface.partition(":")[0] not in NEVER_WAIT


def filters(accepted: Sequence[IdMask]) -> list[CanFilter]:
    """Return ids to receive as python-can's filters; SocketCAN's kernel applies them."""
    made: list[CanFilter] = []
    for number, mask in accepted:
        one: CanFilter = {"can_id": number & ~EXTENDED_BIT, "can_mask": mask & ~EXTENDED_BIT}
        if mask & EXTENDED_BIT:
            one["extended"] = bool(number & EXTENDED_BIT)
        made.append(one)
    return made


def _reason(settings: BusSettings, kind: str, error: Exception) -> str:
    if kind in INTERFACES and isinstance(error, can.CanError | OSError | ValueError | ImportError):
        return f"{_head(settings)}: {error}"
    if kind in INTERFACES:
        what = f"python-can's back end raises {type(error).__name__}: {error}"
        return f"{_head(settings)}: {what}: is the vendor's library installed?"
    known = [TWIN, *sorted(INTERFACES)]
    unknown = f"no interface {kind!r}: there is {', '.join(known)}{did_you_mean(kind, known)}"
    return f"{_head(settings)}: {unknown}. {_what_there_is(can_names())}"


def kernel_has_can() -> bool:
    """True if a CAN socket can be made here (errno 97 where there is no CAN in the kernel)."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return error.errno != errno.EAFNOSUPPORT
    return True


def missing(settings: BusSettings, channel: str, has_can: bool, net: Path = NET) -> str:
    """Say why a SocketCAN channel cannot be opened, what there is, and what to type; "" if nothing is
    missing."""
    present = can_names(net) if has_can else {}
    if channel in present:
        if int((net / channel / "flags").read_text(), 16) & 1:  # IFF_UP
            return ""
        why = f"{channel} is down."
    else:
        no_can = "this machine's kernel has no CAN (errno 97: address family not supported by protocol)"
        why = f"there is no CAN interface {channel!r}" if has_can else no_can
        why += f". {_what_there_is(present)}"
    return f"{_head(settings)}: {why}\n{_commands(settings, channel, has_can=has_can)}"


def check_fit(settings: BusSettings, link: NetLink) -> None:
    """Raise BusError where a SocketCAN interface is configured otherwise than the robot file has the bus."""
    remedy = _set_up(settings, link.name)
    for key, wanted, found in (
        ("bitrate", settings.bitrate, link.bitrate),
        ("data_bitrate", settings.data_bitrate, link.data_bitrate),
    ):
        if wanted and found and abs(wanted - found) > found * BITRATE_TOLERANCE:
            text = f"{link.name} has a {key} of {found} bit/s, the robot file has {wanted}"
            choice = f"Change {key} under [buses.{settings.name}], or the interface:"
            raise BusError("\n  ".join([f"{_head(settings)}: {text}.\n{choice}", *remedy]))
    if settings.kind == "canfd" and link.mtu < CANFD_MTU:
        if link.kind != "can":  # a virtual one has no controller to configure
            remedy = [
                f"sudo ip link set {link.name} down",
                f"sudo ip link set {link.name} mtu {CANFD_MTU} up",
            ]
        text = f"{link.name} carries classic CAN only (mtu {link.mtu}), the robot file has CAN FD"
        raise BusError("\n  ".join([f"{_head(settings)}: {text}.\nTo change that:", *remedy]))


def _head(settings: BusSettings) -> str:
    return f"bus {settings.name!r} cannot be opened as {settings.interface!r}"


def _set_up(settings: BusSettings, channel: str) -> list[str]:
    """Return the commands that configure a controller as the robot file has the bus."""
    fd = f" dbitrate {settings.data_bitrate} fd on" if settings.kind == "canfd" else ""
    return [
        f"sudo ip link set {channel} down",
        f"sudo ip link set {channel} type can bitrate {settings.bitrate}{fd} restart-ms 100",
        f"sudo ip link set {channel} up",
    ]


def _what_there_is(present: Mapping[str, str]) -> str:
    names = listed(present)
    none_needed = '"twin" (the simulated world) and "slcan:PORT" need none'
    return f"CAN interfaces of this machine: {names}. {none_needed}."


def _commands(settings: BusSettings, channel: str, *, has_can: bool) -> str:
    """Return the commands that create a missing vcan, or bring up a real interface at the robot file's
    rate; before that, what gives the kernel CAN, if it has none."""
    if channel.startswith("vcan"):
        mtu = " mtu 72" if settings.kind == "canfd" else ""
        lines = [
            "To create it:",
            "sudo modprobe vcan",
            f"sudo ip link add dev {channel} type vcan",
            f"sudo ip link set {channel}{mtu} up",
        ]
    else:
        lines = ["With the adapter plugged in, to bring it up:", *_set_up(settings, channel)[1:]]
    if not has_can:
        lines[1:1] = ["sudo modprobe can_raw"]
    return "\n  ".join(lines)
