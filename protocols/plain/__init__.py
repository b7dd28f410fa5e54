"""Plain: our own words in bytes, for sensors and motors that have no wire of their own.

Rules. The smallest plugin there is, to be read first by whoever writes one. One serial line carries
any number of devices, each with an address of 1 … 255; words travel exactly (see `codec`, `line`).
"""

from __future__ import annotations

from typing import get_args

from protocols.frames import Frame
from protocols.messages import COMMANDS, MILLISECOND, Command, ReadParameter, Request, Scan
from protocols.plain import codec
from protocols.plain.decoder import PlainDecoder
from protocols.plain.driver import OFFLINE, Options, PlainDriver
from protocols.plain.settings import FAULT_TABLE, Settings
from protocols.plain.twin import twin
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog

MEASUREMENTS = ("Imu", "LaserScan", "Fix")
SENSOR_PERIOD = 100 * MILLISECOND
"""Of the slowest sensor that is usual; what a robot waits for is in its own file."""


def messages(frame: Frame) -> tuple[str, ...]:
    """The kinds of the words that whole messages to a device hold."""
    bodies = codec.Stream().feed(frame) if isinstance(frame, bytes) else []
    said = [codec.read(body, 0, "") for body in bodies]
    return tuple(type(word).__name__ for word in said if isinstance(word, Command | Request))


def read_only(frame: Frame) -> bool:
    """Whether these bytes are whole messages that only ask: Scan, ReadParameter."""
    if not isinstance(frame, bytes):
        return False
    stream = codec.Stream()
    bodies = stream.feed(frame)
    whole = sum(len(codec.frame(body)) for body in bodies) == len(frame)
    asked = [codec.read(body, 0, "") for body in bodies]
    return whole and all(isinstance(word, Scan | ReadParameter) for word in asked)


def spec(device: Device) -> Spec:
    """The contract of one plain device. Raises ValueError for an address that it cannot have."""
    if not 1 <= device.address <= 0xFF:
        raise ValueError(f"a plain device has an address of 1 … 255, not {device.address}")
    motor = device.options.kind == "motor"
    settings: Settings = device.settings
    shared: frozenset[type[Request]] = frozenset(get_args(codec.LineRequest))
    own: frozenset[type[Request]] = frozenset(get_args(codec.MotorRequest))
    commands: frozenset[type[Command]] = frozenset(COMMANDS)
    patience = round(settings.watchdog_ms * MILLISECOND)
    return Spec(
        bus="serial",
        kind="motor" if motor else "sensor",
        sends=frozenset(),
        expects=frozenset(),
        read_only=read_only,
        feedback=FeedbackKind.CYCLIC,
        feedback_period=round(settings.feedback_ms * MILLISECOND) if motor else SENSOR_PERIOD,
        offline_after=OFFLINE,
        commands=commands if motor else frozenset(),
        requests=shared | own if motor else shared,
        ranges=_ranges(motor),
        watchdog=Watchdog(patience if motor and patience else None, enabled=motor and patience > 0),
        holds_unattended=motor and not patience,
        stop_clears_faults=False,
        faults=FAULT_TABLE if motor else {},
    )


def _ranges(motor: bool) -> dict[str, Range]:
    """Everything is float64 on the wire: nothing is rounded but what is next to nothing."""
    measured = {name: name.partition(".")[0] in MEASUREMENTS for name in codec.LIMITS}
    return {
        name: Range(low, high, codec.TINY)
        for name, (low, high) in codec.LIMITS.items()
        if measured[name] != motor
    }


plugin = Plugin(
    name=codec.NAME,
    title="our own words in bytes on a serial line: sensors and motors without a wire of their own",
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
