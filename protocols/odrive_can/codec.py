"""CANSimple of ODrive firmware 0.5.x and 0.6.x: messages ↔ CAN frames, both ways, from one table per line.

Rules. A message is a value in the device's own units: turns, turns/s, N·m, A, V, °C; `turns` and `radians`
below are the only place where turns meet radians. `TABLES` has one table per firmware line; nothing else
knows which command number means what, and `layout` alone knows a byte. The lines use the same identifiers
with other payloads, so decoding takes the line; "" is "not known yet", and its table holds only what has the
same meaning in both, and what identifies the line. Encoding takes no line: a message is of one.

A *node* is the node id of a device, plus `EXTENDED` if its frames have 29-bit identifiers (0.5.x only).

Source: odriverobotics/ODriveArduino@f52eef5 `src/can_simple_messages.hpp`; the DBCs
`odrive-cansimple-0.6.10.dbc` and `odrive-cansimple-0.5.6.dbc` of package odrive-can 2.1.0;
odriverobotics/ODriveResources@06dc846 `examples/can_enumerate.py` (Address), `examples/can_param_access.py`
(SDO); odriverobotics/ODrive@f9b5419 `Firmware/communication/can/can_simple.cpp`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from protocols.frames import CanFrame
from protocols.odrive_can import messages as m
from protocols.odrive_can.layout import Layout, layout

BROADCAST = 0x3F
"""Node id of a broadcast, and of a device that has no address yet (0.6.x)."""
MAX_NODE = 0x3E
"""Highest node id that a device can be given."""
EXTENDED = 1 << 32
"""Added to a node id: the axis receives and sends 29-bit identifiers."""
MAX_EXTENDED_NODE = 0xFFFFFF
CMD_BITS = 5


def turns(radians_: float) -> float:
    """Convert radians (or rad/s) at the device's shaft to turns (or turns/s)."""
    return radians_ / math.tau


def radians(turns_: float) -> float:
    """Convert turns (or turns/s) at the device's shaft to radians (or rad/s)."""
    return turns_ * math.tau


# -- the tables -------------------------------------------------------------------------------------

COMMON: tuple[Layout, ...] = (
    layout(m.Estop, 0x02, "to_device", "", 0),
    layout(m.SetAxisState, 0x07, "to_device", "I"),
    layout(m.GetEncoderEstimates, 0x09, "from_device", "ff"),
    layout(m.SetControllerMode, 0x0B, "to_device", "II"),
    layout(m.SetInputPos, 0x0C, "to_device", "fmm"),
    layout(m.SetInputVel, 0x0D, "to_device", "ff"),
    layout(m.SetInputTorque, 0x0E, "to_device", "f"),
    layout(m.SetLimits, 0x0F, "to_device", "ff"),
    layout(m.SetTrajVelLimit, 0x11, "to_device", "f"),
    layout(m.SetTrajAccelLimits, 0x12, "to_device", "ff"),
    layout(m.SetTrajInertia, 0x13, "to_device", "f"),
    layout(m.GetIq, 0x14, "from_device", "ff"),
    layout(m.GetBusVoltageCurrent, 0x17, "from_device", "ff"),
    layout(m.SetPosGain, 0x1A, "to_device", "f"),
    layout(m.SetVelGains, 0x1B, "to_device", "ff"),
)
"""The same in both lines."""

VERSION = layout(m.GetVersion, 0x00, "from_device", "BBBBBBBB")
ADDRESS = layout(m.Address, 0x06, "both", "BSc", 7)
UNIDENTIFIED_HEARTBEAT = layout(m.UnidentifiedHeartbeat, 0x01, "from_device", "IBBBB", 7)

LINE06: tuple[Layout, ...] = (
    VERSION,
    layout(m.Heartbeat, 0x01, "from_device", "IBBb", 7),
    layout(m.GetError, 0x03, "from_device", "II"),
    layout(m.RxSdo, 0x04, "to_device", "BHBI"),
    layout(m.TxSdo, 0x05, "from_device", "BHBI", 4),
    ADDRESS,
    layout(m.GetTemperature, 0x15, "from_device", "nn"),
    layout(m.Reboot, 0x16, "to_device", "B", 1),
    layout(m.ClearErrors, 0x18, "to_device", "B", 1),
    layout(m.SetAbsolutePosition, 0x19, "to_device", "f"),
    layout(m.GetTorques, 0x1C, "from_device", "ff"),
    layout(m.GetPowers, 0x1D, "from_device", "ff"),
    layout(m.EnterDfuMode, 0x1F, "to_device", "", 0),
)

LINE05: tuple[Layout, ...] = (
    layout(m.Heartbeat05, 0x01, "from_device", "IBbbb7"),
    layout(m.GetMotorError, 0x03, "from_device", "Q"),
    layout(m.GetEncoderError, 0x04, "from_device", "I"),
    layout(m.GetSensorlessError, 0x05, "from_device", "I"),
    layout(m.SetAxisNodeId, 0x06, "to_device", "I"),
    layout(m.GetEncoderCount, 0x0A, "from_device", "ii"),
    layout(m.StartAnticogging, 0x10, "to_device", "", 0),
    layout(m.GetSensorlessEstimates, 0x15, "from_device", "ff"),
    layout(m.Reboot05, 0x16, "to_device", "", 0),
    layout(m.ClearErrors05, 0x18, "to_device", "", 0),
    layout(m.SetLinearCount, 0x19, "to_device", "i"),
    layout(m.RequestAdcVoltage, 0x1C, "to_device", "B"),
    layout(m.GetAdcVoltage, 0x1C, "from_device", "f"),
    layout(m.GetControllerError, 0x1D, "from_device", "I"),
)

