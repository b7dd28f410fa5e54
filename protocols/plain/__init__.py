"""Plain: the project's own messages on a serial line, for sensors and motors without a protocol of their own.

The smallest plugin, and the one to read first before writing another: `table` has the messages, `driver` is
the host's end, `twin` the device's with what it obeys; this file is the contract (`Spec`) and the entry
point. One serial line carries any number of devices; numbers are sent exactly. Exports `plugin`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

from protocols import messages as msg
from protocols import sensors
from protocols.bounds import Invalid
from protocols.frames import Frame
from protocols.messages import COMMANDS, MILLISECOND, Command, Request
from protocols.plain import table
from protocols.plain.driver import OFFLINE, Options, PlainAdapter
from protocols.plain.twin import PlainDecoder, PlainTwin, Settings
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Setting, Spec, Watchdog
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.options import configuration
from protocols.toolkit.serial import messages_in
from protocols.toolkit.table import TINY

__all__ = ["plugin"]

SENSOR_PERIOD = 100 * MILLISECOND
"""Period of the slowest usual sensor; the timeout of a robot's sensor is in its robot file."""


def decoded(frame: Frame) -> tuple[list[msg.Message | None], bool]:
    """Return the messages in a frame, None for a malformed one, and whether it holds nothing else."""
    found, whole = messages_in(table.FRAMING, frame)
    return [table.decode(message, 0, "") for message in found], whole


def messages(frame: Frame) -> tuple[str, ...]:
    """Return the class names of the commands and requests in a frame, those of whole messages."""
    return tuple(type(each).__name__ for each in decoded(frame)[0] if isinstance(each, Command | Request))


def read_only(frame: Frame) -> bool:
    """True if a frame consists of whole messages that only read: Scan, ReadParameter."""
    found, whole = decoded(frame)
    return whole and all(isinstance(each, msg.Scan | msg.ReadParameter) for each in found)


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry. Everything is float64 on the line: only what lies
    below the smallest normal binary32 is rounded."""
    kinds = (*COMMANDS, msg.Feedback) if options.kind == "motor" else sensors.kinds().by_type
    return {
        f"{kind.__name__}.{name}": Range(*bounds, TINY)
        for kind in kinds
        for name, bounds in table.limits(kind).items()
    }


def configured(settings: Settings) -> dict[str, Setting]:
    """Return what is configured on a motor: what the spec and a stop depend on is stated."""
    names = {name: name for name in Settings.__slots__}
    found = configuration(settings, names, ("watchdog_ms", "feedback_ms"), {"serial": "it names the device"})
    return found | {"torque_limit": replace(found["torque_limit"], limit="torque")}


def spec(device: Device) -> Spec:
    """Return the contract of one plain device. Raises ValueError for an address that it cannot have."""
    if device.address not in table.ADDRESSES:
        text = f"a plain device has an address of 1 … 255, not {device.address}"
        raise Invalid(("address", text))
    motor, settings = device.options.kind == "motor", device.settings
    timeout = round(settings.watchdog_ms * MILLISECOND)
    return Spec(
        bus="serial",
        kind="motor" if motor else "sensor",
        sends=(),
        expects=(),
        read_only=read_only,
        feedback=FeedbackKind.CYCLIC,
        feedback_period=round(settings.feedback_ms * MILLISECOND) if motor else SENSOR_PERIOD,
        offline_after=OFFLINE,
        commands=frozenset(COMMANDS if motor else ()),
        tells_serial=True,
        requests=frozenset(get_args(table.TO_ALL | table.TO_MOTOR if motor else table.TO_ALL)),
        ranges=ranges(device.options),
        watchdog=Watchdog(timeout if motor and timeout else None, enabled=motor and timeout > 0),
        holds_unattended=motor and not timeout,
        stop_clears_faults=False,
        faults=table.FAULTS if motor else {},
        parameters=Settings.__slots__ if motor else (),
        configuration=configured(settings) if motor else {},
        stop=(table.encode(device.address, msg.Idle(device.name)),) if motor else (),
    )


plugin = Plugin(
    name=table.NAME,
    title="the project's own messages on a serial line: sensors and motors without a protocol of their own",
    trust="defined here; the bytes of vectors.json are made with msgpack and zlib alone",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(PlainAdapter, spec),
    decoder=PlainDecoder,
    twin=PlainTwin,
    messages=messages,
    vectors=("protocols.plain", "vectors.json"),
)
