"""VESC motor controllers over UART or USB, and those on their CAN (README.md). Exports `plugin`."""

from __future__ import annotations

from collections.abc import Sequence

from protocols import messages as msg
from protocols.plugin import Device, Driver, Plugin, Range, Spec
from protocols.toolkit.assembly import driver_of, serial_motor
from protocols.toolkit.packets import packet_decoder
from protocols.vesc import common
from protocols.vesc_uart.driver import UartAdapter
from protocols.vesc_uart.options import Options, Settings
from protocols.vesc_uart.table import ADDRESSES, BIT, DIRECT, PACKETS
from protocols.vesc_uart.twin import VescUartTwin, motor_of

__all__ = ["plugin"]


def spec(device: Device) -> Spec:
    """Return the contract of one controller. Raises ValueError if its address cannot be one. Of the measured
    it reports more than over CAN."""
    options = device.options
    fields, constant = common(device), options.torque_constant
    most = ((1 << 31) - 2) * 0.01
    fields["ranges"] |= {
        "Feedback.current": Range(-most, most, 1.001e-2),
        "Feedback.torque": Range(-most * constant, most * constant, 1.001e-2 * constant),
    }
    at = DIRECT if device.address == options.uart_id else device.address
    return serial_motor(
        device,
        PACKETS.read_only,
        ADDRESSES,
        requests=frozenset({msg.ClearFault, msg.Scan, msg.Reboot, msg.ReadParameter}),
        tells_serial=True,
        parameters=tuple(BIT),
        stop=(PACKETS.encode("SET_CURRENT", at, value=0.0),),
        **fields,
    )


_driver = driver_of(UartAdapter, spec)


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver of all controllers of a line. Raises ValueError if they disagree about its end."""
    ends = {device.options.uart_id: device.name for device in devices}
    if len(ends) > 1:
        found = ", ".join(f"{end} ({name})" for end, name in ends.items())
        raise ValueError(f"uart_id must be the same for all controllers of a line, not {found}")
    return _driver(devices)


plugin = Plugin(
    name="vesc_uart",
    title="VESC motor controllers over UART or USB, and on their CAN (velocity, torque by current)",
    trust="bytes both ways: pyvesc-fix 1.0.3, which drove the twin; vedderb/bldc@b9d287b3. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=packet_decoder(lambda _: PACKETS, motor_of),
    twin=VescUartTwin,
    messages=PACKETS.names,
    vectors=("protocols.vesc_uart", "vectors.json"),
)
