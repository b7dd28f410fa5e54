"""A mission file (TOML) → a `Mission`: every mistake in it at once, before anything moves.

name = "rounds"                     by default the name of the file
on_failure = "skip"                 of every step that says nothing else: "stop" (the default) or "skip"

[[steps]]                           one key says what is done, the others how
goto = [1.5, 0.5]                   m on the map; yaw_deg; near = true: as near as it can get
drive = 0.3                         m/s forward; left = m/s, turn_deg = degrees/s; seconds, or distance = m
turn_deg = 30                       degrees to the left, on the spot
follow = [[1, 0], [2, 1]]           m; past every point but the last
wait = 5                            s
dock = 3                            a marker's id; distance, left = m
joints = {lift = 0.2, jaw = {torque = 1}}   rad, or any command; seconds; contact = true
tool = [0.3, 0, 0.2]                m, of an arm; attitude_deg = [roll, pitch, yaw]; seconds
repeat = 2                          steps = [{wait = 1}, …]; 0: without an end
on_failure = "skip"                 of any step: "stop", "skip", or steps that are done then
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeAlias

from brain.bodies.body import Base, Linkage
from brain.planning.missions import why_not
from gateway.config import resources
from gateway.config.errors import Mistakes, shown, unknown
from gateway.config.text import read_text, read_toml
from gateway.core.robot import Robot
from gateway.errors import UserError
from protocols import messages as msg
from protocols.messages import Command, Instruction, Mission, Step

MAX_DEPTH = 8
"""Of steps within each other."""
Table: TypeAlias = Mapping[str, object]


def load_mission(name: str | Path, robot: Robot | None = None) -> Mission:
    """Return the mission of a file.

    Args:
        name: the path of a mission file, or the name of one that ships with the package.
        robot: what is to do it; None: not checked.

    Returns:
        Mission: to be submitted to a session.

    Raises:
        ConfigError: the file is wrong or cannot be read; it names every mistake.
        UserError: there is no such file, or the robot cannot do it.
    """
    path = resources.find("missions", str(name))
    mission = parse_mission(read_text(path), str(path))
    if robot is not None and (wrong := cannot(mission, robot)):
        raise UserError(f"{path}: {robot.name!r} cannot do this: {wrong}")
    return mission


def cannot(asked: Instruction, robot: Robot) -> str:
    """Return why a robot cannot do what is asked; "" if it can, as far as its file tells."""
    body = robot.brain.body
    base = body if isinstance(body, Base) else None
    joints = [motor for motor in robot.motors if base is None or motor not in base.joints]
    match asked:
        case Mission(_, steps):
            armless = not isinstance(body, Linkage) and _moves_tool(steps)
            return why_not(asked, base, joints) or "there is no arm to bring the tool there" * armless
        case msg.Goal() | msg.Drive() if base is None:
            return f"{robot.name!r} has no base to drive; its joints take targets: {', '.join(joints)}"
        case msg.Drive(lateral=lateral) if lateral and base is not None and not base.moves_sideways:
            return f"the base of {robot.name!r} does not move sideways"
    motor = getattr(asked, "motor", None)
    if isinstance(asked, msg.Position) and isinstance(body, Linkage) and motor in body.joints:
        low, high = body.ranges[body.joints.index(motor)]
        within = low <= asked.position <= high
        return "" if within else f"{motor} goes from {low:g} to {high:g}, not to {asked.position:g}"
    if isinstance(asked, Command) and motor not in joints:
        if motor in robot.motors:
            bare = f"; bare joints are {', '.join(joints)}" * bool(joints)
            return f"{motor!r} moves the base: use goal or drive{bare}"
        return unknown("bare joint" if joints and base else "motor", str(motor), joints or robot.motors)
    return ""


def _moves_tool(steps: Sequence[Step]) -> bool:
    """True if one of these steps, or of those within them, brings the tip of an arm to a place."""
    return any(
        isinstance(step, msg.MoveTool)
        or (isinstance(step, msg.Repeat | msg.Try) and _moves_tool(step.steps))
        or (isinstance(step, msg.Try) and _moves_tool(step.otherwise))
        for step in steps
    )


def parse_mission(text: str, file: str = "mission.toml") -> Mission:
    """Return the mission of a text.

    Args:
        text: TOML, as in a mission file.
        file: its name, for the mistakes.

    Returns:
        Mission: to be submitted to a session.

    Raises:
        ConfigError: it is wrong, with every mistake.
    """
    mistakes = Mistakes(file, text)
    reader = _Reader(mistakes, _step_lines(text))
    mission = reader.mission(read_toml(text, mistakes), Path(file).stem)
    mistakes.check()
    return mission


def _step_lines(text: str) -> list[int]:
    """Return the line of each [[steps]], from 1."""
    heads = ("".join(line.partition("#")[0].split()) for line in text.splitlines())
    return [number for number, head in enumerate(heads, 1) if head == "[[steps]]"]


class _InvalidError(ValueError):
    """A value that is not what its key needs."""


class _Reader:
    """Reads one file; mistakes are collected with the line of their step."""

    def __init__(self, mistakes: Mistakes, lines: Sequence[int]) -> None:
        self._mistakes, self._lines = mistakes, lines
        self._line = 0

    def mission(self, table: Table, stem: str) -> Mission:
        """Return the mission of a file's table."""
        for key in table:
            if key not in ("name", "on_failure", "steps"):
                self._mistakes.add((key,), unknown("key", key, ("name", "on_failure", "steps")))
        name = table.get("name", stem)
        if not isinstance(name, str) or not name:
            self._mistakes.add(("name",), f"found {shown(name)}, expected a name")
            name = stem
        otherwise = table.get("on_failure", "stop")
        if otherwise not in ("stop", "skip"):
            self._mistakes.add(("on_failure",), f'found {shown(otherwise)}, expected "stop" or "skip"')
        if "steps" not in table:
            self._mistakes.add((), "there are no steps: expected [[steps]]")
        steps = self.steps(table.get("steps", []), "step ", skip=otherwise == "skip", depth=0)
        return Mission(name, steps)

    def steps(self, value: object, prefix: str, *, skip: bool, depth: int) -> tuple[Step, ...]:
        """Return steps; what is none of them is reported and left out."""
        if not isinstance(value, list) or depth > MAX_DEPTH:
            what = f"nested more than {MAX_DEPTH} deep" if depth > MAX_DEPTH else "expected an array of steps"
            self._add(prefix.rstrip(". "), what)
            return ()
        steps: list[Step] = []
        for number, each in enumerate(value, 1):
            if depth == 0:
                self._line = self._lines[number - 1] if number <= len(self._lines) else 0
            where = f"{prefix}{number}"
            if not isinstance(each, dict):
                self._add(where, f"found {shown(each)}, expected a table")
            elif (step := self._step(each, where, skip=skip, depth=depth)) is not None:
                steps.append(step)
        return tuple(steps)

    def _step(self, table: Table, where: str, *, skip: bool, depth: int) -> Step | None:
        kinds = [key for key in KINDS if key in table and not (key == "turn_deg" and "drive" in table)]
        if len(kinds) != 1:
            found = f"found {' and '.join(kinds)}" if kinds else f"found {', '.join(table) or 'nothing'}"
            self._add(where, f"{found}, expected exactly one of {', '.join(KINDS)}")
            return None
        kind = kinds[0]
        needed, optional, make = KINDS[kind]
        known = {kind: needed, **optional}
        values: dict[str, Any] = {}
        right = True
        for key, value in table.items():
            if key == "on_failure" or (kind == "repeat" and key == "steps"):
                continue
            if key not in known:
                self._add(where, unknown("key", key, (*known, "on_failure")))
                right = False
                continue
            try:
                values[key] = known[key](value)
            except _InvalidError as error:
                self._add(where, f"{key}: found {shown(value)}, expected {error}")
                right = False
        if kind == "repeat":
            values["steps"] = self.steps(table.get("steps"), f"{where}.", skip=skip, depth=depth + 1)
        step: Step | None = make(values) if right else None
        return self._tried(step, table.get("on_failure", "skip" if skip else "stop"), where, depth)

    def _tried(self, step: Step | None, otherwise: object, where: str, depth: int) -> Step | None:
        """Return the step with what is to be done if it fails."""
        if isinstance(otherwise, list):
            then = self.steps(otherwise, f"{where} on_failure ", skip=False, depth=depth + 1)
            return step and msg.Try((step,), then)
        if otherwise not in ("stop", "skip"):
            self._add(where, f'on_failure: found {shown(otherwise)}, expected "stop", "skip", or steps')
        return step and (msg.Try((step,)) if otherwise == "skip" else step)

    def _add(self, where: str, text: str) -> None:
        self._mistakes.add((), f"{where}: {text}", self._line)


