"""ODrive over UART or USB: the ASCII protocol of firmware 0.6.x and 0.5.x (README.md). Exports `plugin`."""

from __future__ import annotations

import math

from protocols import messages as msg
from protocols.odrive_ascii.driver import AsciiAdapter
from protocols.odrive_ascii.options import Options, Settings
from protocols.odrive_ascii.table import AXES, LINES, SUPPLY, line
from protocols.odrive_ascii.twin import REPORTED05, memory_of, twin
from protocols.odrive_can import CONTROL_MODES, common, errors
from protocols.odrive_can.options import line_of
from protocols.odrive_can.table import IDLE, ControlMode, InputMode
from protocols.plugin import Device, Plugin, Range, Spec
from protocols.toolkit.assembly import driver_of, serial_motor
from protocols.toolkit.packets import packet_decoder
from protocols.toolkit.table import BINARY32

__all__ = ["plugin"]

DIGITS = 0.501e-6
"""Numbers have six decimals."""
WATCHDOG_NOTE = (
    "the device's watchdog is off: if this host or its cable fails, the motor keeps its last set-point. Write"
    " axisN.config.enable_watchdog, and enable_watchdog under settings, or write"
    ' watchdog = "acknowledged" under options'
)


def _range(limit: float, unit: float = 1.0) -> Range:
    return Range(-limit * unit, limit * unit, DIGITS * unit, BINARY32)


_TURNS, _TURNS_PER_SECOND, _TORQUE = 1e5, 1e3, 1e3
RANGES: dict[str, Range] = {
    "Position.position": _range(_TURNS, math.tau),
    "Position.velocity": _range(_TURNS_PER_SECOND, math.tau),
    "Position.torque": _range(_TORQUE),
    "Velocity.velocity": _range(_TURNS_PER_SECOND, math.tau),
    "Velocity.torque": _range(_TORQUE),
    "Torque.torque": _range(_TORQUE),
    "Feedback.velocity": _range(1e9, math.tau),
    "Feedback.current": _range(1e6),
    "Feedback.temperature": _range(1e6),
}


def spec(device: Device) -> Spec:
    """Return the contract of one axis. ValueError if its address cannot be one."""
    # A position is reported to half a count of the encoder, and to six decimals of a turn.
    step = math.pi / device.settings.encoder_cpr * 1.001 + DIGITS * math.tau
    old = line_of(device) == "0.5"
    axis = f"axis{device.address}."
    return serial_motor(
        device,
        LINES.read_only,
        AXES,
        requests=frozenset(
            {msg.ClearFault, msg.Home, msg.Scan, msg.Reboot, msg.ReadParameter, msg.WriteParameter}
        ),
        tells_serial=True,
        ranges=RANGES | {"Feedback.position": Range(-1e9 * math.tau, 1e9 * math.tau, step, BINARY32)},
        faults=REPORTED05 if old else errors.DEVICE06,
        parameters=(SUPPLY, f"{axis}controller.config.vel_limit"),
        stop=(line(f"w {axis}requested_state {IDLE}"),),
        set_up={
            "Control_Mode": (*CONTROL_MODES, float(ControlMode.VELOCITY)),
            "Input_Mode": (float(InputMode.PASSTHROUGH),),
        },
        unprotected=frozenset(LINES.letters()),
        **common(device, WATCHDOG_NOTE),
    )


plugin = Plugin(
    name="odrive_ascii",
    title="ODrive Pro, S1, Micro (firmware 0.6.x) and v3.x (0.5.x) over UART or USB (ASCII)",
    trust=(
        "bytes: the examples of odriverobotics/ODrive@f9b5419 docs/ascii-protocol.rst, and the lines of"
        " odriverobotics/ODriveArduino@f52eef5; no client, no hardware yet"
    ),
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(AsciiAdapter, spec),
    decoder=packet_decoder(lambda _: LINES, memory_of),
    twin=twin,
    messages=LINES.names,
    vectors=("protocols.odrive_ascii", "vectors.json"),
)
