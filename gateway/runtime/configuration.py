"""What is configured on the motors: read, compared with the robot file or an earlier dump, and restored.

Rules. Requests go through gateway, driver and live loop like any others, one at a time per motor; nothing
is commanded, so that all frames but those that write are read-only. Which parameters there are, what the
robot file states of them and which are never written is the plugin's (`Spec.configuration`). A dump is
checked as a whole before anything is written; what is written is read back, and saved on the device only if
all of it is as it should be.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isclose, isfinite
from pathlib import Path
from typing import Any, TypeAlias

from brain.bodies import bare
from gateway.config.errors import Mistakes, unknown
from gateway.config.text import MAX_SIZE, read_text, read_toml
from gateway.core.clock import date
from gateway.core.robot import Motor, Robot
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.runtime.session import Session
from protocols import messages as msg
from protocols.messages import SECOND, Event, Mode, Nanos
from protocols.plugin import DRIVER_WRITES, FeedbackKind

ANSWER: Nanos = 15 * SECOND
"""Time after which a request counts as not answered; drivers answer sooner (conformance: 8 s)."""
READY: Nanos = 3 * SECOND
"""Time in which the motors may report their states."""
DUMP = 8
"""How often the usual size of a file a dump may be: a program writes it."""
KNOWN = (Mode.READY, Mode.FAULT)
"""States in which a motor is written to."""
UNITS = {"velocity": "rad/s", "torque": "N·m"}
SHARED = "more than one device answers at its address"
NO_PARAMETER = "no parameter of this motor's protocol and options"

Answer: TypeAlias = msg.Done | msg.Refused | msg.Parameter


@dataclass(slots=True)
class Reading:
    """What is configured on one motor, as read or as in a dump."""

    protocol: str
    address: int
    serial: int | None = None
    firmware: str = ""
    values: dict[str, float] = field(default_factory=dict)
    not_read: dict[str, str] = field(default_factory=dict)
    """The reason, by parameter."""
    shared: bool = False
    """More than one device answers at its address."""


Readings: TypeAlias = dict[str, Reading]
"""By motor."""


@dataclass(frozen=True, slots=True)
class ParameterDifference:
    """One parameter that is not as it should be."""

    motor: str
    parameter: str
    found: float | None
    """None: it was not read."""
    wanted: float | None
    """None: there is no one value that is right."""
    text: str
    """What should be, or what the difference means."""
    left: str = ""
    """Why `restore` leaves it; "" if it writes it."""

    def __str__(self) -> str:
        found = "not read" if self.found is None else shown(self.found)
        left = f"; left: {self.left}" if self.left else ""
        return f"{self.motor}.{self.parameter} = {found}: {self.text}{left}"


class Interrupted(UserError):
    """A signal came, or a bus failed, before all was done."""


def motors_only(robot: Robot) -> Robot:
    """Return the robot without sensors and without a base: nothing commands its motors."""
    buses = {motor.bus: robot.buses[motor.bus] for motor in robot.motors.values()}
    brain = replace(robot.brain, body=bare(robot.motors), other=None)
    world = robot.world if robot.brain.body.bare else None
    return replace(robot, world=world, buses=buses, sensors={}, brain=brain)


# -- reading and writing ------------------------------------------------------------------------------


class Motors:
    """The motors of a session that runs, as receivers of requests."""

    def __init__(self, session: Session) -> None:
        self.session, self.motors = session, session.robot.motors
        self.shared: set[str] = set()
        """Those whose address more than one device has, as found so far."""
        self._ticks: Generator[Tick] = session.run()

    def close(self) -> None:
        """End the run."""
        self._ticks.close()

    def unfit(self, motor: str) -> str:
        """Return why nothing is written to a motor, "" if it may be: it is known not to be armed, or tells
        that to nobody who does not command it."""
        joint, spec = self.session.joints[motor], self.motors[motor].spec
        silent = spec.feedback is FeedbackKind.REPLY and joint.mode in (Mode.OFFLINE, Mode.INITIALISING)
        heard = silent and not joint.feedback_lost(self.session.clock.now())
        return SHARED if motor in self.shared else "" if heard or joint.mode in KNOWN else str(joint.mode)

    def ask(self, requests: Sequence[msg.Request], timeout: Nanos = ANSWER) -> dict[str, Answer]:
        """Make one request of each of some motors, or buses. Returns the answers by their names."""
        wanted, answers = {subject(each): each for each in requests}, dict[str, Answer]()
        self.session.submit(*requests)
        for event in self._events(timeout, lambda: answers.keys() == wanted.keys()):
            for name, request in wanted.items():
                if isinstance(event, Answer) and _answers(event, request):
                    answers[name] = event
        return answers

    def wait(self, span: Nanos) -> None:
        """Step for a time."""
        list(self._events(span, lambda: False))

    def identify(self) -> Readings:
        """Wait until all motors report their states, and read which devices they are."""
        known = ("", str(Mode.ARMED))
        list(self._events(READY, lambda: all(self.unfit(name) in known for name in self.motors)))
        readings = {name: Reading(one.plugin.name, one.device.address) for name, one in self.motors.items()}
        self._identify(readings)
        for name in self.shared:
            readings[name].shared = True
        return readings

    def read(self) -> Readings:
        """Read what is configured on all motors."""
        readings = self.identify()
        names = {name: list(motor.spec.configuration) for name, motor in self.motors.items()}
        for at in range(max(map(len, names.values()), default=0)):
            asked = {name: each[at] for name, each in names.items() if at < len(each)}
            answers = self.ask([msg.ReadParameter(name, each) for name, each in asked.items()])
            for name, parameter in asked.items():
                answer = answers.get(name)
                if isinstance(answer, msg.Parameter) and isfinite(answer.value):
                    readings[name].values[parameter] = answer.value
                else:
                    readings[name].not_read[parameter] = reason(answer)
        return readings

    def write(self, motor: str, parameter: str, value: float) -> str:
        """Write a parameter and read it back. Returns what is wrong, "" if it is as written."""
        if (wrong := self.unfit(motor)) and wrong != SHARED:
            return f"{motor} is {wrong}"
        if wrong:
            return wrong
        written = self.ask([msg.WriteParameter(motor, parameter, value)]).get(motor)
        if not isinstance(written, msg.Done) or parameter == self.motors[motor].spec.save:
            return "" if isinstance(written, msg.Done) else reason(written)
        read = self.ask([msg.ReadParameter(motor, parameter)]).get(motor)
        if not isinstance(read, msg.Parameter):
            return f"not read back: {reason(read)}"
        return "" if is_same(read.value, value) else f"{shown(read.value)} is read back"

    def _identify(self, readings: Readings) -> None:
        """Read serial numbers and firmware by a scan of each bus. An answer does not name its bus: of two
        devices that have one address on two buses, neither is identified."""
        for bus in self.session.robot.buses:
            for event in self._scan(bus):
                name, *others = self._named(event) or [""]
                if name and not others and self.motors[name].bus == bus:
                    one = readings[name]
                    self.shared |= {name} if one.serial not in (None, event.serial) else set()
                    one.serial = event.serial
                    one.firmware = event.detail.removeprefix(name).removeprefix(", ")

    def _named(self, found: msg.Found) -> list[str]:
        at = found.protocol, found.address
        return [name for name, one in self.motors.items() if (one.plugin.name, one.device.address) == at]

    def _scan(self, bus: str) -> list[msg.Found]:
        here = [one for one in self.motors.values() if one.bus == bus and msg.Scan in one.spec.requests]
        protocols, ended, found = {one.plugin.name for one in here}, list[Event](), list[msg.Found]()
        self.session.submit(*[msg.Scan(bus)] if here else [])
        for event in self._events(ANSWER, lambda: len(ended) >= len(protocols)):
            if isinstance(event, msg.Found):
                found.append(event)
            elif isinstance(event, msg.Done | msg.Refused) and event.request == msg.Scan.__name__:
                ended.append(event)
        return found

    def _events(self, timeout: Nanos, done: Callable[[], bool]) -> Generator[Event]:
        """Step until that is so, at most until the timeout; yield the events. Raises Interrupted."""
        until = self.session.clock.now() + timeout
        while not done() and self.session.clock.now() < until:
            tick = next(self._ticks, None)
            if tick is None:
                raise Interrupted(f"interrupted: {next(iter(self.session.reasons), 'the run has ended')}")
            for event in tick.outputs.events:
                if isinstance(event, msg.Found) and event.duplicate_address:
                    self.shared.update(self._named(event))
                yield event


def shown(value: float) -> str:
    """Return a value as text: integers whole, others to what binary32 holds."""
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else f"{value:.7g}"


def is_same(one: float, other: float) -> bool:
    """True if two values are the same to a device that keeps binary32."""
    return isclose(one, other, rel_tol=1e-6, abs_tol=1e-12)


def subject(request: msg.Request) -> str:
    """Return the motor that a request is for, or the bus."""
    name: str = getattr(request, "motor", "") or getattr(request, "bus", "")
    return name


def _answers(event: Answer, request: msg.Request) -> bool:
    if isinstance(event, msg.Parameter):
        return msg.ReadParameter(event.motor, event.parameter) == request
    return (event.name, event.request) == (subject(request), type(request).__name__)


def reason(answer: Answer | None) -> str:
    """Return why an answer is not the one that is wanted."""
    match answer:
        case msg.Refused(reason=reason):
            return reason
        case msg.Done(detail=detail):
            return f"no number: {detail}"
        case msg.Parameter(value=value):
            return f"{value} is no finite number"
    return "no answer"


# -- comparing ----------------------------------------------------------------------------------------


def against_robot(robot: Robot, readings: Readings) -> tuple[list[ParameterDifference], list[str]]:
    """Return what differs from the robot file, and remarks: devices' limits wider than the joint's."""
    found, remarks = list[ParameterDifference](), list[str]()
    for name, motor in robot.motors.items():
        for parameter, setting in motor.spec.configuration.items():
            value, expected = readings[name].values.get(parameter), setting.expected
            if setting.protected == DRIVER_WRITES:
                continue
            if value is None:
                if expected is not None or setting.limit:
                    reason = readings[name].not_read.get(parameter, "")
                    found.append(ParameterDifference(name, parameter, None, expected, reason))
            elif expected is not None and not is_same(value, expected):
                text = f"the robot file has {shown(expected)}"
                found.append(ParameterDifference(name, parameter, value, expected, text, setting.protected))
            elif setting.limit:
                gear = motor.joint.gear if setting.limit == "torque" else 1.0 / motor.joint.gear
                reached, most = abs(value) * setting.unit * gear, getattr(motor.joint.limits, setting.limit)
                text = f"{reached:.4g} {UNITS[setting.limit]} at the joint, whose limit is {most:g}"
                if reached < most and not is_same(reached, most):
                    found.append(
                        ParameterDifference(name, parameter, value, None, f"the device allows only {text}")
                    )
                elif reached > most and not is_same(reached, most):
                    remarks.append(f"{name}.{parameter} = {shown(value)}: the device allows {text}")
    return found, remarks


def against_dump(robot: Robot, readings: Readings, dump: Readings) -> list[ParameterDifference]:
    """Return what differs from a dump, in the order of the dump."""
    found = []
    for name, saved in dump.items():
        settings, now = robot.motors[name].spec.configuration, readings[name]
        for parameter, wanted in saved.values.items():
            value = now.values.get(parameter)
            if value is not None and is_same(value, wanted):
                continue
            setting = settings.get(parameter)
            left = NO_PARAMETER if setting is None else setting.protected
            if value is None and not left:
                left = f"not read: {now.not_read.get(parameter, '')}"
            if left != DRIVER_WRITES:
                text = f"the dump has {shown(wanted)}"
                found.append(ParameterDifference(name, parameter, value, wanted, text, left))
    return found


# -- dumps ----------------------------------------------------------------------------------------------


def dump_text(robot: Robot, readings: Readings) -> str:
    """Return readings as TOML."""
    lines = [f"robot = {quoted(robot.name)}", f"date = {quoted(date())}"]
    for name, one in readings.items():
        lines += ["", f"[motors.{name}]", f"protocol = {quoted(one.protocol)}"]
        lines += [f"bus = {quoted(robot.motors[name].bus)}", f"address = {one.address}"]
        lines += [f'serial = "{one.serial:X}"'] if one.serial is not None else []
        lines += [f"firmware = {quoted(one.firmware)}"] if one.firmware else []
        lines += ["", f"[motors.{name}.values]"] if one.values else []
        lines += [f"{quoted(parameter)} = {value!r}" for parameter, value in one.values.items()]
        lines += ["", f"[motors.{name}.not_read]"] if one.not_read else []
        lines += [f"{quoted(parameter)} = {quoted(reason)}" for parameter, reason in one.not_read.items()]
    return "\n".join(lines) + "\n"


def quoted(text: str) -> str:
    """Return a text as a TOML string, on one line and without control characters."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def read_dump(path: Path, robot: Robot) -> Readings:
    """Read a dump of this robot. Raises UserError or ConfigError with all that is wrong."""
    text = read_text(path, DUMP * MAX_SIZE)
    table = read_toml(text, Mistakes(str(path), text), DUMP)
    motors = table.get("motors")
    if not isinstance(motors, dict) or not isinstance(table.get("robot"), str):
        raise UserError(f"{path}: is no dump: `gateway motor dump ROBOT --out FILE` makes one")
    if table["robot"] != robot.name:
        raise UserError(f"{path}: is a dump of the robot {table['robot']!r}, not of {robot.name!r}")
    wrong = list[str]()
    dump = {name: _one(name, each, robot.motors, wrong) for name, each in motors.items()}
    if wrong:
        raise UserError("\n".join(f"{path}: {each}" for each in wrong))
    return dump