# -- values ------------------------------------------------------------------------------------


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e6:
        raise _InvalidError("a number, up to a million")
    return float(value)


def _degrees(value: object) -> float:
    return math.radians(_number(value))


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 1_000_000:
        raise _InvalidError("a whole number, at least 0")
    return value


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise _InvalidError("true or false")
    return value


def _several(count: int, of: Callable[[object], float] = _number) -> Callable[[object], tuple[float, ...]]:
    def read(value: object) -> tuple[float, ...]:
        try:
            if isinstance(value, list) and len(value) == count:
                return tuple(of(each) for each in value)
        except _InvalidError:
            pass
        raise _InvalidError(f"{count} numbers")

    return read


def _points(value: object) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list) or not value:
        raise _InvalidError("points: [[x, y], …]")
    return tuple(_several(2)(each) for each in value)


COMMANDS: dict[str, type[Command]] = {
    "position": msg.Position,
    "velocity": msg.Velocity,
    "torque": msg.Torque,
}
"""A target by its first key; more of its fields may follow. With `stiffness` it is an Impedance."""


def _targets(value: object) -> tuple[Command, ...]:
    if not isinstance(value, dict) or not value:
        raise _InvalidError("targets by joint: {lift = 0.2}")
    return tuple(_target(motor, each) for motor, each in value.items())


