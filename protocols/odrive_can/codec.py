"""CANSimple of ODrive firmware 0.6.x: values ↔ CAN frames, both directions, from one table.

Rules. A message is a frozen value in the device's own units: turns, turns/s, N·m, A, V, °C; `turns` and
`radians` below are the only place where turns meet radians. `LAYOUTS` is the table; nothing else knows a
byte. All values are little-endian, floats IEEE-754 binary32, feed-forwards int16 × 0.001 that saturate. No
number that is not finite is encoded (ValueError: our own mistake) or decoded (the frame is bad). −0.0 and
denormals become 0.0. The 0.5.x line has other payloads under the same ids and gets its own table.

Source: odriverobotics/ODriveArduino@f52eef5 `src/can_simple_messages.hpp`; the DBC
`odrive-cansimple-0.6.10.dbc` of package odrive-can 2.1.0; odriverobotics/ODriveResources@06dc846
`examples/can_enumerate.py` (Address); `examples/can_param_access.py` (SDO).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, Literal, TypeAlias

from protocols.odrive_can.messages import (
    Address,
    Ask,
    ClearErrors,
    EnterDfuMode,
    Estop,
    GetBusVoltageCurrent,
    GetEncoderEstimates,
    GetError,
    GetIq,
    GetPowers,
    GetTemperature,
    GetTorques,
    GetVersion,
    Heartbeat,
    Message,
    Reboot,
    RxSdo,
    SetAbsolutePosition,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajInertia,
    SetTrajVelLimit,
    SetVelGains,
    TxSdo,
)
from protocols.wire import CanFrame

BROADCAST = 0x3F
"""Node id of a broadcast, and of a device that has no address yet."""
MAX_NODE = 0x3E
"""Highest node id that a device can be given."""
CMD_BITS = 5
MILLI = 0.001
"""Scale of the feed-forwards of Set_Input_Pos: turns/s and N·m per count."""
FEED_FORWARD_MAX = 32767 * MILLI
FLOAT_MAX = 3.4028234663852886e38
FLOAT_TINY = 2.0**-126
"""Smallest normal binary32: below it a number counts as 0."""


def turns(radians_: float) -> float:
    """Radians (or rad/s) at the device's shaft as turns (or turns/s)."""
    return radians_ / math.tau


def radians(turns_: float) -> float:
    """Turns (or turns/s) at the device's shaft as radians (or rad/s)."""
    return turns_ * math.tau


# -- one field, by its letter in the table ----------------------------------------------------------


def _binary32(value: float) -> float:
    """Saturating. ValueError for what is not finite, in both directions: it is neither said nor believed."""
    if -FLOAT_MAX <= value <= FLOAT_MAX:
        return 0.0 if -FLOAT_TINY < value < FLOAT_TINY else value
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it never reaches the wire")
    return math.copysign(FLOAT_MAX, value)


