"""A robot as a page shows it: plain data that becomes JSON, and arrays. No sockets, no clients.

Rules. Everything is read, nothing is changed, and each value is made only when it is sent. SI, at the joint's
output shaft; times in s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot, isfinite, nan
from typing import Any, Literal, TypeAlias

from brain.belief import Belief, Pose
from brain.bodies.body import Base
from brain.bodies.limbs import limbs
from brain.settings import AT_RUN_TIME, keys
from gateway.core.joint import LEAST_SHARE, Joint
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.view.figure import Figure, figure
from gateway.vision.camera import Seen
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Nanos

Json: TypeAlias = dict[str, Any]
Kind: TypeAlias = Literal["live", "replay", "twin"]
"""A robot that can be asked; a recording; simulated devices, which have no robot to ask."""

LIMITS = ("velocity", "acceleration", "torque")
"""Of a joint, that can be changed while it runs."""
SIGHTINGS = 64
"""Markers that are kept of each camera."""
SEEN_FOR: Nanos = 2 * SECOND
"""How long what a camera saw is shown."""
FACE = 0.1
"""m, by which the line that shows where a marker's face looks to is drawn before it."""
TRACK = 256
"""Poses that are kept, one per tick: a scan is older than the tick that brings it."""
VALUE = {"Velocity": "velocity", "Position": "position", "Impedance": "position", "Torque": "torque"}
"""The number of a command that is plotted beside the feedback of the same name."""

Quantity: TypeAlias = Callable[[Joint, Nanos], float | None]
"""A number of a joint at a time; None: it is not known, or there is none."""


def _measured(name: str) -> Quantity:
    return lambda joint, _: getattr(joint.feedback, name)


def _commanded(name: str) -> Quantity:
    def number(joint: Joint, _: Nanos) -> float | None:
        kind = type(joint.sent).__name__
        return _value(kind, joint.sent) if VALUE.get(kind) == name else None

    return number


def _error(name: str) -> Quantity:
    def number(joint: Joint, now: Nanos) -> float | None:
        wanted, measured = _commanded(name)(joint, now), _measured(name)(joint, now)
        return None if wanted is None or measured is None else wanted - measured

    return number


def _age(joint: Joint, now: Nanos) -> float | None:
    age = joint.feedback_age(now)
    return None if age is None else age / MILLISECOND


_CONTROLLED = {"position": "rad", "velocity": "rad/s", "torque": "N·m"}
_ONLY_MEASURED = {"current": "A", "voltage": "V", "temperature": "°C"}
QUANTITIES: Mapping[str, tuple[str, Quantity]] = {
    **{name: (unit, _measured(name)) for name, unit in (_CONTROLLED | _ONLY_MEASURED).items()},
    "age": ("ms", _age),
    **{f"{name} command": (unit, _commanded(name)) for name, unit in _CONTROLLED.items()},
    **{f"{name} error": (unit, _error(name)) for name, unit in _CONTROLLED.items()},
}
"""What a page can plot of each joint: unit, number. An error is the command less the measurement, while the
joint is commanded so."""


