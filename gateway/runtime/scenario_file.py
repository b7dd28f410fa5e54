"""A scenario file: what happens to a robot when, and what must hold. Read strictly: every mistake at once.

    name = "a cable comes off"
    robot = "bench"                     # a shipped robot's name, or a file's path beside this one
    seconds = 3.0

    [asks.go]                           # a line as an operator types it
    at = 0.5
    line = "velocity left 4"

    [faults.cable]                      # one of gateway.buses.virtual.faults.CAUSES
    at = 2.0
    cause = "device silent"
    on = "left"

    [must.tell.silence]                 # counted from what happens, by its name
    after = "cable"
    within = 0.3
    on = "left"
    text = "silent: no feedback"

Rules. What happens has a name that is unique in the file, and so has what must hold. Times are of the robot's
clock, from the beginning of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, TypeAlias

from gateway import config
from gateway.buses.virtual.faults import CAUSES, FaultCause
from gateway.config import resources
from gateway.config.errors import Mistakes, unknown
from gateway.config.json_schema import Schema, Writer
from gateway.config.schema import build
from gateway.config.text import read_text, read_toml
from gateway.core.robot import TWIN, Robot
from gateway.errors import UserError
from gateway.operator.commands import Query, RejectedLine, parse
from gateway.sim.files import Point, SceneFile, Torque, Wall, WorldFile
from gateway.sim.load import load_world
from protocols.bounds import Bounds, Invalid
from protocols.messages import Imu, Instruction, LaserScan

Moment: TypeAlias = Annotated[float, Bounds(0.0, 86_400.0, "s")]
Speed: TypeAlias = Annotated[float, Bounds(0.0, 100.0, "m/s")]
Adapt: TypeAlias = Callable[[Robot], Robot]
ROBOT = ""
"""In place of a joint's name: the whole robot"""
LOOP = "loop"
"""As what is told of: the loop that does the steps"""


# -- what happens -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Ask:
    """A person asks for something."""

    at: Moment
    """s from the beginning"""
    line: str
    """As on the terminal of `gateway run`: "goal 1.5 0.5", "velocity left 4", "mission rounds" …"""


@dataclass(frozen=True, slots=True)
class FaultEvent:
    """Something breaks."""

    at: Moment
    """s from the beginning"""
    cause: str
    """How: a name of the table of causes"""
    on: str
    """The motor or sensor that has it; of a bus, any device on it"""
    seconds: Annotated[float, Bounds(0.01, 86_400.0, "s")] | None = None
    """s until it is as before; absent: it stays"""

    def __post_init__(self) -> None:
        if self.cause not in CAUSES:
            raise Invalid(("cause", unknown("cause", self.cause, CAUSES)))


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A torque comes upon a joint, from outside."""

    at: Moment
    """s from the beginning"""
    on: str
    """The motor"""
    torque: Torque
    """N·m at the joint's output shaft; positive drives it forward"""
    seconds: Annotated[float, Bounds(0.001, 86_400.0, "s")] | None = None
    """s until it is gone; absent: it stays"""


@dataclass(frozen=True, slots=True)
class WallEvent:
    """A wall is suddenly there."""

    at: Annotated[float, Bounds(0.001, 86_400.0, "s")]
    """s from the beginning"""
    start: Point
    """m in the world, the middle of one end"""
    end: Point
    """m, the middle of the other"""
    thickness: Annotated[float, Bounds(1e-3, 10.0, "m")] = 0.1
    height: Annotated[float, Bounds(1e-3, 10.0, "m")] = 0.5

    def __post_init__(self) -> None:
        self.wall()

    def wall(self) -> Wall:
        """Return it as a part of the world."""
        return Wall(self.start, self.end, self.thickness, self.height, self.at)


# -- what must hold ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MustReach:
    """Goals are reached."""

    within: Moment
    """s"""
    goals: Annotated[int, Bounds(1, 10_000)] = 1
    """How many"""
    after: str = ""
    """What happens before, by its name; "": the beginning"""


@dataclass(frozen=True, slots=True)
class MustTell:
    """Something is told, as a fault, a note or the reason of the brain's state."""

    within: Moment
    """s"""
    on: str
    """What it is told of: a motor, a sensor, a bus, "brain", or "loop", which does not keep its time"""
    text: str
    """What must be in it, in capital letters or small ones"""
    after: str = ""
    """What happens before, by its name; "": the beginning"""


