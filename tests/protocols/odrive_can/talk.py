"""A conversation of vectors: what devices say, encoded by cantools from the vendor's DBC, and what it means.

Rules. The device's frames come from the DBCs of package odrive-can 2.1.0 by cantools, and what our driver
says is read with the same (`conversation`); our codec has no part in it. What the driver is expected to say
and to tell is written by hand, stage by stage, from the README's promises, the docstrings of `options`, and
the messages' table (odriverobotics/ODrive@f9b5419, odriverobotics/ODriveArduino@f52eef5): see `transcript`
for its form. Virtual time in ms.

Questions that come by the clock (`ROUTINE`) stand in no transcript; how often they come is promised too, and
`test_vectors_asked` counts them. A measurement is told when it changes. In every conversation holds:

* before a command or a request, nothing but questions goes out;
* a remote frame only ever asks for what devices tell;
* errors are cleared only after a ClearFault;
* who has just been called is not due again and again at the same moment;
* a fault has a cause and a cure; every frame is counted once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import groupby
from typing import Any

from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, ClearFault, Command, Event, Feedback, Idle, Request, Velocity
from protocols.odrive_can import RANGES
from protocols.odrive_can.driver import OdriveDriver
from protocols.plugin import Device
from tests.protocols.odrive_can.conversation import device, frame, meaning
from tests.protocols.odrive_can.transcript import Line, difference, expectation, reported

ROUTINE = frozenset(
    {
        "Get_Version",
        "Heartbeat",
        "Get_Encoder_Estimates",
        "Get_Iq",
        "Get_Bus_Voltage_Current",
        "Get_Temperature",
        "Get_Torques",
        "Address",
    }
)
TOLD_BY_DEVICES = ROUTINE | {
    *("Get_Error", "Get_Powers", "Get_Motor_Error", "Get_Encoder_Error", "Get_Sensorless_Error"),
    *("Get_Controller_Error", "Get_Encoder_Count", "Get_Sensorless_Estimates"),
}
ROUND = math.tau
"""rad of a turn: what the wire has as 1."""


@dataclass
class Talk:
    """The driver among devices that say what the test has them say."""

    devices: Sequence[Device]
    line: str = "0.6"
    """In which what the driver says is read, and what devices say is written."""
    others: dict[int, str] = field(default_factory=dict)
    """By node, where it is another one."""
    every: int = 10
    """ms between calls of `send`, besides those that are due; 0: only those."""
    shown: frozenset[str] = frozenset()
    """Questions of `ROUTINE` that stand in the transcript all the same."""
    now: int = 0
    cyclic: dict[tuple[str, int], tuple[int, int, bool, dict[str, Any]]] = field(default_factory=dict)
    """By name and node: from when on, and every so many ms, this is said."""
    answers: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)
    """By name and node: what is answered, 1 ms after it is asked for."""

    def __post_init__(self) -> None:
        self.driver = OdriveDriver(self.devices, RANGES)
        self.lines: list[Line] = []
        self.questions: dict[str, list[int]] = {}
        """When each was asked, since the conversation began, as "3?Heartbeat"."""
        self.began = 0
        self._going_on: Line | None = None
        self._paused = False
        self._measured: dict[tuple[str, tuple[bool, ...]], str] = {}
        self._coming: list[CanFrame] = []
        self._came = 0
        self._counted = (0, 0)
        self._claimed = self._clearing = self._pressing = False

    # -- the devices ---------------------------------------------------------------------------

    def cycle(self, period: int, name: str, node: int = 3, extended: bool = False, **signals: float) -> None:
        """From now on a device says this every `period` ms, and now; 0: no more."""
        self.cyclic[name, node] = (self.now, period, extended, signals)

    def beat(
        self, state: int = 1, error: int = 0, node: int = 3, extended: bool = False, **signals: float
    ) -> None:
        """From now on heartbeats every 100 ms say this."""
        self.cycle(100, "Heartbeat", node, extended, Axis_State=state, Axis_Error=error, **signals)

    def place(
        self, position: float = 0.0, velocity: float = 0.0, node: int = 3, extended: bool = False
    ) -> None:
        """From now on estimates every 10 ms say this."""
        self.cycle(10, "Get_Encoder_Estimates", node, extended, Pos_Estimate=position, Vel_Estimate=velocity)

    def answer(self, name: str, node: int = 3, **signals: float) -> None:
        """From now on this is answered."""
        self.answers[name, node] = signals

    def version(self, node: int = 3, minor: int = 6) -> None:
        """From now on Get_Version is answered."""
        self.answer("Get_Version", node, Protocol_Version=2, Fw_Version_Minor=minor, Fw_Version_Revision=10)

    def up(self, node: int = 3, state: int = 1) -> None:
        """A device of 0.6.x that stands still."""
        self.version(node)
        self.beat(state, node=node)
        self.place(node=node)

    def up05(self, node: int = 3, extended: bool = False) -> None:
        """An axis of 0.5.x that stands still."""
        self.beat(node=node, extended=extended)
        self.place(node=node, extended=extended)
        self.answer("Get_Bus_Voltage_Current", node, Bus_Voltage=24.0)

    def report(self, name: str, node: int = 3, extended: bool = False, **signals: float) -> None:
        """A device says this now, once."""
        self.handle(frame(name, self.line_of(node), node, extended, **signals))

    def line_of(self, node: int) -> str:
        """In which a node is spoken with."""
        return self.others.get(node, self.line)

    def handle(self, *frames: CanFrame) -> None:
        """These frames come now."""
        for raw in frames:
            self._came += 1
            self._reported(self.driver.receive(self.now * MILLISECOND, raw))

    def mute(self, node: int = 3) -> None:
        """From now on a device says nothing."""
        for key in [key for key in self.cyclic if key[1] == node]:
            del self.cyclic[key]
        for key in [key for key in self.answers if key[1] == node]:
            del self.answers[key]

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
        self.handle(*arrived)
        for (name, node), (since, period, extended, signals) in list(self.cyclic.items()):
            if period and (self.now - since) % period == 0:
                self.report(name, node, extended, **signals)
        due = self.driver.due()
        at = self.now * MILLISECOND
        if (self.every and self.now % self.every == 0) or (due is not None and due <= at):
            self._send(words)
        self.now += 1

    def _send(self, words: Sequence[Command | Request]) -> None:
        self._claimed = self._claimed or any(not isinstance(word, Idle) for word in words)
        self._clearing = self._clearing or any(isinstance(word, ClearFault) for word in words)
        events, frames = self.driver.send(self.now * MILLISECOND, words)
        due = self.driver.due()
        pressing = due is not None and due <= self.now * MILLISECOND
        assert not (pressing and self._pressing), "it has just been called, and wants to be again and again"
        self._pressing = pressing
        self._reported(events)
        said = []
        for raw in frames:
            assert isinstance(raw, CanFrame)
            assert raw.remote or self._claimed, "something other than a question, unasked"
            text = meaning(raw, self.line_of(raw.id >> 5))
            assert self._clearing or "Clear_Errors" not in text, "errors are cleared unasked"
            if not raw.remote or self._asked(text, raw):
                said.append(text)
        counted = [(text, len(list(same))) for text, same in groupby(said)]
        self._said(" | ".join(f"{count} × {text}" if count > 1 else text for text, count in counted))

    def _asked(self, text: str, raw: CanFrame) -> bool:
        """A question goes out; whether it stands in the transcript."""
        node, cmd = raw.id >> 5, raw.id & 0x1F
        name = {0: "Get_Version", 6: "Address"}.get(cmd, text.partition("?")[2])  # not in the DBC of 0.5.x
        assert name in TOLD_BY_DEVICES, "a remote frame of a host's message"
        assert name != "Address" or (node == 63 and not raw.extended), "an axis of 0.5.x would obey it"
        self.questions.setdefault(f"{node}?{name}", []).append(self.now)
        if (name, node) in self.answers:
            line = "0.6" if name == "Get_Version" else self.line_of(node)
            self._coming.append(frame(name, line, node, raw.extended, **self.answers[name, node]))
        return name not in ROUTINE or name in self.shown

    # -- the transcript --------------------------------------------------------------------------

    def _said(self, text: str) -> None:
        if not text:
            self._paused = True
            return
        at = self.now - self.began
        without_pause = bool(self.every) and not self._paused
        self._paused = False
        if self._going_on is None or not self._going_on.again(text, at, without_pause):
            self._going_on = Line(">", text, at, at)
            self.lines.append(self._going_on)

    def _reported(self, events: Sequence[Event]) -> None:
        for event in events:
            text = reported(event)
            if event.t != self.now * MILLISECOND:
                text += f" @{event.t / MILLISECOND - self.began:g}"
            if isinstance(event, Feedback):
                key = (event.motor, tuple(getattr(event, f.name) is None for f in fields(event)))
                if self._measured.get(key) == text:
                    continue
                self._measured[key] = text
            self._going_on = None
            last = self.lines[-1] if self.lines else None
            line = Line("<", text, self.now - self.began, self.now - self.began)
            if last is not None and (last.way, last.text, last.first) == (line.way, line.text, line.first):
                last.said += 1
            else:
                self.lines.append(line)

    def reports(self, transcript: str, bad: int = 0, foreign: int = 0) -> None:
        """This was said and told since the last stage, and so many frames were bad and foreign."""
        wrong = difference(self.lines, expectation(transcript))
        assert not wrong, wrong
        counters = self.driver.counters
        assert counters.accepted + counters.malformed + counters.ignored == self._came
        assert (counters.malformed - self._counted[0], counters.ignored - self._counted[1]) == (bad, foreign)
        self.stage()

    def stage(self) -> None:
        """A stage begins; whatever was said before is not looked at."""
        self.lines.clear()
        self.began, self._going_on, self._paused = self.now, None, False
        self._counted = (self.driver.counters.malformed, self.driver.counters.ignored)


def standing(**options: Any) -> Talk:
    """A device of 0.6.x that stands still and is known."""
    talk = Talk([device(poll_ms=0, **options)])
    talk.up()
    talk.run(200)
    talk.stage()
    return talk


def running() -> Talk:
    """One that is driven with a turn a second, and was last heard to be in closed loop before that."""
    talk = standing()
    talk.beat(8)
    talk.run(100, Velocity("left", ROUND))
    talk.stage()
    return talk


def standing05(*others: int) -> Talk:
    """Axes of 0.5.x that stand still and are known."""
    nodes = (3, *others)
    talk = Talk([device(f"axis{node}", node, poll_ms=0, firmware="0.5") for node in nodes], "0.5")
    for node in nodes:
        talk.up05(node)
    talk.run(300)
    talk.stage()
    return talk
