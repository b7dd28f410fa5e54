"""ODrive over CAN: the CANSimple protocol of firmware 0.6.x (Pro, S1, Micro) and 0.5.x (v3.x boards). See
README.md beside this.

Rules. This file is the contract (`Spec`) and the entry point; nothing is decided here that the device or the
robot file should decide. Ranges are what the wire can carry in sense, not what a joint may do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND
from protocols.odrive_can.codec import BROADCAST, MAX_EXTENDED_NODE, MAX_NODE, TABLES, cmd_of, frame_id
from protocols.odrive_can.decoder import OdriveDecoder
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.faults import FAULT_TABLE06
from protocols.odrive_can.faults05 import FAULT_TABLE05
from protocols.odrive_can.layout import FEED_FORWARD_MAX
from protocols.odrive_can.message_names import messages_in
from protocols.odrive_can.messages import Address, EnterDfuMode, GetVersion, Heartbeat, RxSdo
from protocols.odrive_can.messages05 import AskAdcVoltage, SetAxisNodeId, StartAnticogging
from protocols.odrive_can.options import Options, Settings, line_of
from protocols.odrive_can.twin import OdriveTwin
from protocols.odrive_can.twin05 import Twin05
from protocols.odrive_can.twin06 import Twin06
from protocols.plugin import Device, Driver, FeedbackKind, Plugin, Range, Spec, Watchdog

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
NOT_SENT = (RxSdo, EnterDfuMode, SetAxisNodeId, StartAnticogging, AskAdcVoltage)
"""Host's messages that this driver never sends."""
LINES = {"auto": ("0.5", "0.6"), "0.5": ("0.5",), "0.6": ("0.6",)}
"""The firmware lines that a device may turn out to be of, by the option: the driver asks first."""
CMD_MASK = 0x1F
ALL_OF_NODE = 0x9FFF_FFE0
"""The bits of an identifier, and of its format, that say for which node it is."""
DISCOVERY = frame_id(BROADCAST, cmd_of(Address))
WATCHDOG_NOTE = (
    "the device's watchdog is off, and cannot be switched on over CAN: if this host or its cable fails, the"
    " motor keeps its last set-point. Set axis0.config.enable_watchdog with the vendor's tool over USB and"
    ' enable_watchdog under settings, or write watchdog = "acknowledged" under options'
)


def _measured(settings: Settings) -> Range:
    """A position is told to half a count of the encoder, and rounded to binary32."""
    return replace(_scalar, resolution=math.pi / settings.encoder_cpr * 1.001)


def asks(options: Options) -> frozenset[int]:
    """The commands that may be asked for by a remote frame: what a device of any line in question answers or
    takes no notice of, and none obeys. (0.5.x obeys remote frames, e.g. one of Set_Axis_Node_ID, which has
    the number of 0.6.x's Address.)"""
    tables = [TABLES[line] for line in LINES[options.firmware]]
    answered = frozenset().union(
        *(table.askable for table in tables), {cmd_of(GetVersion), cmd_of(Heartbeat)}
    )
    rows = [row for table in tables if table.remote_obeyed for row in table.to_device.values()]
    return answered - {row.cmd for row in rows if row.message is not AskAdcVoltage}


@dataclass(frozen=True, slots=True)
class ReadOnly:
    """Whether a wire only asks: a remote frame for a message that devices tell."""

    cmds: frozenset[int]
    extended: bool
    discovery: frozenset[int]

    def __call__(self, frame: Frame) -> bool:
        """A value rather than a function, so that equal specs are equal."""
        if not isinstance(frame, CanFrame) or not frame.remote:
            return False
        if frame.id in self.discovery and not frame.extended:
            return True
        return frame.extended == self.extended and frame.id & 0x1F in self.cmds


def spec(device: Device) -> Spec:
    """The contract of one ODrive. ValueError if its address cannot be one."""
    options, settings = device.options, device.settings
    if not isinstance(options, Options) or not isinstance(settings, Settings):
        raise TypeError("an odrive_can device takes odrive_can's Options and Settings")
    most = MAX_EXTENDED_NODE if options.is_extended else MAX_NODE
    if not 0 <= device.address <= most:
        raise ValueError(f"address {device.address} of {device.name}: a node id is 0 to {most}")
    rows = [row for line in LINES[options.firmware] for row in TABLES[line].layouts]
    reported = {row.cmd for row in rows if row.direction != "to_device"}
    said = {row.cmd for row in rows if row.direction != "from_device" and row.message not in NOT_SENT}
    discovery = frozenset({DISCOVERY} if options.firmware != "0.5" else ())
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
    quiet = options.watchdog == "acknowledged" or settings.enable_watchdog
    timeout = round(settings.watchdog_timeout * SECOND) or None
    sends = frozenset(frame_id(device.address, cmd) for cmd in said | asks(options))
    expects = frozenset(frame_id(device.address, cmd) for cmd in reported)
    return Spec(
        bus="can",
        kind="motor",
        sends=sends | discovery,
        expects=expects | discovery,
        read_only=ReadOnly(asks(options), options.is_extended, discovery),
        feedback=FeedbackKind.CYCLIC,
        feedback_period=options.feedback_ms * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset({msg.Idle, msg.Hold, msg.Position, msg.Velocity, msg.Torque}),
        requests=frozenset(requests),
        ranges=RANGES | {"Feedback.position": _measured(settings)},
        watchdog=Watchdog(
            timeout,
            settings.enable_watchdog,
            "" if quiet else WATCHDOG_NOTE,
            "any wire" if line_of(device) == "0.5" else "its commands",
        ),
        holds_unattended=not settings.enable_watchdog,
        stop_clears_faults=False,
        faults=FAULT_TABLE05 if line_of(device) == "0.5" else FAULT_TABLE06,
        receives_also=((cmd_of(Address), CMD_MASK), (cmd_of(Heartbeat), CMD_MASK)),
        extended=sends | expects if options.is_extended else frozenset(),
        obeys_also=((frame_id(device.address, 0) | options.is_extended << 31, ALL_OF_NODE),),
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Our end, for all ODrives of one bus. ValueError if two have the same address."""
    addresses = [(device.address, device.options.is_extended) for device in devices]
    for device, address in zip(devices, addresses, strict=True):
        if addresses.count(address) > 1:
            raise ValueError(f"address {device.address} of {device.name} is given twice on this bus")
    return OdriveDriver(devices, RANGES)


def twin(device: Device, seed: int) -> OdriveTwin:
    """One device, of the firmware line that it is configured to have."""
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
