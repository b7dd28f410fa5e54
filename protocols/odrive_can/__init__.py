"""ODrive over CAN: the CANSimple protocol of firmware 0.6.x (Pro, S1, Micro) and 0.5.x (v3.x boards). See
README.md beside this. Exports `plugin`; imports nothing but `protocols`.

Rules. This file is the contract (`Spec`) and the entry point; nothing is decided here that the device or the
robot file should decide. Ranges are what a frame can usefully carry, not what a joint may do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from protocols import messages as msg
from protocols.frames import EXTENDED_BIT, CanFrame, Frame, exact
from protocols.messages import MILLISECOND, SECOND
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import BROADCAST, MAX_EXTENDED_NODE, MAX_NODE, TABLES, cmd_of, frame_id
from protocols.odrive_can.decoder import OdriveDecoder
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.faults import FAULT_TABLE06
from protocols.odrive_can.faults05 import FAULT_TABLE05
from protocols.odrive_can.layout import FEED_FORWARD_MAX
from protocols.odrive_can.message_names import messages_in
from protocols.odrive_can.options import Options, Settings, line_of
from protocols.odrive_can.twin import OdriveTwin
from protocols.odrive_can.twin05 import Twin05
from protocols.odrive_can.twin06 import Twin06
from protocols.plugin import Device, Driver, FeedbackKind, Plugin, Range, Spec, Watchdog

__all__ = ["Options", "Settings", "plugin"]

BINARY32 = 2.0**-24
"""Largest relative error of rounding to binary32."""
MILLI_ROUNDING = 0.0005
"""Largest error of rounding to int16 × 0.001."""
MAX_TURNS = 1e6
MAX_SPEED = 1e3
"""turns/s"""
MAX_TORQUE = 1e3
"""N·m"""


def _range(limit: float) -> Range:
    """Return the range of a binary32 field."""
    return Range(-limit, limit, 1e-12, BINARY32 * 1.01)


RANGES: dict[str, Range] = {
    "Position.position": _range(MAX_TURNS * math.tau),
    "Position.velocity": Range(
        -FEED_FORWARD_MAX * math.tau, FEED_FORWARD_MAX * math.tau, MILLI_ROUNDING * math.tau * 1.001
    ),
    "Position.torque": Range(-FEED_FORWARD_MAX, FEED_FORWARD_MAX, MILLI_ROUNDING * 1.001),
    "Velocity.velocity": _range(MAX_SPEED * math.tau),
    "Velocity.torque": _range(MAX_TORQUE),
    "Torque.torque": _range(MAX_TORQUE),
    **{
        f"Feedback.{quantity}": _range(3.4e38)
        for quantity in ("position", "velocity", "torque", "current", "voltage", "temperature")
    },
}
NOT_SENT = (m.RxSdo, m.EnterDfuMode, m.SetAxisNodeId, m.StartAnticogging, m.RequestAdcVoltage)
"""A host's messages that this driver never sends."""
LINES = {"auto": ("0.5", "0.6"), "0.5": ("0.5",), "0.6": ("0.6",)}
"""The firmware lines that a device may turn out to have, by the option."""
CMD_MASK = 0x1F
NODE_MASK = 0x9FFF_FFE0
"""The bits of an identifier, and of its format, that give the node."""
DISCOVERY_ID = frame_id(BROADCAST, cmd_of(m.Address))
WATCHDOG_NOTE = (
    "the device's watchdog is off, and cannot be switched on over CAN: if this host or its cable fails, the"
    " motor keeps its last set-point. Set axis0.config.enable_watchdog with the vendor's tool over USB and"
    ' enable_watchdog under settings, or write watchdog = "acknowledged" under options'
)


def requestable(options: Options) -> frozenset[int]:
    """Return the commands that may be requested by a remote frame: what a device of any possible line answers
    or ignores, and none obeys. (0.5.x obeys remote frames, e.g. one of Set_Axis_Node_ID, which has the number
    of 0.6.x's Address.)"""
    tables = [TABLES[line] for line in LINES[options.firmware]]
    answered = frozenset().union(
        *(table.requestable for table in tables), {cmd_of(m.GetVersion), cmd_of(m.Heartbeat)}
    )
    rows = [row for table in tables if table.obeys_remote_frames for row in table.to_device.values()]
    return answered - {row.cmd for row in rows if row.message is not m.RequestAdcVoltage}