def _one(name: str, table: Any, motors: Mapping[str, Motor], wrong: list[str]) -> Reading:  # noqa: ANN401 -- TOML
    if name not in motors:
        wrong.append(unknown("motor", name, motors))
        return Reading("", 0)
    plugin, settings = motors[name].plugin.name, motors[name].spec.configuration
    table = table if isinstance(table, dict) else {}
    protocol, address, serial = (table.get(key) for key in ("protocol", "address", "serial"))
    values = table.get("values", {})
    if protocol != plugin:
        wrong.append(f"{name}: the dump is of the protocol {protocol!r}, the robot file has {plugin!r}")
    is_serial = serial is None or re.fullmatch(r"[0-9A-F]{1,32}", str(serial))
    if type(address) is not int or not is_serial or not isinstance(values, dict):
        wrong.append(f"{name}: address must be an integer, serial hexadecimal digits, values a table")
        return Reading(plugin, 0)
    for parameter, value in values.items():
        setting = settings.get(parameter)
        if type(value) not in (int, float) or not isfinite(value):
            wrong.append(f"{name}.{parameter}: {value!r} is no finite number")
        elif setting is not None and not setting.protected and not setting.low <= value <= setting.high:
            wrong.append(f"{name}.{parameter}: {value!r} is outside {setting.low:g} … {setting.high:g}")
    return Reading(plugin, address, None if serial is None else int(str(serial), 16), values=values)


