"""WitMotion's inertial sensors, WT901 and relatives (protocol 0x55), which stream on a serial line
(README.md). Exports `plugin`."""

from __future__ import annotations

from protocols.frames import Frame
from protocols.messages import MILLISECOND
from protocols.plugin import Device, Plugin, Range, Spec
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.sensors import serial_sensor
from protocols.toolkit.serial import messages_in
from protocols.witmotion import table as wit
from protocols.witmotion.driver import WitmotionAdapter
from protocols.witmotion.options import Options, Settings
from protocols.witmotion.twin import WitmotionDecoder, WitmotionTwin

__all__ = ["plugin"]

PERIOD = 100 * MILLISECOND
"""As delivered"""


def messages(frame: Frame) -> tuple[str, ...]:
    """Return the names of the commands in a frame: the registers that are written, or read."""
    return tuple(_name(*wit.command_of(message)) for message in messages_in(wit.COMMANDS, frame)[0])


def _name(register: int, word: int) -> str:
    return f"read {wit.register_name(word & 0xFF)}" if register == wit.READ else wit.register_name(register)


def read_only(frame: Frame) -> bool:
    """True if a frame consists of commands that read registers."""
    found, whole = messages_in(wit.COMMANDS, frame)
    return whole and bool(found) and all(wit.command_of(message)[0] == wit.READ for message in found)


def _range(most: float) -> Range:
    """Return the range of a scale, within its ends: what stands there is not reported."""
    unit = most / wit.FULL
    return Range(unit * (wit.ENDS[0] + 2), unit * (wit.ENDS[1] - 1), 0.501 * unit)


def spec(device: Device) -> Spec:
    """Return the contract of a sensor. Raises ValueError for an address that it cannot have."""
    ranges = {
        "Imu.angular_velocity": _range(wit.RATE_MOST),
        "Imu.linear_acceleration": _range(wit.G_MOST),
    }
    return serial_sensor(device, ranges, PERIOD, read_only=read_only)


plugin = Plugin(
    name=wit.NAME,
    title="WitMotion inertial sensors WT901, BWT901, WT931 by UART",
    trust="bytes: WITMOTION/WitStandardProtocol_JY901@e8f4e3a, witmotion 0.0.1.dev0. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(WitmotionAdapter, spec),
    decoder=WitmotionDecoder,
    twin=WitmotionTwin,
    messages=messages,
    vectors=("protocols.witmotion", "vectors.json"),
)
