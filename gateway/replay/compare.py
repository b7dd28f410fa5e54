"""Replay of a recording: its inputs go through the present code, and every output is compared to the byte.

Rules. The result is good only if something was compared, nothing was left over, nothing in the recording was
changed, and everything is equal: each packet to the byte, on its bus and in its order, each event, each note
and each view. After a difference the replay continues, so that the result can show what a change of the input
did to the frames. Nothing here knows a device: the command decoder of a bus gives the meaning of a frame.

A recording of format 1 has texts for people that were worded differently: these, and the contents of the
views made from them, are left out of the comparison, and the result says so. So are the views of poses of a
recording of format 1 or 2, in which all of them are in one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar

from brain.belief import Belief
from brain.perception.mount import Mount
from gateway.config import parse_robot
from gateway.core.guard import decoder_of
from gateway.core.message_text import escaped
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.errors import RecordingError, expect
from gateway.recording import Recording, Step, environment, read_recording
from gateway.recording.environment import PLUGIN, PROGRAM
from gateway.recording.layout import NEVER, VIEWS_FROM
from gateway.recording.ros_messages import CAN_FRAME, FD_FRAME
from gateway.recording.ros_views import ViewMessage, Views
from gateway.recording.tick_codec import packet_text
from gateway.replay import diff
from protocols import messages as msg
from protocols.frames import Packet
from protocols.messages import Event, Nanos, Obeyed, seconds
from protocols.plugin import CommandDecoder

T = TypeVar("T")
Observe: TypeAlias = Callable[[Tick, Belief], None]
Watch: TypeAlias = Callable[[Gateway], Observe]
Kind: TypeAlias = Literal[
    "recording", "times", "states", "received", "instructions", "events", "packets", "notes", "views"
]
"""Times, states, received packets and instructions differ between two recordings only (`beside`)."""
_KINDS: tuple[Kind, ...] = ("recording", "events", "packets", "notes", "views")
_FRAME_VIEWS = (CAN_FRAME, FD_FRAME)
_MAX_SETTINGS = 12
"""Changed settings that are listed."""
_TEXTS: dict[type[Event], tuple[str, ...]] = {
    msg.State: ("detail",),
    msg.Fault: ("cause", "remedy"),
    msg.Done: ("detail",),
    msg.Refused: ("reason",),
}
"""Fields of events that are texts for people."""
_TEXT_VIEWS = ("/diagnostics", "/rosout")
"""Views that are made from such texts."""
_POSE_VIEWS = ("/odom", "/tf", "/estimate", "/pose", "/map", "/plan", "/goal_pose")
"""Views of what lies in a frame"""


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
class Comparison:
    """Result of a replay."""

    ticks: int
    packets: int
    """Sent packets that were compared."""
    bytes: int
    """Bytes of data of these packets."""
    views: int
    """View messages that were compared."""
    given: int
    """Received packets that were given to the gateway again."""
    left_over: int
    """Received packets that it has no bus for."""
    unread: int
    """Ticks that the recording's index counts, and that could not be read."""
    differing: int
    """Ticks whose packets differ."""
    differences: tuple[Difference, ...]
    """The first of each kind, in order of time."""
    causes: tuple[str, ...]
    """What has changed since the recording."""
    texts_compared: bool = True
    """False for a recording of format 1: see above."""
    poses_compared: bool = True
    """False for a recording of format 1 or 2"""
    cut: bool = False
    """True if the recording has no end: what followed its last tick is not known."""
    recovered: bool = False
    """True if it is what could be recovered of another."""

    @property
    def first(self) -> Difference | None:
        """The first difference of all."""
        return self.differences[0] if self.differences else None

    @property
    def ok(self) -> bool:
        """True if the replay proves that the outputs are the same."""
        return not self.objections()

    def objections(self) -> list[str]:
        """Return why the result is not good; [] if it is."""
        objections = []
        if not self.ticks:
            objections.append("there is no tick in the recording: nothing was compared")
        elif not self.packets:
            objections.append("no packet was sent in the recording: nothing was compared")
        if self.left_over:
            objections.append(f"{self.left_over} received packets are left over: the robot has no such bus")
        if self.unread:
            objections.append(
                f"{self.unread} ticks are left over: the recording could not be read to its end"
            )
        return objections + [str(difference) for difference in self.differences]

    def text(self) -> str:
        """Return the result as text."""
        counts = (
            f"compared {self.ticks} ticks, {self.packets} packets with {self.bytes} bytes, and {self.views} "
            f"view messages; {self.given} received packets given again, {self.left_over} left over"
        )
        compared = [counts]
        if not self.texts_compared:
            compared.append("texts for people were left out: they were worded differently in format 1")
        if not self.poses_compared:
            compared.append("views of poses were left out: they had one frame before format 3")
        if self.recovered:
            compared.append("it was recovered: what had been cut off or damaged is not in it")
        if self.ok:
            return "\n".join(["the same, byte for byte", *compared])
        objections = self.objections()
        merely_cut = self.cut and len(objections) == 1
        lines = ["the same up to its end, which is missing" if merely_cut else "NOT the same", *objections]
        if self.differing:
            lines.append(f"the packets of {self.differing} ticks differ in all")
        lines += [f"likely cause: {cause}" for cause in self.causes]
        return "\n".join([*lines, *compared])


