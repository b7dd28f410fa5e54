"""Judges a replay: the recorded inputs go through the code of today, and every byte is compared.

Rules. A verdict is good only if something was compared, nothing was left over, nothing in the recording was
changed, and all is the same: each packet to the byte, on its bus and in its order, each event, each note and
each message that shows what was believed. After a difference the replay goes on, so that the verdict can tell
what a change in the input did to the wires. Nothing here knows a device: the ear of a bus says what a frame
means.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Literal, TypeAlias

from brain.belief import Belief
from brain.perception.mount import Mount
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.errors import RecordingError
from gateway.recording import Recording, Step
from gateway.recording.environment import PROGRAM
from gateway.recording.ros_messages import CAN_FRAME, FD_FRAME
from gateway.recording.ros_views import View, Views
from gateway.recording.tick_codec import show
from gateway.replay import diff
from protocols.frames import Frame, Packet
from protocols.messages import Command, Event, Nanos, Request, seconds
from protocols.plugin import CommandDecoder

Kind: TypeAlias = Literal["recording", "events", "packets", "notes", "views"]
_KINDS: tuple[Kind, ...] = ("recording", "events", "packets", "notes", "views")
FRAMES = (CAN_FRAME, FD_FRAME)
_MOST_SETTINGS = 12


@dataclass(frozen=True, slots=True)
class Difference:
    """The first difference of its kind."""

    kind: Kind
    tick: int
    since: Nanos
    """Time since the first tick."""
    text: str
    """What differs, both sides, in words; one or more lines."""

    def __str__(self) -> str:
        return f"tick {self.tick}, {seconds(self.since):.3f} s after the start: {self.text}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a replay has shown."""

    ticks: int
    packets: int
    """Sent packets that were compared,"""
    bytes: int
    """with so many bytes of data."""
    views: int
    """Messages that show what was believed, compared likewise."""
    given: int
    """Received packets that were given to the gateway again,"""
    left_over: int
    """and those that it has no bus for."""
    unread: int
    """Ticks that the recording's index counts, and that could not be read."""
    differing: int
    """Ticks whose packets differ."""
    differences: tuple[Difference, ...]
    """The first of each kind, in order of time."""
    causes: tuple[str, ...]
    """What is not as it was when it was recorded."""

    @property
    def first(self) -> Difference | None:
        """The first difference of all."""
        return self.differences[0] if self.differences else None

    @property
    def ok(self) -> bool:
        """Whether the replay proves that the same comes out."""
        return not self.objections()

    def objections(self) -> list[str]:
        """Why the verdict is not good; [] if it is."""
        said = []
        if not self.ticks:
            said.append("there is no tick in the recording: nothing was compared")
        elif not self.packets:
            said.append("not one packet was sent in the recording: nothing was compared")
        if self.left_over:
            said.append(f"{self.left_over} received packets are left over: the robot has no such bus")
        if self.unread:
            said.append(f"{self.unread} ticks are left over: the recording could not be read to its end")
        return said + [str(d) for d in self.differences]

    def text(self) -> str:
        """For a person."""
        compared = (
            f"compared {self.ticks} ticks, {self.packets} packets with {self.bytes} bytes, and {self.views} "
            f"view messages; {self.given} received packets given again, {self.left_over} left over"
        )
        if self.ok:
            return f"the same, byte for byte\n{compared}"
        lines = ["NOT the same", *self.objections()]
        if self.differing:
            lines.append(f"the packets of {self.differing} ticks differ in all")
        lines += [f"likely cause: {cause}" for cause in self.causes]
        return "\n".join([*lines, compared])


def compare(
    recording: Recording,
    step: Callable[[Nanos, Inputs], Outputs],
    belief: Callable[[], Belief],
    decode: Callable[[str], CommandDecoder],
    *,
    robot_text: str | None = None,
    facts: Mapping[str, str] | None = None,
    mounts: Mapping[str, Mount] | None = None,
    buses: Collection[str] | None = None,
) -> Verdict:
    """Run the recorded inputs through `step` and compare all that comes out.

    `belief` is asked after each step; `decode` makes the ear of a bus; `mounts` are those of the recorder.
    `robot_text` and `facts` are of today, to find the cause of a difference (None: the recorded ones). What
    was received on a bus that is not among `buses` (None: all are) is not given to `step`, but left over."""
    judge = _Judge(step, belief, decode, Views(mounts), buses)
    try:
        for recorded in recording.steps:
            judge.take(recorded)
    except RecordingError as error:
        judge.differ("recording", f"the recording cannot be read on: {error}")
    if not recording.whole and judge.ticks:
        judge.differ(
            "recording", "the recording ends here without its end: it was cut; all before was compared"
        )
    causes: list[str] = []
    if judge.found:
        causes = _causes(judge, recording, robot_text, facts)
    return judge.verdict(recording.promised, causes)