def _milli(value: float) -> int:
    """int16 × 0.001, saturating: a wrapped feed-forward would kick the other way."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it never reaches the wire")
    return max(-32768, min(32767, round(max(-33.0, min(33.0, value)) / MILLI)))


def _same(value: Any) -> Any:  # noqa: ANN401 -- whatever the field is
    return value


_TO_WIRE: dict[str, Callable[[Any], Any]] = {
    "S": lambda serial: serial.to_bytes(6, "little"),
    "f": _binary32,
    "n": lambda value: math.nan if value is None else _binary32(value),
    "m": _milli,
    "c": lambda value: value or 0,
}
_FROM_WIRE: dict[str, Callable[[Any], Any]] = {
    "S": lambda data: int.from_bytes(data, "little"),
    "f": _binary32,
    "n": lambda value: _binary32(value) if math.isfinite(value) else None,
    "m": lambda count: count * MILLI,
    "b": lambda value: value & 1,
}


# -- the table --------------------------------------------------------------------------------------

Direction: TypeAlias = Literal["to_device", "from_device", "both"]


@dataclass(frozen=True, slots=True)
class Layout:
    """One row of the table: how one message stands in a frame."""

    message: type[Any]
    cmd: int
    direction: Direction
    codes: str
    """One letter per field: b bit 0, B u8, c u8 that may be left out, H u16, I u32, S u48, f binary32,
    n binary32 or NaN, m int16 × 0.001."""
    dlc: int
    """Bytes that we send, and the fewest that are taken from a device."""
    pack: Callable[..., bytes]
    unpack: Callable[[bytes], tuple[Any, ...]]
    take: Callable[[Any], tuple[Any, ...]]
    """The fields of a message."""
    to_wire: tuple[Callable[[Any], Any], ...]
    from_wire: tuple[Callable[[Any], Any], ...]

    def told(self) -> bool:
        """Whether the device sends it, and hence may be asked for it."""
        return self.direction != "to_device"


def _layout(message: type[Any], cmd: int, direction: Direction, codes: str, dlc: int = 8) -> Layout:
    names = tuple(field.name for field in fields(message))
    wire = "<" + "".join(
        {"S": "6s", "m": "h", "n": "f", "b": "B", "c": "B"}.get(code, code) for code in codes
    )
    packer = struct.Struct(wire + "x" * (8 - struct.calcsize(wire)))
    to_wire = tuple(_TO_WIRE.get(code, _same) for code in codes)
    from_wire = tuple(_FROM_WIRE.get(code, _same) for code in codes)
    return Layout(
        message, cmd, direction, codes, dlc, packer.pack, packer.unpack, _taker(names), to_wire, from_wire
    )


def _taker(names: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
    if len(names) > 1:
        return attrgetter(*names)
    return lambda message: tuple(getattr(message, name) for name in names)


LAYOUTS: tuple[Layout, ...] = (
    _layout(GetVersion, 0x00, "from_device", "BBBBBBBB"),
    _layout(Heartbeat, 0x01, "from_device", "IBBb", 7),
    _layout(Estop, 0x02, "to_device", "", 0),
    _layout(GetError, 0x03, "from_device", "II"),
    _layout(RxSdo, 0x04, "to_device", "BHBI"),
    _layout(TxSdo, 0x05, "from_device", "BHBI", 4),
    _layout(Address, 0x06, "both", "BSc", 7),
    _layout(SetAxisState, 0x07, "to_device", "I"),
    _layout(GetEncoderEstimates, 0x09, "from_device", "ff"),
    _layout(SetControllerMode, 0x0B, "to_device", "II"),
    _layout(SetInputPos, 0x0C, "to_device", "fmm"),
    _layout(SetInputVel, 0x0D, "to_device", "ff"),
    _layout(SetInputTorque, 0x0E, "to_device", "f"),
    _layout(SetLimits, 0x0F, "to_device", "ff"),
    _layout(SetTrajVelLimit, 0x11, "to_device", "f"),
    _layout(SetTrajAccelLimits, 0x12, "to_device", "ff"),
    _layout(SetTrajInertia, 0x13, "to_device", "f"),
    _layout(GetIq, 0x14, "from_device", "ff"),
    _layout(GetTemperature, 0x15, "from_device", "nn"),
    _layout(Reboot, 0x16, "to_device", "B", 1),
    _layout(GetBusVoltageCurrent, 0x17, "from_device", "ff"),
    _layout(ClearErrors, 0x18, "to_device", "B", 1),
    _layout(SetAbsolutePosition, 0x19, "to_device", "f"),
    _layout(SetPosGain, 0x1A, "to_device", "f"),
    _layout(SetVelGains, 0x1B, "to_device", "ff"),
    _layout(GetTorques, 0x1C, "from_device", "ff"),
    _layout(GetPowers, 0x1D, "from_device", "ff"),
    _layout(EnterDfuMode, 0x1F, "to_device", "", 0),
)
BY_CMD: dict[int, Layout] = {layout.cmd: layout for layout in LAYOUTS}
BY_TYPE: dict[type[Any], Layout] = {layout.message: layout for layout in LAYOUTS}
ASKABLE: frozenset[int] = frozenset(layout.cmd for layout in LAYOUTS if layout.told())
"""Commands that a device answers when it is asked by a remote frame."""


def cmd_of(message: type[Any]) -> int:
    """The command number of a kind of message."""
    return BY_TYPE[message].cmd


def frame_id(node: int, cmd: int) -> int:
    """The standard identifier: 6 bits of node, 5 bits of command."""
    return node << CMD_BITS | cmd


def ask(node: int, message: type[Any]) -> CanFrame:
    """The remote frame that asks a node for a message."""
    return CanFrame(frame_id(node, BY_TYPE[message].cmd), remote=True)


def encode(node: int, message: Message) -> CanFrame:
    """The frame of a message of or to a node. ValueError for a number that is not finite."""
    layout = BY_TYPE[type(message)]
    if layout.codes == "ff":  # set-points and estimates, at every step: the same, without a loop
        a, b = layout.take(message)
        return CanFrame(node << CMD_BITS | layout.cmd, layout.pack(_binary32(a), _binary32(b)))
    # Every field has a converter: _layout makes as many as there are codes.
    data = layout.pack(*[f(value) for f, value in zip(layout.to_wire, layout.take(message))])  # noqa: B905
    return CanFrame(node << CMD_BITS | layout.cmd, data[: _length(layout, message)])


def _length(layout: Layout, message: Message) -> int:
    if layout.direction == "to_device":
        return layout.dlc
    if isinstance(message, Address) and message.connection is None:
        return layout.dlc
    return 8


def decode_from_device(frame: CanFrame) -> Message | None:
    """What a device says with this data frame; None if it is short or holds a number that is not one."""
    layout = BY_CMD[frame.id & 0x1F]
    if len(frame.data) < layout.dlc or len(frame.data) > 8:
        return None
    return _decode(layout, frame.data)


def decode_to_device(frame: CanFrame) -> Message | Ask | None:
    """What a device understands of this frame; None if nothing.

    A remote frame, or an empty data frame, asks for a message. Short data is read as if the rest were
    zeros: a device reads its 8-byte buffer whatever the DLC (ODrive@f9b5419
    `communication/can/can_simple.cpp`), and vendor hosts send Set_Axis_State with DLC 4.
    """
    layout = BY_CMD.get(frame.id & 0x1F)
    if layout is None or frame.extended or frame.fd or len(frame.data) > 8:
        return None
    if layout.told() and (frame.remote or not frame.data):
        return Ask(layout.cmd)
    if frame.remote or layout.direction == "from_device":
        return None
    return _decode(layout, frame.data)


def _decode(layout: Layout, data: bytes) -> Message | None:
    raw = layout.unpack(data if len(data) == 8 else data.ljust(8, b"\0"))
    if layout.codes == "ff":
        return _pair(layout.message, *raw)
    try:
        values = [f(value) for f, value in zip(layout.from_wire, raw)]  # noqa: B905 -- as many by _layout
    except ValueError:  # a float that is not finite: the frame changes nothing
        return None
    if layout.message is Address and len(data) < 8:
        values[2] = None
    message: Message = layout.message(*values)
    return message


def _pair(kind: type[Any], a: float, b: float) -> Message | None:
    if not math.isfinite(a + b):  # two binary32 never overflow in binary64
        return None
    message: Message = kind(
        0.0 if -FLOAT_TINY < a < FLOAT_TINY else a, 0.0 if -FLOAT_TINY < b < FLOAT_TINY else b
    )
    return message
