"""A conversation of vectors: drives of package canopen (`firmware`), the driver, and an expected transcript.

Rules. The driver's frames are decoded with canopen's dictionary, constants and PDO maps; this project's codec
has no part in it. Virtual time in ms. A conversation has chapters; a chapter is a number of ms with the same
commands, and the frames and events expected in it, in this order:

    12..20 write 6060 = 9       SDO download; only between 12 and 20 ms after the chapter's beginning
    rpdo1 6040=000F 607A=-5 …   repeated any number of times; "×3": three times; "/10": every 10 ms
    rpdo1 6040=0006 /50 until 400..460      the last time then; else it goes on to the chapter's end
    nmt OPERATIONAL 2           with the node's number
    < Fault 2310 *              an event; "*" stands for anything

The same value sent again to the same object (or by the same RPDO) is one line, at its first time. These have
no place in the order: SYNC and the host's heartbeat ("sync /10, beat ?"; "?": any); and, compared only where
they are given, an RPDO that goes on as before the chapter ("still rpdo1 …"), uploads ("reads"; "asks" for
polled feedback), and the last measurements ("measures").
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

from canopen.nmt import NMT_COMMANDS, NMT_STATES
from canopen.objectdictionary import ODVariable
from canopen.sdo import constants as sdo

from protocols.cia402 import plugin
from protocols.cia402.options import Options, Settings
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, Command, Event, Feedback, Found, Hold, Request
from protocols.plugin import Device, Driver
from tests.protocols.cia402.firmware import Drive
from tests.protocols.cia402.stack import dictionary

BEGIN = 1_000_000
"""ms: the clock's zero lies anywhere."""
FEEDBACK = ("6041", "6061", "6064", "606C", "6077", "6078", "6079")
HEX = (0x6040, 0x6041, 0x1016)
"""Objects of bits."""
NMT = {number: name for name, number in NMT_COMMANDS.items()}
DICTIONARY = dictionary(1)
SUMMED = ("still", "reads", "asks", "sync", "beat", "measures")


# -- the driver's frames, decoded with canopen ---------------------------------------------------------------


def title(index: int, sub: int) -> str:
    """Return an object's address: 6041, 608F:01."""
    return f"{index:04X}:{sub:02X}" if sub else f"{index:04X}"


def number(index: int, sub: int, data: bytes) -> str:
    """Return a value as canopen's dictionary decodes it."""
    found = DICTIONARY.indices.get(index)
    variable = found if found is None or isinstance(found, ODVariable) else found[sub]
    value = int.from_bytes(data, "little") if variable is None else int(variable.decode_raw(data))
    bits = index in HEX or (0x1400 <= index < 0x1C00 and len(data) == 4)
    return f"{value:0{2 * len(data)}X}" if bits else str(value)


def _sdo(data: bytes) -> str:
    command, index, sub = sdo.SDO_STRUCT.unpack_from(data)
    name = title(index, sub)
    match command & 0xE0:
        case sdo.REQUEST_UPLOAD if data[4:] == bytes(4):
            return f"read {name}"
        case sdo.REQUEST_SEGMENT_UPLOAD:
            return "read on"
        case sdo.REQUEST_DOWNLOAD if command & sdo.EXPEDITED:
            size = 4 - (command >> 2 & 3) if command & sdo.SIZE_SPECIFIED else 4
            return f"write {name} = {number(index, sub, data[4 : 4 + size])}"
    return f"sdo {data.hex()}"


