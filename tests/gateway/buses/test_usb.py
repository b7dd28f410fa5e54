"""Adapters by their USB identity: which port or CAN interface is theirs now."""

from __future__ import annotations

from pathlib import Path

import pytest
from serial.tools.list_ports_common import ListPortInfo

from gateway.buses.usb import can_names, port_names, resolved
from gateway.core.robot import BusSettings
from gateway.errors import BusError


def port(device: str, serial: str | None = None, location: str = "") -> ListPortInfo:
    made = ListPortInfo(device)
    made.serial_number, made.location = serial, location
    if serial is not None:
        made.vid, made.pid = 0x0483, 0x5740
    return made


PORTS = [
    port("/dev/ttyACM1", "3A5F", "1-1:1.0"),
    port("/dev/ttyACM0", "77", "1-2:1.2"),
    port("/dev/ttyACM2", "77", "1-2:1.0"),
    port("/dev/ttyS0"),
]


def bus(interface: str) -> BusSettings:
    return BusSettings("can0", "can", interface, bitrate=1_000_000)


@pytest.mark.parametrize(
    ("interface", "found"),
    [
        ("slcan:usb-0483:5740:3A5F", "slcan:/dev/ttyACM1"),
        ("slcan:usb-0483:5740:3a5f@2000000", "slcan:/dev/ttyACM1@2000000"),
        ("serial:usb-0483:5740:77/0", "serial:/dev/ttyACM2"),
        ("serial:usb-0483:5740:77/1", "serial:/dev/ttyACM0"),
        ("serial:usb-0483:5740:77", "serial:/dev/ttyACM2"),
        ("serial:/dev/ttyUSB7", "serial:/dev/ttyUSB7"),
        ("virtual:usb", "virtual:usb"),
    ],
)
def test_a_port_is_found_by_the_identity_of_its_adapter(interface: str, found: str) -> None:
    assert resolved(bus(interface), port_names(PORTS)).interface == found


def test_an_adapter_that_is_not_there_is_named_with_those_that_are() -> None:
    text = (
        r"'slcan:usb-0483:5740:99': that adapter is not there. There is /dev/ttyACM0 \(usb-0483:5740:77/1\)"
    )
    with pytest.raises(BusError, match=text):
        resolved(bus("slcan:usb-0483:5740:99"), port_names(PORTS))


def test_can_interfaces_are_found_by_the_identity_of_their_adapter(tmp_path: Path) -> None:
    """The tree of sysfs: an interface's device is a part of a USB device; dev_port numbers its channels."""
    net = tmp_path / "net"
    for name, adapter, channel in (
        ("can0", "1-4", "1"),
        ("can1", "1-4", "0"),
        ("can2", "1-3", "0"),
        ("vcan0", "", "0"),
    ):
        (net / name).mkdir(parents=True)
        (net / name / "type").write_text("280\n")
        (net / name / "dev_port").write_text(f"{channel}\n")
        if adapter:
            part = tmp_path / "usb" / adapter / f"{adapter}:1.0"
            part.mkdir(parents=True, exist_ok=True)
            for key, value in (("idVendor", "1d50"), ("idProduct", "606f"), ("serial", f"S{adapter}")):
                (part.parent / key).write_text(f"{value}\n")
            (net / name / "device").symlink_to(part)
    names = can_names(net)
    assert names == {
        "can1": "usb-1D50:606F:S1-4/0",
        "can0": "usb-1D50:606F:S1-4/1",
        "can2": "usb-1D50:606F:S1-3",
        "vcan0": "",
    }
    assert resolved(bus("socketcan:usb-1d50:606f:S1-4/1"), names).interface == "socketcan:can0"
