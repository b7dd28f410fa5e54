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
tool = [0.3, 0, 0.2]                m, of an arm; attitude_deg = [roll, pitch, yaw]; seconds; limb = "left"
repeat = 2                          steps = [{wait = 1}, …]; 0: without an end
on_failure = "skip"                 of any step: "stop", "skip", or steps that are done then
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from brain import doors
from brain.planning.missions import why_not
from brain.reading import InvalidError, Read, whole
from brain.skills import found
from brain.skills.skill import Skill
from gateway.config import resources
from gateway.config.errors import Mistakes, shown, unknown
from gateway.config.text import read_text, read_toml
from gateway.core.robot import Robot
from gateway.errors import UserError
from protocols import messages as msg
from protocols.messages import Command, Instruction, Mission, Repeat, Step, Try

MAX_DEPTH = 8
"""Of steps within each other."""
REPEAT = "repeat"
"""The key of steps that are done several times."""
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
    able = robot.brain.abilities(robot.motors)
    base, joints = able.base, able.joints
    match asked:
        case Mission():
            takes = {name: motor.joint.commands(motor.spec) for name, motor in robot.motors.items()}
            return why_not(asked, replace(able, takes=takes))
        case msg.Goal() | msg.Drive() | msg.Locate() | msg.Grid() if base is None:
            return f"{robot.name!r} has no base to drive; its joints take targets: {', '.join(joints)}"
        case msg.Drive(lateral=lateral) if lateral and base is not None and not base.moves_sideways:
            return f"the base of {robot.name!r} does not move sideways"
    motor = getattr(asked, "motor", None)
    if isinstance(asked, msg.Position) and (arm := able.arm_of(asked.motor)) is not None:
        low, high = arm.ranges[arm.joints.index(asked.motor)]
        within = low <= asked.position <= high
        return "" if within else f"{motor} goes from {low:g} to {high:g}, not to {asked.position:g}"
    if isinstance(asked, Command) and motor not in joints:
        if motor in robot.motors:
            bare = f"; bare joints are {', '.join(joints)}" * bool(joints)
            return f"{motor!r} moves the base: use goal or drive{bare}"
        return unknown("bare joint" if joints and base else "motor", str(motor), joints or robot.motors)
    return ""


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
        if (kind := self._kind(table, where)) is None:
            return None
        if isinstance(kind, Skill):
            step = self._made(kind, table, where)
        else:
            given = self._values(table, {REPEAT: whole}, where, also=("steps",))
            inside = self.steps(table.get("steps"), f"{where}.", skip=skip, depth=depth + 1)
            step = None if given is None else Repeat(given[REPEAT], inside)
        return self._tried(step, table.get("on_failure", "skip" if skip else "stop"), where, depth)

    def _kind(self, table: Table, where: str) -> Skill[Any] | str | None:
        """Return what kind of step a table is; None: none, or several."""
        names = [*found.names(), REPEAT]
        try:
            there = {key: REPEAT if key == REPEAT else found.load(key) for key in names if key in table}
        except doors.Closed as error:
            self._add(where, str(error))
            return None
        further = {key for one in there.values() if isinstance(one, Skill) for key in one.keys}
        kinds = [key for key in there if key not in further]
        if len(kinds) == 1:
            return there[kinds[0]]
        here = f"found {' and '.join(kinds)}" if kinds else f"found {', '.join(table) or 'nothing'}"
        self._add(where, f"{here}, expected exactly one of {', '.join(names)}")
        return None

    def _values(
        self, table: Table, known: Mapping[str, Read], where: str, also: Sequence[str] = ()
    ) -> dict[str, Any] | None:
        """Return the values of a step's keys; None if one is wrong. `also`: keys that are read elsewhere."""
        values: dict[str, Any] = {}
        right = True
        for key, value in table.items():
            if key == "on_failure" or key in also:
                continue
            if key not in known:
                self._add(where, unknown("key", key, (*known, "on_failure")))
                right = False
                continue
            try:
                values[key] = known[key](value)
            except InvalidError as error:
                self._add(where, f"{key}: found {shown(value)}, expected {error}")
                right = False
        return values if right else None

    def _made(self, kind: Skill[Any], table: Table, where: str) -> Step | None:
        """Return a skill's step; None if it is wrong, or the skill has failed."""
        keys = {kind.name: kind.own, **kind.keys}
        try:
            given = found.read(kind, self._values, table, keys, where)
            return None if given is None else found.read(kind, lambda: found.crossing(kind, kind.make(given)))
        except (InvalidError, doors.Broken) as error:
            self._add(where, str(error))
            return None

    def _tried(self, step: Step | None, otherwise: object, where: str, depth: int) -> Step | None:
        """Return the step with what is to be done if it fails."""
        if isinstance(otherwise, list):
            then = self.steps(otherwise, f"{where} on_failure ", skip=False, depth=depth + 1)
            return step and Try((step,), then)
        if otherwise not in ("stop", "skip"):
            self._add(where, f'on_failure: found {shown(otherwise)}, expected "stop", "skip", or steps')
        return step and (Try((step,)) if otherwise == "skip" else step)

    def _add(self, where: str, text: str) -> None:
        self._mistakes.add((), f"{where}: {text}", self._line)
