"""Conversations of vectors, independent bytes: package canopen 2.4.1 speaks, our end hears and answers.

Rules. A conversation is kept as text, a line for each moment in which something happens. With the driver the
device's frames are those of canopen's LocalNode, behind which `Firmware` moves the statusword; with an axis
(what ear and twin lean on) the host's frames are those of canopen's RemoteNode. `record` makes them anew with
the package; playing them again needs no package. What our end makes of them was read before it was kept.

Run as a program, it writes the file anew: every line that changes is to be understood.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from protocols.cia402 import objects as o
from protocols.cia402 import sdo
from protocols.cia402.axis import Axis
from protocols.cia402.options import Options, Settings
from protocols.conformance.rehearsal import START, STEP
from protocols.plugin import Device
from protocols.wire import BusState, CanFrame
from protocols.words import (
    ClearFault,
    Command,
    Estop,
    Event,
    Hold,
    Home,
    Idle,
    Impedance,
    Position,
    ReadParameter,
    Reboot,
    Request,
    Scan,
    SetId,
    Stop,
    Torque,
    Velocity,
    WriteParameter,
    Zero,
)
from tests.protocols.cia402 import tables

FILE = Path(__file__).parent / "conversations.txt"
NODE = 2
Words = Sequence[Command | Request]
M = "m"


@dataclass(frozen=True, slots=True)
class Script:
    """What is said to the driver, and what becomes of the device."""

    options: Mapping[str, Any] = field(default_factory=dict)
    words: Sequence[tuple[int, int, Words]] = ()
    """From which ms to before which one these words are said."""
    acts: Mapping[int, Callable[[Any], None]] = field(default_factory=dict)
    """By ms, what happens to the `Firmware`; what is at -1 before it is switched on."""
    bus: Mapping[int, BusState] = field(default_factory=dict)
    length: int = 500

    def said(self, ms: int) -> list[Command | Request]:
        """The words of a moment."""
        return [word for first, end, words in self.words if first <= ms < end for word in words]


def _put(key: o.Key, value: int) -> Callable[[Any], None]:
    return lambda firmware: firmware.put(key, value)


def _lacks(*indices: int) -> Callable[[Any], None]:
    def act(firmware: Any) -> None:
        for index in indices:
            firmware.lose(index)

    return act


def _named(name: bytes) -> Callable[[Any], None]:
    def act(firmware: Any) -> None:
        firmware.slave.node.data_store.setdefault(0x1008, {})[0] = name

    return act


def _all(*acts: Callable[[Any], None]) -> Callable[[Any], None]:
    def act(firmware: Any) -> None:
        for each in acts:
            each(firmware)

    return act


def _set(name: str, value: object) -> Callable[[Any], None]:
    return lambda firmware: setattr(firmware, name, value)


_RUNNING = _all(_put(o.STATUSWORD, 0x237), _put(o.CONTROLWORD, 15), _put(o.MODE, 8))
_STOPPED = _all(_put(o.STATUSWORD, 0x217), _put(o.CONTROLWORD, 2), _put(o.MODE, 8))


def _noisy(firmware: Any) -> None:
    """Every vector, whole, cut and lengthened, beside what the device says."""
    firmware.extra = tables.frames()


def _strangers(firmware: Any) -> None:
    firmware.strangers = True


def _beatless(firmware: Any) -> None:
    firmware.beating = False
    firmware.put(o.PRODUCER_HEARTBEAT, 0)


def _usual(tells: int, timer: int, obeys: int) -> Callable[[Any], None]:
    """It comes with PDOs: its state and position, told so, and its set-points, obeyed so."""
    rows = (
        (0x1800, 0x40000182, tells, timer, (0x60410010, 0x60610008, 0x60640020)),
        (0x1801, 0x40000282, tells, timer, (0x606C0020, 0x60770010, 0x603F0010)),
        (0x1400, 0x202, obeys, 0, (0x60400010, 0x60600008, 0x607A0020)),
        (0x1401, 0x302, obeys, 0, (0x60FF0020, 0x60710010)),
    )

    def act(firmware: Any) -> None:
        for index, cob, kind, event, words in rows:
            firmware.put((index, 1), cob)
            firmware.put((index, 2), kind)
            firmware.put((index, 5), event)
            firmware.put((index + 0x200, 0), len(words))
            for sub, word in enumerate(words, 1):
                firmware.put((index + 0x200, sub), word)

    return act


MOVES: tuple[tuple[int, int, Words], ...] = (
    (150, 300, [Hold(M)]),
    (300, 330, [Position(M, -0.5, 0.25, 0.125)]),
    (330, 360, [Velocity(M, -1.5, 0.0625)]),
    (360, 390, [Torque(M, 0.25)]),
    (390, 410, [Hold(M)]),
    (410, 500, [Idle(M)]),
)
ASKED: tuple[tuple[int, int, Words], ...] = (
    (5, 6, [ReadParameter(M, "6064")]),
    (110, 111, [ReadParameter(M, "Profile velocity"), ReadParameter(M, "608F:01"), ReadParameter(M, "1008")]),
    (112, 113, [ReadParameter(M, "5FFF"), ReadParameter(M, "nonsense"), ReadParameter("other", "6064")]),
    (114, 115, [WriteParameter(M, "6083", 12_345.0), WriteParameter(M, "6083", 0.5), SetId("bus", 1, 2)]),
    (
        116,
        117,
        [WriteParameter(M, "6041", 1.0), WriteParameter(M, "6040", 6.0), WriteParameter(M, "1008", 1)],
    ),
    (118, 119, [WriteParameter(M, "1400:01", 1.0), WriteParameter(M, "6098", 300.0)]),
    (
        120,
        121,
        [WriteParameter(M, "60FF", 1.0), WriteParameter(M, "1017", 250.0), WriteParameter(M, "2000", 1)],
    ),
    (122, 123, [WriteParameter(M, "6087", float("nan")), WriteParameter(M, "1A03:08", 1.0), Scan("can0")]),
    (124, 125, [Scan("can0"), ReadParameter(M, "6502"), Home(M), Zero(M)]),
    (130, 131, [WriteParameter(M, "608F:01", 8192.0)]),
    (250, 280, [Impedance(M, 0.0, 0.0, 0.0, 1.0, 1.0)]),
    (280, 290, [Position(M, 1e9)]),
    (290, 300, [Torque(M, float("inf")), Hold("other")]),
    (300, 301, [ReadParameter(M, "1018:04")]),
    (640, 641, [Reboot(M)]),
)
MANY = [ReadParameter(M, "6064") for _ in range(35)]


def _fault(firmware: Any) -> None:
    firmware.fail(0x2310)


SCRIPTS: dict[str, Script] = {
    "sync": Script({}, MOVES, length=520),
    "event": Script({"feedback": "event", "heartbeat_ms": 0}, MOVES, length=520),
    "sdo": Script({"feedback": "sdo", "watchdog_ms": 0}, MOVES, length=520),
    "keep": Script({"mapping": "keep"}, MOVES, length=520),
    "profile": Script({"modes": "profile", "feedback": "sdo"}, MOVES, length=520),
    "profile, by PDO": Script({"modes": "profile", "sync_ms": 5}, MOVES, length=520),
    "somebody else's SYNC": Script({"sync_ms": 0}, MOVES, length=460),
    "position only": Script({}, MOVES, {-1: _put(o.SUPPORTED_MODES, 0x80)}, length=460),
    "no offsets": Script({"feedback": "event"}, MOVES, {-1: _lacks(0x60B1, 0x60B2, 0x6079)}, length=460),
    "units of the robot file": Script(
        {"counts_per_turn": 1000.0, "rated_torque": 0.5, "feedback": "sdo"},
        MOVES,
        {-1: _all(_lacks(0x608F, 0x6091, 0x6092, 0x6076, 0x6075, 0x1008), _put(o.SERIAL_NUMBER, 77))},
        length=460,
    ),
    "no units": Script({}, MOVES[:1], {-1: _lacks(0x608F, 0x6092)}, length=250),
    "another profile": Script({}, MOVES[:1], {-1: _put(o.DEVICE_TYPE, 0x191)}, length=250),
    "a fault": Script(
        {},
        ((150, 420, [Hold(M)]), (420, 421, [ClearFault(M)]), (421, 800, [Hold(M)])),
        {320: _fault, 700: _set("quiet", True)},
        length=1300,
    ),
    "a fault, asked": Script(
        {"feedback": "sdo"},
        ((150, 420, [Velocity(M, 1.0)]), (420, 421, [ClearFault(M)]), (421, 600, [Velocity(M, 1.0)])),
        {320: _all(_fault, _set("stubborn", 2))},
        length=1000,
    ),
    "stop": Script({}, ((150, 320, [Hold(M)]), (320, 321, [Stop()]), (321, 450, [Idle(M)])), length=460),
    "stop of another's": Script({}, ((10, 11, [Stop()]), (11, 400, [Idle(M)])), {-1: _RUNNING}, length=400),
    "another's, left alone": Script(
        {}, ((10, 200, [Idle(M)]), (200, 400, [Hold(M)])), {-1: _RUNNING}, length=400
    ),
    "estop": Script(
        {},
        ((150, 320, [Hold(M)]), (320, 321, [Estop(M)]), (321, 400, [Hold(M)]), (400, 401, [ClearFault(M)])),
        length=560,
    ),
    "a quick stop that holds": Script(
        {},
        ((150, 420, [Hold(M)]),),
        {-1: _all(_STOPPED, _put(o.QUICK_STOP_OPTION, 6))},
        length=420,
    ),
    "a quick stop that ends": Script({}, ((150, 420, [Hold(M)]),), {-1: _STOPPED}, length=420),
    "does not arm": Script(
        {"state_timeout_ms": 150}, ((150, 500, [Hold(M)]),), {-1: _set("deaf", True)}, length=500
    ),
    "does not disarm": Script(
        {}, ((150, 300, [Hold(M)]), (300, 1000, [Idle(M)])), {310: _set("deaf", True)}, length=1000
    ),
    "lost answers": Script(
        {"sdo_timeout_ms": 30},
        ((150, 400, [Hold(M)]),),
        {40: _set("mute", True), 90: _set("mute", False), 160: _set("mute", True), 300: _set("mute", False)},
        length=500,
    ),
    "answers of two": Script(
        {"feedback_ms": 50},
        ((150, 200, [Hold(M)]), (150, 151, [Scan("can0")])),
        {100: _set("twice", True)},
        length=700,
    ),
    "beats of two": Script({}, (), {20: _set("beats", [127, 5, 127, 5, 127])}, length=120),
    "another device": Script({"feedback_ms": 50}, (), {500: _put(o.SERIAL_NUMBER, 99)}, length=1300),
    "restart": Script({}, ((150, 700, [Hold(M)]),), {320: lambda f: f.restart()}, length=700),
    "it stops": Script(
        {}, ((150, 600, [Hold(M)]),), {320: lambda f: f.nmt(2), 450: lambda f: f.nmt(128)}, length=600
    ),
    "the bus": Script(
        {},
        ((150, 800, [Hold(M)]), (242, 243, [Scan("can0"), ReadParameter(M, "6064")])),
        bus={243: BusState.GONE, 260: BusState.BACK, 500: BusState.FULL, 600: BusState.OFF},
        length=800,
    ),
    "asked": Script({}, ASKED, length=900),
    "asked too much": Script({}, ((130, 131, MANY),), length=250),
    "asked, and silence": Script(
        {"sdo_timeout_ms": 50},
        (
            (150, 151, [ReadParameter(M, "6064"), WriteParameter(M, "6083", 1.0)]),
            (152, 153, [Reboot(M), ClearFault(M)]),
        ),
        {150: _set("quiet", True)},
        length=9000,
    ),
    "noise": Script(
        {}, ((150, 400, [Hold(M)]), (250, 251, [Scan("can0")])), {60: _noisy, 240: _noisy}, length=560
    ),
    "noise, asked": Script({"feedback": "sdo"}, ((150, 300, [Velocity(M, 1.0)]),), {60: _noisy}, length=400),
    "strangers": Script(
        {}, ((60, 61, [Scan("can0")]), (700, 701, [Scan("can0")])), {-1: _strangers}, length=1250
    ),
    "nothing of its NMT state": Script(
        {"feedback": "sdo", "mapping": "keep", "heartbeat_ms": 0, "watchdog_ms": 0},
        ((150, 450, [Hold(M)]), (450, 600, [Idle(M)])),
        {-1: _beatless},
        length=620,
    ),
    "its own PDOs, by its timer": Script(
        {"feedback": "event"}, MOVES, {-1: _usual(255, 10, 255)}, length=460
    ),
    "its own PDOs, too slow": Script({"feedback": "event"}, MOVES, {-1: _usual(255, 200, 255)}, length=460),
    "its own PDOs, on change": Script(
        {"feedback": "event"}, MOVES[:2], {-1: _usual(255, 0, 255)}, length=340
    ),
    "its own PDOs, by SYNC": Script({}, MOVES, {-1: _usual(1, 0, 1)}, length=460),
    "its own PDOs, by every second SYNC": Script({"sync_ms": 5}, MOVES, {-1: _usual(2, 0, 255)}, length=460),
    "its own PDOs, of somebody's SYNC": Script({"sync_ms": 0}, MOVES, {-1: _usual(1, 0, 1)}, length=460),
    "its own PDOs, kept": Script(
        {"mapping": "keep", "feedback": "event", "feedback_ms": 20},
        MOVES,
        {-1: _usual(255, 20, 255)},
        length=520,
    ),
    "its own PDOs, profile modes": Script({"modes": "profile"}, MOVES, {-1: _usual(1, 0, 1)}, length=520),
    "its own PDOs, running": Script({}, (), {-1: _all(_usual(255, 10, 255), lambda f: f.nmt(1))}, length=300),
    "slower": Script(
        {
            "feedback": "event",
            "feedback_ms": 25,
            "sync_ms": 7,
            "heartbeat_ms": 50,
            "watchdog_ms": 120,
            "host_id": 99,
        },
        MOVES,
        {-1: _put((0x1800, 1), 0x40000182)},
        length=520,
    ),
    "a fault, cleared before the statusword tells it": Script(
        {},
        ((150, 321, [Hold(M)]), (321, 322, [ClearFault(M)]), (322, 440, [Hold(M)])),
        {321: _fault},
        length=440,
    ),
    "a fault, cleared before it is asked": Script(
        {"feedback": "sdo"},
        ((150, 321, [Hold(M)]), (321, 322, [ClearFault(M)]), (322, 440, [Hold(M)])),
        {321: _fault},
        length=440,
    ),
    "a fault while it is disarmed": Script(
        {}, ((150, 400, [Hold(M)]), (400, 520, [Idle(M)])), {401: _fault}, length=520
    ),
    "a fault while it is disarmed, asked": Script(
        {"feedback": "sdo"}, ((150, 400, [Hold(M)]), (400, 520, [Idle(M)])), {401: _fault}, length=520
    ),
    "cleared again and again, unanswered": Script(
        {"sdo_timeout_ms": 700},
        ((150, 300, [Hold(M)]), (350, 351, [ClearFault(M)]), (600, 601, [ClearFault(M)])),
        {320: _all(_fault, _set("stubborn", 9)), 349: _set("mute", True), 1800: _set("mute", False)},
        length=3700,
    ),
    "stopped while it is cleared": Script(
        {"feedback": "sdo"},
        (
            (150, 300, [Hold(M)]),
            (350, 351, [ClearFault(M)]),
            (352, 353, [Estop(M)]),
            (353, 400, [Idle(M)]),
            (400, 401, [ClearFault(M)]),
        ),
        {320: _all(_fault, _set("stubborn", 2))},
        length=1000,
    ),
    "without a name, looked for": Script({}, ((124, 125, [Scan("can0")]),), {-1: _lacks(0x1008)}, length=700),
    "a name of a fixed length, looked for": Script(
        {}, ((124, 125, [Scan("can0")]),), {-1: _named(b" drive 7 \0\0\0")}, length=700
    ),
    "looked for twice": Script(
        {}, ((60, 61, [Scan("can0")]), (70, 71, [Scan("can0")]), (700, 701, [Scan("can0")])), length=1400
    ),
    "the mode does not come": Script(
        {"state_timeout_ms": 120},
        ((150, 320, [Hold(M)]), (320, 500, [Velocity(M, 1.0)]), (500, 520, [Idle(M)])),
        {319: _set("deaf", True)},
        length=520,
    ),
    "stopped, and armed again": Script(
        {},
        ((150, 300, [Hold(M)]), (300, 301, [Idle(M)]), (301, 500, [Hold(M)])),
        {300: lambda f: f.nmt(2)},
        length=500,
    ),
    "still in fault": Script(
        {"feedback_ms": 50, "feedback": "sdo"},
        ((200, 201, [ClearFault(M)]),),
        {80: _all(_fault, _set("stubborn", 9))},
        length=3300,
    ),
    "no acknowledgement": Script(
        {"modes": "profile", "feedback": "sdo"},
        ((150, 250, [Hold(M)]), (250, 900, [Position(M, 1.0)]), (900, 1000, [Position(M, -1.0)])),
        {240: _set("acknowledges", False), 700: _set("acknowledges", True)},
        length=1000,
    ),
    "no acknowledgement by PDO": Script(
        {"modes": "profile"},
        ((150, 250, [Hold(M)]), (250, 700, [Position(M, 1.0)]), (700, 720, [Position(M, -1.0)])),
        {240: _set("acknowledges", False), 600: _set("acknowledges", True)},
        length=720,
    ),
    "no device type": Script({}, MOVES[:1], {-1: _lacks(0x1000)}, length=250),
    "no serial number": Script({"feedback_ms": 100}, (), {-1: _lacks(0x1018)}, length=1200),
    "cleared after an emergency stop": Script(
        {"feedback": "sdo", "mapping": "keep"},
        (
            (150, 300, [Velocity(M, 1.0)]),
            (300, 301, [Estop(M)]),
            (301, 420, [Velocity(M, 1.0)]),
            (420, 421, [ClearFault(M)]),
            (421, 500, [Velocity(M, 1.0)]),
        ),
        length=500,
    ),
    "reboot while armed": Script({}, ((150, 400, [Hold(M)]), (350, 351, [Reboot(M)])), length=420),
    "home": Script({}, ((150, 500, [Hold(M)]), (350, 351, [Home(M)]), (360, 361, [Home(M)])), length=520),
    "home by SDO": Script(
        {"feedback": "sdo", "mapping": "keep"}, ((150, 500, [Hold(M)]), (350, 351, [Home(M)])), length=520
    ),
    "home fails": Script(
        {}, ((150, 500, [Hold(M)]), (350, 351, [Home(M)])), {-1: _set("homes", False)}, length=520
    ),
    "home never ends": Script(
        {"home_timeout_ms": 100},
        ((150, 600, [Hold(M)]), (350, 351, [Home(M)])),
        {-1: _set("homes", None)},
        length=700,
    ),
    "home is left": Script(
        {},
        ((150, 360, [Hold(M)]), (350, 351, [Home(M)]), (360, 500, [Idle(M)])),
        {-1: _set("homes", None)},
        length=520,
    ),
    "zero": Script({}, ((150, 600, [Hold(M)]), (350, 351, [Zero(M)])), length=620),
    "zero, the older number": Script(
        {},
        ((150, 600, [Hold(M)]), (350, 351, [Zero(M)])),
        {-1: _set("refused", {(0x6098, 37): 0x06090030})},
        length=620,
    ),
    "no zero": Script({}, ((150, 600, [Hold(M)]), (350, 351, [Zero(M)])), {-1: _lacks(0x6098)}, length=520),
    "PDOs cannot be written": Script(
        {}, MOVES, {-1: _set("refused", {(0x1400, None): 0x06010002, (0x1801, None): 0x06010002})}, length=460
    ),
    "the watchdog cannot be written": Script(
        {}, MOVES[:1], {-1: _set("refused", {(0x1016, None): 0x06020000})}, length=300
    ),
    "the heartbeat cannot be written": Script(
        {"feedback": "event"}, MOVES[:2], {-1: _set("refused", {(0x1017, None): 0x06020000})}, length=340
    ),
}


# -- playing ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Line:
    """A moment of a conversation with the driver."""

    ms: int
    up: tuple[str, ...]
    """What the device said."""
    down: tuple[str, ...] = ()
    due: int | None = None
    """ms from now; -1 at once, None never."""
    events: tuple[str, ...] = ()

    def __str__(self) -> str:
        parts = (str(self.ms), " ".join(self.up), " ".join(self.down), str(self.due), " ; ".join(self.events))
        return " | ".join(parts)


def frame_of(text: str) -> CanFrame:
    """A frame in candump's notation."""
    head, _, data = text.partition("#")
    return CanFrame(int(head, 16), bytes.fromhex(data))


