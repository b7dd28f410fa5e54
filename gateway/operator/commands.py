"""The commands of an operator: a line → an instruction for the robot, or why it is rejected.

Rules. Pure: a line and the robot in, a value out. The first word is the command, the rest are numbers and
names of this robot; a number that is not finite is rejected. Lengths are m, speeds m/s and rad/s, torques
N·m, at the joint's output shaft. `goal`'s yaw is in degrees and `position` in rad; either may be written with
its unit (`90deg`, `1.57rad`), as may times and lengths (`3s`, `3 s`, `2 m`). What a base does as measured is
a mission of one step. A rejected line gets a sentence and the nearest valid name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias, TypeVar

from brain import doors, reading
from brain.reading import InvalidError
from brain.skills import found
from brain.skills.skill import Skill
from gateway.config import resources
from gateway.config.errors import unknown
from gateway.config.mission import cannot, load_mission
from gateway.core.robot import Robot
from gateway.errors import ConfigError, UserError
from protocols import messages as msg

Result = TypeVar("Result")
S = TypeVar("S")
FRESH: msg.Nanos = 300 * msg.MILLISECOND
"""How long ago something that is held may have been asked for, as far as is known: at most the time there and
back on a link."""
ALL = "all"
"""Instead of a motor's name in a request: every motor."""


@dataclass(frozen=True, slots=True)
class Query:
    """A line that is answered at once, and does not reach the robot."""

    kind: Literal["status", "doctor", "help", "quit", "ready", "view"]
    text: str = ""
    """Its arguments."""


@dataclass(frozen=True, slots=True)
class RejectedLine:
    """A line that is no valid command, and why."""

    reason: str


def parse(line: str, robot: Robot, *, files: bool = True) -> msg.Instruction | Query | RejectedLine | None:
    """Return what a line asks of this robot; None for an empty line or a comment (#).

    Without `files` it may name what ships with the package, but no path."""
    words = _words(line)
    if not words:
        return None
    name, texts = words[0].lower(), words[1:]
    if [name, *texts] == ["wait", "ready"]:
        name, texts = "ready", []
    command = COMMANDS.get(name)
    if command is None:
        others, broken = _others()
        command = others.get(name)
    if command is None:
        known = unknown("command", words[0], [*COMMANDS, *others])
        return RejectedLine(broken.get(name) or f"{known}. Type help for what they do")
    if command.of_file and not files and any(map(resources.is_path, texts)):
        return RejectedLine(f"{name} one that ships: files are for the gateway's own terminal")
    if command.of_base and (wrong := cannot(msg.Drive(0.0, 0.0), robot)):
        return RejectedLine(wrong)
    usage = f"{name} {command.usage}".rstrip()
    return safely(lambda: command.parse(texts, robot), f"; expected: {usage}")


def safely(ask: Callable[[], Result], expected: str = "") -> Result | RejectedLine:
    """Return what is asked, or why not: what an operator sends ends no run, nor does a defect in reading it.

    `expected` follows what is wrong with an argument."""
    try:
        return ask()
    except InvalidError as error:
        return RejectedLine(f"{error}{expected}")
    except Exception as error:  # noqa: BLE001 -- the run goes on, with nothing done
        return RejectedLine(f"nothing was done: a defect of the gateway, {type(error).__name__}: {error}")


def command_of(line: str) -> str:
    """Return the command that a line begins with, known or not; "" for an empty line."""
    words = _words(line)
    return words[0].lower() if words else ""


def _words(line: str) -> list[str]:
    return line.partition("#")[0].replace(",", " ").split()


def help_text() -> str:
    """Return every command, its arguments, and what it does."""
    others, broken = _others()
    known = {**COMMANDS, **others}
    rows = [(f"{name} {command.usage}".strip(), command.summary) for name, command in known.items()]
    rows += broken.items()
    width = max(len(usage) for usage, _ in rows)
    return "\n".join(f"{usage:<{width}}  {summary}" for usage, summary in rows)


Convert: TypeAlias = Callable[[str, Robot], object]
"""The text of one argument → its value; raises InvalidError."""


