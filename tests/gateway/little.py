"""A little robot for tests of recordings: one wheel on one CAN bus, with a belief, all of it deterministic.

Also strategies for ticks of every kind, with every kind of message.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from hypothesis import strategies as st

from brain.belief import Belief, BrainState, Estimate, MapView, Pose
from brain.perception.mount import Mount
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.recording import Recorder
from gateway.recording.ros_views import Views
from gateway.recording.tick_writer import TickWriter
from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.message_codec import CODES
from protocols.messages import MILLISECOND, Command, Event, Measurement, Message, Mode, Nanos, Request
from protocols.sensors import OURS

PERIOD = 5 * MILLISECOND
FEEDBACK_ID, COMMAND_ID = 0x029, 0x00D
ROBOT = 'name = "little"\n[brain]\ngain = 2.0\n[[motors]]\nname = "left"\ngear = 8.0\n'
MOUNTS = {"lidar": Mount(x=0.1, z=0.2, yaw=math.pi / 2)}


@dataclass
class Little:
    """Receives positions as float32, sends velocities = -gain · position as float32."""

    gain: float = 2.0
    position: float = 0.0
    t: Nanos = 0
    seen: int = 0
    goal: msg.Goal | None = None
    grid: np.ndarray[Any, np.dtype[np.float32]] = field(default_factory=lambda: np.zeros((4, 6), np.float32))

    def step(self, now: Nanos, inputs: Inputs) -> Outputs:
        events: list[Event] = []
        for packet in inputs.packets:
            if isinstance(packet.frame, CanFrame) and packet.frame.id == FEEDBACK_ID:
                (self.position,) = struct.unpack("<f", packet.frame.data[:4])
                self.t, self.seen = packet.t, self.seen + 1
                events.append(msg.Feedback("left", packet.t, self.position))
        for one in inputs.instructions:
            if isinstance(one, msg.Goal):
                self.goal = one
        notes = (Note("info", "brain", f"goal {self.goal}"),) if inputs.instructions else ()
        velocity = -self.gain * self.position
        return Outputs((Packet(now, "can0", command(velocity)),), tuple(events), notes)

    def belief(self) -> Belief:
        estimate = Estimate(self.t, Pose(self.position, 0.5, 0.1), 0.2, 0.3, np.eye(3) * 0.01)
        grid = self.grid.copy()
        grid[0, 0] = self.seen
        view = MapView(self.seen // 100, 0.05, {(0, 0): grid}, corner=(-1.0, -2.0))
        return Belief(
            BrainState.RUNNING, "", estimate, self.goal, ((0.0, 0.0), (1.0, 1.0)), 1, view, {"lidar": 0}, 0
        )


class LittleDecoder:
    """Decodes what the wheel obeys."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        if isinstance(frame, CanFrame) and frame.id == COMMAND_ID:
            return (msg.Velocity("left", struct.unpack("<f", frame.data[:4])[0]),)
        return ()


def command(velocity: float) -> CanFrame:
    return CanFrame(COMMAND_ID, struct.pack("<ff", velocity, 0.0))


def feedback(position: float) -> CanFrame:
    return CanFrame(FEEDBACK_ID, struct.pack("<ff", position, 0.0))


def inputs(number: int) -> Inputs:
    """Return a report of the wheel (200 Hz), a foreign frame, serial bytes, and sometimes a goal."""
    now = number * PERIOD
    packets = (
        Packet(now - 1_000, "can0", feedback(math.sin(0.01 * number))),
        Packet(now - 500, "can0", CanFrame(0x7FF, bytes([number & 0xFF]))),
        Packet(now - 100, "tty", bytes([0xA5, number & 0xFF])),
    )
    states = (("can0", BusState.UP),) if number == 0 else ()
    instructions: tuple[msg.Instruction, ...] = (
        (msg.Goal(number * 0.1, 1.0), msg.Drive(0.1, 0.2)) if number % 50 == 10 else ()
    )
    return Inputs(states, packets, instructions)


def life(count: int, robot: Little | None = None) -> Iterator[tuple[Tick, Belief]]:
    """Yield the first ticks of a little robot."""
    robot = robot or Little()
    for number in range(count):
        now, given = number * PERIOD, inputs(number)
        yield Tick(number, now, given, robot.step(now, given)), robot.belief()


