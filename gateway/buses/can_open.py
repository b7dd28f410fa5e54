"""Opening a CAN interface, and saying in a sentence what is missing where it cannot be opened."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
from can.typechecking import CanFilter

from gateway.buses.adapters.fdcanusb_client import FdcanusbInterface
from gateway.buses.adapters.slcan_client import SlcanInterface
from gateway.buses.socketcan.link import Link
from gateway.config.errors import unknown
from gateway.core.robot import TWIN, BusSettings
from gateway.errors import BusError

NET = Path("/sys/class/net")
ARPHRD_CAN = "280"
"""The type of a network interface that is a CAN bus (Linux, if_arp.h)."""
CANFD_MTU = 72
"""Size of the frames that an interface takes: 72 with CAN FD, 16 without (linux/can.h)."""
BITRATE_TOLERANCE = 0.01
"""A controller's clock cannot be divided to every rate; nodes agree to about this."""

_REFUSALS = (can.CanError, OSError, ValueError, TypeError, RuntimeError, ImportError)
"""What python-can's back ends raise when they cannot be opened (NotImplementedError is a RuntimeError)."""


INTERFACES = can.VALID_INTERFACES | {"fdcanusb"}
"""By which a CAN bus can be reached: python-can's, and ours."""
SILENT: dict[str, dict[str, Any]] = {
    "slcan": {"listen_only": True},
    "vector": {"listen_only": True},
    "nixnet": {"listen_only": True},
    "kvaser": {"driver_mode": False},
    "pcan": {"state": can.BusState.PASSIVE},
}
"""How an interface is opened so that it does not even acknowledge (python-can 4.6.1, can/interfaces/*); the
others, SocketCAN among them, have no such argument."""


def open_interface(settings: BusSettings, *, listen_only: bool = False) -> can.BusABC:
    """python-can's bus for these settings. Raises BusError with what is missing and how to get it.

    `listen_only`: the adapter is told to send nothing, not even acknowledgements, where it can be told."""
    interface, _, channel = settings.interface.partition(":")
    if interface == "socketcan" and (why := missing(settings, channel, kernel_has_can())):
        raise BusError(why)
    rates: dict[str, Any] = {"bitrate": settings.bitrate, "fd": settings.kind == "canfd"}
    if settings.data_bitrate:
        rates["data_bitrate"] = settings.data_bitrate
    if listen_only:
        rates |= SILENT.get(interface, {})
    try:
        if interface == "slcan":
            frame: can.BusABC = SlcanInterface(
                channel, settings.bitrate, settings.data_bitrate, listen_only=listen_only
            )
        elif interface == "fdcanusb":
            frame = FdcanusbInterface(channel, settings.bitrate, settings.data_bitrate)
        else:
            frame = can.Bus(channel=channel, interface=interface, ignore_config=True, **rates)
    except _REFUSALS as error:
        raise BusError(_refusal(settings, interface, error)) from error
    if settings.receive_filter and not listen_only:
        frame.set_filters(filters(settings.receive_filter))
    return frame


def filters(received: Sequence[tuple[int, int]]) -> list[CanFilter]:
    """The ids to let in, of either format, as python-can has them; SocketCAN applies them in the kernel."""
    return [{"can_id": number, "can_mask": mask} for number, mask in received]


def _refusal(settings: BusSettings, interface: str, error: Exception) -> str:
    said = _head(settings)
    if interface in INTERFACES:
        return f"{said}: {error}"
    kinds = unknown("interface", interface, [TWIN, *sorted(INTERFACES)])
    return f"{said}: {kinds}. {_what_there_is(can_interfaces())}"


def kernel_has_can() -> bool:
    """Whether a CAN socket can be made here (errno 97 where there is no CAN in the kernel)."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return error.errno != errno.EAFNOSUPPORT
    return True


def can_interfaces(net: Path = NET) -> list[str]:
    """The names of the machine's CAN interfaces, as the kernel lists them."""
    types = {path.parent.name: path.read_text().strip() for path in sorted(net.glob("*/type"))}
    return [name for name, kind in types.items() if kind == ARPHRD_CAN]


def missing(settings: BusSettings, channel: str, has_can: bool, net: Path = NET) -> str:
    """Why a SocketCAN channel cannot be opened, what there is, and what to type; "" if nothing is missing."""
    head = _head(settings)
    there = can_interfaces(net) if has_can else []
    if channel in there:
        if int((net / channel / "flags").read_text(), 16) & 1:  # IFF_UP
            return ""
        return f"{head}: {channel} is down.\n{_to_type(settings, channel)}"
    if has_can:
        why = f"there is no CAN interface {channel!r}"
    else:
        why = "this machine's kernel has no CAN (errno 97: address family not supported by protocol)"
    return f"{head}: {why}. {_what_there_is(there)}\n{_to_type(settings, channel)}"


def check_fit(settings: BusSettings, link: Link) -> None:
    """Raises BusError where a SocketCAN interface is set up otherwise than the robot file has the bus."""
    remedy = _set_up(settings, link.name)
    for which, wanted, found in (
        ("bitrate", settings.bitrate, link.bitrate),
        ("data_bitrate", settings.data_bitrate, link.data_bitrate),
    ):
        if wanted and found and abs(wanted - found) > found * BITRATE_TOLERANCE:
            said = f"{link.name} has a {which} of {found} bit/s, the robot file says {wanted}"
            choice = f"Change {which} under [buses.{settings.name}], or the interface:"
            raise BusError("\n  ".join([f"{_head(settings)}: {said}.\n{choice}", *remedy]))
    if settings.kind == "canfd" and link.mtu < CANFD_MTU:
        if link.kind != "can":  # a virtual one has no controller that could be set up
            remedy = [
                f"sudo ip link set {link.name} down",
                f"sudo ip link set {link.name} mtu {CANFD_MTU} up",
            ]
        said = f"{link.name} carries classic CAN alone (mtu {link.mtu}), the robot file says CAN FD"
        raise BusError("\n  ".join([f"{_head(settings)}: {said}.\nTo change that:", *remedy]))


def _head(settings: BusSettings) -> str:
    return f"bus {settings.name!r} cannot be opened as {settings.interface!r}"


def _set_up(settings: BusSettings, channel: str) -> list[str]:
    """The lines that set a controller up as the robot file has the bus."""
    fd = f" dbitrate {settings.data_bitrate} fd on" if settings.kind == "canfd" else ""
    return [
        f"sudo ip link set {channel} down",
        f"sudo ip link set {channel} type can bitrate {settings.bitrate}{fd} restart-ms 100",
        f"sudo ip link set {channel} up",
    ]


def _what_there_is(there: list[str]) -> str:
    names = ", ".join(there) or "none"
    return (
        f'CAN interfaces of this machine: {names}. "twin" (the simulated world) and "slcan:PORT" need none.'
    )


def _to_type(settings: BusSettings, channel: str) -> str:
    """The lines that create a missing vcan, or bring up a real interface at the robot file's bit rate."""
    if channel.startswith("vcan"):
        size = " mtu 72" if settings.kind == "canfd" else ""
        lines = [
            "To create it:",
            "sudo modprobe vcan",
            f"sudo ip link add dev {channel} type vcan",
            f"sudo ip link set {channel}{size} up",
        ]
    else:
        lines = ["With the adapter plugged in, to bring it up:", *_set_up(settings, channel)[1:]]
    return "\n  ".join(lines)