@dataclass(slots=True)
class Scene:
    """A gateway as it is shown. Fed with each tick by `observe`."""

    gateway: Gateway
    kind: Kind
    facts: Callable[[], Json]
    """What the gateway does not know of itself: ticks missed, buses, recording, playback."""
    pictures: Callable[[], Mapping[str, Seen]] = dict
    """The newest image of each camera, where this process has one."""
    scans: dict[str, msg.LaserScan] = field(default_factory=dict)
    """The newest of each lidar."""
    swept: dict[str, list[list[float | None]]] = field(default_factory=dict)
    """Where the robot was at the first and the last beam of it: x, y, yaw; empty if it did not know."""
    sightings: dict[str, deque[msg.Marker]] = field(default_factory=dict)
    """What each camera reported lately, oldest first."""
    now: Nanos = 0
    belief: Belief = field(init=False)
    """After the last tick."""
    _figure: Figure | None = None
    _track: deque[tuple[Nanos, Pose]] = field(default_factory=lambda: deque(maxlen=TRACK))

    def __post_init__(self) -> None:
        self.belief = self.gateway.belief()

    @property
    def robot(self) -> Robot:
        """The robot that is shown."""
        return self.gateway.robot

    @property
    def figure(self) -> Figure:
        """What the robot looks like."""
        if self._figure is None:
            self._figure = figure(self.robot)
        return self._figure

    def adopt(self, gateway: Gateway) -> None:
        """Show another gateway of the same robot from now on, as after a jump in a recording."""
        self.gateway = gateway
        self.scans.clear()
        self.sightings.clear()
        self._track.clear()

    def observe(self, tick: Tick, belief: Belief) -> None:
        """Take what a tick brought."""
        self.now, self.belief = tick.now, belief
        if belief.estimate is not None:
            self._track.append((tick.now, belief.estimate.pose))
        for event in tick.outputs.events:
            if isinstance(event, msg.LaserScan):
                self.scans[event.sensor] = event
                self.swept[event.sensor] = self._at(event.t) + self._at(event.t + event.duration)
            elif isinstance(event, msg.Marker):
                self.sightings.setdefault(event.sensor, deque(maxlen=SIGHTINGS)).append(event)

    def _at(self, t: Nanos) -> list[list[float | None]]:
        """Return the pose at a time of the recent past, or the oldest kept; empty if there is none."""
        poses = self._track
        found = next((pose for now, pose in reversed(poses) if now <= t), poses[0][1] if poses else None)
        return [] if found is None else [[_number(v) for v in (found.x, found.y, found.yaw)]]

    def present(self) -> Tick:
        """Return a tick that brings the newest of everything."""
        events: list[msg.Event] = list(self.scans.values())
        for name, joint in self.gateway.joints.items():
            state = msg.State(name, self.now, joint.mode, joint.detail)
            events += [state, joint.feedback, *joint.faults.values()]
        return Tick(0, self.now, Inputs(), Outputs(events=tuple(events)))

    def hello(self) -> Json:
        """Return what does not change: joints, buses, body, what the robot can be asked."""
        robot, base = self.robot, self.robot.brain.base
        wheels = base.joints if base is not None else ()
        return {
            "robot": robot.name,
            "mode": self.kind,
            "joints": [
                {
                    "name": name,
                    "protocol": motor.plugin.name,
                    "address": motor.device.address,
                    "bus": motor.bus,
                    "commands": sorted(kind.__name__ for kind in motor.joint.commands(motor.spec)),
                    "requests": sorted(kind.__name__ for kind in motor.spec.requests),
                    "limits": {limit: getattr(motor.joint.limits, limit) for limit in LIMITS},
                    "parameters": sorted(motor.spec.parameters),
                    "moves": "base" if name in wheels else "joint",
                }
                for name, motor in robot.motors.items()
            ],
            "quantities": {name: unit for name, (unit, _) in QUANTITIES.items()},
            "buses": [
                {"name": bus.name, "kind": bus.kind, "interface": bus.interface, "bitrate": bus.bitrate}
                for bus in robot.buses.values()
            ],
            "base": _base(base) if base is not None else None,
            "figure": self.figure.described,
            "missing": self.figure.missing,
        }

    def settings(self) -> list[Json]:
        """Return what can be changed while it runs: the value, the robot file's, and the bounds known."""
        brain, robot = self.gateway.brain, self.robot
        ways = {path: way for way, _, names in AT_RUN_TIME for path in names.split()}
        in_file, rows = dict(keys(robot.brain)), list[Json]()
        for name, motor in robot.motors.items():
            limits = self.gateway.joints[name].settings.limits
            for limit in LIMITS:
                most: float = getattr(motor.joint.limits, limit)
                bounds = {"low": LEAST_SHARE * most, "high": most}
                rows.append(
                    {"key": f"{name}.limits.{limit}", "value": getattr(limits, limit), "file": most} | bounds
                )
        named = limbs(robot.brain.body)
        for key, value in brain.numbers().items():
            table, _, rest = key.partition(".")
            way = ways.get(f"body.{rest}" if table in named else key)
            if way is not None:
                file = in_file[key]
                bound = {"at most": {"high": file}, "at least": {"low": file}, "free": {}}[way]
                rows.append({"key": f"brain.{key}", "value": value, "file": file} | bound)
        return rows

    def joints(self) -> Json:
        """Return every joint's state, in the order of `hello`: a row each; and how its figure stands."""
        joints = self.gateway.joints
        at = {name: joint.feedback.position for name, joint in joints.items()}
        return {
            "t": self.now / SECOND,
            "rows": [self._joint(joint) for joint in joints.values()],
            "figure": self.figure.stands(self.robot, at),
        }

    def values(self, signals: Sequence[tuple[str, str]]) -> list[float]:
        """Return the newest values of signals, each a joint and a quantity of it; NaN: none."""
        joints, now = self.gateway.joints, self.now
        found = [QUANTITIES[quantity][1](joints[joint], now) for joint, quantity in signals]
        return [nan if value is None else value for value in found]

    def cameras(self) -> Json:
        """Return what each camera saw in the last seconds: of each image the markers, by bearing and rise
        (tangents, to the left and upward), the distance [m], and where their faces look to."""
        since = self.now - SEEN_FOR
        return {
            "t": self.now / SECOND,
            "cameras": [
                {"name": name, "seen": [_sighting(one) for one in found if one.t >= since]}
                for name, found in self.sightings.items()
            ],
        }

    def _joint(self, joint: Joint) -> list[Any]:
        """Return mode, armed, kind of command, its value, then the feedback, its age [ms] and faults."""
        feedback, sent, age = joint.feedback, joint.sent, joint.feedback_age(self.now)
        kind = type(sent).__name__
        measured = [*(_CONTROLLED | _ONLY_MEASURED)]
        return [
            joint.mode.value,
            joint.armed,
            kind,
            _number(_value(kind, sent), 3),
            *(_number(getattr(feedback, name), 3) for name in measured),
            None if age is None else age // MILLISECOND,
            len(joint.faults),
        ]

    def state(self) -> Json:
        """Return everything else that changes, but map, path and scans."""
        gateway, belief = self.gateway, self.belief
        estimate, mission = belief.estimate, belief.mission
        return {
            "t": self.now / SECOND,
            "state": belief.state.value,
            "reason": belief.reason,
            "stopped": gateway.why_stopped(),
            "stop": bool(gateway.stopped),
            "systems": [[one.name, one.state, one.reason] for one in belief.systems],
            "pose": None
            if estimate is None
            else [_number(v) for v in (estimate.pose.x, estimate.pose.y, estimate.pose.yaw)],
            "covariance": None if estimate is None else [_number(float(v)) for v in estimate.covariance.flat],
            "twist": None
            if estimate is None
            else [_number(v) for v in (estimate.linear, estimate.angular, estimate.lateral)],
            "raw": None if belief.raw is None else [_number(v) for v in (belief.raw.x, belief.raw.y)],
            "goal": None if belief.goal is None else [belief.goal.x, belief.goal.y, belief.goal.yaw],
            "mission": None
            if mission is None
            else {
                "name": mission.name,
                "phase": mission.phase,
                "step": mission.step,
                "steps": mission.steps,
                "text": mission.text,
                "reason": mission.reason,
            },
            "faults": [
                {"joint": name, "name": one.name, "cause": one.cause, "remedy": one.remedy, "code": one.code}
                for name, joint in gateway.joints.items()
                for one in joint.faults.values()
            ],
            "received": [
                {
                    "bus": bus,
                    "protocol": protocol,
                    "accepted": c.accepted,
                    "malformed": c.malformed,
                    "ignored": c.ignored,
                }
                for bus, protocol, c in gateway.rx_counters()
            ],
            "bus_states": gateway.bus_states,
            **self.facts(),
        }


