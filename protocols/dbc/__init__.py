"""Motors whose CAN messages a file describes (DBC, KCD, SYM, ARXML): the robot file says which signals
command them, and which report (README.md). Exports `plugin`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from protocols import messages as msg
from protocols.dbc.database import messages_of
from protocols.dbc.driver import DbcAdapter
from protocols.dbc.options import Commanded, Faulty, Fed, Feedback, Options, Settings, Told
from protocols.dbc.table import FAULTS, Declared, Memory, declared, memory_of
from protocols.dbc.twin import DbcTwin
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Nanos, Obeyed
from protocols.plugin import CommandDecoder, Device, Driver, FeedbackKind, Plugin, Spec, Watchdog, Written
from protocols.toolkit.assembly import copied
from protocols.toolkit.motor_driver import MotorDriver

__all__ = ["example", "plugin"]

NO_TIMEOUT = (
    "nothing says that the device lets go when its host is silent (timeout_ms = 0): its last command goes on "
    'if this host or its cable fails. State its timeout_ms, or write watchdog = "acknowledged" under options'
)


def nothing(frame: Frame) -> bool:
    """Return False: whatever is sent may move something."""
    return False


def _set_up(of: Declared) -> Written:
    """Return what is sent beside set-points: what is declared, and initial values."""
    found: dict[str, dict[float, None]] = {}
    for message, signal, raw in of.constants():
        initial = of.messages[message].signals[signal].initial
        found.setdefault(f"{message}.{signal}", {}).update({float(raw): None, float(initial): None})
    kinds = [f"{kind.__name__}.{kind.__name__.lower()}" for kind in of.setpoints]
    return {**{name: tuple(values) for name, values in found.items()}, **{name: (name,) for name in kinds}}


def _stops(of: Declared) -> tuple[Frame, ...]:
    """Return the safe command as frames: with two values of its counters, since a device takes none twice."""
    frames: list[Frame] = []
    for count in (0, 1):
        for name, raws in of.idle.items():
            message = of.messages[name]
            count_of = {message.counter: count} if message.counter else {}
            frames.append(message.encode({**raws, **count_of}))
    return tuple(dict.fromkeys(frames))


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises Invalid with all that its file lacks, or contradicts."""
    options: Options = device.options
    of = declared(options, device.address)
    kinds = {*of.setpoints, msg.Idle, *((msg.Hold,) if msg.Position in of.setpoints else ())}
    ranges = {
        f"{kind.__name__}.{kind.__name__.lower()}": one.number.range() for kind, one in of.setpoints.items()
    }
    ranges |= {
        f"Feedback.{name}": one.range(inside=1)
        for name, one in of.fed.items()
        if name != "position" or not options.feedback.within_turn
    }
    timeout = round(options.timeout_ms * MILLISECOND) or None
    note = "" if timeout or options.watchdog == "acknowledged" else NO_TIMEOUT
    return Spec(
        bus="can",
        kind="motor",
        sends=tuple(dict.fromkeys(of.messages[name].ids for name in of.to_device)),
        expects=tuple(dict.fromkeys(of.messages[name].ids for name in of.from_device)),
        read_only=nothing,
        feedback=FeedbackKind.CYCLIC,
        feedback_period=round(options.feedback_ms * MILLISECOND),
        offline_after=round(options.offline_ms * MILLISECOND),
        commands=frozenset(kinds),
        requests=frozenset({msg.ClearFault} if of.clear else ()),
        ranges=ranges,
        watchdog=Watchdog(timeout, timeout is not None, note),
        holds_unattended=timeout is None and msg.Hold in kinds,
        stop_clears_faults=False,
        faults=FAULTS if of.fault else {},
        set_up=_set_up(of),
        stop=_stops(of),
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver of all motors on one bus. ValueError if two contradict each other."""
    commanded: dict[tuple[str, str], str] = {}
    for device in devices:
        for one in declared(device.options, device.address).setpoints.values():
            other = commanded.setdefault((one.number.message, one.number.signal.name), device.name)
            if other != device.name:
                raise ValueError(f"{one.number.key} commands both {other} and {device.name}")
    for device in devices:
        others = [memory_of(each) for each in devices if each is not device]
        for frame in spec(device).stop:
            DbcDecoder(others).decode(0, frame)
        if driven := [each.name for each in others if each.armed]:
            text = (
                f"the stop of {device.name} would command {', '.join(driven)}, by initial values of the file"
            )
            raise ValueError(f"{text} (GenSigStartValue): set them to what idle gives them")
    return MotorDriver(DbcAdapter(devices), devices, {each.name: spec(each).ranges for each in devices})


@dataclass(slots=True)
class DbcDecoder:
    """What the motors of a bus would obey."""

    memories: list[Memory]

    def __deepcopy__(self, memo: dict[int, Any]) -> DbcDecoder:
        return DbcDecoder([copied(each, memo) for each in self.memories])

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the motors would obey in this frame."""
        return [obeyed for each in self.memories for obeyed in each.obey(frame)]


def decoder(devices: Sequence[Device]) -> CommandDecoder:
    """Return what the motors of one bus would obey."""
    return DbcDecoder([memory_of(each) for each in devices])


@cache
def _text() -> str:
    return (files("protocols.dbc") / "example.dbc").read_text("utf-8")


def example() -> Options:
    """Return the options of an invented motor, which the contract tries: its file has four of them."""
    command, motion, status = (f"Motor{{}}_{name}" for name in ("Command", "Motion", "Status"))
    return Options(
        f"example.dbc\n{_text()}",
        position=Commanded(f"{command}.ANGLE", "deg", beside=(f"{command}.MODE = position",)),
        velocity=Commanded(f"{command}.SPEED", "rpm", beside=(f"{command}.MODE = velocity",)),
        torque=Commanded(f"{command}.TORQUE", "N·m", beside=(f"{command}.MODE = torque",)),
        enable=(f"{command}.ENABLE = 1",),
        idle=(f"{command}.ENABLE = 0", f"{command}.MODE = none"),
        clear=("Motor{}_Clear",),
        counters=(f"{command}.COUNTER", f"{status}.COUNTER"),
        checksums=(f"{command}.CHECKSUM = crc8_j1850", f"{status}.CHECKSUM = crc8_autosar"),
        feedback=Feedback(
            position=Fed(f"{motion}.ANGLE", "rad"),
            velocity=Fed(f"{motion}.SPEED", "rpm"),
            current=Fed(f"{motion}.CURRENT", "A"),
            voltage=Fed(f"{status}.VOLTAGE", "V"),
            temperature=Fed(f"{status}.TEMPERATURE", "°C"),
            state=Told(f"{status}.STATE", ("on",), "off"),
            fault=Faulty(f"{status}.FAULT", "none"),
        ),
        timeout_ms=200.0,
    )


def names(frame: Frame) -> Sequence[str]:
    """Return the message of the example in a frame to it: other files are not known here."""
    if not isinstance(frame, CanFrame):
        return ()
    kinds = "_Command", "_Clear"
    found = messages_of("example.dbc", _text()).values()
    return [
        one.name.partition("_")[2]
        for one in found
        if one.id == frame.id
        and not frame.extended
        and one.name.endswith(kinds)
        and one.decode(frame) is not None
    ]


plugin = Plugin(
    name="dbc",
    title="any motor on CAN whose messages a DBC, KCD, SYM or ARXML file describes",
    trust="bits and numbers: cantools 45.1.0, both ways; checksums: crccheck 1.3.1, opendbc 0.3.1; the same "
    "bytes as odrive_can by ODrive's DBC. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=decoder,
    twin=DbcTwin,
    messages=names,
    vectors=("protocols.dbc", "vectors.json"),
    example=example,
)