@dataclass(frozen=True, slots=True)
class MustStand:
    """A joint, or the robot, stands, from then on to the end."""

    within: Moment
    """s"""
    on: str = ROBOT
    """The motor; "": the whole robot"""
    after: str = ""
    """What happens before, by its name; "": the beginning"""


@dataclass(frozen=True, slots=True)
class MustTurn:
    """A joint turns as asked, from then on to the end."""

    within: Moment
    """s"""
    on: str
    """The motor"""
    velocity: Annotated[float, Bounds(-1e3, 1e3, "rad/s")]
    """rad/s of its output shaft"""
    tolerance: Annotated[float, Bounds(1e-3, 100.0, "rad/s")]
    """rad/s to either side"""
    after: str = ""
    """What happens before, by its name; "": the beginning"""


Requirement: TypeAlias = MustReach | MustTell | MustStand | MustTurn
Happening: TypeAlias = Ask | FaultEvent | LoadStep | WallEvent


@dataclass(frozen=True, slots=True)
class Requirements:
    """What must come after something, within a time."""

    reach: dict[str, MustReach] = field(default_factory=dict)
    tell: dict[str, MustTell] = field(default_factory=dict)
    stand: dict[str, MustStand] = field(default_factory=dict)
    turn: dict[str, MustTurn] = field(default_factory=dict)

    def all(self) -> dict[str, Requirement]:
        """Return all by their names in the file: "tell.silence"."""
        kinds: dict[str, Mapping[str, Requirement]] = {
            "reach": self.reach,
            "tell": self.tell,
            "stand": self.stand,
            "turn": self.turn,
        }
        return {f"{kind}.{name}": one for kind, each in kinds.items() for name, one in each.items()}


@dataclass(frozen=True, slots=True)
class Never:
    """What must never be, from the beginning to the end."""

    faster: Speed | None = None
    """m/s of the base"""
    nearer: Annotated[float, Bounds(0.0, 1.0, "m")] | None = None
    """m from the robot to a wall, a fixed box or a person"""
    touches: Annotated[int, Bounds(0, 10_000)] | None = None
    """More than so many touches of walls and fixed boxes (of hard stops on a bench)"""


@dataclass(frozen=True, slots=True)
class ScenarioFile:
    """A scenario file."""

    name: str
    """For reports"""
    robot: str
    """A shipped robot's name, or a file's path beside this one"""
    seconds: Annotated[float, Bounds(0.1, 86_400.0, "s")]
    """s, how long it runs"""
    world: str = ""
    """A world in place of the robot file's: a shipped one's name, or a file's path beside this one"""
    seed: Annotated[int, Bounds(0, 2**63 - 1)] = 1
    """Of the simulated world's noise, and of what happens by chance"""
    asks: dict[str, Ask] = field(default_factory=dict)
    faults: dict[str, FaultEvent] = field(default_factory=dict)
    loads: dict[str, LoadStep] = field(default_factory=dict)
    walls: dict[str, WallEvent] = field(default_factory=dict)
    must: Requirements = field(default_factory=Requirements)
    never: Never = field(default_factory=Never)

    def events(self) -> Iterator[tuple[str, str, Happening]]:
        """Yield table, name and event of all that happens."""
        tables: dict[str, Mapping[str, Happening]] = {
            "asks": self.asks,
            "faults": self.faults,
            "loads": self.loads,
            "walls": self.walls,
        }
        yield from ((table, name, one) for table, each in tables.items() for name, one in each.items())


@dataclass(frozen=True, slots=True)
class FaultFile:
    """What happens to a robot that does again what a recording asks, and what must hold: a scenario file
    without name, robot, seconds and asks."""

    seed: Annotated[int, Bounds(0, 2**63 - 1)] = 1
    """Of what happens by chance"""
    faults: dict[str, FaultEvent] = field(default_factory=dict)
    loads: dict[str, LoadStep] = field(default_factory=dict)
    walls: dict[str, WallEvent] = field(default_factory=dict)
    must: Requirements = field(default_factory=Requirements)
    never: Never = field(default_factory=Never)


@dataclass(frozen=True, slots=True)
class Scenario:
    """A scenario that fits its robot."""

    path: Path
    file: ScenarioFile
    robot: Robot
    asks: Mapping[str, Instruction]
    """What the lines ask, by their names"""
    world: WorldFile | None
    """With the walls that appear; None: the robot has none"""

    def moment(self, event: str) -> float:
        """Return when something happens [s]; "": the beginning."""
        return next((one.at for _, name, one in self.file.events() if name == event), 0.0)