@dataclass(frozen=True, slots=True)
class _Command:
    usage: str
    summary: str
    make: Callable[..., msg.Instruction | Query]
    """Makes the instruction from the values of the arguments."""
    arguments: tuple[Convert, ...] = ()
    optional: int = 0
    """How many of the last arguments may be missing."""
    free_text: bool = False
    """Whether the rest of the line is its one argument, which may be empty."""
    of_base: bool = False
    """Whether it needs a base that drives."""
    of_file: bool = False
    """Whether its argument may be the path of a file."""
    of_words: Callable[[list[str], Robot], msg.Instruction] | None = None
    """What makes the instruction of all words, in place of `make` and `arguments`."""

    def parse(self, texts: list[str], robot: Robot) -> msg.Instruction | Query:
        """Make the instruction; raises InvalidError, also if the robot cannot do it."""
        asked = self._make(texts, robot)
        if not isinstance(asked, Query) and (wrong := cannot(asked, robot)):
            raise InvalidError(wrong.removeprefix("step 1: "))
        return asked

    def _make(self, texts: list[str], robot: Robot) -> msg.Instruction | Query:
        """Convert the arguments; raises InvalidError."""
        if self.of_words is not None:
            return self.of_words(texts, robot)
        if self.free_text:
            return self.make(" ".join(texts))
        if len(texts) < len(self.arguments) - self.optional:
            raise InvalidError("an argument is missing")
        if len(texts) > len(self.arguments):
            raise InvalidError(f"{texts[-1]!r} is one argument too many")
        return self.make(
            *(convert(text, robot) for convert, text in zip(self.arguments, texts, strict=False))
        )


# -- arguments ---------------------------------------------------------------------------------


def _text(text: str, _: Robot) -> str:
    return text


def _number(text: str, _: Robot) -> float:
    return reading.number_of(text)


def _angle(unit: Literal["deg", "rad"]) -> Convert:
    """Return a conversion to rad; `unit` is the unit of a bare number."""
    return lambda text, _: reading.angle_of(text, unit)


def _integer(base: Literal[10, 16]) -> Convert:
    return lambda text, _: reading.integer_of(text, base)


def _name(what: str, text: str, known: Iterable[str]) -> str:
    if text not in known:
        raise InvalidError(unknown(what, text, known))
    return text


def _motor(text: str, robot: Robot) -> str:
    return _name("motor", text, robot.motors)


def _motor_or_all(text: str, robot: Robot) -> str:
    return _name("motor", text, (*robot.motors, ALL))


def _setting(text: str, robot: Robot) -> str:
    owner, dot, _ = text.partition(".")
    _name("owner of settings", owner, ("brain", *robot.motors))
    if not dot:
        raise InvalidError(f"{text!r} names no setting")
    return text


def _bus(text: str, robot: Robot) -> str:
    return _name("bus", text, robot.buses)


# -- missions ----------------------------------------------------------------------------------


def _of_skill(skill: Skill[S]) -> _Command:
    """Return the command that begins a mission of one step, named by what it does."""
    assert skill.words is not None, "it has words"
    parse = skill.words.parse

    def make(texts: list[str], robot: Robot) -> msg.Instruction:
        able = robot.brain.abilities(robot.motors)
        try:
            step = found.read(skill, lambda: found.crossing(skill, parse(texts, able)))
        except doors.Broken as error:
            raise InvalidError(str(error)) from error
        return msg.Mission(found.text(step), (step,))

    return _Command(skill.words.usage, skill.words.summary, _no, of_words=make, of_base=skill.needs_base)


def _others() -> tuple[dict[str, _Command], dict[str, str]]:
    """Return the commands of other distributions' skills, and why some of these cannot be used."""
    commands: dict[str, _Command] = {}
    broken: dict[str, str] = {}
    for name in found.others():
        try:
            skill = found.load(name)
        except doors.Closed as error:
            broken[name] = str(error)
            continue
        if skill.words is not None and name not in COMMANDS:
            commands[name] = _of_skill(skill)
    return commands, broken


def _mission(texts: list[str], robot: Robot) -> msg.Instruction:
    if len(texts) != 1:
        raise InvalidError("one file is needed")
    try:
        return load_mission(texts[0], robot)
    except (ConfigError, UserError) as error:
        raise InvalidError(str(error)) from error


# -- the commands ------------------------------------------------------------------------------


def _no() -> Query:
    """Stand for a command that is made of all its words."""
    return Query("help")