class _Judge:
    """Counts and first differences so far, and the ears that have heard all that was sent so far."""

    def __init__(
        self,
        step: Callable[[Nanos, Inputs], Outputs],
        belief: Callable[[], Belief],
        decode: Callable[[str], CommandDecoder],
        views: Views,
        buses: Collection[str] | None,
    ) -> None:
        self._step, self._belief, self._decode = step, belief, decode
        self._views, self._buses = views, buses
        self._decoders: dict[str, CommandDecoder | None] = {}
        self._start: Nanos = 0
        self._last: Tick | None = None
        self.found: dict[Kind, Difference] = {}
        self.ticks = self.packets = self.bytes = self.shown = self.given = self.left = self.differing = 0

    def verdict(self, promised: int | None, causes: Sequence[str]) -> Verdict:
        """What it all comes to."""
        order = sorted(self.found.values(), key=lambda d: (d.tick, _KINDS.index(d.kind)))
        unread = max(0, (promised or 0) - self.ticks)
        return Verdict(
            self.ticks,
            self.packets,
            self.bytes,
            self.shown,
            self.given,
            self.left,
            unread,
            self.differing,
            tuple(order),
            tuple(causes),
        )

    def differ(self, kind: Kind, text: str) -> None:
        """Keep the difference if it is the first of its kind."""
        tick = self._last
        number, since = (tick.number, tick.now - self._start) if tick else (0, 0)
        self.found.setdefault(kind, Difference(kind, number, since, text))

    def take(self, recorded: Step) -> None:
        """One tick through the code of today."""
        tick = recorded.tick
        self._follow(tick)
        for damage in recorded.damage:
            self.differ("recording", damage)
        inputs = self._known(tick.inputs)
        outputs = self._step(tick.now, inputs)
        self.ticks += 1
        self.given += len(inputs.packets)
        self.left += len(tick.inputs.packets) - len(inputs.packets)
        self._compare_events(tick.outputs.events, outputs.events)
        self._compare_packets(tick.outputs.packets, outputs.packets)
        self._compare_notes(tick.outputs.notes, outputs.notes)
        views = self._views.messages(replace(tick, outputs=outputs), self._belief())
        if recorded.whole:
            self._compare_views(recorded.views, views)

    def _follow(self, tick: Tick) -> None:
        before, self._last = self._last, tick
        if before is None:
            self._start = tick.now
        elif tick.number != before.number + 1:
            self.differ(
                "recording", f"the tick before it in the recording is {before.number}: some were lost"
            )

    def _known(self, inputs: Inputs) -> Inputs:
        """What of the inputs is on a bus that the gateway has."""
        buses = self._buses
        if buses is None:
            return inputs
        return replace(
            inputs,
            states=tuple((bus, state) for bus, state in inputs.states if bus in buses),
            packets=tuple(packet for packet in inputs.packets if packet.bus in buses),
        )

    # -- packets ----------------------------------------------------------------------------------

    def _compare_packets(self, recorded: Sequence[Packet], now: Sequence[Packet]) -> None:
        self.packets += len(recorded)
        self.bytes += sum(len(_data(packet.frame)) for packet in recorded)
        self.differing += tuple(recorded) != tuple(now)
        if "packets" in self.found:
            return
        for one, two in zip_longest(recorded, now):
            if one != two:
                self.differ("packets", self._side_by_side(one, two))
                return
            self._handle(self._decoders, one)

    def _side_by_side(self, recorded: Packet | None, now: Packet | None) -> str:
        """Both packets and what a device would obey on hearing them, given all that it heard before."""
        words = [self._handle(deepcopy(self._decoders), packet) for packet in (recorded, now)]
        buses = dict.fromkeys(packet.bus for packet in (recorded, now) if packet)
        return "\n".join(
            [
                f"bus {' and '.join(buses)}",
                *(
                    f"  {side} {show(packet) if packet else 'nothing more'}{f'   {said}' if said else ''}"
                    for side, packet, said in zip(
                        ("recorded:", "now:     "), (recorded, now), diff.contrast(*words), strict=True
                    )
                ),
            ]
        )

    def _handle(
        self, decoders: dict[str, CommandDecoder | None], packet: Packet | None
    ) -> Sequence[Command | Request]:
        if packet is None:
            return ()
        if packet.bus not in decoders:
            decoders[packet.bus] = self._decoder(packet.bus)
        decoder = decoders[packet.bus]
        return decoder.decode(packet.t, packet.frame) if decoder else ()

    def _decoder(self, bus: str) -> CommandDecoder | None:
        known = self._buses is None or bus in self._buses
        return self._decode(bus) if known else None

    # -- events, notes, views ---------------------------------------------------------------------

    def _compare_events(self, recorded: Sequence[Event], now: Sequence[Event]) -> None:
        if tuple(recorded) == tuple(now) or "events" in self.found:
            return
        one, two = next((a, b) for a, b in zip_longest(recorded, now) if a != b)
        said = diff.contrast([one] if one else [], [two] if two else [])
        self.differ("events", _both("heard from a device", *said))

    def _compare_notes(self, recorded: Sequence[Note], now: Sequence[Note]) -> None:
        if tuple(recorded) == tuple(now) or "notes" in self.found:
            return
        one, two = next((a, b) for a, b in zip_longest(recorded, now) if a != b)
        said = [f"{note.source}: {note.text} ({note.level})" if note else "" for note in (one, two)]
        self.differ("notes", _both("told to a person", *said))

    def _compare_views(self, recorded: Sequence[View], now: Sequence[View]) -> None:
        self.shown += len(recorded)
        if "views" in self.found or list(recorded) == list(now):
            return
        # Frames last: that they differ was told already, as packets or as a change of the recording.
        for frames in (False, True):
            pairs = zip_longest(
                *([v for v in side if (v.type in FRAMES) is frames] for side in (recorded, now))
            )
            differing = next(((a, b) for a, b in pairs if a != b), None)
            if differing and not (frames and self.found):
                self._differ_view(*differing)
                return

    def _differ_view(self, one: View | None, two: View | None) -> None:
        if one and two and one[:2] == two[:2]:
            field = (
                diff.first_field(self._views.open(one), self._views.open(two))
                if one.data != two.data
                else f"its time: {one.t} ns recorded, {two.t} ns now"
            )
            self.differ("views", f"what was believed or seen, {one.topic}: {field}")
        else:
            said = [view.topic if view else "" for view in (one, two)]
            self.differ("views", _both("shown", *said))


