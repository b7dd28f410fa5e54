"""A conversation of vectors: what devices say, encoded by cantools from the vendor's DBC, and what it means.

Rules. The device's frames come from the DBCs of package odrive-can 2.1.0 by cantools, what our driver says is
read with the same; our codec has no part in it. Virtual time in ms. A transcript has a line for each change:
"t > frames" of one call of `send`, in their order ("…t2/dt": said again every dt ms until then, "-": nothing
to say), "t < event" with its fields (its time only where it is not now). A measurement is told when it
changes.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import groupby
from typing import Any

from odrive_can.utils import get_dbc

from protocols.odrive_can import RANGES
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.options import Options, Settings
from protocols.plugin import Device
from protocols.wire import BusState, CanFrame
from protocols.words import MILLISECOND, Command, Event, Feedback, Request

DBCS = {"0.5": get_dbc("odrive-cansimple-0.5.6"), "0.6": get_dbc("odrive-cansimple-0.6.10")}
MESSAGES: dict[str, dict[str, Any]] = {
    line: {m.name[6:]: m for m in dbc.messages if m.name.startswith("Axis3_")} for line, dbc in DBCS.items()
}
"""By firmware line and name: the messages of the DBC."""
BY_CMD = {line: {m.frame_id & 0x1F: m for m in table.values()} for line, table in MESSAGES.items()}
ADDRESS = 0x06
"""Assigning a node id is not in the DBC, and shown as bytes."""


def frame(name: str, line: str = "0.6", node: int = 3, extended: bool = False, **signals: float) -> CanFrame:
    """A message as cantools encodes it; a signal that is not named is 0."""
    return _frame(name, line, node, extended, tuple(signals.items()))


@cache
def _frame(
    name: str, line: str, node: int, extended: bool, signals: tuple[tuple[str, float], ...]
) -> CanFrame:
    message = MESSAGES[line][name]
    data = message.encode({s.name: 0 for s in message.signals} | dict(signals), scaling=True, strict=True)
    return CanFrame(node << 5 | message.frame_id & 0x1F, data, extended)


@cache
def meaning(wire: CanFrame, line: str = "0.6") -> str:
    """A frame as cantools reads it: node, name, values."""
    node, cmd = f"{'x' if wire.extended else ''}{wire.id >> 5}", wire.id & 0x1F
    message = BY_CMD[line].get(cmd)
    if wire.remote:
        return f"{node}?{message.name[6:] if message else hex(cmd)}"
    if message is None or cmd == ADDRESS:
        return f"{node}:{cmd:#04x} {wire.data.hex()}".rstrip()
    values = message.decode(wire.data, decode_choices=False)
    return " ".join([f"{node}:{message.name[6:]}", *(f"{value:g}" for value in values.values())])


def device(name: str = "left", address: int = 3, **options: Any) -> Device:
    """A device of the robot file."""
    return Device(name, address, Options(**options), Settings())


@dataclass
class Run:
    """The same said again and again."""

    text: str
    first: int
    last: int
    step: int = 0

    def __str__(self) -> str:
        return f"{self.first}{f'…{self.last}/{self.step}' if self.step else ''} > {self.text}"


@dataclass
class Talk:
    """The driver among devices that say what the test has them say."""

    devices: Sequence[Device]
    line: str = "0.6"
    """In which what the driver says is read, and what devices say is written."""
    every: int = 10
    """ms between calls of `send`, besides those that are due; 0: only those."""
    now: int = 0
    cyclic: dict[tuple[str, int], tuple[int, dict[str, Any]]] = field(default_factory=dict)
    """By name and node: every so many ms this is said."""
    answers: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)
    """By name and node: what is answered, 1 ms after it is asked for."""
    words: tuple[Command, ...] = ()
    lines: list[tuple[int, Run | str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.driver = OdriveDriver(self.devices, RANGES)
        self._spoken: Run | None = None
        self._measured: dict[tuple[str, tuple[bool, ...]], str] = {}
        self._coming: list[CanFrame] = []

    # -- the devices ---------------------------------------------------------------------------

    def cycle(self, period: int, name: str, node: int = 3, **signals: float) -> None:
        """From now on a device says this every `period` ms, and now; 0: no more."""
        self.cyclic[name, node] = (period, signals)

    def beat(self, state: int = 1, error: int = 0, node: int = 3, **signals: float) -> None:
        """From now on heartbeats every 100 ms say this."""
        self.cycle(100, "Heartbeat", node, Axis_State=state, Axis_Error=error, **signals)

    def place(self, position: float = 0.0, velocity: float = 0.0, node: int = 3) -> None:
        """From now on estimates every 10 ms say this."""
        self.cycle(10, "Get_Encoder_Estimates", node, Pos_Estimate=position, Vel_Estimate=velocity)

    def answer(self, name: str, node: int = 3, **signals: float) -> None:
        """From now on this is answered."""
        self.answers[name, node] = signals

    def version(self, node: int = 3, minor: int = 6) -> None:
        """From now on Get_Version is answered."""
        self.answer("Get_Version", node, Protocol_Version=2, Fw_Version_Minor=minor, Fw_Version_Revision=10)

    def up(self, node: int = 3) -> None:
        """A device of 0.6.x that stands still."""
        self.version(node)
        self.beat(node=node)
        self.place(node=node)

    def tell(self, name: str, node: int = 3, extended: bool = False, **signals: float) -> None:
        """A device says this now, once."""
        self.hear(frame(name, self.line, node, extended, **signals))

    def hear(self, *wires: CanFrame) -> None:
        """These frames come now."""
        for wire in wires:
            self._told(self.driver.receive(self.now * MILLISECOND, wire))

    def mute(self, node: int = 3) -> None:
        """From now on a device says nothing."""
        for table in (self.cyclic, self.answers):
            for key in [key for key in table if key[1] == node]:
                del table[key]

    # -- the host ------------------------------------------------------------------------------

    def run(self, ms: int, *words: Command) -> None:
        """So many ms with these words in every step."""
        for _ in range(ms):
            self._millisecond(words)

    def ask(self, *requests: Request | Command) -> None:
        """Say these now."""
        self._send(requests)

    def bus(self, state: BusState) -> None:
        """The bus changes."""
        self.driver.bus(self.now * MILLISECOND, state)

    def _millisecond(self, words: tuple[Command, ...]) -> None:
        arrived, self._coming = self._coming, []
        self.hear(*arrived)
        for (name, node), (period, signals) in list(self.cyclic.items()):
            if period and self.now % period == 0:
                self.tell(name, node, **signals)
        due = self.driver.due()
        at = self.now * MILLISECOND
        if (self.every and self.now % self.every == 0) or (due is not None and due <= at):
            self._send(words)
        self.now += 1

    def _send(self, words: Sequence[Command | Request]) -> None:
        events, wires = self.driver.send(self.now * MILLISECOND, words)
        self._told(events)
        said = []
        for wire in wires:
            assert isinstance(wire, CanFrame)
            said.append(meaning(wire, self.line))
            name = said[-1].partition("?")[2]
            if wire.remote and (name, wire.id >> 5) in self.answers:
                signals = self.answers[name, wire.id >> 5]
                self._coming.append(frame(name, self.line, wire.id >> 5, wire.extended, **signals))
        counted = [(text, len(list(same))) for text, same in groupby(said)]
        text = " | ".join(f"{count} × {text}" if count > 1 else text for text, count in counted)
        self._said(text or ("" if self.every else "-"))

    # -- the transcript --------------------------------------------------------------------------

    def _said(self, text: str) -> None:
        run = self._spoken
        if run and run.text == text and run.step in (0, self.now - run.last):
            run.last, run.step = self.now, self.now - run.last
            return
        self._spoken = Run(text, self.now, self.now)
        if text:
            self.lines.append((self.now, self._spoken))

    def _told(self, events: Sequence[Event]) -> None:
        for event in events:
            values = [(f.name, getattr(event, f.name)) for f in fields(event)]
            shown = [f"{v:g}" if isinstance(v, float) else str(v) for name, v in values if name != "t"]
            text = " ".join([type(event).__name__, *shown])
            if event.t != self.now * MILLISECOND:
                text += f" @{event.t / MILLISECOND:g}"
            if isinstance(event, Feedback):
                key = (event.motor, tuple(v is None for _, v in values))
                if self._measured.get(key) == text:
                    continue
                self._measured[key] = text
                text = " ".join(["Feedback", *(f"{n}={v:g}" for n, v in values[2:] if v is not None)])
            self.lines.append((self.now, f"{self.now} < {text}"))

    def text(self) -> str:
        """The transcript, and what was counted."""
        tally = self.driver.tally
        counted = [(text, len(list(same))) for text, same in groupby(str(line) for _, line in self.lines)]
        said = [f"{text} (× {count})" if count > 1 else text for text, count in counted]
        said.append(f"heard {tally.heard}, bad {tally.bad}, foreign {tally.foreign}")
        wrapped = [
            textwrap.wrap(line, 100, subsequent_indent="    ", break_on_hyphens=False) for line in said
        ]
        return "\n".join(piece for pieces in wrapped for piece in pieces)

    def is_as_told(self, transcript: str) -> None:
        """The transcript is this one."""
        wanted = textwrap.dedent(transcript).strip("\n")
        assert self.text() == wanted, "\n" + self.text()


SERIAL = 0x385F34733330
DISCOVERED = CanFrame(0x66, bytes.fromhex("03303373345f3800"))
"""Vector address_reply06."""


def standing(**options: Any) -> Talk:
    """A device of 0.6.x that stands still and is known."""
    talk = Talk([device(poll_ms=0, **options)], every=20)
    talk.up()
    talk.run(210)
    return talk


def standing05(*others: int) -> Talk:
    """Axes of 0.5.x that stand still and are known."""
    nodes = (3, *others)
    talk = Talk([device(f"axis{node}", node, poll_ms=0, firmware="0.5") for node in nodes], "0.5", every=20)
    for node in nodes:
        talk.beat(node=node)
        talk.place(node=node)
        talk.answer("Get_Bus_Voltage_Current", node, Bus_Voltage=24.0)
    talk.run(300)
    return talk