WRITABLE: dict[type[Any], tuple[str, ...]] = {
    m.SetLimits: ("Velocity_Limit", "Current_Limit"),
    m.SetTrajVelLimit: ("Traj_Vel_Limit",),
    m.SetTrajAccelLimits: ("Traj_Accel_Limit", "Traj_Decel_Limit"),
    m.SetTrajInertia: ("Traj_Inertia",),
    m.SetPosGain: ("Pos_Gain",),
    m.SetVelGains: ("Vel_Gain", "Vel_Integrator_Gain"),
}
"""The messages that write parameters, in both lines, with the vendor's names of their fields in order."""


@dataclass(frozen=True, slots=True)
class Table:
    """The messages of one firmware line, by command number and direction."""

    layouts: tuple[Layout, ...]
    from_device: dict[int, Layout]
    to_device: dict[int, Layout]
    requestable: frozenset[int]
    """Commands that a device sends in reply to a remote frame or an empty one."""
    obeys_remote_frames: bool
    """A remote frame of a host's message is obeyed, as if its data were zeros."""
    always_replied: frozenset[int] = frozenset()
    """Commands that are replied to whatever the frame."""


def _table(layouts: tuple[Layout, ...], not_requestable: frozenset[int], obeys_remote: bool = False) -> Table:
    from_device = {row.cmd: row for row in layouts if row.direction != "to_device"}
    to_device = {row.cmd: row for row in layouts if row.direction != "from_device"}
    return Table(layouts, from_device, to_device, frozenset(from_device) - not_requestable, obeys_remote)


def _table05() -> Table:
    """0.5.x sends a heartbeat cyclically only and an ADC's voltage in reply to a data frame only, replies to
    any frame with Get_Controller_Error's number, and obeys remote frames (ODrive@f9b5419
    `can_simple.cpp`)."""
    table = _table(COMMON + LINE05, frozenset({0x01, 0x1C}), obeys_remote=True)
    return replace(
        table,
        # A device of this line never sends Get_Version: one that does is of another, which must be noticed.
        from_device=table.from_device | {VERSION.cmd: VERSION},
        always_replied=frozenset({0x1D}),
    )


UNIDENTIFIED = (
    *(row for row in COMMON if row.direction == "from_device"),
    VERSION,
    UNIDENTIFIED_HEARTBEAT,
    ADDRESS,
)
TABLES: dict[str, Table] = {
    "": _table(UNIDENTIFIED, frozenset()),
    "0.5": _table05(),
    "0.6": _table(COMMON + LINE06, frozenset()),
}
"""By firmware line; "" before it is known."""
BY_TYPE: dict[type[Any], Layout] = {
    row.message: row for row in (*COMMON, *LINE06, *LINE05, UNIDENTIFIED_HEARTBEAT)
}


# -- frames -------------------------------------------------------------------------------------------


def cmd_of(message: type[Any]) -> int:
    """Return the command number of a type of message."""
    return BY_TYPE[message].cmd


def frame_id(node: int, cmd: int) -> int:
    """Return the identifier: 6 (extended: 24) bits of node id, 5 bits of command."""
    return (node & MAX_EXTENDED_NODE) << CMD_BITS | cmd


def node_of(frame: CanFrame) -> int:
    """Return the node that a frame is from or for."""
    node = frame.id >> CMD_BITS
    return node | EXTENDED if frame.extended else node


def remote_frame(node: int, cmd: int) -> CanFrame:
    """Return the remote frame that requests a message of a node, by its command number."""
    return CanFrame(frame_id(node, cmd), extended=node >= EXTENDED, remote=True)


def encode(node: int, message: m.Message) -> CanFrame:
    """Return the frame of a message from or to a node. ValueError for a number that is not finite."""
    row = BY_TYPE[type(message)]
    data = row.encode(message)
    if row is ADDRESS and isinstance(message, m.Address) and message.connection is None:
        data = data[: row.dlc]
    if node < EXTENDED:
        return CanFrame(node << CMD_BITS | row.cmd, data)
    return CanFrame(frame_id(node, row.cmd), data, extended=True)


def decode_from_device(frame: CanFrame, line: str = "0.6") -> m.Message | None:
    """Decode a data frame of a device of a firmware line. None for a command that the line does not have,
    wrong lengths, and numbers that are not finite."""
    row = TABLES[line].from_device.get(frame.id & 0x1F)
    data = frame.data
    if row is None or not row.dlc <= len(data) <= 8:
        return None
    if len(data) == 8:
        message: m.Message | None = row.decode(data)
        return message
    return _decode_padded(row, data)


def decode_to_device(frame: CanFrame, line: str = "0.6") -> m.Message | m.RemoteRequest | None:
    """Decode a frame of a host as a device of a firmware line does; None if the device ignores it.

    A remote frame, or an empty data frame, requests a message. Short data is read as if the rest were
    zeros: a device reads its 8-byte buffer whatever the DLC (ODrive@f9b5419
    `communication/can/can_simple.cpp`), and vendor hosts send Set_Axis_State with DLC 4.
    """
    table, cmd, data = TABLES[line], frame.id & 0x1F, frame.data
    if frame.fd or len(data) > 8:
        return None
    if cmd in table.always_replied or (cmd in table.requestable and (frame.remote or not data)):
        return m.RemoteRequest(cmd)
    row = table.to_device.get(cmd)
    if row is None or (frame.remote and not table.obeys_remote_frames):
        return None
    return _decode_padded(row, data)


def _decode_padded(row: Layout, data: bytes) -> m.Message | None:
    message: m.Message | None = row.decode(data.ljust(8, b"\0"))
    if row is ADDRESS and isinstance(message, m.Address) and len(data) < 8:
        return m.Address(message.node, message.serial)
    return message