def meaning(frame: CanFrame, drives: Sequence[Drive]) -> tuple[str, str]:
    """Return (subject, text) of a frame: one text replaces another with the same subject."""
    function, node = frame.id & ~0x7F, frame.id & 0x7F
    own = "" if [node] == [drive.node for drive in drives] else f"{node}: "
    if frame.id == 0 and len(frame.data) == 2:
        return "nmt", f"nmt {NMT[frame.data[0]]} {frame.data[1]}"
    if frame.id == 0x80 and not frame.data:
        return "sync", "sync"
    if function == 0x700 and len(frame.data) == 1:
        return "beat", f"beat {node} {NMT_STATES[frame.data[0]]}"
    if function == 0x600 and len(frame.data) == 8:
        said = _sdo(frame.data)
        return f"{own}{said.partition(' =')[0]}", own + said
    for drive in drives:
        pdo = drive.rpdo(frame.id)
        if pdo is not None and len(frame.data) == sum(len(v.get_data()) for v in pdo.map):
            at, said = 0, f"{own}rpdo{(frame.id >> 8) - 1}"
            for variable in pdo.map:
                size = len(variable.get_data())
                reported = number(variable.index, variable.subindex, frame.data[at : at + size])
                said, at = f"{said} {title(variable.index, variable.subindex)}={reported}", at + size
            return said.partition(" 6")[0], said
    return str(frame), str(frame)


def configured(index: int, cob: int, kind: int, *entries: int, timer: int = 0) -> str:
    """Return the lines of a PDO that is written, in the order of `PdoMap.save()` of the package.

    The event timer [ms] of a TPDO comes with an inhibit time as long, which counts 100 µs."""
    mapped = index + 0x200
    lines = [f"write {index:04X}:01 = {cob | 1 << 31:08X}", f"write {index:04X}:02 = {kind}"]
    lines += [f"write {index:04X}:03 = {10 * timer}", f"write {index:04X}:05 = {timer}"] if timer else []
    lines.append(f"write {mapped:04X} = 0")
    lines += [f"write {mapped:04X}:{sub:02X} = {entry:08X}" for sub, entry in enumerate(entries, 1)]
    lines += [f"write {mapped:04X} = {len(entries)}", f"write {index:04X}:01 = {cob:08X}"]
    return "\n".join(lines)


# -- the transcript ---------------------------------------------------------------------------------------


@dataclass
class Run:
    """The same text at these times [ms of the chapter]."""

    text: str
    times: list[int]

    def line(self, end: int) -> str:
        """Return its line in a transcript."""
        gaps = sorted(self.gaps())
        if not gaps:
            return f"{self.times[0]} {self.text}"
        step = f"/{gaps[0]}" if gaps[0] == gaps[-1] else f"/{gaps[0]}..{gaps[-1]}"
        until = f" until {self.times[-1]}" if self.ended(end) else ""
        return f"{self.times[0]} {self.text} {step} ×{len(self.times)}{until}"

    def gaps(self) -> list[int]:
        """Return the times between one and the next."""
        return [late - soon for soon, late in pairwise(self.times)]

    def ended(self, end: int) -> bool:
        """True if it was due once more before the chapter's end."""
        return bool(self.gaps()) and self.times[-1] + max(self.gaps()) < end


_LINE = re.compile(
    r"(?:(?P<first>\d+)(?:\.\.(?P<last>\d+))? )?(?P<text>.*?)"
    r"(?: (?P<any>…)| /(?P<low>\d+)(?:\.\.(?P<high>\d+))?| ×(?P<count>\d+))?"
    r"(?: until (?P<end>\d+)(?:\.\.(?P<ends>\d+))?)?"
)


_READ = re.compile(r"(?P<own>(?:\d+:)?) ?read (?P<name>\S+)")


def _periodic(line: str) -> list[str]:
    """Split "sync /10, beat ?"."""
    return line.split(", ") if line.startswith("sync ") else [line]


def _within(value: int, low: str | None, high: str | None) -> bool:
    return low is None or int(low) <= value <= int(high or low)