def same_devices(readings: Readings, dump: Readings) -> list[str]:
    """Return in words which motors are not those of which the dump was made."""
    wrong = []
    for name, saved in dump.items():
        now = readings[name]
        if now.shared:
            wrong.append(f"{name}: {SHARED}")
        elif None not in (saved.serial, now.serial) and saved.serial != now.serial:
            text = f"the device has the serial number {now.serial:X}, the dump is of {saved.serial:X}"
            wrong.append(f"{name}: {text}")
        elif None in (saved.serial, now.serial) and saved.address != now.address:
            text = f"address {now.address}, the dump is of address {saved.address}"
            wrong.append(f"{name}: {text}, and no serial number shows that it is the same device")
    return wrong


def restore(
    motors: Motors, differences: Sequence[ParameterDifference], report: Callable[[str], None]
) -> bool:
    """Write what differs and is not to be left, and save it. Returns whether all was done."""
    concerned = dict.fromkeys(each.motor for each in differences if not each.left)
    if refused := [
        f"{name} is {wrong}" for name in concerned if (wrong := motors.unfit(name)) not in ("", SHARED)
    ]:
        raise UserError(f"nothing is written: {', '.join(refused)}; disarm it first")
    good = True
    for name in concerned:
        wanted = {each.parameter: each.wanted for each in differences if each.motor == name and not each.left}
        failed = False
        for parameter, value in wanted.items():
            wrong = motors.write(name, parameter, value or 0.0)
            report(f"{name}.{parameter}: {wrong or f'written: {shown(value or 0.0)}'}")
            failed |= bool(wrong)
        save = motors.motors[name].spec.save
        if failed and save:
            report(f"{name}: not saved: what was written is lost when it is switched off")
        elif save:
            wrong = motors.write(name, save, 1.0)
            report(f"{name}: {f'not saved: {wrong}' if wrong else 'saved'}")
            failed = bool(wrong)
        good &= not failed
    return good