def replay_recording(
    recording: Recording | Path | str,
    robot: Robot | None = None,
    watch: Watch | None = None,
    *,
    views: bool = True,
) -> Comparison:
    """Run a recording's inputs through the code of today, and compare every output to the byte.

    Args:
        recording: what `read_recording` returned, or a path.
        robot: another robot than the recorded one.
        watch: called with the gateway before the first step; what it returns is called with every tick, as it
            is today, and with the belief after it.
        views: False: the messages of views are not compared, which are a tenth of the work.

    Returns:
        Comparison: `ok`, the first difference of each kind, and the likely causes; `text()` for a person.

    Raises:
        ConfigError: the recorded robot file is not valid any more.
        RecordingError: it is no recording, or unreadable.
        UserError: it is neither a recording nor a path.
    """
    expect("recording", recording, Recording | Path | str, "a recording, or its path")
    if not isinstance(recording, Recording):
        recording = read_recording(recording)
    robot = robot or parse_robot(recording.robot_text, f"{recording.path}: robot.toml")
    gateway = Gateway(robot)
    return compare(
        recording,
        gateway.step,
        gateway.belief,
        lambda bus: decoder_of(robot, bus),
        robot_text=robot.text,
        facts=environment.facts(),
        mounts={name: sensor.mount for name, sensor in robot.sensors.items()},
        buses=robot.buses,
        observe=watch(gateway) if watch else None,
        views=views,
    )


def compare(
    recording: Recording,
    step: Callable[[Nanos, Inputs], Outputs],
    belief: Callable[[], Belief],
    decoder: Callable[[str], CommandDecoder],
    *,
    robot_text: str | None = None,
    facts: Mapping[str, str] | None = None,
    mounts: Mapping[str, Mount] | None = None,
    buses: Collection[str] | None = None,
    observe: Observe | None = None,
    views: bool = True,
) -> Comparison:
    """Run the recorded inputs through `step` and compare all outputs.

    `belief` is called after each step, and `observe` with it and the tick as it is today; `decoder` makes the
    command decoder of a bus; `mounts` are those of the recorder. `robot_text` and `facts` are the present
    ones, to find the cause of a difference (None: the recorded ones). Frames received on a bus that is not
    among `buses` (None: all are) are left over. Without `views`, their messages are not compared."""
    comparer = Comparer(recording, step, belief, decoder, Views(mounts), buses, observe, compare_views=views)
    error: RecordingError | None = None
    try:
        for recorded in recording.steps:
            comparer.take(recorded)
    except RecordingError as raised:
        error = raised
    comparer.end(error)
    return comparer.result(recording.indexed, robot_text, facts)