def _data(frame: Frame) -> bytes:
    return frame if isinstance(frame, bytes) else frame.data


def _both(what: str, recorded: str, now: str) -> str:
    return f"{what}\n  recorded: {recorded or 'nothing more'}\n  now:      {now or 'nothing more'}"


def _causes(
    judge: _Judge, recording: Recording, robot_text: str | None, facts: Mapping[str, str] | None
) -> list[str]:
    """What is not as it was, most likely first."""
    causes = []
    changed = diff.settings(recording.robot_text, robot_text) if robot_text is not None else []
    if changed:
        more = [f"and {len(changed) - _MOST_SETTINGS} more"] if len(changed) > _MOST_SETTINGS else []
        causes.append("the robot file is not the recorded one: " + "; ".join(changed[:_MOST_SETTINGS] + more))
    spoilt = judge.found.get("recording")
    if spoilt and all(spoilt.tick <= other.tick for other in judge.found.values()):
        causes.append("the recording is not as it was written: see above")
    machine = diff.mappings(*_comparable(recording.facts, facts)) if facts is not None else []
    if any(line.startswith(PROGRAM) for line in machine):
        causes.append("the program: its sources have changed since")
    elsewhere = [line for line in machine if not line.startswith(PROGRAM)]
    if elsewhere:
        causes.append("it was recorded elsewhere: " + "; ".join(elsewhere))
    if not causes:
        causes.append("the program: robot file and inputs are the recorded ones")
    return causes


def _comparable(recorded: Mapping[str, str], now: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """What both sides tell: a recorder adds facts of its own (a date) that no replay has."""
    return (
        {key: value for key, value in recorded.items() if key in now},
        {key: value for key, value in now.items() if key in recorded},
    )
