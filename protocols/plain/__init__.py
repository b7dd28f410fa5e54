"""Plain: the project's own messages on a serial line, for sensors and motors without a protocol of their own.

The smallest plugin, and the one to read first before writing another: `codec` frames messages, `decoder`
decodes what devices would obey, `driver` is the host's end, `twin` the device's; this file is the contract
(`Spec`) and the entry point. One serial line carries any number of devices, each with an address of 1 … 255;
numbers are sent exactly. Imports nothing but `protocols`. Exports `plugin`.
"""

from __future__ import annotations

from typing import get_args

from protocols.frames import Frame
from protocols.messages import COMMANDS, MILLISECOND, Command, Message, ReadParameter, Request, Scan
from protocols.plain import codec
from protocols.plain.decoder import PlainDecoder
from protocols.plain.driver import OFFLINE, Options, PlainDriver
from protocols.plain.twin import FAULTS, Settings, twin
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog

__all__ = ["plugin"]

MEASUREMENTS = ("Imu", "LaserScan", "Fix")
SENSOR_PERIOD = 100 * MILLISECOND
"""Period of the slowest usual sensor; the timeout of a robot's sensor is in its robot file."""


def messages(frame: Frame) -> tuple[str, ...]:
    """Return the class names of the commands and requests in a frame, those of whole messages."""
    decoded, _ = _decoded(frame)
    return tuple(type(message).__name__ for message in decoded if isinstance(message, Command | Request))


def read_only(frame: Frame) -> bool:
    """True if a frame consists of whole messages that only read: Scan, ReadParameter."""
    decoded, size = _decoded(frame)
    whole = isinstance(frame, bytes) and size == len(frame)
    return whole and all(isinstance(message, Scan | ReadParameter) for message in decoded)


def _decoded(frame: Frame) -> tuple[list[Message | None], int]:
    """Return the messages in a frame, None for a malformed one, and how many bytes of it they fill."""
    bodies = codec.Stream().feed(frame) if isinstance(frame, bytes) else []
    return [codec.decode(body, 0, "") for body in bodies], sum(len(codec.frame(body)) for body in bodies)


def spec(device: Device) -> Spec:
    """Return the contract of one plain device. Raises ValueError for an address that it cannot have."""
    if not 1 <= device.address <= 0xFF:
        raise ValueError(f"a plain device has an address of 1 … 255, not {device.address}")
    motor = device.options.kind == "motor"
    settings: Settings = device.settings
    shared: frozenset[type[Request]] = frozenset(get_args(codec.BroadcastRequest))
    own: frozenset[type[Request]] = frozenset(get_args(codec.MotorRequest))
    commands: frozenset[type[Command]] = frozenset(COMMANDS)
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
        commands=commands if motor else frozenset(),
        requests=shared | own if motor else shared,
        # Everything is float64 on the line: only what lies below the smallest normal binary32 is rounded.
        ranges={
            name: Range(low, high, codec.TINY)
            for name, (low, high) in codec.LIMITS.items()
            if (name.partition(".")[0] in MEASUREMENTS) != motor
        },
        watchdog=Watchdog(timeout if motor and timeout else None, enabled=motor and timeout > 0),
        holds_unattended=motor and not timeout,
        stop_clears_faults=False,
        faults=FAULTS if motor else {},
    )


plugin = Plugin(
    name=codec.NAME,
    title="the project's own messages on a serial line: sensors and motors without a protocol of their own",
    trust="defined here; the bytes of fixtures/vectors/plain.json are made with msgpack and zlib alone",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=PlainDriver,
    decoder=PlainDecoder,
    twin=twin,
    messages=messages,
    vectors=("gateway.fixtures", "vectors/plain.json"),
)
