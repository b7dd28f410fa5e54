"""A robot file from what was found on its buses, what is stated, and what a person answers.

Rules. Which questions there are is read from the dataclasses that the robot file fills: what a body, a
protocol's options and a joint have no default for, and what a protocol says that a number's meaning hangs on
(`Spec.scales`). Such numbers are stated or asked, never proposed; what only limits a motion may be proposed,
and the file says so. Nothing is opened here, and nothing is written: the text is one that `parse_robot`
takes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot, inf
from typing import Any, Literal, get_args, get_origin

from brain.bodies import urdf
from brain.bodies.body import Base, Body, Linkage
from brain.bodies.plane import Twist
from gateway.config.answers import Answers, Question, docs, question_of, required
from gateway.config.bodies import load_body, names
from gateway.config.robot_file import parse_robot
from gateway.config.toml_text import Table, bus_section, common, filled, rounded, section, shown, without
from gateway.core.joint import JointSettings
from gateway.core.robot import Robot
from gateway.errors import UserError
from protocols import messages as msg
from protocols.bounds import Settings, bounds_of, hints, keys
from protocols.plugin import Device, Plugin, Spec, load

ROOM = 1.25
"""By how much a joint's limits exceed what the base's limits need of it."""
GENTLE: Mapping[str, float] = {
    "max_linear": 0.3,
    "max_angular": 1.0,
    "max_linear_acceleration": 0.5,
    "max_angular_acceleration": 2.0,
}
"""What is proposed of a base: m/s, rad/s, m/s², rad/s²."""
SWING = 20.0
"""rad/s², proposed of a joint that no base limits"""
UNITS = {"velocity": "rad/s", "acceleration": "rad/s²", "torque": "N·m"}
"""Of the limits of a joint"""
STEERING = 3.0
"""rad/s and rad/s² of a joint that steers, of which the base says nothing"""
SIGNS = ("1", "-1")
PROPOSED = "proposed; "


@dataclass(frozen=True, slots=True)
class Part:
    """A device that was found."""

    interface: str
    protocol: str
    address: int
    rate: int = 0
    kind: Literal["can", "canfd", "serial", "i2c", "camera"] = "can"
    data_rate: int = 0
    serial: int | None = None
    detail: str = ""

    def __str__(self) -> str:
        serial = "" if self.serial is None else f", serial number {self.serial:X}"
        detail = f", {self.detail}" if self.detail else ""
        return f"{self.protocol} at address {self.address} on {self.interface}{serial}{detail}"


def plugin_of(part: Part) -> Plugin:
    """Return the protocol of a device."""
    return load(part.protocol)


def spec_of(part: Part, options: Table | None = None) -> Spec:
    """Return the spec of a device, with these options."""
    plugin = plugin_of(part)
    made = plugin.options(**(options or {}))
    return plugin.spec(Device("device", part.address, made, plugin.settings(), part.rate))


@dataclass(slots=True)
class Plan:
    """What a robot is to be, as far as it is known."""

    name: str
    parts: Sequence[Part]
    answers: Answers
    urdf_name: str = ""
    """As the robot file names it,"""
    urdf_text: str = ""
    """and its text."""
    body: type[Body] = field(init=False)
    motors: dict[str, Part] = field(default_factory=dict)
    sensors: dict[str, Part] = field(default_factory=dict)
    allowed: dict[str, dict[str, float]] = field(default_factory=dict)
    """By motor, what its device allows at its own shaft: velocity [rad/s], torque [N·m]"""
    _keys: dict[str, list[str]] = field(default_factory=dict)
    """The motors of each key of the body"""

    def __post_init__(self) -> None:
        kinds = tuple(names())
        self.body = load_body(
            self.answers.get(Question("body", f"what it is: {', '.join(kinds)}"), kinds, "joints")
        )

    # -- which device is what ---------------------------------------------------------------------------

    def found(self, kind: Literal["motor", "sensor"]) -> list[Part]:
        """Return the devices of a kind that were found."""
        return [one for one in self.parts if spec_of(one).kind == kind]

    @property
    def joints(self) -> dict[str, urdf.UrdfJoint]:
        """The joints of the URDF that move by themselves."""
        model = urdf.parse(self.urdf_text) if self.urdf_text else None
        return {n: one for n, one in model.joints.items() if one.moves and not one.mimics} if model else {}

    def named(self) -> list[str]:
        """Return the names of the motors, by the body's keys."""
        for key in self.body.motor_keys():
            if hints(self.body)[key] is str:
                self._keys[key] = [key]
            elif key not in self._keys:
                asked = Question(key, f"names of the motors, with commas: {key}", self._names_for(key))
                self._keys[key] = self.answers.get(asked, tuple[str, ...], [])
        return list(dict.fromkeys(name for several in self._keys.values() for name in several))

    def _names_for(self, key: str) -> str:
        """Return what may be the motors of a key of the body, "" if that is not known."""
        if self.joints and key in ("axes", "motors"):
            return ",".join(self.joints)
        several = self.body.motor_keys()
        count, rest = divmod(len(self.found("motor")), len(several))
        places = {1: ("",), 2: ("front_", "rear_"), 3: ("front_", "middle_", "rear_")}.get(count, ())
        if rest or not count:
            return ""
        if key in ("left", "right") and places:
            return ",".join(f"{place}{key}" for place in places)
        return ",".join(f"{key.removesuffix('s')}_{at + 1}" for at in range(count))

    def assign(self, shown: Callable[[str, Sequence[Part]], tuple[Part, int] | None] | None = None) -> None:
        """Decide which device each motor is. `shown`: lets a person show which one it is of those that are
        left; returns it and its sign; None: it was not shown."""
        left = self.found("motor")
        for name in self.named():
            asks = shown is not None and left and not self.answers.has(f"{name}.address")
            if asks and shown is not None and (one := shown(name, left)) is not None:
                self.answers.state(f"{name}.address", str(one[0].address))
                self.answers.state(f"{name}.interface", one[0].interface)
                self.answers.state(f"{name}.sign", str(one[1]))
            part = self._part(name, left)
            if part is not None:
                self.motors[name] = part
                left.remove(part)
        self.answers.forget(f"{name}.interface" for name in self.motors)

    def _part(self, name: str, left: Sequence[Part]) -> Part | None:
        """Return the device of a name, of those that are left; None: there is none left. Where nobody tells,
        it is any, so that all that is missing is found."""
        there = ", ".join(str(one.address) for one in left) or "none is left"
        address = self.answers.get(
            Question(f"{name}.address", f"which device is {name} (found: {there})"), int, None
        )
        several = [one for one in left if one.address == address]
        if len({one.interface for one in several}) > 1:
            on = tuple(dict.fromkeys(one.interface for one in several))
            asked = Question(f"{name}.interface", f"on which of {', '.join(on)} it is")
            chosen = self.answers.get(asked, on, on[0])
            several = [one for one in several if one.interface == chosen]
        if not several and address is not None:
            raise UserError(f"{name}: no motor was found at address {address}; found: {there}")
        return several[0] if several else left[0] if left else None

    def place(self) -> None:
        """Name the sensors that were found."""
        found = self.found("sensor")
        for one in found:
            alike = [each.protocol for each in found].count(one.protocol) > 1
            usual = f"{one.protocol}_{one.address}" if alike else one.protocol
            asked = Question(f"{one.protocol}.{one.address}", f"name of the {one}; - leaves it out", usual)
            name = self.answers.get(asked, str, usual)
            self.sensors |= {} if name == "-" else {name: one}

    # -- the tables of the file -------------------------------------------------------------------------

    def text(self) -> str:
        """Return the robot file. Raises UserError with all that is missing, ConfigError if it cannot be."""
        buses = self.buses((*self.motors.values(), *self.sensors.values()))
        motors = {name: self._motor(name, buses) for name in self.motors}
        sensors = {name: self._sensor(name, buses) for name in self.sensors}
        body = self._body()
        self._rate()
        self._limit(motors, dict.fromkeys(motors, (1.0, 1.0)))
        self.answers.check()
        if isinstance_base(self.body):
            base = self._parsed(self._file(buses, motors, sensors, body)).brain.body.as_base
            assert base is not None, "its class says so"
            self._limit(motors, needed(base))
        text = self._file(buses, motors, sensors, body)
        self._parsed(text)
        return text

    def _rate(self) -> float:
        rate: float = self.answers.get(Question("rate_hz", "steps per second", "200"), float)
        return rate

    def _parsed(self, text: str) -> Robot:
        file = f"\n[files]\n{shown(self.urdf_name)} = '''\n{self.urdf_text}'''\n" if self.urdf_text else ""
        return parse_robot(text + file, self.name)

    def buses(self, parts: Iterable[Part]) -> dict[str, Table]:
        """Return the buses that devices are on, by interface."""
        found: dict[str, Table] = {}
        for one in parts:
            if one.interface in found:
                continue
            line, many = one.kind == "serial", len(found)
            channel = one.interface.partition(":")[2]
            kind = "line" if line else one.kind.removesuffix("fd")
            name = channel if re.fullmatch("can[0-9]+", channel) else f"{kind}{many}"
            rate = one.rate or self.answers.get(Question(f"{name}.rate", f"bit/s of {one.interface}"), int)
            rates = {"baudrate": rate} if line else {"bitrate": rate}
            rates |= {"data_bitrate": one.data_rate} if one.kind == "canfd" else {}
            found[one.interface] = {"name": name, "kind": one.kind, **rates, "interface": one.interface}
        return found

    def _options(self, name: str, part: Part) -> Table:
        """Return the options of a device: what its meaning hangs on, what has no default, what is stated."""
        kind = plugin_of(part).options
        options: Table = {}
        for key, one in keys(kind).items():
            scale = key in spec_of(part, options).scales or key in required(kind)
            plain = f"options.{key}" if key in keys(JointSettings) else key  # a gear of its own
            own = f"{name}.{plain}"
            if self.answers.has(own) or self.answers.has(plain) or scale:
                asked = own if self.answers.has(own) else plain
                hint = hints(kind)[one.name]
                options[key] = self.answers.get(question_of(kind, one.name, asked), hint, one.default)
        return options

    def _motor(self, name: str, buses: Mapping[str, Table]) -> Table:
        part = self.motors[name]
        gear = self._each(name, "gear", Question("gear", "turns of the device's shaft per turn of the joint"))
        sign = Question(f"{name}.sign", "1, or -1: its motor is mounted the other way round")
        connection = self.connection(name, part, buses)
        return {
            "address": part.address,
            "sign": int(self.answers.get(sign, SIGNS, "1")),
            **{key: value for key, value in connection.items() if key != "options"},
            "gear": gear,
            **self._stops(spec_of(part, connection["options"])),
            "options": connection["options"],
        }

    def connection(self, name: str, part: Part, buses: Mapping[str, Table]) -> Table:
        """Return how a device is connected, with its options."""
        table = {"protocol": part.protocol, "bus": buses[part.interface]["name"], "address": part.address}
        return {**table, "options": self._options(name, part)}

    def _each(self, name: str, key: str, asked: Question) -> Any:  # noqa: ANN401 -- a number
        """Return a number that is stated of one motor, or of all."""
        own = f"{name}.{key}"
        return self.answers.get(asked._replace(key=own) if self.answers.has(own) else asked, float)

    def _stops(self, spec: Spec) -> Table:
        """Return what stops a motor: a wheel brakes, what carries a load holds it."""
        if isinstance_base(self.body):
            return {"stop_action": "brake"} if msg.Velocity in spec.commands else {}
        if msg.Hold not in spec.commands:
            return {}
        let_go = {} if spec.holds_unattended else {"unattended": "released"}
        return {"on_command_timeout": "hold", "stop_action": "hold", **let_go}

    def _limit(self, motors: dict[str, Table], needs: Mapping[str, tuple[float, float]]) -> None:
        """Give the motors limits: what the base needs, what the URDF has, what is stated, within what their
        devices allow."""
        for name, table in motors.items():
            told, joint, gear = self.allowed.get(name, {}), self.joints.get(name), table["gear"]
            most = {"velocity": told.get("velocity", inf) / gear, "torque": told.get("torque", inf) * gear}
            limits: Table = {}
            if isinstance_base(self.body):
                velocity, limits["acceleration"] = map(rounded, needs[name])
                limits["velocity"] = min(velocity, most["velocity"])
            of_urdf = {"velocity": joint.velocity, "torque": joint.effort} if joint else {}
            for what, unit in UNITS.items():
                stated = any(map(self.answers.has, (f"{name}.{what}", what)))
                if stated or (what not in limits and of_urdf.get(what) is None):
                    end = most.get(what, SWING)
                    asked = Question(what, f"{unit} of the joint, at most", f"{end:g}" if end < inf else "")
                    limits[what] = self._each(name, what, asked)
            table["limits"] = {what: limits[what] for what in UNITS if what in limits}

    def _sensor(self, name: str, buses: Mapping[str, Table]) -> Table:
        part = self.sensors[name]
        mount: Table = {}
        links = urdf.parse(self.urdf_text).links if self.urdf_text else {}
        if self.answers.has(f"{name}.link") or (name in links and not self.answers.has(f"{name}.mount")):
            asked = Question(
                f"{name}.link", f"the link of the URDF that {name} is", name if name in links else ""
            )
            mount["link"] = self.answers.get(asked, str, name)
        else:
            asked = Question(f"{name}.mount", f"where {name} is: x, y, z, yaw[, pitch, roll] [m, rad]")
            numbers = self.answers.get(asked, tuple[float, ...], [0.0])
            mount = dict(zip(("x", "y", "z", "yaw", "pitch", "roll"), numbers, strict=False))
        return {**self.connection(name, part, buses), "mount": mount}

    def _body(self) -> Table:
        """Return the table of the body."""
        kind, table = self.body, Table()
        for key, several in self._keys.items():
            hint = hints(kind)[key]
            value = get_args(hint)[1] if get_origin(hint) is dict else None
            table[key] = several[0] if hint is str else several if value is None else _axes(value, several)
        joints = {name: name for name in self.joints if name in self.motors}
        known = kind.from_urdf(self.urdf_text, joints, table) if self.urdf_text else {}
        if isinstance_base(kind):
            sides = [
                self.answers.get(
                    Question(key, f"m, of the whole robot, {text}; its origin is in the middle"), float
                )
                for key, text in (("length", "from front to rear"), ("width", "from left to right"))
            ]
            x, y = (rounded(one / 2.0) for one in sides)
            known = {**known, "radius": 0.0}
            table["radius"] = rounded(hypot(x, y) + 0.005)
            table["footprint"] = [[x, y], [-x, y], [-x, -y], [x, -y]]
        for key, one in keys(kind).items():
            if key in table or key in known or not (key in required(kind) or self.answers.has(key)):
                continue
            proposal = f"{GENTLE[key]:g}" if key in GENTLE else self._tip() if key == "tip" else ""
            hint = hints(kind)[one.name]
            table[key] = self.answers.get(question_of(kind, one.name, key, proposal), hint)
        if issubclass(kind, Linkage) and "control" in keys(kind):
            specs = [spec_of(part, self._options(name, part)) for name, part in self.motors.items()]
            springs = all(msg.Impedance in spec.commands for spec in specs)
            table.setdefault("control", "impedance" if springs else "position")
        return table

    def _tip(self) -> str:
        """Return the link at the end of the longest chain of the URDF."""
        if not self.urdf_text:
            return ""
        model = urdf.parse(self.urdf_text)
        return max(model.links, key=lambda link: len(list(model.above(link))))

    # -- the text -----------------------------------------------------------------------------------------

    def _file(
        self,
        buses: Mapping[str, Table],
        motors: Mapping[str, Table],
        sensors: Mapping[str, Table],
        body: Table,
    ) -> str:
        top: Table = {"name": self.name}
        top |= {"rate_hz": self._rate()}
        top |= {"urdf": self.urdf_name} if self.urdf_text else {}
        sections = [section("", top, {"urdf": "links and joints, with their limits"})]
        sections[0] = (
            f"# Made by `gateway new` of what was found on its buses, and what was stated.\n{sections[0]}"
        )
        sections += [bus_section(table) for table in buses.values()]
        shared = common(list(motors.values()))
        said = {**docs(JointSettings), "sign": "-1: the motor is mounted the other way round"}
        if shared:
            sections += self._device("defaults.motors", shared, said, next(iter(self.motors.values())))
        for name, table in motors.items():
            own = without(table, shared)
            sections += self._device(f"motors.{name}", own, said, self.motors[name], str(self.motors[name]))
        for name, table in sensors.items():
            table = filled(table)
            mounted = {"mount": "in the robot's frame: m, rad"}
            sections += self._device(
                f"sensors.{name}", table, mounted, self.sensors[name], str(self.sensors[name])
            )
        sections.append(section("brain", {"body": self.body.kind}, {}))
        sections += self._sections(f"brain.{self.body.kind}", body, self._noted(self.body))
        return "\n".join(sections)

    def _noted(self, kind: type) -> dict[str, str]:
        """Return the comments of a dataclass' fields; what was proposed is said to be."""
        units = {name: bounds.unit for name, hint in hints(kind).items() if (bounds := bounds_of(hint))}
        noted = {
            key: f"{PROPOSED}{text}" if key in self.answers.proposed else text
            for key, text in {**units, **docs(kind)}.items()
        }
        return noted | {
            key: f"{PROPOSED}raise it when it drives well" for key in GENTLE if key in self.answers.proposed
        }

    def _device(
        self, at: str, table: Table, said: Mapping[str, str], part: Part, title: str = ""
    ) -> list[str]:
        plain = {key: value for key, value in table.items() if key not in ("options", "limits")}
        found = [section(at, plain, said, title)] if plain else []
        if options := table.get("options"):
            found.append(section(f"{at}.options", options, self._noted(plugin_of(part).options)))
        if limits := table.get("limits"):
            base = isinstance_base(self.body)
            why = "what the base needs, and a quarter" if base else "of the joint"
            found.append(
                section(
                    f"{at}.limits",
                    limits,
                    {
                        "velocity": f"rad/s; {why}",
                        "acceleration": f"rad/s²; {why}",
                        "torque": "N·m of the joint",
                    },
                )
            )
        return found

    def _sections(self, at: str, table: Table, said: Mapping[str, str]) -> list[str]:
        """Return a table, and below it the tables of its motors."""
        below = {key: one for key, one in table.items() if isinstance(one, dict)}
        found = [section(at, {key: one for key, one in table.items() if key not in below}, said)]
        for key, several in below.items():
            found += [section(f"{at}.{key}.{name}", one, {}) for name, one in several.items()]
        return found


def isinstance_base(kind: type[Body]) -> bool:
    """True for a body that moves in the plane."""
    return issubclass(kind, Base)


def _axes(kind: type[Settings], motors: Sequence[str]) -> Table:
    """Return a table of defaults for each motor."""
    return {name: {key: one.default for key, one in keys(kind).items()} for name in motors}


def needed(base: Base) -> dict[str, tuple[float, float]]:
    """Return the velocity and acceleration of each joint that a base's limits need, and some more."""
    lateral = base.moves_sideways

    def most(linear: float, angular: float) -> list[float]:
        twists = [Twist(linear, turn, 0.0) for turn in (angular, -angular)]
        twists += [Twist(0.0, turn, linear) for turn in (angular, -angular)] if lateral else []
        unknown = (None,) * len(base.joints)
        sets = [[abs(one.velocity or 0.0) for one in base.inverse(twist, unknown)] for twist in twists]
        return [ROOM * max(each) or STEERING for each in zip(*sets, strict=True)]

    speeds = most(base.max_linear, base.max_angular)
    changes = most(base.max_linear_acceleration, base.max_angular_acceleration)
    return dict(zip(base.joints, zip(speeds, changes, strict=True), strict=True))
