"""One part of a robot alone, with other settings, on what it was given in a recording.

Rules. The recording is replayed with its own settings, and compared to the byte as ever; beside it, tick by
tick, a second robot with other settings does the same step, and what comes before the part is handed to it as
the first one made it. So a difference is of that part alone: it is neither of the parts before, nor does it
come back through them. What the world would have answered is not asked: the recorded robot went its own way.

    part        is given                                   makes
    perception  events of motors and sensors               percepts: pose, map, trust
    planning    percepts                                   allowances and plans
    control     percepts, allowances, plans                commands
    driver      commands, received frames, instructions    events and frames: joints, drivers, guard

Control tells planning that it has arrived, and when it is due: beside a planning with other settings runs a
control with the recorded ones (brain.pursuit), which follows its plan; and what only one of both was asked
for, since control was due there, is not compared.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from math import inf, isnan
from textwrap import indent

import numpy as np
from numpy.typing import NDArray

from brain.belief import BrainTask
from brain.bodies.limbs import limbs
from brain.brain import Brain
from brain.limb import Plan, StepValues
from brain.perception.map import Map
from gateway.config import parse_robot
from gateway.core.guard import decoder_of
from gateway.core.message_text import escaped, message_text
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs
from gateway.errors import UserError
from gateway.recording import Recording, environment
from gateway.recording.tick_codec import packet_text
from gateway.replay.compare import compare, on_known_buses
from protocols import messages as msg
from protocols.messages import SECOND, Command, Event, Nanos
from protocols.plugin import CommandDecoder

PARTS = ("perception", "planning", "control", "driver")
SHOWN = 12
"""Values that are told"""
NOT_RECORDED = "with the recorded settings the replay of the whole is not the recorded one:"


@dataclass(slots=True)
class _Parting:
    """How one value differs."""

    ticks: int = 0
    last: Nanos = -1
    most: float = 0.0
    at: Nanos = 0
    """When that was"""


@dataclass(slots=True)
class PartAlone:
    """What another setting makes of one part."""

    part: str
    ticks: int = 0
    differing: int = 0
    """Ticks in which a value differs"""
    first: str = ""
    """The first difference, in words"""
    partings: dict[str, _Parting] = field(default_factory=dict)
    """By value, without the places in sequences"""
    objection: str = ""
    """Why it shows less than it seems to; "" if it does not"""
    notes: list[str] = field(default_factory=list)
    """What else is to be known of it"""
    sides: tuple[str, str] = ("recorded", "now")
    """What the two are called"""

    @property
    def same(self) -> bool:
        """Whether nothing differs, and the rest was as it was recorded."""
        return bool(self.ticks) and not self.differing and not self.objection

    def lines(self) -> list[str]:
        """Return it in words."""
        told = [f"{self.part} alone, on what it was given in {self.ticks} recorded ticks"]
        told += [*self.objection.splitlines(), *self.notes]
        if not self.differing:
            return told + ["the same in every tick"] * bool(self.ticks)
        told += [*self.first.splitlines(), f"{self.differing} of {self.ticks} ticks differ"]
        for name, one in [*self.partings.items()][:SHOWN]:
            most = f", by {one.most:.6g} at most, at {one.at / SECOND:.3f} s" if one.most else ""
            told.append(f"  {name}: in {one.ticks} tick{'s' * (one.ticks != 1)}{most}")
        return told + [f"  and {len(self.partings) - SHOWN} more"] * (len(self.partings) > SHOWN)

    def take(self, now: Nanos, found: Iterator[tuple[str, object, object]]) -> None:
        """Take what differs in a tick, at a time since the first [ns]."""
        differs = False
        for name, one, two in found:
            if not self.first:
                where = f"tick {self.ticks}, {now / SECOND:.3f} s after the start"
                width = max(map(len, self.sides)) + 1
                texts = zip(self.sides, (_text(one), _text(two)), strict=True)
                lines = (f"  {side + ':':{width}} {text}" for side, text in texts)
                self.first = "\n".join([f"first in {where}: {name}", *lines])
            differs = True
            value = self.partings.setdefault(re.sub(r"\[\d+\]", "", name), _Parting())
            value.ticks, value.last = value.ticks + (value.last != now), now
            far = abs(two - one) if isinstance(one, int | float) and isinstance(two, int | float) else 0.0
            if value.most < far < inf:
                value.most, value.at = far, now
        self.ticks, self.differing = self.ticks + 1, self.differing + differs


def run_alone(recording: Recording, robot: Robot, part: str) -> PartAlone:
    """Run a part of a robot alone on what it was given in a recording, and compare what it makes.

    Args:
        recording: of this gateway.
        robot: with other settings than the recorded one, and the same motors, sensors and limbs.
        part: of PARTS.

    Raises:
        ConfigError: the recorded robot file is not valid any more.
        RecordingError: it is unreadable.
        UserError: the robot is another, has no such part, or the part raised with these settings.
    """
    before = parse_robot(recording.robot_text, f"{recording.path}: robot.toml")
    _check(before, robot, part)
    first = _Watched(before)
    other = _Commanded(robot) if part == "driver" else _Beside(before, robot, part)
    found, began = PartAlone(part), list[Nanos]()

    def step(now: Nanos, inputs: Inputs) -> Outputs:
        began[:] = began or [now]
        first.question = None
        outputs = first.step(now, inputs)
        try:
            found.take(now - began[0], other.take(now, inputs, first, outputs))
        except Exception as error:  # a robot that runs latches it as a fault of its brain
            when = f"{(now - began[0]) / SECOND:.3f} s after the start"
            text = f"{part}, with the other settings, raised {type(error).__name__} {when}: {error}"
            raise UserError(text) from error
        return outputs

    result = compare(
        recording,
        step,
        first.belief,
        lambda bus: decoder_of(before, bus),
        robot_text=before.text,
        facts=environment.facts(),
        mounts={name: sensor.mount for name, sensor in before.sensors.items()},
        buses=before.buses,
    )
    if not result.ok:
        found.objection = (
            f"{NOT_RECORDED}\n{indent(result.objections()[0], '  ')}\n"
            "what follows is held against what the program of today makes of them"
        )
    return found


def _check(before: Robot, robot: Robot, part: str) -> None:
    """Raise UserError if the parts of two robots are not the same."""
    if part != "driver" and (before.brain.other or robot.brain.other):
        name = (before.brain.other or robot.brain.other).kind.name  # type: ignore[union-attr]
        raise UserError(f"its brain {name!r} is of another distribution, and has no {part} that runs alone")
    for what, one, two in (
        ("buses", before.buses, robot.buses),
        ("motors", before.motors, robot.motors),
        ("sensors", before.sensors, robot.sensors),
    ):
        if list(one) != list(two):
            raise UserError(
                f"the {what} of the recorded robot are {_list(one)}, those of the other {_list(two)}: one "
                "part alone takes other settings, not another robot"
            )
    recorded, other = (
        {name: each.body.joints for name, each in limbs(which.brain.body).items()}
        for which in (before, robot)
    )
    if part != "driver" and recorded != other:
        raise UserError(
            f"the recorded body moves {_list(before.brain.body.joints)} in {_list(recorded)}, the other "
            f"{_list(robot.brain.body.joints)} in {_list(other)}: one part alone takes other "
            "settings, not another body"
        )


class _Watched(Gateway):
    """A gateway that keeps what its brain was asked, and all that the brain's systems made of it."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.question: tuple[Nanos, Sequence[Event], Sequence[BrainTask], str] | None = None
        """What the brain was asked in the last step; None: that was between two of the brain's"""
        self.values = StepValues()
        """What it has made at last"""

    def _think(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        self.question = now, events, tasks, stopped
        if isinstance(self.brain, Brain):
            self.values = self.brain.values(*self.question)
        else:
            self.values = StepValues(commands=super()._think(*self.question))
        return self.values.commands


class _Beside:
    """A brain with other settings, which is handed what comes before its part."""

    def __init__(self, before: Robot, robot: Robot, part: str) -> None:
        if part == "planning":  # its control is the recorded one
            robot = replace(robot, brain=replace(robot.brain, pursuit=before.brain.pursuit))
        brain = Gateway(robot).brain
        assert isinstance(brain, Brain), "it was looked for"
        self._brain, self._part = brain, part
        self._maps: dict[str, tuple[int, int]] = {}
        """Versions of both maps of each limb up to which they were compared"""

    def take(
        self, _now: Nanos, inputs: Inputs, first: _Watched, _outputs: Outputs
    ) -> Iterator[tuple[str, object, object]]:
        """Do the step of a tick; yield what differs: name, recorded, now."""
        for one in inputs.instructions:
            if isinstance(one, msg.Set) and one.key.startswith("brain."):
                self._brain.set(one.key.removeprefix("brain."), one.value)
        if first.question is None:
            return
        made = first.values
        if self._part == "perception":
            now_made = self._brain.values(*first.question)
            for name, percept in made.percepts.items():
                other = now_made.percepts[name]
                yield from differences(name, percept, other)
                if percept.sight is not None and other.sight is not None:
                    yield from self._map(name, percept.sight.map, other.sight.map)
        elif self._part == "planning":
            now_made = self._brain.values(*first.question, StepValues(made.percepts))
            yield from differences("", made.allowances, now_made.allowances)
            for name, plan in made.plans.items():
                yield from differences(name, *_where_both_are_due(plan, now_made.plans[name]))
        else:
            given = StepValues(made.percepts, made.allowances, made.plans)
            now_made = self._brain.values(*first.question, given)
            yield from differences("", _by_motor(made.commands), _by_motor(now_made.commands))

    def _map(self, name: str, one: Map, two: Map) -> Iterator[tuple[str, object, object]]:
        """Yield by how many cells two maps differ in the tiles that have changed."""
        if one.resolution != two.resolution:
            yield f"{name}: sight.map.resolution", one.resolution, two.resolution
            return
        since = self._maps.get(name, (-1, -1))
        self._maps[name] = one.version, two.version
        if since == self._maps[name]:
            return
        tiles = {*one.changed(since[0]), *two.changed(since[1])}
        pairs = [[side.tile(*tile) for side in (one, two)] for tile in tiles]
        if apart := sum(int(np.sum(_cells(a) != _cells(b))) for a, b in pairs):
            yield f"{name}: sight.map: cells that differ", 0, apart


class _Commanded(Gateway):
    """A gateway with other settings, whose brain's commands are those that another has made."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._given: Sequence[Command] = ()
        self._decoders: list[dict[str, CommandDecoder]] = [
            {bus: decoder_of(robot, bus) for bus in robot.buses} for _ in range(2)
        ]

    def _think(self, *_asked: object) -> Sequence[Command]:
        return self._given

    def take(
        self, now: Nanos, inputs: Inputs, first: _Watched, outputs: Outputs
    ) -> Iterator[tuple[str, object, object]]:
        """Do the step of a tick; yield what differs: name, recorded, now."""
        self._given = first.values.commands
        made = self.step(now, on_known_buses(inputs, self.robot.buses))
        yield from differences("events", outputs.events, made.events)
        obeyed = []
        for side, decoders in zip((outputs, made), self._decoders, strict=True):
            texts, meant = dict[str, list[str]](), dict[str, object]()
            for one in side.packets:
                texts.setdefault(one.bus, []).append(packet_text(one))
                for each in decoders[one.bus].decode(one.t, one.frame):
                    meant[f"{getattr(each, 'motor', one.bus)}: obeys {type(each).__name__}"] = each
            obeyed.append((texts, meant))
        (texts, meant), (texts_now, meant_now) = obeyed
        if texts != texts_now:
            yield from differences("", meant, meant_now)
            yield from differences("frames", texts, texts_now)


def _where_both_are_due(one: Plan, two: Plan) -> tuple[Plan, Plan]:
    """Return two plans without what only one of both was asked for."""
    if one.inputs is not None and two.inputs is not None:
        return one, two
    return replace(one, inputs=None), replace(two, inputs=None)


def _by_motor(commands: Sequence[Command]) -> Mapping[str, Command]:
    return {command.motor: command for command in commands}


def _cells(tile: NDArray[np.int8] | None) -> NDArray[np.int8]:
    """Return the cells of a tile of a map; one that is not there has none but 0."""
    return np.zeros((), np.int8) if tile is None else tile


def differences(name: str, one: object, two: object) -> Iterator[tuple[str, object, object]]:
    """Yield each number, text or choice that differs in two values: its name, and both.

    What computes (a function of a plan) and what is too large to be held against another at every step (the
    map) is left out."""
    if one is two or callable(one) or isinstance(one, Map):
        return
    if isinstance(one, np.ndarray) and isinstance(two, np.ndarray):
        one, two = one.tolist(), two.tolist()
    if is_dataclass(one) and type(one) is type(two):
        for each in fields(one):
            yield from differences(_inner(name, each.name), getattr(one, each.name), getattr(two, each.name))
    elif isinstance(one, Mapping) and isinstance(two, Mapping):
        for key in {**one, **two}:
            yield from differences(_inner(name, key), one.get(key), two.get(key))
    elif isinstance(one, list | tuple) and isinstance(two, list | tuple):
        if len(one) != len(two):
            yield _inner(name, "number"), len(one), len(two)
        for place, pair in enumerate(zip(one, two, strict=False)):
            yield from differences(f"{name}[{place}]", *pair)
    elif one != two and not _both_unknown(one, two):
        yield name, one, two


def _inner(name: str, key: object) -> str:
    return f"{name}{': ' if ':' not in name else '.'}{key}" if name else str(key)


def _both_unknown(one: object, two: object) -> bool:
    return isinstance(one, float) and isinstance(two, float) and isnan(one) and isnan(two)


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.9g}"
    return escaped(message_text(value, 9) if isinstance(value, msg.Message) else str(value))[:200]


def _list(names: object) -> str:
    return ", ".join(map(str, names)) or "none"  # type: ignore[call-overload]