class Comparer:
    """Counts and first differences so far.

    `follow`: decode all packets as they come, until they differ; otherwise all before the first difference
    are read and decoded again, when it is met: less work in all, but much at once."""

    def __init__(
        self,
        recording: Recording,
        step: Callable[[Nanos, Inputs], Outputs],
        belief: Callable[[], Belief],
        decoder: Callable[[str], CommandDecoder],
        views: Views,
        buses: Collection[str] | None,
        observe: Observe | None = None,
        *,
        follow: bool = False,
        compare_views: bool = True,
    ) -> None:
        self._recording, self._observe = recording, observe
        self._step, self._belief, self._decoder = step, belief, decoder
        self._views, self._buses = views, buses
        self._compares_views = compare_views
        self._viewless = recording.facts.get(VIEWS_FROM) == NEVER or not compare_views
        self._texts, self._poses = recording.format != "1", recording.format not in ("1", "2")
        self._start: Nanos = 0
        self._last: Tick | None = None
        self._decoders: dict[str, CommandDecoder | None] | None = None
        if follow:
            self._decoders = {bus: decoder(bus) for bus in buses or ()}
        self.differences: dict[Kind, Difference] = {}
        self.outputs: Outputs | None = None
        """Those of the last tick, as the code of today makes them."""
        self.ticks = 0
        self._packets = self._bytes = self._view_count = self._given = self._left_over = self._differing = 0

    def end(self, error: RecordingError | None = None) -> None:
        """Compare the end: nothing more can be read, for this reason if there is one."""
        if error is not None:
            self.differ("recording", f"the recording cannot be read further: {error}")
        if not self._recording.whole and self.ticks:
            self.differ(
                "recording", "the recording ends here without its end: it was cut; all before was compared"
            )

    def result(
        self, indexed: int | None, robot_text: str | None = None, facts: Mapping[str, str] | None = None
    ) -> Comparison:
        """Return the result so far, with its causes; `indexed`: number of ticks that there should be."""
        causes: list[str] = []
        if self.differences:
            causes = _causes(self.differences, self._recording, robot_text, facts)
        return Comparison(
            self.ticks,
            self._packets,
            self._bytes,
            self._view_count,
            self._given,
            self._left_over,
            max(0, (indexed or 0) - self.ticks),
            self._differing,
            self.in_order(),
            tuple(causes),
            self._texts,
            self._poses,
            not self._recording.whole,
            self._recording.recovered,
        )

    def in_order(self) -> tuple[Difference, ...]:
        """Return the differences so far, in order of time."""
        return tuple(sorted(self.differences.values(), key=lambda d: (d.tick, _KINDS.index(d.kind))))

    def differ(self, kind: Kind, text: str) -> None:
        """Keep a difference if it is the first of its kind."""
        tick = self._last
        number, since = (tick.number, tick.now - self._start) if tick else (0, 0)
        self.differences.setdefault(kind, Difference(kind, number, since, text))

    def take(self, recorded: Step) -> None:
        """Run one tick and compare it."""
        tick = recorded.tick
        self._check_number(tick)
        for damage in recorded.damage:
            self.differ("recording", damage)
        inputs = on_known_buses(tick.inputs, self._buses)
        self.outputs = outputs = self._step(tick.now, inputs)
        self.ticks += 1
        self._given += len(inputs.packets)
        self._left_over += len(tick.inputs.packets) - len(inputs.packets)
        self._compare_events(tick.outputs.events, outputs.events)
        self._compare_packets(tick.outputs.packets, outputs.packets)
        self._compare_notes(tick.outputs.notes, outputs.notes)
        today, belief = replace(tick, outputs=outputs), self._belief()
        views = () if self._viewless else self._views.messages(today, belief)
        if self._observe is not None:
            self._observe(today, belief)
        if recorded.whole and self._compares_views:
            self._compare_views(recorded.views, views)

    def _check_number(self, tick: Tick) -> None:
        before, self._last = self._last, tick
        if before is None:
            self._start = tick.now
            if tick.number:
                self.differ(
                    "recording",
                    f"it begins with tick {tick.number}: it was switched on under way, and the state that "
                    "was reached before is not in it; what follows differs for this reason alone",
                )
        elif tick.number != before.number + 1:
            self.differ(
                "recording", f"the tick before it in the recording is {before.number}: some were lost"
            )

    # -- packets ----------------------------------------------------------------------------------

    def _compare_packets(self, recorded: Sequence[Packet], now: Sequence[Packet]) -> None:
        self._packets += len(recorded)
        self._bytes += sum(len(p.frame if isinstance(p.frame, bytes) else p.frame.data) for p in recorded)
        self._differing += tuple(recorded) != tuple(now)
        if "packets" in self.differences:
            return
        for same, (one, two) in enumerate(zip_longest(recorded, now)):
            if one != two:
                self.differ("packets", self._side_by_side(one, two, recorded[:same]))
                return
            if self._decoders is not None:
                self._decode(self._decoders, one)

    def _side_by_side(self, recorded: Packet | None, now: Packet | None, same: Sequence[Packet]) -> str:
        """Return both packets and what a device would obey, given all frames before."""
        decoders = self._decoders
        if decoders is None:
            decoders, before = {}, islice(self._recording.ticks, self.ticks - 1)
            for each in chain(chain.from_iterable(tick.outputs.packets for tick in before), same):
                self._decode(decoders, each)
        commands = [self._decode(deepcopy(decoders), packet) for packet in (recorded, now)]
        buses = dict.fromkeys(packet.bus for packet in (recorded, now) if packet)
        lines = [f"bus {' and '.join(buses)}"]
        for side, packet, text in zip(
            ("recorded:", "now:     "), (recorded, now), diff.message_texts(*commands), strict=True
        ):
            frame = packet_text(packet) if packet else "nothing more"
            lines.append(f"  {side} {frame}{f'   {text}' if text else ''}")
        return "\n".join(lines)

    def _decode(self, decoders: dict[str, CommandDecoder | None], packet: Packet | None) -> Sequence[Obeyed]:
        if packet is None:
            return ()
        if packet.bus not in decoders:
            known = self._buses is None or packet.bus in self._buses
            decoders[packet.bus] = self._decoder(packet.bus) if known else None
        decoder = decoders[packet.bus]
        return decoder.decode(packet.t, packet.frame) if decoder else ()

    # -- events, notes, views ---------------------------------------------------------------------

    def _compare_events(self, recorded: Iterable[Event], now: Iterable[Event]) -> None:
        if not self._texts:
            recorded, now = ([_without_texts(event) for event in side] for side in (recorded, now))
        pair = _first_pair(recorded, now)
        if pair and "events" not in self.differences:
            texts = diff.message_texts(*([event] if event else [] for event in pair))
            self.differ("events", _both("event of a device", *texts))

    def _compare_notes(self, recorded: Iterable[Note], now: Iterable[Note]) -> None:
        if not self._texts:
            recorded, now = ([replace(note, text="") for note in side] for side in (recorded, now))
        pair = _first_pair(recorded, now)
        if pair and "notes" not in self.differences:
            texts = [f"{note.source}: {note.text} ({note.level})" if note else "" for note in pair]
            self.differ("notes", _both("note", *texts))

    def _compare_views(self, recorded: Sequence[ViewMessage], now: Sequence[ViewMessage]) -> None:
        if not self._poses:
            recorded, now = ([v for v in side if v.topic not in _POSE_VIEWS] for side in (recorded, now))
        self._view_count += len(recorded)
        if not self._texts:
            recorded, now = (
                [view._replace(data=b"") if view.topic in _TEXT_VIEWS else view for view in side]
                for side in (recorded, now)
            )
        if "views" in self.differences or list(recorded) == list(now):
            return
        # Frames last: that they differ was already found, as packets or as a change of the recording.
        for frames in (False, True):
            pair = _first_pair(
                *([v for v in side if (v.type in _FRAME_VIEWS) is frames] for side in (recorded, now))
            )
            if pair and not (frames and self.differences):
                self._differ_view(*pair)
                return

    def _differ_view(self, one: ViewMessage | None, two: ViewMessage | None) -> None:
        if one and two and one[:2] == two[:2]:
            field = (
                diff.first_field(self._views.deserialise(one), self._views.deserialise(two))
                if one.data != two.data
                else f"its time: {one.t} ns recorded, {two.t} ns now"
            )
            self.differ("views", f"view {one.topic}: {field}")
        else:
            self.differ("views", _both("view", *(view.topic if view else "" for view in (one, two))))