def schema() -> Schema:
    """Return the JSON schema of scenario files."""
    write = Writer()
    top = write.table(ScenarioFile, complete=True)
    for name, one in write.definitions.items():
        if name.startswith(f"{FaultEvent.__module__}.{FaultEvent.__qualname__}"):
            one["properties"]["cause"] |= {"enum": list(CAUSES)}
    return write.done("A scenario file of Motor Gateway", top)


def load_scenario(name: str | Path, adapt: Adapt = lambda robot: robot, real: Sequence[str] = ()) -> Scenario:
    """Return the scenario of a file.

    Args:
        name: the path of a scenario file, or the name of one that ships with the package.
        adapt: changes the robot, such as the interfaces of its buses.
        real: the devices that are there, as `load_robot` takes them.

    Raises:
        ConfigError: the file, the robot's or the world's is wrong; it names every mistake.
        UserError: there is no such file.
    """
    path = resources.find("scenarios", str(name))
    return parse_scenario(read_text(path), path, adapt, real)


def parse_scenario(
    text: str, path: Path, adapt: Adapt = lambda robot: robot, real: Sequence[str] = ()
) -> Scenario:
    """Return the scenario of a text, likewise; `path` is its name in mistakes, and where its files are."""
    mistakes = Mistakes(str(path), text)
    file = build(ScenarioFile, read_toml(text, mistakes), (), mistakes)
    mistakes.check()
    assert file is not None, "mistakes were added"
    robot = world = None
    try:
        robot = adapt(config.load_robot(resources.beside(file.robot, path), real=real))
        if file.world:
            robot = replace(robot, world=str(resources.find("worlds", resources.beside(file.world, path))))
        world = _world(file, robot, mistakes)
    except UserError as error:
        mistakes.add(("robot" if robot is None else "world",), str(error))
    mistakes.check()
    assert robot is not None, "mistakes were added"
    asks = _check_events(file, robot, mistakes)
    _check_requirements(file, robot, mistakes)
    if not (file.must.all() or file.never != Never()):
        mistakes.add((), "nothing must hold: expected a table [must.…] or [never]")
    mistakes.check()
    return Scenario(path, file, robot, asks, world)


def parse_faults(
    text: str,
    path: Path,
    robot: Robot,
    lasts: float,
    seed: int | None = None,
    world: WorldFile | None = None,
) -> Scenario:
    """Return the scenario of what is asked elsewhere, and what a file lets happen meanwhile.

    Args:
        text: of the file; "" for nothing.
        path: its name in mistakes.
        robot: all of it simulated.
        lasts: s
        seed: of the simulated world's noise; None: that of the file.
        world: another than the robot's.

    Raises:
        ConfigError: as `load_scenario`.
    """
    mistakes = Mistakes(str(path), text)
    given = build(FaultFile, read_toml(text, mistakes), (), mistakes)
    mistakes.check()
    assert given is not None, "mistakes were added"
    tables = {each.name: getattr(given, each.name) for each in fields(FaultFile)}
    file = ScenarioFile(path.stem, robot.name, lasts, **tables | ({} if seed is None else {"seed": seed}))
    try:
        world = _world(file, robot, mistakes, world)
    except UserError as error:
        mistakes.add((), str(error))
    _check_events(file, robot, mistakes)
    _check_requirements(file, robot, mistakes)
    mistakes.check()
    return Scenario(path, file, robot, {}, world)


def _world(
    file: ScenarioFile, robot: Robot, mistakes: Mistakes, given: WorldFile | None = None
) -> WorldFile | None:
    """Return the robot's world, or the one given, with the walls that appear."""
    world = load_world(robot.world) if given is None and robot.world is not None else given
    if not file.walls:
        return world
    if not isinstance(world, SceneFile):
        mistakes.add(("walls",), f"{robot.name!r} is in no place in which walls could appear")
        return world
    for name in file.walls.keys() & world.walls.keys():
        mistakes.add(("walls", name), f"the world {world.name!r} has a wall of this name: expected another")
    return replace(world, walls=world.walls | {name: one.wall() for name, one in file.walls.items()})


