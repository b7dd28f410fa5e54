"""ODrive over CAN: the CANSimple protocol of firmware 0.6.x (Pro, S1, Micro) and 0.5.x (v3.x boards). See
README.md beside this. Exports `plugin`; imports nothing but `protocols`.

Rules. This file is the contract (`Spec`) and the entry point; nothing is decided here that the device or the
robot file should decide. Ranges are what a frame can usefully carry, not what a joint may do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from protocols import messages as msg
from protocols.frames import EXTENDED_BIT
from protocols.messages import SECOND
from protocols.odrive_can import errors, table
from protocols.odrive_can.driver import OdriveAdapter
from protocols.odrive_can.firmware import memory
from protocols.odrive_can.options import Options, Settings, configured, line_of
from protocols.odrive_can.setpoints import COMMANDS, control_mode
from protocols.odrive_can.table import FULL_CALIBRATION, IDLE, InputMode
from protocols.odrive_can.twin import twin
from protocols.plugin import (
    CommandDecoder,
    Device,
    Driver,
    FeedbackKind,
    Plugin,
    Range,
    Spec,
    Watchdog,
    unchanged,
)
from protocols.toolkit.assembly import TableDecoder, can_motor
from protocols.toolkit.motor_driver import MotorDriver
from protocols.toolkit.table import BINARY32

__all__ = ["Options", "Settings", "plugin", "twin"]


def _range(limit: float) -> Range:
    """Return the range of a binary32 field."""
    return Range(-limit, limit, 1e-12, BINARY32)


_TURNS, _TURNS_PER_SECOND, _TORQUE, _ANY = 1e6 * math.tau, 1e3 * math.tau, 1e3, 3.4e38
RANGES: dict[str, Range] = {
    "Position.position": _range(_TURNS),
    "Position.velocity": table.table_of("0.6").range("Set_Input_Pos", "Vel_FF", math.tau),
    "Position.torque": table.table_of("0.6").range("Set_Input_Pos", "Torque_FF"),
    "Velocity.velocity": _range(_TURNS_PER_SECOND),
    "Velocity.torque": _range(_TORQUE),
    "Torque.torque": _range(_TORQUE),
}
for _measured in ("position", "velocity", "torque", "current", "voltage", "temperature"):
    RANGES[f"Feedback.{_measured}"] = _range(_ANY)
REQUESTS: frozenset[type[msg.Request]] = frozenset(
    {
        msg.ClearFault,
        msg.Estop,
        msg.Scan,
        msg.Zero,
        msg.Home,
        msg.Reboot,
        msg.ReadParameter,
        msg.WriteParameter,
    }
)
CONTROL_MODES = tuple(
    (float(control_mode(each)), type(each))
    for each in (msg.Velocity("", 0.0), msg.Torque("", 0.0), msg.Position("", 0.0), msg.Hold(""))
)
NOT_WITH_POSITIONS = {
    "pos_filter": {"Position.torque"},
    "trap_traj": {"Position.torque", "Position.velocity"},
}
"""What the device does not follow with a position, by the option."""
WATCHDOG_NOTE = (
    "the device's watchdog is off, and cannot be switched on over CAN: if this host or its cable fails, the"
    " motor keeps its last set-point. Set axis0.config.enable_watchdog with the vendor's tool over USB and"
    ' enable_watchdog under settings, or write watchdog = "acknowledged" under options'
)


def ranges_of(options: Options) -> dict[str, Range]:
    """Return the ranges of a device."""
    without = NOT_WITH_POSITIONS.get(options.position_input, ())
    return {name: each for name, each in RANGES.items() if name not in without}


def common(device: Device, note: str) -> dict[str, Any]:
    """Return what the spec has over any transport; `note`: what a person must know if its watchdog is off."""
    settings = device.settings
    acknowledged = device.options.watchdog == "acknowledged" or settings.enable_watchdog
    timeout = round(settings.watchdog_timeout * SECOND) or None
    return {
        "commands": COMMANDS,
        "watchdog": Watchdog(timeout, settings.enable_watchdog, "" if acknowledged else note),
        "holds_unattended": not settings.enable_watchdog,
    }


def spec(device: Device) -> Spec:
    """Return the contract of one ODrive. ValueError if its address cannot be one."""
    options, settings = device.options, device.settings
    if not isinstance(options, Options) or not isinstance(settings, Settings):
        raise TypeError("an odrive_can device takes odrive_can's Options and Settings")
    highest = table.MAX_EXTENDED_NODE if options.is_extended else table.MAX_NODE
    line, extended, address = options.firmware, options.is_extended, device.address
    tables = [table.table_of(each, extended) for each in table.LINES[line]]
    fields = common(device, WATCHDOG_NOTE)
    if line_of(device) == "0.5":
        fields["watchdog"] = replace(fields["watchdog"], fed_by="any frame")
    # A position is reported to half a count of the encoder, and rounded to binary32.
    position = replace(RANGES["Feedback.position"], resolution=math.pi / settings.encoder_cpr * 1.001)
    return can_motor(
        device,
        table.requests_of(line, extended),
        range(highest + 1),
        sends=table.ids_of_driver(line, extended, address),
        expects=tuple(dict.fromkeys(one for each in tables for one in each.ids("from_device", address))),
        feedback=FeedbackKind.CYCLIC,
        requests=REQUESTS | {msg.SetAddress if line == "0.5" else msg.SetId},
        tells_serial=line != "0.5",
        ranges=ranges_of(options) | {"Feedback.position": position},
        faults=errors.DEVICE05 if line_of(device) == "0.5" else errors.DEVICE06,
        parameters=("Bus_Voltage", "Iq_Measured"),
        stop=tuple(
            tables[0].encode(name, address, **values)
            for name, values in (("Set_Axis_State", {"Axis_Requested_State": IDLE}), ("Estop", {}))
        ),
        set_up={
            "Control_Mode": CONTROL_MODES,
            "Input_Mode": tuple(
                float(InputMode[each.upper()]) for each in ("passthrough", options.position_input)
            ),
        },
        configuration={} if line_of(device) == "0.5" else configured(options, settings),
        calibration=("Axis_Requested_State", float(FULL_CALIBRATION)),
        save="" if line_of(device) == "0.5" else table.SAVE,
        receives_also=((0x06, 0x1F), (0x01, 0x1F)),
        obeys_also=((address << table.CMD_BITS | extended * EXTENDED_BIT, 0x9FFF_FFE0),),
        **fields,
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver of all ODrives of one bus. ValueError if two have the same address."""
    addresses = [(device.address, device.options.is_extended) for device in devices]
    for device, address in zip(devices, addresses, strict=True):
        if addresses.count(address) > 1:
            raise ValueError(f"address {device.address} of {device.name} is used by two devices on this bus")
    return MotorDriver(
        OdriveAdapter(devices), devices, {each.name: ranges_of(each.options) for each in devices}
    )


def decoder(devices: Sequence[Device]) -> CommandDecoder:
    """Return what the ODrives of one bus would obey."""
    tables = {each.name: table.table_of(line_of(each), each.options.is_extended) for each in devices}
    return TableDecoder([(tables[each.name], memory(each), unchanged) for each in devices])


plugin = Plugin(
    name="odrive_can",
    title="ODrive Pro, S1, Micro (firmware 0.6.x) and v3.x (0.5.x) over CAN (CANSimple)",
    trust=(
        "bytes of every message both ways: odrive-can 2.1.0 with its DBCs 0.6.10 and 0.5.6, cantools 45.1.0;"
        " discovery: odriverobotics/ODriveResources@06dc846; twins of both lines driven by odrive-can 2.1.0's"
        " client, that of 0.6 by pyodrivecan 0.1.3 too"
    ),
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=decoder,
    twin=twin,
    messages=table.names,
    vectors=("protocols.odrive_can", "vectors.json"),
)