def _sighting(one: msg.Marker) -> Json:
    """Return a marker as a camera has it in its image; an image without one has its time alone."""
    found: Json = {"t": one.t / SECOND, "marker": one.marker}
    if one.position is None or one.position[0] <= 0.0:
        return found
    x, y, z = one.position
    found |= {"at": [_number(y / x), _number(z / x)], "distance": _number(hypot(x, y, z), 3)}
    if one.orientation is not None:
        i, j, k, w = one.orientation  # the image of x, out of its face
        face = 1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + k * w), 2.0 * (i * k - j * w)
        ahead = [a + FACE * b for a, b in zip(one.position, face, strict=True)]
        if ahead[0] > 0.0:
            found["face"] = [_number(ahead[1] / ahead[0]), _number(ahead[2] / ahead[0])]
    return found


def note(t: Nanos, one: Note) -> Json:
    """Return a note, to be logged."""
    return {"t": t / SECOND, "level": one.level, "source": one.source, "text": one.text}


def _base(body: Base) -> Json:
    return {
        "outline": [list(corner) for corner in body.outline],
        "max_linear": body.max_linear,
        "max_lateral": (body.max_lateral or body.max_linear) if body.moves_sideways else 0.0,
        "max_angular": body.max_angular,
        "turning_radius": body.turning_radius,
    }


def _value(kind: str, command: Command) -> float | None:
    return getattr(command, VALUE[kind]) if kind in VALUE else None


def _number(value: float | None, digits: int = 5) -> float | None:
    """Return a number that JSON has, with as many digits as a screen shows."""
    return None if value is None or not isfinite(value) else round(value, digits)


def lidar_mounts(robot: Robot) -> Mapping[str, tuple[float, float, float]]:
    """Return where each sensor is, in the robot's frame: m, m, rad."""
    return {name: (one.mount.x, one.mount.y, one.mount.yaw) for name, one in robot.sensors.items()}
