"""ODrive over CAN: the CANSimple protocol of firmware 0.6.x (Pro, S1, Micro). See README.md beside this.

Rules. This file is the contract (`Spec`) and the entry point; nothing is decided here that the device or the
robot file should decide. Ranges are what the wire can carry in sense, not what a joint may do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from protocols.odrive_can.codec import (
    ASKABLE,
    BROADCAST,
    FEED_FORWARD_MAX,
    LAYOUTS,
    MAX_NODE,
    cmd_of,
    frame_id,
)
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.ear import OdriveEar
from protocols.odrive_can.messages import Address, EnterDfuMode, RxSdo
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.twin import OdriveTwin
from protocols.plugin import Device, Driver, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.wire import CanFrame, Wire
from protocols.words import (
    MILLISECOND,
    SECOND,
    ClearFault,
    Estop,
    Hold,
    Idle,
    Position,
    ReadParameter,
    Reboot,
    Scan,
    SetId,
    Torque,
    Velocity,
    WriteParameter,
    Zero,
)

BINARY32 = 2.0**-24
"""Largest relative error of rounding to binary32."""
MILLI_ROUNDING = 0.0005
"""Largest error of rounding to int16 × 0.001."""
MAX_TURNS = 1e6
MAX_SPEED = 1e3
"""turns/s"""
MAX_TORQUE = 1e3
"""N·m"""

_position = Range(-MAX_TURNS * math.tau, MAX_TURNS * math.tau, 1e-12, BINARY32 * 1.01)
_velocity = Range(-MAX_SPEED * math.tau, MAX_SPEED * math.tau, 1e-12, BINARY32 * 1.01)
_torque = Range(-MAX_TORQUE, MAX_TORQUE, 1e-12, BINARY32 * 1.01)
_feed_velocity = Range(
    -FEED_FORWARD_MAX * math.tau, FEED_FORWARD_MAX * math.tau, MILLI_ROUNDING * math.tau * 1.001
)
_feed_torque = Range(-FEED_FORWARD_MAX, FEED_FORWARD_MAX, MILLI_ROUNDING * 1.001)
_scalar = Range(-3.4e38, 3.4e38, 1e-12, BINARY32 * 1.01)
RANGES: dict[str, Range] = {
    "Position.position": _position,
    "Position.velocity": _feed_velocity,
    "Position.torque": _feed_torque,
    "Velocity.velocity": _velocity,
    "Velocity.torque": _torque,
    "Torque.torque": _torque,
    "Feedback.position": _scalar,
    "Feedback.velocity": _scalar,
    "Feedback.torque": _scalar,
    "Feedback.current": _scalar,
    "Feedback.voltage": _scalar,
    "Feedback.temperature": _scalar,
}
NOT_SENT = frozenset({cmd_of(RxSdo), cmd_of(EnterDfuMode)})
"""Host's messages that this driver never sends."""
WATCHDOG_NOTE = (
    "the device's watchdog is off, and cannot be switched on over CAN: if this host or its cable fails, the"
    " motor keeps its last set-point. Set axis0.config.enable_watchdog with the vendor's tool over USB and"
    ' enable_watchdog under settings, or write watchdog = "acknowledged" under options'
)


def _measured(settings: Settings) -> Range:
    """A position is told to half a count of the encoder, and rounded to binary32."""
    return replace(_scalar, resolution=math.pi / settings.encoder_cpr * 1.001)


def read_only(wire: Wire) -> bool:
    """Whether a wire only asks: a remote frame for a message that devices tell."""
    return isinstance(wire, CanFrame) and wire.remote and not wire.extended and wire.id & 0x1F in ASKABLE


def spec(device: Device) -> Spec:
    """The contract of one ODrive. ValueError if its address cannot be one."""
    options, settings = device.options, device.settings
    if not isinstance(options, Options) or not isinstance(settings, Settings):
        raise TypeError("an odrive_can device takes odrive_can's Options and Settings")
    if not 0 <= device.address <= MAX_NODE:
        raise ValueError(f"address {device.address} of {device.name}: a node id is 0 to {MAX_NODE}")
    discovery = frame_id(BROADCAST, cmd_of(Address))
    cmds = [layout.cmd for layout in LAYOUTS if layout.cmd not in NOT_SENT]
    told = [layout.cmd for layout in LAYOUTS if layout.told()]
    quiet = options.watchdog == "acknowledged" or settings.enable_watchdog
    timeout = round(settings.watchdog_timeout * SECOND) or None
    return Spec(
        bus="can",
        kind="motor",
        sends=frozenset({frame_id(device.address, cmd) for cmd in cmds} | {discovery}),
        expects=frozenset({frame_id(device.address, cmd) for cmd in told} | {discovery}),
        read_only=read_only,
        feedback=FeedbackKind.CYCLIC,
        feedback_period=options.feedback_ms * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset({Idle, Hold, Position, Velocity, Torque}),
        requests=frozenset({ClearFault, Estop, Scan, SetId, Zero, ReadParameter, WriteParameter, Reboot}),
        ranges=RANGES | {"Feedback.position": _measured(settings)},
        watchdog=Watchdog(timeout, settings.enable_watchdog, "" if quiet else WATCHDOG_NOTE),
        holds_unattended=not settings.enable_watchdog,
        stop_clears_faults=False,
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Our end, for all ODrives of one bus. ValueError if two have the same address."""
    addresses = [device.address for device in devices]
    for device in devices:
        if addresses.count(device.address) > 1:
            raise ValueError(f"address {device.address} of {device.name} is given twice on this bus")
    return OdriveDriver(devices, RANGES)


plugin = Plugin(
    name="odrive_can",
    title="ODrive Pro, S1, Micro over CAN (CANSimple, firmware 0.6.x)",
    trust=(
        "bytes of every message both ways: odrive-can 2.1.0 with its DBC 0.6.10 and cantools 45.1.0;"
        " discovery: odriverobotics/ODriveResources@06dc846; twin driven by odrive-can 2.1.0's client"
    ),
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    ear=OdriveEar,
    twin=OdriveTwin,
)
