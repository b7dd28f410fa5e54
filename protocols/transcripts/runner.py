"""One block, run: driver, decoder or twins, stepped from moment to moment through its lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias

from protocols import messages as msg
from protocols.conformance.bench import OnLine, Shaft, make_driver
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Feedback, Nanos
from protocols.plugin import Device, Driver, Plugin, join
from protocols.reference_vectors import vectors_of
from protocols.transcripts.file import HEAD, Block, TranscriptLine, nanos
from protocols.transcripts.notation import (
    MESSAGES,
    Frames,
    candump,
    close,
    message,
    number,
    shown,
    tokens,
    values_of,
)

FrameNotation: TypeAlias = Callable[[str], Frame | str] | None
START: Nanos = 1_000_000 * MILLISECOND
"""Time 0 of a block: the clock does not begin at zero."""
DELAY: Nanos = MILLISECOND
"""From a frame of the driver to the reply that a rule gives, and from a twin to the driver."""
GIVEN = {"driver": "rx", "twin": "tx", "decoder": "tx", "both": ""}
"""The frames that a file gives, by what it tests; it expects the others."""
SHOWN = 10
"""Mistakes of a run that are printed."""
ENOUGH = 100
"""Mistakes after which a run ends."""
COUNTED = ("accepted", "malformed", "ignored")


class Peer(Protocol):
    """A device made of independent software, for a driver that is tested."""

    def receive(self, frame: Frame) -> None:
        """Handle a frame of the driver."""

    def step(self) -> Sequence[Frame]:
        """Advance by a millisecond. Returns what it sends."""

    def change(self, text: str) -> str:
        """Do what a line demands, or return what is not as it says."""


def run(
    block: Block,
    plugin: Plugin,
    notation: FrameNotation = None,
    peer: Callable[[Device], Peer] | None = None,
) -> None:
    """Run a block. Raises AssertionError with each line that is not so."""
    __tracebackhide__ = True
    runs = (TranscriptRun(block, plugin, notation, lines, peer) for lines in block.runs())
    wrong = [mistake for each in runs for mistake in each.mistakes()]
    if wrong:
        raise AssertionError("\n".join(["", *wrong]))


@dataclass
class Expectation:
    """What a line expects: a message, or frames in this order at one moment; perhaps repeatedly."""

    line: TranscriptLine
    kind: str
    matches: Sequence[Callable[[Nanos, Any], bool]]
    seen: list[Nanos] = field(default_factory=list)
    part: int = 0

    def takes(self, now: Nanos, kind: str, actual: object) -> bool:
        """True if it expects this now, and then no longer."""
        on_time = now == self.seen[-1] if self.part else self._is_time(now)
        if kind != self.kind or not on_time or not self.matches[self.part](START + now, actual):
            return False
        self.seen += [] if self.part else [now]
        self.part = (self.part + 1) % len(self.matches)
        return True

    def _is_time(self, now: Nanos) -> bool:
        line, (low, high) = self.line, self.line.gap or (0, 0)
        if line.gap is None:
            return not self.seen and line.start <= now <= line.stop
        if self.seen:
            return self.seen[-1] + low <= now <= min(self.seen[-1] + high, line.stop)
        return line.start <= now <= line.start + (high if high > low else 0)

    def is_met(self) -> bool:
        """True if nothing of it is missing."""
        last = self.line.stop - self.line.gap[1] if self.line.gap else -1
        return self.part == 0 and bool(self.seen) and self.seen[-1] > last


class TranscriptRun:
    """Driver, decoder or twins, stepped from moment to moment through the lines."""

    def __init__(
        self,
        block: Block,
        plugin: Plugin,
        notation: FrameNotation,
        lines: Sequence[TranscriptLine],
        peer: Callable[[Device], Peer] | None,
    ) -> None:
        self.plugin = plugin
        head: dict[str, list[str]] = {kind: [] for kind in HEAD}
        for line in block.head:
            head[line.kind].append(line.body)
        self.tests = head["tests"][-1]
        self.cycle = nanos(head["cycle"][-1]) if head["cycle"] else None
        names = dict(body.split(None, 1) for body in head["name"])
        self.frames = Frames(names, {each.name: each.frame for each in vectors_of(plugin)}, notation)
        devices = [*{each.name: each for each in map(self._device, head["device"])}.values()]
        drives, simulates = self.tests in ("driver", "both"), self.tests in ("twin", "both")
        self.driver: Driver | None = make_driver(plugin, devices) if drives else None
        self.decoder = plugin.decoder(devices)
        self.twins = {each.name: plugin.twin(each, at) for at, each in enumerate(devices) if simulates}
        join([*self.twins.values()])
        self.shafts = {name: Shaft() for name in self.twins}
        named = {line.body.split()[0] for line in (*block.head, *lines) if line.kind == "peer"}
        self.peers = {each.name: peer(each) for each in devices if peer and each.name in named}
        self.torques: dict[str, float] = {}
        self.commands: dict[str, Command] = {}
        self.cyclic: dict[object, tuple[Nanos, Nanos, Frame]] = {}
        self.replies: dict[str, tuple[str, ...]] = {}
        self.arriving: list[tuple[Nanos, Frame]] = []
        self.now: Nanos = 0
        self.end = max(line.stop for line in lines)
        self.stimuli = [line for line in block.head if line.kind in ("cyclic", "reply", "peer")]
        self.stimuli += [line for line in lines if not self._is_expected(line)]
        self.expected = [each for line in lines for each in self._expectations(line)]
        driving = [line for line in self.stimuli if line.kind in ("host", "bus", "cyclic", "reply")]
        if driving and self.driver is None:
            raise ValueError(f"{driving[0]}: there is no driver where a {self.tests} is tested")
        self.background = head["background"]
        self.came: list[str] = []
        self.wrong: list[str] = []

    def _device(self, body: str) -> Device:
        """Return a device of the head: name, address, options and settings."""
        name, address, *rest = tokens(body)
        parts: dict[str, dict[str, str]] = {"options": {}, "settings": {}}
        into = parts["options"]
        for token in rest:
            key, _, value = token.partition("=")
            into = parts.get(token, into)
            into |= {key: value} if value else {}
        options = self.plugin.options(**values_of(self.plugin.options, parts["options"]))
        settings = self.plugin.settings(**values_of(self.plugin.settings, parts["settings"]))
        return Device(name, int(address, 0), options, settings)

    # -- what is expected ------------------------------------------------------------------------

    def _is_expected(self, line: TranscriptLine) -> bool:
        return line.kind in ("tx", "rx", "event", "obeys") and line.kind != GIVEN[self.tests]

    def _expectations(self, line: TranscriptLine) -> Iterator[Expectation]:
        if self._is_expected(line):
            yield self._expectation(line, line.kind, line.body)
        elif line.kind != "reply":
            for text in line.results:
                if text not in COUNTED and text.split(" ")[0] not in ("nothing", "named"):
                    frame = "tx" if self.driver else "rx"
                    is_message = text.split(" ")[0] in MESSAGES
                    kind = frame if not is_message else "event" if self.driver else "obeys"
                    yield self._expectation(line, kind, text)

    def _expectation(self, line: TranscriptLine, kind: str, text: str) -> Expectation:
        return Expectation(line, kind, [self._matcher(kind, part) for part in text.split(" | ")])

    def _matcher(self, kind: str, text: str) -> Callable[[Nanos, Any], bool]:
        if kind in ("tx", "rx"):
            return lambda _, frame: self.frames.matches(text, frame)
        return message(text).matches

    def _came(self, kind: str, actual: Any) -> None:
        """Compare a frame or message with what is expected."""
        text = f"{self.now / MILLISECOND:<8g} {kind:<6} {shown(actual, START + self.now)}"
        if any(each.takes(self.now, kind, actual) for each in self.expected):
            self.came.append(text)
        elif not isinstance(actual, msg.Kept) and not any(
            self._is_background(kind, actual, each) for each in self.background
        ):
            self.came.append(f"{text}   <- not written")
            self.wrong.append(f"not written, and not in the background: {text}")

    def _is_background(self, kind: str, actual: Any, body: str) -> bool:
        way, _, text = body.partition(" ")
        matchers = (self._matcher(kind, each.strip()) for each in text.split(" ; "))
        return kind == way and any(matches(START + self.now, actual) for matches in matchers)

    # -- one moment after the other --------------------------------------------------------------

    def mistakes(self) -> list[str]:
        """Run to the end. Returns what is not as written."""
        upcoming: Nanos | None = 0
        while upcoming is not None and upcoming <= self.end and len(self.wrong) < ENOUGH:
            self.now = upcoming
            self._moment([line for line in self.stimuli if line.next(upcoming - 1) == upcoming])
            upcoming = self._next()
        self.wrong += [f"{each.line}\n    did not come so" for each in self.expected if not each.is_met()]
        if not self.wrong:
            return []
        return [*self.wrong[:SHOWN], "what came:", *(f"    {text}" for text in self.came[-4 * SHOWN :])]

    def _next(self) -> Nanos | None:
        """Return the next moment at which something happens."""
        times = [line.next(self.now) for line in self.stimuli] + [t for t, _ in self.arriving]
        periods = [(since, period) for since, period, _ in self.cyclic.values()]
        periods += [(0, self.cycle)] if self.cycle else []
        periods += [(0, MILLISECOND)] if self.twins or self.peers else []
        times += [self.now + period - (self.now - since) % period for since, period in periods]
        due = self.driver.due() if self.driver else None
        times += [] if due is None else [max(due - START, self.now + 1)]
        return min((t for t in times if t is not None), default=None)

    def _moment(self, lines: Sequence[TranscriptLine]) -> None:
        for line in lines:
            if line.kind not in ("host", "tx", "rx"):
                self._change(line)
        arrived = [frame for t, frame in self.arriving if t == self.now]
        self.arriving = [(t, frame) for t, frame in self.arriving if t != self.now]
        arrived += [raw for at, period, raw in self.cyclic.values() if (self.now - at) % period == 0]
        arrived += [raw for peer in self.peers.values() for raw in peer.step()]
        for frame in arrived:
            self._receive(frame, ())
        for line in lines:
            if line.kind == "rx":
                self._receive(self.frames.frame(line.body), line.results, str(line))
        sent = [frame for line in lines if line.kind == "tx" for frame in self._given(line)]
        sent += self._send([line for line in lines if line.kind == "host"])
        self._step_twins(sent)
        for line in lines:
            if line.kind == "measure":
                self._measure(line)

    def _change(self, line: TranscriptLine) -> None:
        """Change the bus, the devices or their shafts."""
        first, *rest = tokens(line.body) or [""]
        if line.kind == "bus" and self.driver:
            self.driver.bus(START + self.now, BusState(first))
        elif line.kind == "cyclic":
            frame = self.frames.frame(" ".join(rest))
            self.cyclic[frame.id if isinstance(frame, CanFrame) else frame] = (self.now, nanos(first), frame)
        elif line.kind == "reply":
            self.replies[line.body] = line.results
        elif line.kind == "peer":
            mistake = self.peers[first].change(" ".join(rest))
            self.wrong += [f"{line}\n    {mistake}"] if mistake else []
        elif line.kind == "silence":
            self.cyclic.clear()
            self.replies.clear()
        elif line.kind == "shaft":
            for name, _, value in (token.partition("=") for token in rest):
                setattr(self.shafts[first], name, value == "yes" if name == "locked" else number(value))
        elif line.kind == "fault":
            self.twins[first].provoke(int(rest[0], 0))

    def _receive(self, frame: Frame, results: Sequence[str], place: str = "") -> None:
        """Give a frame to the driver, and see that it is counted once, and as what."""
        if self.driver is None:
            return
        before = self._counts(self.driver)
        if self.tests == "both":
            self._came("rx", frame)
        for event in self.driver.receive(START + self.now, frame):
            self._came("event", event)
        change = [now - was for now, was in zip(self._counts(self.driver), before, strict=True)]
        wanted = [results.count(each) for each in COUNTED]
        if not any(wanted) or (isinstance(frame, bytes) and not wanted[0]):
            wanted[0] = 1 if isinstance(frame, CanFrame) else change[0]
        if change != wanted and self.tests == "driver":
            what = "accepted, malformed and ignored"
            self.wrong.append(f"{place or candump(frame)}\n    counted as {what}: {change}, not {wanted}")

    @staticmethod
    def _counts(driver: Driver) -> list[int]:
        return [driver.counters.accepted, driver.counters.malformed, driver.counters.ignored]

    def _given(self, line: TranscriptLine) -> list[Frame]:
        """Return the frame of a host in a file that has no driver."""
        frame = self.frames.frame(line.body)
        for received in self.decoder.decode(START + self.now, frame) if self.tests == "decoder" else ():
            self._came("obeys", received)
        for text in line.results:
            first, *names = (each.strip('"') for each in tokens(text))
            named = list(self.plugin.messages(frame))
            if first == "named" and named != names:
                self.wrong.append(f"{line}\n    its messages are named {named}")
        return [frame]

    def _send(self, lines: Sequence[TranscriptLine]) -> list[Frame]:
        """Call the driver's `send`: with what the host is given, in each cycle, and while it is due."""
        if self.driver is None:
            return []
        given: list[Any] = []
        for line in lines:
            if line.body == "nothing":
                self.commands.clear()
            else:
                given += [message(text).build(START + self.now) for text in line.body.split(" ; ")]
        if self.cycle is not None:
            self.commands |= {each.motor: each for each in given if isinstance(each, Command)}
            given = [each for each in given if not isinstance(each, Command)] + [*self.commands.values()]
        in_cycle = self.cycle is not None and self.now % self.cycle == 0
        sent = self._call(self.driver, given) if lines or in_cycle or self.now == 0 else []
        for _ in range(2):
            due = self.driver.due()
            if due is None or due > START + self.now:
                return sent
            if isinstance(self.driver, OnLine) and not self._is_due(self.driver.driver):
                sent += self._went(*self.driver.go_on(START + self.now))
            else:
                sent += self._call(self.driver, ())
        self.wrong.append(f"{self.now / MILLISECOND:g}: due at once again after each call of send")
        return sent

    def _is_due(self, driver: Driver) -> bool:
        due = driver.due()
        return due is not None and due <= START + self.now

    def _call(self, driver: Driver, messages: Sequence[Any]) -> list[Frame]:
        return self._went(*driver.send(START + self.now, messages))

    def _went(self, events: Sequence[Any], frames: Sequence[Frame]) -> list[Frame]:
        for event in events:
            self._came("event", event)
        for frame in frames:
            self._came("tx", frame)
            for peer in self.peers.values():
                peer.receive(frame)
            for request, answers in self.replies.items():
                if self.frames.matches(request, frame):
                    answers = tuple(text for text in answers if text != "nothing")
                    self.arriving += [(self.now + DELAY, self.frames.frame(text)) for text in answers]
        return list(frames)

    def _step_twins(self, sent: Sequence[Frame]) -> None:
        now = START + self.now
        for name, twin in self.twins.items():
            shaft = self.shafts[name]
            for frame in sent:
                twin.receive(now, frame)
            torques, frames = twin.step(now, [Feedback(name, now, shaft.position, shaft.velocity)])
            for torque in torques:
                self.torques[name] = torque.torque
                shaft.turn(torque.torque, MILLISECOND)
            for frame in frames:
                if self.tests == "twin":
                    self._came("rx", frame)
                self.arriving.append((self.now + DELAY, frame))

    def _measure(self, line: TranscriptLine) -> None:
        """Compare position, velocity and torque of a shaft with what is written."""
        name, *rest = tokens(line.body)
        shaft = self.shafts[name]
        actual = {"position": shaft.position, "velocity": shaft.velocity, "torque": self.torques[name]}
        for quantity, _, value in (token.partition("=") for token in rest):
            if not close(value, actual[quantity]):
                self.wrong.append(f"{line}\n    the {quantity} is {actual[quantity]:.6g}")