@dataclass(frozen=True, slots=True)
class ReadOnly:
    """The test whether a frame only requests a message: a value rather than a function, so that equal specs
    are equal."""

    cmds: frozenset[int]
    extended: bool
    discovery: bool
    """The request for addresses is one."""

    def __call__(self, frame: Frame) -> bool:
        """True for a remote frame of a message that devices send."""
        if not isinstance(frame, CanFrame) or not frame.remote:
            return False
        if self.discovery and frame.id == DISCOVERY_ID and not frame.extended:
            return True
        return frame.extended == self.extended and frame.id & CMD_MASK in self.cmds


def spec(device: Device) -> Spec:
    """Return the contract of one ODrive. ValueError if its address cannot be one."""
    options, settings = device.options, device.settings
    if not isinstance(options, Options) or not isinstance(settings, Settings):
        raise TypeError("an odrive_can device takes odrive_can's Options and Settings")
    highest = MAX_EXTENDED_NODE if options.is_extended else MAX_NODE
    if not 0 <= device.address <= highest:
        raise ValueError(f"address {device.address} of {device.name}: a node id is 0 to {highest}")
    rows = [row for line in LINES[options.firmware] for row in TABLES[line].layouts]
    received = {row.cmd for row in rows if row.direction != "to_device"}
    sent = {row.cmd for row in rows if row.direction != "from_device" and row.message not in NOT_SENT}
    discovery = (exact(DISCOVERY_ID),) if options.firmware != "0.5" else ()
    requests = {
        msg.ClearFault,
        msg.Estop,
        msg.Scan,
        msg.Zero,
        msg.ReadParameter,
        msg.WriteParameter,
        msg.Reboot,
    }
    requests |= {msg.SetId} if options.firmware != "0.5" else set()
    acknowledged = options.watchdog == "acknowledged" or settings.enable_watchdog
    sends = frozenset(frame_id(device.address, cmd) for cmd in sent | requestable(options))
    expects = frozenset(frame_id(device.address, cmd) for cmd in received)
    # A position is reported to half a count of the encoder, and rounded to binary32.
    position = replace(RANGES["Feedback.position"], resolution=math.pi / settings.encoder_cpr * 1.001)
    return Spec(
        bus="can",
        kind="motor",
        sends=tuple(exact(number, options.is_extended) for number in sorted(sends)) + discovery,
        expects=tuple(exact(number, options.is_extended) for number in sorted(expects)) + discovery,
        read_only=ReadOnly(requestable(options), options.is_extended, bool(discovery)),
        feedback=FeedbackKind.CYCLIC,
        feedback_period=options.feedback_ms * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset({msg.Idle, msg.Hold, msg.Position, msg.Velocity, msg.Torque}),
        requests=frozenset(requests),
        ranges=RANGES | {"Feedback.position": position},
        watchdog=Watchdog(
            round(settings.watchdog_timeout * SECOND) or None,
            settings.enable_watchdog,
            "" if acknowledged else WATCHDOG_NOTE,
            "any frame" if line_of(device) == "0.5" else "its commands",
        ),
        holds_unattended=not settings.enable_watchdog,
        stop_clears_faults=False,
        faults=FAULT_TABLE05 if line_of(device) == "0.5" else FAULT_TABLE06,
        parameters=("Bus_Voltage", "Iq_Measured"),
        receives_also=((cmd_of(m.Address), CMD_MASK), (cmd_of(m.Heartbeat), CMD_MASK)),
        obeys_also=((frame_id(device.address, 0) | options.is_extended * EXTENDED_BIT, NODE_MASK),),
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver of all ODrives of one bus. ValueError if two have the same address."""
    addresses = [(device.address, device.options.is_extended) for device in devices]
    for device, address in zip(devices, addresses, strict=True):
        if addresses.count(address) > 1:
            raise ValueError(f"address {device.address} of {device.name} is used by two devices on this bus")
    return OdriveDriver(devices, RANGES)


def twin(device: Device, seed: int) -> OdriveTwin:
    """Return the twin of one device, of the firmware line that it is configured to have."""
    return Twin05(device, seed) if line_of(device) == "0.5" else Twin06(device, seed)


plugin = Plugin(
    name="odrive_can",
    title="ODrive Pro, S1, Micro (firmware 0.6.x) and v3.x (0.5.x) over CAN (CANSimple)",
    trust=(
        "bytes of every message both ways: odrive-can 2.1.0 with its DBCs 0.6.10 and 0.5.6, cantools 45.1.0;"
        " discovery: odriverobotics/ODriveResources@06dc846; twins of both lines driven by odrive-can 2.1.0's"
        " client"
    ),
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=OdriveDecoder,
    twin=twin,
    messages=messages_in,
    vectors=("gateway.fixtures", "vectors/odrive_can.json"),
)