def on_known_buses(inputs: Inputs, buses: Collection[str] | None) -> Inputs:
    """Return the inputs without those on a bus that is not among `buses` (None: all are)."""
    if buses is None:
        return inputs
    return replace(
        inputs,
        states=tuple((bus, state) for bus, state in inputs.states if bus in buses),
        packets=tuple(packet for packet in inputs.packets if packet.bus in buses),
    )


def _first_pair(recorded: Iterable[T], now: Iterable[T]) -> tuple[T | None, T | None] | None:
    """Return the first pair that differs; None if there is none."""
    return next((pair for pair in zip_longest(recorded, now) if pair[0] != pair[1]), None)


def _without_texts(event: Event) -> Event:
    texts = dict.fromkeys(_TEXTS.get(type(event), ()), "")
    return replace(event, **texts) if texts else event  # type: ignore[arg-type]  # all are strings


def _both(what: str, recorded: str, now: str) -> str:
    recorded, now = (escaped(text) or "nothing more" for text in (recorded, now))
    return f"{what}\n  recorded: {recorded}\n  now:      {now}"


def _causes(
    differences: Mapping[Kind, Difference],
    recording: Recording,
    robot_text: str | None,
    facts: Mapping[str, str] | None,
) -> list[str]:
    """Return what has changed since the recording, most likely cause first."""
    causes = []
    changed = diff.settings(recording.robot_text, robot_text) if robot_text is not None else []
    if changed:
        more = [f"and {len(changed) - _MAX_SETTINGS} more"] if len(changed) > _MAX_SETTINGS else []
        causes.append("the robot file is not the recorded one: " + "; ".join(changed[:_MAX_SETTINGS] + more))
    damaged = differences.get("recording")
    if damaged and all(damaged.tick <= other.tick for other in differences.values()):
        cut = f"the recording was cut off: `gateway recover {recording.path}` repairs it"
        causes.append("the recording is not as it was written: see above" if recording.whole else cut)
    # Only facts of both sides, and plugins that are gone: a recorder adds some of its own (a date).
    known = {key for key in recording.facts if key in facts or key.startswith(PLUGIN)} if facts else set()
    then, today = ({key: side[key] for key in known & side.keys()} for side in (recording.facts, facts or {}))
    environments = diff.mappings(then, today)
    if any(line.startswith(PROGRAM) for line in environments):
        causes.append("the program: its sources have changed since")
    elsewhere = [line for line in environments if not line.startswith(PROGRAM)]
    if elsewhere:
        causes.append("it was recorded elsewhere: " + "; ".join(elsewhere))
    return causes or ["the program: robot file and inputs are the recorded ones"]