def fits(line: str, run: Run, end: int) -> bool:
    """True if a line of the expectation matches."""
    found = _LINE.fullmatch(line)
    if found is None:
        return False
    wanted = ".*".join(re.escape(part) for part in found["text"].split("*"))
    if not re.fullmatch(wanted, run.text) or not _within(run.times[0], found["first"], found["last"]):
        return False
    if found["low"] and not all(_within(gap, found["low"], found["high"]) for gap in run.gaps()):
        return False
    if found["count"] and len(run.times) != int(found["count"]):
        return False
    if not (found["any"] or found["low"] or found["count"]) and len(run.times) > 1:
        return False
    if found["end"]:
        return _within(run.times[-1], found["end"], found["ends"])
    return bool(found["any"] or found["count"]) or not run.ended(end)


# -- the conversation ---------------------------------------------------------------------------------------


class Talk:
    """The driver on a bus with drives."""

    def __init__(self, *drives: Drive, names: Sequence[str] = ("m", "n", "p"), **options: Any) -> None:
        self.drives = drives or (Drive(),)
        devices = [
            Device(name, drive.node, Options(**options), Settings())
            for name, drive in zip(names, self.drives, strict=False)
        ]
        self.driver: Driver = plugin.driver(devices)
        self.every = 10
        """ms between calls of `send`, besides those that are due."""
        self.now = BEGIN
        self.frames: list[tuple[int, CanFrame]] = []
        """All frames of the driver, with their time since the beginning."""
        self.events: list[Event] = []
        self.frame_count = 0
        """Frames that the driver has received."""
        self._runs: list[Run] = []
        self._latest: dict[str, Run] = {}
        self._asked: set[str] = set()
        self._read: set[str] = set()
        self._measured: dict[str, str] = {}
        self._began = self.now
        self._before: dict[str, str] = {}
        """The last text of each RPDO before this chapter."""

    @property
    def drive(self) -> Drive:
        """The first drive."""
        return self.drives[0]

    def chapter(self, ms: int, *words: Command | Request, expected: str | None = None) -> None:
        """Run for this time. Commands are repeated in each step, requests are in the first one."""
        self._before |= {about: run.text for about, run in self._latest.items() if "rpdo" in about}
        self._runs, self._latest, self._began = [], {}, self.now
        self._asked, self._read, self._measured = set(), set(), {}
        requests = [word for word in words if not isinstance(word, Command)]
        commands = [word for word in words if isinstance(word, Command)]
        for at in range(ms):
            self._millisecond([*requests, *commands] if at == 0 else commands, at == 0)
        if expected is not None:
            lines = [line.strip() for line in expected.splitlines()]
            self._compare([part for line in lines for part in _periodic(line)], ms)

    def bus(self, state: BusState) -> None:
        """Let the bus change."""
        self.driver.bus(self.now * MILLISECOND, state)

    def handle(self, *frames: CanFrame) -> None:
        """Put frames on the bus, from any sender."""
        for frame in frames:
            self.frame_count += 1
            self._reported(self.driver.receive(self.now * MILLISECOND, frame))

    def _millisecond(self, words: Sequence[Command | Request], first: bool) -> None:
        at = self.now * MILLISECOND
        for drive in self.drives:
            self.handle(*drive.speak(self.now - BEGIN))
        due = self.driver.due()
        if first or self.now % self.every == 0 or (due is not None and due <= at):
            events, frames = self.driver.send(at, words)
            self._reported(events)
            for frame in frames:
                assert isinstance(frame, CanFrame)
                self._on_sent(frame)
        self.now += 1

    def _on_sent(self, frame: CanFrame) -> None:
        self.frames.append((self.now - BEGIN, frame))
        about, text = meaning(frame, self.drives)
        for drive in self.drives:
            drive.handle(frame)
        read = _READ.fullmatch(text)
        if read is None:
            self._note(about, text)
        elif read["name"] in FEEDBACK:
            self._asked.add(read["own"] + read["name"])
        else:
            self._read.add(read["own"] + read["name"])

    def _reported(self, events: Iterable[Event]) -> None:
        for event in events:
            self.events.append(event)
            assert getattr(event, "protocol", "cia402") == "cia402", event
            assert event.t == self.now * MILLISECOND, event
            if isinstance(event, Feedback):
                own = f"{event.motor}." if len(self.drives) > 1 else ""
                reported = [(f.name, getattr(event, f.name)) for f in fields(event)[2:]]
                self._measured |= {
                    f"{own}{name}": f"{value:.5g}" for name, value in reported if value is not None
                }
            else:
                self._note("", f"< {_event(event, len(self.drives) > 1)}")

    def _note(self, about: str, text: str) -> None:
        run = self._latest.get(about)
        if run is None or run.text != text or not about:
            run = self._latest[about] = Run(text, [])
            self._runs.append(run)
        run.times.append(self.now - self._began)

    def _ordered(self) -> list[Run]:
        """Return what has its place in the order: not RPDOs that go on as before."""
        reported: set[str] = set()
        runs = []
        for run in self._runs:
            about = run.text.partition(" 6")[0]
            if run.text.split()[0] not in SUMMED and (
                about in reported or run.text != self._before.get(about)
            ):
                runs.append(run)
            reported.add(about)
        return runs

    def runs(self) -> list[Run]:
        """Return the frames and events of this chapter."""
        return list(self._runs)

    # -- comparing ----------------------------------------------------------------------------------

    def transcript(self, end: int) -> list[str]:
        """Return the chapter's transcript."""
        summed = [("reads", self._read), ("asks", self._asked)]
        lines = [f"{name} {' '.join(sorted(reported))}" for name, reported in summed if reported]
        measured = " ".join(f"{name}={value}" for name, value in sorted(self._measured.items()))
        return [
            *(run.line(end) for run in self._runs),
            *lines,
            *([f"measures {measured}"] if measured else []),
        ]

    def _compare(self, wanted: Sequence[str], end: int) -> None:
        got = "\n".join(self.transcript(end))
        orderly = [line for line in wanted if line and line.split()[0] not in SUMMED]
        runs = self._ordered()
        for line, run in zip(orderly, runs, strict=False):
            assert fits(line, run, end), f"{line!r} is not {run.line(end)!r}\n{got}"
        rest = orderly[len(runs) :] or [run.line(end) for run in runs[len(orderly) :]]
        assert len(orderly) == len(runs), f"{len(orderly)} lines, and {len(runs)}: {rest}\n{got}"
        still = [run for run in self._runs if run not in runs]
        for line in [line.removeprefix("still ") for line in wanted if line.startswith("still ")]:
            assert any(fits(line, run, end) for run in still), f"not still {line!r}\n{got}"
        for name in ("sync", "beat"):
            lines = [line for line in wanted if line.split()[:1] == [name]]
            if lines == [f"{name} ?"]:
                continue
            reported = [run for run in self._runs if run.text.split()[0] == name]
            agree = len(lines) == len(reported) and all(map(fits, lines, reported, [end] * len(reported)))
            assert agree, f"{lines} is not {[run.line(end) for run in reported]}\n{got}"
        for line in wanted:
            name, _, rest_of = line.partition(" ")
            known = {"reads": self._read, "asks": self._asked}.get(name)
            assert known is None or known == set(rest_of.split()), f"{line}\n{got}"
            for part in rest_of.split() if name == "measures" else ():
                field_, _, value = part.partition("=")
                assert self._measured.get(field_) == value, f"{part}\n{got}"