def record(path: Path, count: int, *, facts: dict[str, str] | None = None) -> list[Tick]:
    """Write a closed recording of a little robot's first ticks."""
    ticks = []
    with Recorder(path, ROBOT, facts or {}, MOUNTS) as recorder:
        for tick, belief in life(count):
            recorder.record(tick, belief, patient=True)
            ticks.append(tick)
    assert (recorder.lost, recorder.trouble) == (0, "")
    return ticks


def record_in_chunks(path: Path, count: int) -> None:
    """Write the same without the recorder's threads, so that chunks always end at the same ticks."""
    writer = TickWriter(path, ROBOT, {}, Views(MOUNTS))
    results = [writer.add(tick, belief) for tick, belief in life(count)]
    assert not any((*results, writer.finish()))


def bare_belief() -> Belief:
    """Return a belief without an estimate."""
    return Belief(BrainState.READY, "", None, None, (), 0, None, {}, 0)


def scan(t: Nanos = 0, beams: int = 360) -> msg.LaserScan:
    """Return a scan with a range in every beam but the first three: no reading, nothing hit, out of range."""
    ranges = (0.0, 10.0, 11.0, *(1.0 + 0.01 * i for i in range(beams - 3)))
    return msg.LaserScan("lidar", t, -math.pi, 2 * math.pi / beams, 0.1, 10.0, ranges)


# -- anything ----------------------------------------------------------------------------------

text = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
int64 = st.integers(-(2**63), 2**63 - 1)
_floats = st.floats(allow_nan=False, allow_infinity=False)


def _of(hint: object) -> st.SearchStrategy[Any]:
    plain: dict[object, st.SearchStrategy[Any]] = {
        float: _floats,
        int: int64,
        bool: st.booleans(),
        str: text,
        bytes: st.binary(max_size=12),
        Mode: st.sampled_from(Mode),
        type(None): st.none(),
    }
    if hint in plain:
        return plain[hint]
    if hint in (msg.Repeat, msg.Try):  # they hold steps, too
        return st.builds(msg.Try, st.just((msg.Wait(1.0),)))
    if hint is msg.Perform:
        return st.builds(msg.Perform, text, st.lists(st.tuples(text, _floats | text), max_size=3).map(tuple))
    if hint in CODES.values():
        return messages([cast("type[Message]", hint)])
    arguments = get_args(hint)
    if get_origin(hint) is tuple:
        if arguments[-1] is Ellipsis:
            return st.lists(_of(arguments[0]), max_size=3).map(tuple)
        return st.tuples(*(_of(a) for a in arguments))
    assert get_origin(hint) is Union or type(hint).__name__ == "UnionType", hint
    return st.one_of(*(_of(a) for a in arguments))


def messages(kinds: Sequence[type[Message]]) -> st.SearchStrategy[Any]:
    """Return a strategy for messages of these kinds."""
    return st.one_of(*(_of(kind) if kind is msg.Perform else _message(kind) for kind in kinds))


def _message(kind: type[Message]) -> st.SearchStrategy[Any]:
    hints = get_type_hints(kind)
    return st.builds(kind, **{f.name: _of(hints[f.name]) for f in fields(kind)})


EVENTS = (*(kind for kind in get_args(Event) if kind is not Measurement), *(kind.message for kind in OURS))
INSTRUCTIONS = tuple(kind for kind in CODES.values() if kind not in EVENTS)

frames: st.SearchStrategy[Frame] = st.one_of(
    st.binary(max_size=70),
    st.builds(
        CanFrame,
        id=st.integers(0, 2**29 - 1),
        data=st.binary(max_size=64),
        extended=st.booleans(),
        remote=st.booleans(),
        fd=st.booleans(),
        brs=st.booleans(),
        requested=st.integers(0, 8),
    ),
)
packets = st.lists(st.builds(Packet, t=int64, bus=text, frame=frames), max_size=4).map(tuple)
notes = st.lists(st.builds(Note, st.sampled_from(("info", "warning", "error")), text, text), max_size=3)
ticks: st.SearchStrategy[Tick] = st.builds(
    Tick,
    number=st.integers(0, 2**64 - 1),
    now=int64,
    inputs=st.builds(
        Inputs,
        states=st.lists(st.tuples(text, st.sampled_from(BusState)), max_size=2).map(tuple),
        packets=packets,
        instructions=st.lists(messages(INSTRUCTIONS), max_size=3).map(tuple),
    ),
    outputs=st.builds(
        Outputs,
        packets=packets,
        events=st.lists(messages(EVENTS), max_size=3).map(tuple),
        notes=notes.map(tuple),
    ),
)
