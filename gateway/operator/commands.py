"""What a person may say to a running robot: a line → what is asked, or what is wrong with it.

Rules. Pure: a line and the robot in, a value out. The first word says what is meant, the rest are numbers
and names of this robot; a number that is not finite is not taken. Lengths are m, speeds m/s and rad/s,
torques N·m, at the joint's output shaft. `goal`'s yaw is in degrees and `position` in rad; either may be
written with its unit (`90deg`, `1.57rad`). What is not understood gets a sentence and the nearest word.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, radians
from typing import Literal, TypeAlias

from gateway.config.errors import unknown
from gateway.core.robot import Robot
from protocols import messages as msg

ALL = "all"
"""Instead of a motor's name in a request: every motor."""


@dataclass(frozen=True, slots=True)
class Query:
    """What is answered at once, and leaves the robot alone."""

    kind: Literal["status", "help", "quit"]


@dataclass(frozen=True, slots=True)
class Mistake:
    """The line is not understood, and why."""

    sentence: str


def parse(line: str, robot: Robot) -> msg.Instruction | Query | Mistake | None:
    """What a line asks of this robot; None for an empty line or a comment (#)."""
    words = line.partition("#")[0].replace(",", " ").split()
    if not words:
        return None
    form = FORMS.get(words[0].lower())
    if form is None:
        return Mistake(f"{unknown('word', words[0], FORMS)}. Say help for what they mean")
    try:
        return form.make(words[1:], robot)
    except _Wrong as wrong:
        return Mistake(f"{wrong}; expected: {_usage(words[0].lower(), form)}")


def help_text() -> str:
    """Every word, what follows it, and what it does."""
    rows = [(_usage(word, form), form.says) for word, form in FORMS.items()]
    width = max(len(usage) for usage, _ in rows)
    return "\n".join(f"{usage:<{width}}  {says}" for usage, says in rows)


class _Wrong(ValueError):
    """What is wrong with a line."""


Args: TypeAlias = list[str]
Make: TypeAlias = Callable[[Args, Robot], msg.Instruction | Query]


@dataclass(frozen=True, slots=True)
class _Form:
    usage: str
    says: str
    make: Make


def _usage(word: str, form: _Form) -> str:
    return f"{word} {form.usage}".strip()


# -- parts of a line ---------------------------------------------------------------------------


def _count(args: Args, least: int, most: int | None = None) -> None:
    if len(args) < least:
        raise _Wrong("something is missing" if args or least > 1 else "nothing follows it")
    if len(args) > (least if most is None else most):
        raise _Wrong(f"{args[-1]!r} is too much")


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise _Wrong(f"{text!r} is not a number") from None
    if not isfinite(value):
        raise _Wrong(f"{text!r} is not a finite number")
    return value


def _angle(text: str, unit: Literal["deg", "rad"]) -> float:
    """In rad; `unit` is what a bare number is in."""
    for suffix in ("deg", "rad"):
        if text.endswith(suffix):
            text, unit = text.removesuffix(suffix), suffix
            break
    value = _number(text)
    return radians(value) if unit == "deg" else value


def _whole(text: str, base: int) -> int:
    try:
        value = int(text, base)
    except ValueError:
        raise _Wrong(f"{text!r} is not a{' hexadecimal' if base == 16 else 'n'} integer") from None
    if value < 0:
        raise _Wrong(f"{text!r} is negative")
    return value


def _name(what: str, text: str, known: Sequence[str]) -> str:
    if text not in known:
        raise _Wrong(unknown(what, text, known))
    return text


def _motor(text: str, robot: Robot) -> str:
    return _name("motor", text, list(robot.motors))


def _motor_or_all(text: str, robot: Robot) -> str:
    return text if text == ALL else _name("motor", text, [*robot.motors, ALL])


def _bare_joint(text: str, robot: Robot) -> str:
    """A motor that is no wheel of a base."""
    base = robot.brain.differential if robot.brain.body == "differential" else None
    wheels = () if base is None else (base.left, base.right)
    joints = [name for name in robot.motors if name not in wheels]
    if not joints:
        raise _Wrong(f"the motors of {robot.name!r} are the wheels of its base: say goal or drive")
    if text in wheels:
        raise _Wrong(f"{text!r} is a wheel: say goal or drive; bare joints are {', '.join(joints)}")
    return _name("bare joint", text, joints)


def _needs_base(robot: Robot) -> None:
    if robot.brain.body != "differential":
        raise _Wrong(f"{robot.name!r} is bare joints and goes nowhere: say position, velocity or torque")


# -- the words ---------------------------------------------------------------------------------


def _goal(args: Args, robot: Robot) -> msg.Goal:
    _needs_base(robot)
    _count(args, 2, 3)
    yaw = _angle(args[2], "deg") if len(args) == 3 else None
    return msg.Goal(_number(args[0]), _number(args[1]), yaw)


def _drive(args: Args, robot: Robot) -> msg.Drive:
    _needs_base(robot)
    _count(args, 2)
    return msg.Drive(_number(args[0]), _number(args[1]))