# -- what many conversations share --------------------------------------------------------------------------

RPDO1 = (0x60400010, 0x60600008, 0x607A0020)
RPDO2 = (0x60FF0020, 0x60710010, 0x60B20010)
RPDO3 = (0x60B10020,)
TPDO1 = (0x60410010, 0x60610008, 0x60640020)
TPDO2 = (0x606C0020, 0x60770010, 0x603F0010)
TPDO3 = (0x60780010, 0x60790020)
"""The mappings that the driver writes, by the README: index, subindex, bits."""
WRITTEN_FOR_SYNC = "\n".join(
    (
        configured(0x1800, 0x40000182, 1, *TPDO1),
        configured(0x1801, 0x40000282, 1, *TPDO2),
        configured(0x1802, 0x40000382, 10, *TPDO3),
    )
)
"""The feedback: with SYNC, the last with every tenth."""
CONFIGURED = "\n".join(
    (
        configured(0x1400, 0x202, 1, *RPDO1),
        configured(0x1401, 0x302, 1, *RPDO2),
        configured(0x1402, 0x402, 1, *RPDO3),
        WRITTEN_FOR_SYNC,
        "write 1016:01 = 007F01F4",
    )
)
"""All of them; 1016: node 127 (7F), 500 ms (1F4)."""
READS = (
    "reads 1000 1008 1017 1018:01 1018:02 1018:03 1018:04 603F 605A 6075 6076 608F:01 608F:02"
    " 6091:01 6091:02 6092:01 6092:02 60B1 60B2 6502 on"
)
"""What is read at the start, without the PDOs; 1008 in segments: "on"."""
STARTED = "nmt OPERATIONAL 2\nrpdo2 60FF=0 6071=0 60B2=0 …\nrpdo3 60B1=0 …"
CLEARED = """write 6040 = 0000
write 6040 = 0080
< State ready SWITCH ON DISABLED
< Done ClearFault m"""
HOMING = """rpdo1 6040=000F 6060=6 607A=4096 …
< State armed OPERATION ENABLED, homing
rpdo1 6040=001F 6060=6 607A=4096 …"""
ARMED_BY_SDO = """write 607A = 4096 …
write 6060 = 8
write 6040 = 0006
< State ready READY TO SWITCH ON
write 6040 = 0007
< State ready SWITCHED ON
write 6040 = 000F
< State armed OPERATION ENABLED, cyclic synchronous position"""
MODES = {1: "profile position", 8: "cyclic synchronous position", 9: "cyclic synchronous velocity"}


