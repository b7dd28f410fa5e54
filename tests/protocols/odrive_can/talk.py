"""A conversation of vectors: frames of devices, encoded by cantools from the vendor's DBC, and what they
mean.

Rules. The devices' frames come from the DBCs of package odrive-can 2.1.0 by cantools, and the driver's frames
are decoded with the same (`conversation`); our codec has no part in it. The expected frames and events are
written by hand, stage by stage, from the README, the docstrings of `options`, and the messages' table
(odriverobotics/ODrive@f9b5419, odriverobotics/ODriveArduino@f52eef5): see `transcript` for their form.
Virtual time in ms.

Periodic requests (`ROUTINE`) are in no transcript; their periods are promised too, and `test_vectors_polling`
counts them. A measurement is listed when it changes. In every conversation holds:

* before a command or a request, only remote frames are sent;
* a remote frame only ever requests a message that devices send;
* errors are cleared only after a ClearFault;
* `due` is never at once again after a call of `send`;
* a fault has a cause and a remedy; every frame is counted once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import groupby
from typing import Any

from protocols.frames import BusState, CanFrame, Frame
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
SENT_BY_DEVICES = ROUTINE | {
    *("Get_Error", "Get_Powers", "Get_Motor_Error", "Get_Encoder_Error", "Get_Sensorless_Error"),
    *("Get_Controller_Error", "Get_Encoder_Count", "Get_Sensorless_Estimates"),
}
ROUND = math.tau
"""rad of one turn"""


@dataclass
class Talk:
    """The driver among devices whose frames the test determines."""

    devices: Sequence[Device]
    line: str = "0.6"
    """The firmware line that frames are decoded and encoded with."""
    others: dict[int, str] = field(default_factory=dict)
    """The line by node, where it is another one."""
    every: int = 10
    """ms between calls of `send`, besides those that are due; 0: only those."""
    shown: frozenset[str] = frozenset()
    """Requests of `ROUTINE` that are in the transcript all the same."""
    now: int = 0
    cyclic: dict[tuple[str, int], tuple[int, int, bool, dict[str, Any]]] = field(default_factory=dict)
    """Cyclic messages by name and node: start, period [ms], format, signals."""
    answers: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)
    """Replies by name and node, sent 1 ms after the request."""

    def __post_init__(self) -> None:
        self.driver = OdriveDriver(self.devices, RANGES)
        self.lines: list[Line] = []
        self.requests: dict[str, list[int]] = {}
        """When each message was requested, since the conversation began, as "3?Heartbeat"."""
        self.began = 0
        self._going_on: Line | None = None
        self._paused = False
        self._measured: dict[tuple[str, tuple[bool, ...]], str] = {}
        self._coming: list[CanFrame] = []
        self._came = 0
        self._counted = (0, 0)
        self._commanded = self._clearing = self._pressing = False

    # -- the devices ---------------------------------------------------------------------------

    def cycle(self, period: int, name: str, node: int = 3, extended: bool = False, **signals: float) -> None:
        """Send this message every `period` ms, from now on; 0: no more."""
        self.cyclic[name, node] = (self.now, period, extended, signals)

    def beat(
        self, state: int = 1, error: int = 0, node: int = 3, extended: bool = False, **signals: float
    ) -> None:
        """Send heartbeats of this content every 100 ms."""
        self.cycle(100, "Heartbeat", node, extended, Axis_State=state, Axis_Error=error, **signals)

    def place(
        self, position: float = 0.0, velocity: float = 0.0, node: int = 3, extended: bool = False
    ) -> None:
        """Send estimates of this content every 10 ms."""
        self.cycle(10, "Get_Encoder_Estimates", node, extended, Pos_Estimate=position, Vel_Estimate=velocity)

    def answer(self, name: str, node: int = 3, **signals: float) -> None:
        """Reply with this message from now on."""
        self.answers[name, node] = signals

    def version(self, node: int = 3, minor: int = 6) -> None:
        """Reply to Get_Version from now on."""
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
        """Send a message of a device once."""
        self.handle(frame(name, self.line_of(node), node, extended, **signals))

    def line_of(self, node: int) -> str:
        """The firmware line of a node."""
        return self.others.get(node, self.line)

    def handle(self, *frames: Frame) -> None:
        """Let the driver receive frames."""
        for raw in frames:
            self._came += 1
            self._reported(self.driver.receive(self.now * MILLISECOND, raw))

    def mute(self, node: int = 3) -> None:
        """Let a device send nothing from now on."""
        for key in [key for key in self.cyclic if key[1] == node]:
            del self.cyclic[key]
        for key in [key for key in self.answers if key[1] == node]:
            del self.answers[key]

    # -- the host ------------------------------------------------------------------------------

    def run(self, ms: int, *messages: Command) -> None:
        """Run with these commands in every step."""
        for _ in range(ms):
            self._millisecond(messages)

    def ask(self, *requests: Request | Command) -> None:
        """Send these now."""
        self._send(requests)

    def bus(self, state: BusState) -> None:
        """The bus changes."""
        self.driver.bus(self.now * MILLISECOND, state)

    def _millisecond(self, messages: tuple[Command, ...]) -> None:
        arrived, self._coming = self._coming, []
        self.handle(*arrived)
        for (name, node), (since, period, extended, signals) in list(self.cyclic.items()):
            if period and (self.now - since) % period == 0:
                self.report(name, node, extended, **signals)
        due = self.driver.due()
        at = self.now * MILLISECOND
        if (self.every and self.now % self.every == 0) or (due is not None and due <= at):
            self._send(messages)
        self.now += 1

    def _send(self, messages: Sequence[Command | Request]) -> None:
        self._commanded = self._commanded or any(not isinstance(message, Idle) for message in messages)
        self._clearing = self._clearing or any(isinstance(message, ClearFault) for message in messages)
        events, frames = self.driver.send(self.now * MILLISECOND, messages)
        due = self.driver.due()
        pressing = due is not None and due <= self.now * MILLISECOND
        assert not (pressing and self._pressing), "due at once again after a call of send"
        self._pressing = pressing
        self._reported(events)
        sent = []
        for raw in frames:
            assert isinstance(raw, CanFrame)
            assert raw.remote or self._commanded, "something other than a remote frame, before any command"
            text = meaning(raw, self.line_of(raw.id >> 5))
            assert self._clearing or "Clear_Errors" not in text, "errors are cleared unasked"
            if not raw.remote or self._on_remote_request(text, raw):
                sent.append(text)
        counted = [(text, len(list(same))) for text, same in groupby(sent)]
        self._sent(" | ".join(f"{count} × {text}" if count > 1 else text for text, count in counted))

    def _on_remote_request(self, text: str, raw: CanFrame) -> bool:
        """Note a remote request; True if it is in the transcript."""
        node, cmd = raw.id >> 5, raw.id & 0x1F
        name = {0: "Get_Version", 6: "Address"}.get(cmd, text.partition("?")[2])  # not in the DBC of 0.5.x
        assert name in SENT_BY_DEVICES, "a remote frame of a host's message"
        assert name != "Address" or (node == 63 and not raw.extended), "an axis of 0.5.x would obey it"
        self.requests.setdefault(f"{node}?{name}", []).append(self.now)
        if (name, node) in self.answers:
            line = "0.6" if name == "Get_Version" else self.line_of(node)
            self._coming.append(frame(name, line, node, raw.extended, **self.answers[name, node]))
        return name not in ROUTINE or name in self.shown

    # -- the transcript --------------------------------------------------------------------------

    def _sent(self, text: str) -> None:
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
                last.count += 1
            else:
                self.lines.append(line)

    def reports(self, transcript: str, bad: int = 0, foreign: int = 0) -> None:
        """Compare frames and events since the last stage; `bad` and `foreign`: numbers of received frames."""
        wrong = difference(self.lines, expectation(transcript))
        assert not wrong, wrong
        counters = self.driver.counters
        assert counters.accepted + counters.malformed + counters.ignored == self._came
        assert (counters.malformed - self._counted[0], counters.ignored - self._counted[1]) == (bad, foreign)
        self.stage()

    def stage(self) -> None:
        """Begin a stage: what was before is not compared."""
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
    """A device that is driven at one turn per second, and last reported closed loop before that."""
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