def play(script: Script, up: Callable[[int, Sequence[str]], Sequence[CanFrame]]) -> Iterator[Line]:
    """The driver's side of a conversation. `up`: what the device says at a ms, after what it heard before."""
    from protocols.cia402 import plugin

    driver = plugin.driver([Device(M, NODE, Options(**script.options), Settings())])
    down: tuple[str, ...] = ()
    due: int | None = None
    for ms in range(script.length):
        now = START + ms * STEP
        if ms in script.bus:
            driver.bus(now, script.bus[ms])
        frames = up(ms, down)
        events = [event for frame in frames for event in driver.receive(now, frame)]
        told, wires = driver.send(now, script.said(ms))
        down = tuple(map(str, wires))
        before, at = due, driver.due()
        due = None if at is None else max((at - now) // STEP, -1) + ms
        heard = tuple(map(_plain, [*events, *told]))
        line = Line(ms, tuple(map(str, frames)), down, None if due is None else due - ms, heard)
        if line.up or line.down or line.events or due != before:
            yield line
    tally = driver.tally
    yield Line(script.length, (), events=(f"{tally.heard} heard, {tally.bad} bad, {tally.foreign} foreign",))


def _plain(event: Event) -> str:
    """An event in short: what it is, and its values, but for the motor's name and the time."""
    values = [getattr(event, name) for name in event.__slots__ if name not in ("motor", "t")]
    late = (event.t - START) // STEP
    said = " ".join("-" if value is None else f"{value}" for value in values)
    return f"{type(event).__name__} {said} @{late}"


def kept() -> dict[str, list[str]]:
    """The file: the lines of each conversation."""
    found: dict[str, list[str]] = {}
    for line in FILE.read_text("utf-8").splitlines():
        if line.startswith("== "):
            lines = found[line[3:]] = []
        else:
            lines.append(line)
    return found


def again(script: Script, lines: Sequence[str]) -> list[str]:
    """Our end of a kept conversation, as it is now."""
    said = {int(line.split(" | ")[0]): line.split(" | ")[1].split() for line in lines}
    return [str(line) for line in play(script, lambda ms, _: [frame_of(text) for text in said.get(ms, ())])]


# -- what ear and twin obey -----------------------------------------------------------------------------


def obeyed(frames: Sequence[CanFrame], name: str) -> list[str]:
    """What an axis makes of frames: words, and where it stands."""
    settings = Settings(pdos="usual") if "usual" in name else Settings()
    axis = Axis(Device(M, NODE, Options(), settings), instant=name.endswith("ear"))
    axis.position = 1000
    lines = []
    for at, frame in enumerate(frames):
        words = axis.hear(START + at * STEP, frame)
        answers = [sdo.encode(answer).hex() for answer in axis.answers]
        stands = (
            axis.nmt.name,
            axis.state.name,
            axis.mode.name,
            axis.goal,
            axis.next_goal,
            axis.acknowledged,
        )
        signals = [signal.name for signal in axis.signals]
        axis.answers.clear()
        axis.signals.clear()
        rest = f"{signals} {axis.host_beat} {axis.homing_asked}"
        lines.append(f"{frame} | {list(words)} | {answers} | {stands} | {rest}")
    return lines