def held_at(position: int, mode: int = 8, last: str = "…") -> str:
    """Return the lines of a drive that is enabled in a mode, at a position."""
    armed = f"< State armed OPERATION ENABLED, {MODES[mode]}"
    return f"rpdo1 6040=000F 6060={mode} 607A={position} {last}\n{armed}"


def arming(position: int = 4096, mode: int = 8, last: str = "…") -> str:
    """Return the lines of arming by RPDO1, whose other RPDOs go on as before."""
    ready = f"rpdo1 6040=0006 6060={mode} 607A={position} …\n< State ready READY TO SWITCH ON"
    switched_on = f"rpdo1 6040=0007 6060={mode} 607A={position} …\n< State ready SWITCHED ON"
    return f"{ready}\n{switched_on}\n{held_at(position, mode, last)}"


ARMED = arming()


def up(talk: Talk, ms: int = 100) -> Talk:
    """Let the drives start, and the driver read them."""
    talk.chapter(ms)
    return talk


NEVER = 10**12


def lazy(*drives: Drive, **options: Any) -> Talk:
    """Return a talk whose host calls the driver only when it is due, and at the beginning of a chapter."""
    talk = Talk(*drives, **options)
    talk.every = NEVER
    return talk


def armed(talk: Talk, *commands: Command) -> Talk:
    """Let it start, and arm it by these commands."""
    up(talk).chapter(300, *(commands or (Hold("m"),)))
    assert talk.drive.state == "OPERATION ENABLED", talk.transcript(300)
    return talk


def _event(event: Event, several: bool) -> str:
    """Return an event in short: its kind and its values, without the time and the texts for people."""
    left = ("t", "cause", "remedy", "protocol") + (() if several else ("motor",))
    values = [(f.name, getattr(event, f.name)) for f in fields(event) if f.name not in left]
    said = [type(event).__name__]
    for name, value in values:
        if name == "duplicate_address" and isinstance(event, Found):
            said += ["duplicate_address"] if value else []
        elif name == "code":
            said.append(f"{value:04X}")
        else:
            said.append(f"{value:g}" if isinstance(value, float) else str(value))
    return " ".join(part for part in said if part)