def _clear(motor: str = ALL) -> msg.ClearFault:
    return msg.ClearFault(motor)


# fmt: off
COMMANDS: dict[str, _Command] = {
    "goal": _Command("X Y [YAW]", "drive to a place on the map [m, m, degrees]",
                     msg.Goal, (_number, _number, _angle("deg")), optional=1, of_base=True),
    "drive": _Command("LINEAR ANGULAR [LATERAL]",
                      "drive by hand [m/s, rad/s, m/s to the left]; repeat it before it times out",
                      msg.Drive, (_number, _number, _number), optional=1, of_base=True),
    "mission": _Command("FILE", "do the steps of a mission file, or of one that ships", _no,
                        of_words=_mission, of_file=True),
    **{skill.called: _of_skill(skill) for skill in found.ours().values() if skill.words},
    "pause": _Command("", "stand, and keep the mission", msg.Pause),
    "resume": _Command("", "go on with a mission that was paused", msg.Resume),
    "drop": _Command("", "give up the mission, and every goal", msg.Drop),
    "locate": _Command("X Y YAW", "tell a robot that does not know it where it is on the map [m, m, degrees]",
                       msg.Locate, (_number, _number, _angle("deg")), of_base=True),
    "stop": _Command("[REASON]", "stop at once, and stay stopped until release", msg.Stop, free_text=True),
    "release": _Command("", "release stop", msg.Release),
    "clear": _Command("[MOTOR]", "clear the faults of a motor, or of all",
                      _clear, (_motor_or_all,), optional=1),
    "estop": _Command("MOTOR|all", "the device's own emergency stop; clear releases it",
                      msg.Estop, (_motor_or_all,)),
    "position": _Command("MOTOR VALUE", "bare joints: move to a position [rad]",
                         msg.Position, (_text, _angle("rad"))),
    "velocity": _Command("MOTOR VALUE", "bare joints: turn at a velocity [rad/s]",
                         msg.Velocity, (_text, _number)),
    "torque": _Command("MOTOR VALUE", "bare joints: apply a torque [N·m]", msg.Torque, (_text, _number)),
    "idle": _Command("MOTOR", "bare joints: no torque", msg.Idle, (_text,)),
    "hold": _Command("MOTOR", "bare joints: hold the present position", msg.Hold, (_text,)),
    "set": _Command("KEY VALUE", "a limit or gain, as brain.pursuit.… or MOTOR.limits.velocity",
                    msg.Set, (_setting, _number)),
    "zero": _Command("MOTOR", "make the present position zero", msg.Zero, (_motor,)),
    "home": _Command("MOTOR", "run the device's own homing", msg.Home, (_motor,)),
    "confirm": _Command("MOTOR", "the position it reports is the true one, after it had jumped",
                        msg.Confirm, (_motor,)),
    "reboot": _Command("MOTOR", "restart the device", msg.Reboot, (_motor,)),
    "read": _Command("MOTOR PARAMETER", "read a parameter of the device by its own name",
                     msg.ReadParameter, (_motor, _text)),
    "write": _Command("MOTOR PARAMETER VALUE", "write a parameter of the device by its own name",
                      msg.WriteParameter, (_motor, _text, _number)),
    "scan": _Command("BUS", "look for devices; enables and clears nothing", msg.Scan, (_bus,)),
    "setid": _Command("BUS SERIAL ADDRESS", "give the device with this serial number (hex) an address",
                      msg.SetId, (_bus, _integer(16), _integer(10))),
    "setaddress": _Command("MOTOR ADDRESS", "give the device of a motor another address; it is silent then",
                           msg.SetAddress, (_motor, _integer(10))),
    "status": _Command("", "what the robot does, and why", partial(Query, "status")),
    "doctor": _Command("", "what hinders it, why that matters, and what to type", partial(Query, "doctor")),
    "view": _Command("[HOST:PORT] [steer]", "open the live view for a browser; print its address",
                     partial(Query, "view"), free_text=True),
    "ready": _Command("", "keep the lines after it until every motor was heard (also: wait ready)",
                      partial(Query, "ready")),
    "help": _Command("", "this list", partial(Query, "help")),
    "quit": _Command("", "send the stop command and end the run", partial(Query, "quit")),
}
# fmt: on