def _check_events(file: ScenarioFile, robot: Robot, mistakes: Mistakes) -> dict[str, Instruction]:
    """Check that all can happen to this robot; return what is asked of it."""
    asks: dict[str, Instruction] = {}
    names: set[str] = set()
    for table, name, event in file.events():
        if name in names:
            mistakes.add((table, name), "something else that happens has this name: expected another")
        names.add(name)
        if event.at >= file.seconds:
            mistakes.add((table, name, "at"), f"{event.at:g} s is after the end, at {file.seconds:g} s")
        if isinstance(event, Ask):
            asked = parse(event.line, robot)
            if asked is None or isinstance(asked, RejectedLine | Query):
                why = asked.reason if isinstance(asked, RejectedLine) else "it asks nothing of the robot"
                mistakes.add((table, name, "line"), f"found {event.line!r}: {why}")
            else:
                asks[name] = asked
        elif isinstance(event, FaultEvent | LoadStep):
            cause = CAUSES[event.cause] if isinstance(event, FaultEvent) else LOADED
            if wrong := _cannot_have(cause, event.on, robot):
                mistakes.add((table, name, "on"), wrong)
    return asks


def _cannot_have(cause: FaultCause, device: str, robot: Robot) -> str:
    """Return why a device cannot have a fault; "" if it can."""
    able = [one.name for one in robot.devices() if fits(cause, one.name, robot)]
    if device not in able:
        return unknown(cause.on, device, able)
    bus = next(one.bus for one in robot.devices() if one.name == device)
    if robot.buses[bus].interface != TWIN:
        return f"{device!r} is real: it can be given no fault from here; expected a simulated device"
    return ""


def fits(cause: FaultCause, device: str, robot: Robot) -> bool:
    """Return whether a device is of the kind that can have a fault."""
    if cause.on == "device":
        return device in robot.motors or device in robot.sensors
    if cause.on == "motor":
        return device in robot.motors
    if cause.on == "wheel":
        return device in robot.brain.abilities(robot.motors).wheels
    measured = {"lidar": LaserScan, "imu": Imu}[cause.on].__name__
    sensor = robot.sensors.get(device)
    return sensor is not None and any(name.startswith(f"{measured}.") for name in sensor.spec.ranges)


LOADED = FaultCause(lambda _site: None, "motor")
"""What can be loaded: a motor"""


def _check_requirements(file: ScenarioFile, robot: Robot, mistakes: Mistakes) -> None:
    """Check that what must hold is about what there is, and can be judged in the time."""
    events = {name: one.at for _, name, one in file.events()}
    base = robot.brain.abilities(robot.motors).base
    told_of = [*robot.motors, *robot.sensors, *robot.buses, "brain", LOOP]
    for path, one in file.must.all().items():
        at = ("must", *path.split("."))
        if one.after and one.after not in events:
            mistakes.add((*at, "after"), unknown("event", one.after, events))
        elif events.get(one.after, 0.0) + one.within > file.seconds:
            mistakes.add((*at, "within"), f"this is after the end, at {file.seconds:g} s")
        if isinstance(one, MustTell) and one.on not in told_of:
            mistakes.add((*at, "on"), unknown("device", one.on, told_of))
        whole = isinstance(one, MustStand) and one.on == ROBOT
        if isinstance(one, MustStand | MustTurn) and not whole and one.on not in robot.motors:
            mistakes.add((*at, "on"), unknown("motor", one.on, robot.motors))
        if isinstance(one, MustReach) and base is None:
            mistakes.add(at, f"{robot.name!r} has no base to drive to a goal")
    if all(bus.interface != TWIN for bus in robot.buses.values()):
        wrong = [("never", name) for name in ("nearer", "touches") if getattr(file.never, name) is not None]
        for key in [*wrong, *[("walls",)] * bool(file.walls)]:
            mistakes.add(key, "every device is real: there is no simulated world")
    for name in ("faster", "nearer"):
        if getattr(file.never, name) is not None and base is None:
            mistakes.add(("never", name), f"{robot.name!r} has no base that drives")


def scenarios_in(names: Sequence[str | Path]) -> list[Path]:
    """Return the scenario files of these: a file, a folder of files, or the name of one that ships.

    Raises UserError for what there is not."""
    found: dict[Path, None] = {}
    for name in names:
        if Path(name).is_dir():
            inside = sorted(Path(name).rglob("*.toml"))
            if not inside:
                raise UserError(f"{name}: there is no scenario file (.toml) in this folder")
            found |= dict.fromkeys(inside)
        else:
            found[resources.find("scenarios", str(name))] = None
    return list(found)