def _target(motor: str, value: object) -> Command:
    if value in ("hold", "idle"):
        return msg.Hold(motor) if value == "hold" else msg.Idle(motor)
    if not isinstance(value, dict):
        return msg.Position(motor, _number(value))
    kinds = [COMMANDS[key] for key in COMMANDS if key in value]
    kind: type[Command] = msg.Impedance if "stiffness" in value else kinds[0] if kinds else msg.Position
    names = [field.name for field in fields(kind) if field.name != "motor"]
    wrong = [key for key in value if key not in names]
    given = {key: _number(each) for key, each in value.items() if key in names}
    if kind is msg.Impedance:
        given = dict.fromkeys(("velocity", "torque", "damping"), 0.0) | given
    required = names if kind is msg.Impedance else names[:1]
    if wrong or not all(name in given for name in required):
        raise _InvalidError(f"for {motor}: a number (rad), or {', '.join(names)}")
    return kind(motor, **given)


# -- kinds of steps ----------------------------------------------------------------------------


def _goal(place: tuple[float, float], yaw: float | None, *, near: bool) -> Step:
    return msg.Goal(place[0], place[1], yaw, near)


Triple: TypeAlias = tuple[float, float, float]


def _tool(place: Triple, attitude: Triple | None, seconds: float) -> Step:
    return msg.MoveTool(place[0], place[1], place[2], attitude, seconds)


Read: TypeAlias = Callable[[object], object]
Make: TypeAlias = Callable[[dict[str, Any]], Step]
KINDS: dict[str, tuple[Read, dict[str, Read], Make]] = {
    "goto": (
        _several(2),
        {"yaw_deg": _degrees, "near": _flag},
        lambda v: _goal(v["goto"], v.get("yaw_deg"), near=v.get("near", False)),
    ),
    "drive": (
        _number,
        {"left": _number, "turn_deg": _degrees, "seconds": _number, "distance": _number},
        lambda v: msg.Move(
            v["drive"], v.get("left", 0.0), v.get("turn_deg", 0.0), v.get("seconds"), v.get("distance")
        ),
    ),
    "turn_deg": (_degrees, {}, lambda v: msg.Turn(v["turn_deg"])),
    "follow": (_points, {}, lambda v: msg.Follow(v["follow"])),
    "wait": (_number, {}, lambda v: msg.Wait(v["wait"])),
    "dock": (
        _whole,
        {"distance": _number, "left": _number},
        lambda v: msg.Dock(v["dock"], v.get("distance", 0.5), v.get("left", 0.0)),
    ),
    "joints": (
        _targets,
        {"seconds": _number, "contact": _flag},
        lambda v: msg.Reach(v["joints"], v.get("seconds", 0.0), v.get("contact", False)),
    ),
    "tool": (
        _several(3),
        {"attitude_deg": _several(3, _degrees), "seconds": _number},
        lambda v: _tool(v["tool"], v.get("attitude_deg"), v.get("seconds", 0.0)),
    ),
    "repeat": (_whole, {}, lambda v: msg.Repeat(v["repeat"], v["steps"])),
}
"""Of each kind of step: how its own value is read, the other keys, and what makes the step of them."""