def _stop(args: Args, _: Robot) -> msg.Stop:
    return msg.Stop(" ".join(args))


def _release(args: Args, _: Robot) -> msg.Release:
    _count(args, 0)
    return msg.Release()


def _position(args: Args, robot: Robot) -> msg.Position:
    _count(args, 2)
    return msg.Position(_bare_joint(args[0], robot), _angle(args[1], "rad"))


def _value(kind: type[msg.Velocity] | type[msg.Torque]) -> Make:
    def make(args: Args, robot: Robot) -> msg.Instruction:
        _count(args, 2)
        return kind(_bare_joint(args[0], robot), _number(args[1]))

    return make


def _at_rest(kind: type[msg.Idle] | type[msg.Hold]) -> Make:
    def make(args: Args, robot: Robot) -> msg.Instruction:
        _count(args, 1)
        return kind(_bare_joint(args[0], robot))

    return make


def _of_motor(kind: type[msg.Reboot] | type[msg.Zero] | type[msg.Home]) -> Make:
    def make(args: Args, robot: Robot) -> msg.Instruction:
        _count(args, 1)
        return kind(_motor(args[0], robot))

    return make


def _clear(args: Args, robot: Robot) -> msg.ClearFault:
    _count(args, 0, 1)
    return msg.ClearFault(_motor_or_all(args[0], robot) if args else ALL)


def _estop(args: Args, robot: Robot) -> msg.Estop:
    _count(args, 1)
    return msg.Estop(_motor_or_all(args[0], robot))


def _set(args: Args, robot: Robot) -> msg.Set:
    _count(args, 2)
    room, dot, _ = args[0].partition(".")
    _name("room", room, ["brain", *robot.motors])
    if not dot:
        raise _Wrong(f"{args[0]!r} names no setting")
    return msg.Set(args[0], _number(args[1]))


def _scan(args: Args, robot: Robot) -> msg.Scan:
    _count(args, 1)
    return msg.Scan(_name("bus", args[0], list(robot.buses)))


def _setid(args: Args, robot: Robot) -> msg.SetId:
    _count(args, 3)
    return msg.SetId(_name("bus", args[0], list(robot.buses)), _whole(args[1], 16), _whole(args[2], 10))


def _read(args: Args, robot: Robot) -> msg.ReadParameter:
    _count(args, 2)
    return msg.ReadParameter(_motor(args[0], robot), args[1])


def _write(args: Args, robot: Robot) -> msg.WriteParameter:
    _count(args, 3)
    return msg.WriteParameter(_motor(args[0], robot), args[1], _number(args[2]))


def _query(kind: Literal["status", "help", "quit"]) -> Make:
    def make(args: Args, _: Robot) -> Query:
        _count(args, 0)
        return Query(kind)

    return make


# fmt: off
FORMS: dict[str, _Form] = {
    "goal": _Form("X Y [YAW]", "go to a place on the map [m, m, degrees]", _goal),
    "drive": _Form("LINEAR ANGULAR", "drive by hand [m/s, rad/s]; say it again before it grows old", _drive),
    "stop": _Form("[REASON]", "stop at once, and stay stopped until release", _stop),
    "release": _Form("", "take back stop", _release),
    "clear": _Form("[MOTOR]", "clear the faults of a motor, or of all", _clear),
    "estop": _Form("MOTOR|all", "the device's own emergency stop; clear takes it back", _estop),
    "position": _Form("MOTOR VALUE", "bare joints: go to a position [rad]", _position),
    "velocity": _Form("MOTOR VALUE", "bare joints: turn at a velocity [rad/s]", _value(msg.Velocity)),
    "torque": _Form("MOTOR VALUE", "bare joints: give a torque [N·m]", _value(msg.Torque)),
    "idle": _Form("MOTOR", "bare joints: no torque", _at_rest(msg.Idle)),
    "hold": _Form("MOTOR", "bare joints: stay where it is", _at_rest(msg.Hold)),
    "set": _Form("KEY VALUE", "a limit or gain, as brain.pursuit.… or MOTOR.limits.velocity", _set),
    "zero": _Form("MOTOR", "call the present position zero", _of_motor(msg.Zero)),
    "home": _Form("MOTOR", "run the device's own homing", _of_motor(msg.Home)),
    "reboot": _Form("MOTOR", "restart the device", _of_motor(msg.Reboot)),
    "read": _Form("MOTOR PARAMETER", "read a parameter of the device by its own name", _read),
    "write": _Form("MOTOR PARAMETER VALUE", "write a parameter of the device by its own name", _write),
    "scan": _Form("BUS", "look for devices; enables and clears nothing", _scan),
    "setid": _Form("BUS SERIAL ADDRESS", "give the device with this serial number (hex) an address", _setid),
    "status": _Form("", "what the robot does, and why", _query("status")),
    "help": _Form("", "this list", _query("help")),
    "quit": _Form("", "leave: the safe word, and then the end", _query("quit")),
}
# fmt: on
