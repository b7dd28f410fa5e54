"""An arm: a chain of joints on a base that stands still, from its URDF.

Its table in the robot file has the links `base` and `tip`, and an axis for every motor:

    [brain.arm.axes.shoulder]     a motor, whose joint in the URDF has its name (or: urdf_joint)
    stiffness = 120.0             N·m/rad
    damping = 4.0                 N·m·s/rad
    velocity = 1.5                rad/s; acceleration and jerk likewise
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

from brain.bodies import urdf
from brain.bodies.body import Linkage, Placement, Search
from brain.bodies.chain import Chain, rotation
from brain.bodies.parts import UPRIGHT, Part, of_urdf
from brain.bodies.reach import ReachSearch
from protocols import messages as msg
from protocols.bounds import Bounds, Invalid, check
from protocols.messages import Command


@dataclass(frozen=True, slots=True, kw_only=True)
class JointAxis:
    """How a motor moves its joint: rad and N·m, or m and N of a joint that slides."""

    stiffness: Annotated[float, Bounds(0.0, 1e6, "N·m/rad")] = 50.0
    """N·m/rad, of the spring about a set-point (control = "impedance")"""
    damping: Annotated[float, Bounds(0.0, 1e5, "N·m·s/rad")] = 2.0
    velocity: Annotated[float, Bounds(1e-3, 50.0, "rad/s")] = 1.0
    """rad/s, of a planned motion; so are the next"""
    acceleration: Annotated[float, Bounds(1e-2, 1e3, "rad/s²")] = 3.0
    jerk: Annotated[float, Bounds(0.1, 1e5, "rad/s³")] = 30.0

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialArm(Linkage):
    """Its joints are in the order of the URDF, from the base on."""

    kind: ClassVar[str] = "arm"
    axes: dict[str, JointAxis]
    """By motor."""
    tip: str
    """The link that is brought to a place."""
    base: str = ""
    """The link whose frame places are in; "": the root."""
    control: Literal["impedance", "position"] = "impedance"
    """What the motors are commanded: a spring about the set-point, or the set-point alone."""
    urdf: str = ""
    """The text of the URDF; by default that of the robot."""
    joint_names: dict[str, str] = field(default_factory=dict)
    """The URDF's name for a motor's joint, where it is another."""

    def __post_init__(self) -> None:
        if not self.urdf:
            raise ValueError('an arm needs its links and joints: urdf = "FILE" at the top of the robot file')
        self.check_motors()
        if len({self._joint(motor) for motor in self.axes}) < len(self.axes):
            raise Invalid(("joint_names", "joint_names: two motors move one joint"))
        _ = self.chain

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the key of the axes."""
        return ("axes",)

    @classmethod
    def from_urdf(cls, text: str, joints: Mapping[str, str], table: Mapping[str, Any]) -> dict[str, Any]:
        """Return the text, and the names of the joints."""
        return {"urdf": text, "joint_names": dict(joints)}

    def _joint(self, motor: str) -> str:
        return self.joint_names.get(motor, motor)

    @property
    def chain(self) -> Chain:
        """The mechanism."""
        return _chain(self.urdf, self.base, self.tip, tuple(map(self._joint, self.axes)))

    @property
    def joints(self) -> tuple[str, ...]:
        """The motors, from the base to the tip."""
        motors = {self._joint(motor): motor for motor in self.axes}
        order = urdf.parse(self.urdf).joints
        return tuple(motors[name] for name in sorted(motors, key=lambda name: [*order, name].index(name)))

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """The ranges of the URDF."""
        return tuple(zip(self.chain.low.tolist(), self.chain.high.tolist(), strict=True))

    @property
    def of_tip(self) -> tuple[str, ...]:
        """All but a gripper's."""
        aside = self.chain.aside
        return tuple(motor for i, motor in enumerate(self.joints) if i not in aside)

    @property
    def limits(self) -> tuple[tuple[float, float, float], ...]:
        """The axes' velocity, acceleration and jerk."""
        axes = (self.axes[motor] for motor in self.joints)
        return tuple((axis.velocity, axis.acceleration, axis.jerk) for axis in axes)

    def points(self, positions: Sequence[float]) -> tuple[tuple[float, float, float], ...]:
        """Return the joints that move the tip, between the base and the tip."""
        found = self.chain.points(positions).tolist()
        aside = self.chain.aside
        return (0.0, 0.0, 0.0), *(tuple(one) for i, one in enumerate(found) if i not in aside)

    def parts(self) -> list[Part]:
        """Return the links of its URDF."""
        motors = {self._joint(motor): motor for motor in self.axes}
        return of_urdf(urdf.parse(self.urdf), motors, UPRIGHT)

    def gravity(self, positions: Sequence[float]) -> tuple[float, ...]:
        """Return the torques that hold it."""
        return tuple(self.chain.gravity(positions).tolist())

    def torques(
        self, positions: Sequence[float], velocities: Sequence[float], accelerations: Sequence[float]
    ) -> tuple[float, ...]:
        """Return the torques of a motion: inverse dynamics of the links, without friction and rotors."""
        if not any(velocities) and not any(accelerations):
            return self.gravity(positions)
        return tuple(self.chain.torques(positions, velocities, accelerations).tolist())

    def command(self, motor: str, position: float, velocity: float, torque: float) -> Command:
        """Return a spring about the state, or the state itself."""
        if self.control == "position":
            return msg.Position(motor, position, velocity, torque)
        axis = self.axes[motor]
        return msg.Impedance(motor, position, velocity, torque, axis.stiffness, axis.damping)

    def push(self, motor: str, position: float, torque: float) -> Command:
        """Return a torque, with the axis' damping where the motor can."""
        if self.control == "position":
            return msg.Torque(motor, torque)
        return msg.Impedance(motor, position, 0.0, torque, 0.0, self.axes[motor].damping)

    def search(self, positions: Sequence[float], place: Placement) -> Search:
        """Return a search that leaves joints alone on which the tip does not depend."""
        attitude = None if place.attitude is None else rotation(*place.attitude)
        return ReachSearch(self.chain, positions, place[:3], attitude, self.chain.aside)


@lru_cache(maxsize=8)
def _chain(text: str, base: str, tip: str, driven: tuple[str, ...]) -> Chain:
    model = urdf.parse(text)
    return Chain(model, base or model.root, tip, driven)
