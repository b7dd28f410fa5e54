"""VESC motor controllers over UART or USB, and those on their CAN (README.md). Exports `plugin`."""

from __future__ import annotations

from collections.abc import Sequence

from protocols import messages as msg
from protocols.messages import MILLISECOND
from protocols.plugin import CommandDecoder, Device, Driver, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import driver_of, serial_motor
from protocols.toolkit.packets import PacketDecoder
from protocols.vesc import caution, ranges
from protocols.vesc.table import FAULTS
from protocols.vesc_uart.driver import UartAdapter
from protocols.vesc_uart.options import Options, Settings
from protocols.vesc_uart.table import ADDRESSES, BIT, DIRECT, PACKETS
from protocols.vesc_uart.twin import VescTwin, motor_of

__all__ = ["plugin"]


def ranges_of(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry: of the measured, more than over CAN."""
    most = ((1 << 31) - 2) * 0.01
    current = Range(-most, most, 1.001e-2)
    torque = Range(
        -most * options.torque_constant, most * options.torque_constant, 1.001e-2 * options.torque_constant
    )
    return ranges(options) | {"Feedback.current": current, "Feedback.torque": torque}


def spec(device: Device) -> Spec:
    """Return the contract of one controller. Raises ValueError if its address cannot be one."""
    options, settings = device.options, device.settings
    timeout = (settings.timeout_ms or options.timeout_ms) * MILLISECOND
    zero = PACKETS.encode(
        "SET_CURRENT", DIRECT if device.address == options.uart_id else device.address, value=0.0
    )
    return serial_motor(
        device,
        PACKETS.read_only,
        ADDRESSES,
        commands=frozenset({msg.Idle, msg.Velocity, msg.Torque}),
        requests=frozenset({msg.ClearFault, msg.Scan, msg.Reboot, msg.ReadParameter}),
        tells_serial=True,
        ranges=ranges_of(options),
        watchdog=Watchdog(timeout, enabled=True),
        faults=FAULTS,
        parameters=tuple(BIT),
        stop=(zero,),
        scales=dict.fromkeys(("pole_pairs", "torque_constant", "min_erpm"), ""),
        caution=caution(options),
    )


_driver = driver_of(UartAdapter, spec)


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver of all controllers of a line. Raises ValueError if they disagree about its end."""
    ends = {device.options.uart_id: device.name for device in devices}
    if len(ends) > 1:
        told = ", ".join(f"{end} ({name})" for end, name in ends.items())
        raise ValueError(f"uart_id must be the same for all controllers of a line, not {told}")
    return _driver(devices)


def decoder(devices: Sequence[Device]) -> CommandDecoder:
    """Return what the controllers of a line would obey."""
    return PacketDecoder(PACKETS, map(motor_of, devices))


plugin = Plugin(
    name="vesc_uart",
    title="VESC motor controllers over UART or USB, and on their CAN (velocity, torque by current)",
    trust="bytes both ways: pyvesc-fix 1.0.3, which drove the twin; vedderb/bldc@b9d287b3. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=decoder,
    twin=VescTwin,
    messages=PACKETS.names,
    vectors=("gateway.fixtures", "vectors/vesc_uart.json"),
)
