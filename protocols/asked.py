"""What a driver may tell its devices: what it was given, and the set-up that its spec declares.

Rules. It is an allow-list. A device may be disarmed, and come to rest; it may be given the command that its
driver has for it, in the numbers of that command; what a request that is under way asks for; and what
`Spec.set_up` declares. The guard holds every frame against it, and so does the contract. Limits are not
looked at here. Numbers are at the device's shaft.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias, get_args

from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, Obeyed
from protocols.plugin import Declared, Spec

SetPoint: TypeAlias = msg.Velocity | msg.Position | msg.Torque | msg.Impedance
SET_POINTS = get_args(SetPoint)
READS = msg.Scan, msg.ReadParameter
ANSWERS = msg.Done, msg.Refused, msg.Parameter
"""Kinds are tuples that are made once: a union that is made for each look takes ten times as long."""
_RESTING = msg.Idle, msg.Hold
Objection: TypeAlias = tuple[str, str]
"""The rule that is broken, and the numbers."""

UNDER_WAY: Nanos = 60 * SECOND
"""How long a request is taken to be under way, if it is not answered: homing takes its time."""
ENDS: Nanos = SECOND
"""How long after its answer: what it changed is put back."""
DELAYS: Nanos = 300 * MILLISECOND
"""How old a command may be that a device is sent while it moves: a set-point waits for its SYNC, and for the
answer to the one before."""
TORQUE_DELAYS: Nanos = 30 * MILLISECOND
"""The same of a torque."""
CHANGES: Nanos = SECOND
"""How long after another kind of command a device may go on in the numbers of the last: a driver that changes
the mode sends set-points in between."""
LATENCY: Nanos = 50 * MILLISECOND
"""A position may lead the measured one by what the commanded velocity makes of it in this time,"""
NEAR = 1e-2
"""and by this [rad]."""
ROUNDED = 1e-6
"""Share by which a parameter may differ from what was asked for: most are sent as binary32."""

NOT_MADE = "a request that was not made"
NOT_COMMANDED = "a set-point that was not commanded"
NOT_DECLARED = "a setting that was neither asked for nor declared"
NOT_TO_ARM = "arming a motor that is to be idle"

NUMBERS: Mapping[type[Command], tuple[str, ...]] = {
    msg.Idle: (),
    msg.Hold: ("torque",),
    msg.Position: ("position", "velocity", "torque"),
    msg.Velocity: ("velocity", "torque"),
    msg.Torque: ("torque",),
    msg.Impedance: ("position", "velocity", "torque", "stiffness", "damping"),
}
_KEYS = {kind: [(name, f"{kind.__name__}.{name}") for name in names] for kind, names in NUMBERS.items()}
_KINDS = {f"{kind.__name__}.{name}": (kind, name) for kind, names in NUMBERS.items() for name in names}


def waiting(*commands: Command) -> tuple[msg.Kept, ...]:
    """Return what set-points are to a device that keeps them, and is not armed as far as a command decoder
    knows."""
    return tuple(
        msg.Kept(each.motor, f"{type(each).__name__}.{name}", getattr(each, name))
        for each in commands
        for name in NUMBERS[type(each)]
    )


def set_id(serial: int) -> str:
    """Return what stands for the address of another device, in a frame that is not obeyed by those known."""
    return f"SetId {serial:X}"


class Reported(NamedTuple):
    """What a device reports."""

    armed: bool = False
    position: float | None = None
    """rad; None: not known"""


@dataclass(slots=True)
class _Given:
    """What one device was given. Plain data."""

    spec: Spec
    errors: dict[tuple[type[Command], str], tuple[float, float]]
    """Of the encoding of each number of each command: absolute, and relative."""
    command: Command
    """The last, in its canonical form,"""
    raw: Command
    """and as it was given."""
    since: Nanos = 0
    """When another kind than before was given."""
    before: Command | None = None
    """What the device was sent last,"""
    place: float | None = None
    """and where it is held, since it is to stand."""
    start: float | None = None
    """Where it was then."""
    recent: list[tuple[Nanos, Command]] = field(default_factory=list)
    """The commands before, with the times at which the next was given."""
    asked: dict[str, list[Nanos]] = field(default_factory=dict)
    """Until when requests are taken to be under way, by the names of their types."""
    saves: Nanos = 0
    """Until when the configuration is being saved."""
    answered: dict[str, int] = field(default_factory=dict)
    """How many of these were answered."""
    address: int = -1
    """That it was last asked to take."""
    values: dict[str, float] = field(default_factory=dict)
    """The parameters that were asked to be written, ever."""
    kept: dict[str, float] = field(default_factory=dict)
    """What it was last sent of each number: a device that does not run keeps it, and nothing comes of it."""

    def close(self, one: Command, name: str, value: float) -> bool:
        """True if a number of a command is this one, but for its encoding."""
        number: float = getattr(one, name)
        off = abs(number - value)
        if off <= 1e-9:
            return True
        # A number of one command may reach the device, in between, in the encoding of another.
        for each in (one, self.command, self.before):
            if each is not None and off <= 2.0 * self.error(type(each), name, value) + 1e-9:
                return True
        return False

    def error(self, kind: type[Command], name: str, value: float) -> float:
        """Return by how much the encoding of a number of a command may be wrong."""
        absolute, relative = self.errors.get((kind, name), (0.0, ROUNDED))
        return absolute + relative * abs(value)

    def most_torque(self, one: Command, has: float, last: float, since: Nanos = 0) -> float:
        """Return what a torque and the feed-forward of a command before add up to, at most."""
        recent = (each for until, each in self.recent if until >= since)
        before: list[float] = [abs(getattr(each, "torque", 0.0)) for each in recent]
        error, _ = self.errors.get((type(one), "torque"), (0.0, 0.0))
        return max(abs(has), *before, 0.0) + abs(last) + 2.0 * error

    def was(self, now: Nanos, one: Command, name: str, most: Nanos = DELAYS) -> bool:
        """True if the device had this number in a command of this type a short time ago: a shorter one if it
        is to stand now, and is sent again what it already does, as by a mode before the set-point."""
        within = LATENCY if _stands(self.command) and name != "position" else most
        return any(
            now - until <= within and type(each) is type(one) and self.close(one, name, getattr(each, name))
            for until, each in self.recent
        )

    def under_way(self, now: Nanos, kind: type[object]) -> bool:
        """True if a request of this type is."""
        return any(now <= until for until in self.asked.get(kind.__name__, ()))


class Asked:
    """What the devices of one robot, or of one driver, were given. Its state is plain data."""

    def __init__(self, specs: Mapping[str, Spec]) -> None:
        self._devices = {
            name: _Given(spec, _errors(spec), msg.Idle(name), msg.Idle(name)) for name, spec in specs.items()
        }
        self._ids: list[tuple[Nanos, msg.SetId]] = []
        self._stop_at: Nanos | None = None
        """When all devices were last asked to stop."""

    # -- what is given ------------------------------------------------------------------------------

    def give(self, now: Nanos, message: Any) -> None:  # noqa: ANN401 -- a command or a request
        """Note what a driver is given."""
        device = self._devices.get(getattr(message, "motor", ""))
        if isinstance(message, msg.Stop):
            self._stop_at = now
        elif isinstance(message, msg.SetId):
            self._ids = [each for each in self._ids if now - each[0] <= UNDER_WAY] + [(now, message)]
        elif device is not None and isinstance(message, msg.COMMANDS):
            if message != device.raw:
                self._command(now, device, message)
        elif device is not None:
            if isinstance(message, msg.SetAddress):
                device.address = message.address
            if isinstance(message, msg.WriteParameter):
                device.values[device.spec.decoded(message.parameter)] = message.value
                if message.parameter == device.spec.save:
                    device.saves = now + UNDER_WAY
            kind = type(message).__name__
            under_way = [until for until in device.asked.get(kind, ()) if now <= until]
            device.asked[kind] = [*under_way, now + UNDER_WAY]

    def _command(self, now: Nanos, device: _Given, command: Command) -> None:
        before, device.raw = device.command, command
        device.command = device.spec.canonical(command)
        device.recent = [each for each in device.recent if now - each[0] <= DELAYS] + [(now, before)]
        other = type(device.command) is not type(before)
        device.since = now if other else device.since
        if other or not _stands(before):
            device.place = device.start = None

    def answer(self, event: Event) -> None:
        """Note the answer to a request: it is not under way any more."""
        if not isinstance(event, ANSWERS):
            return
        if isinstance(event, msg.Parameter):
            kind, name = msg.ReadParameter.__name__, event.motor
        else:
            kind, name = event.request, event.name
        device = self._devices.get(name)
        if device is not None and (under_way := device.asked.get(kind)):
            answered = device.answered.get(kind, 0) + 1
            if answered >= len(under_way):  # which of several is answered is not known
                device.asked[kind] = [event.t + ENDS]
                answered = 0
            device.answered[kind] = answered

    def passed(self, one: Obeyed, reported: Reported) -> None:
        """Note what a device has been sent."""
        device = self._devices.get(getattr(one, "motor", ""))
        if device is None:
            return
        if isinstance(one, msg.Kept):
            device.kept[one.name] = one.value
        elif isinstance(one, msg.COMMANDS):
            for name, key in _KEYS[type(one)]:
                device.kept[key] = getattr(one, name)
            device.before = one
            if not reported.armed:
                device.place = None
            elif _stands(device.command):
                device.place = getattr(one, "position", device.place)

    def stands(self, motor: str) -> bool:
        """True if a device is to be disarmed, or to come to rest."""
        return _stands(self._devices[motor].command)

    def is_to_be_idle(self, motor: str) -> bool:
        """True if a device is to be disarmed."""
        return isinstance(self._devices[motor].command, msg.Idle)

    def moves_on(self, motor: str) -> bool:
        """True if a device is to stand, and was sent last what makes it turn, or push, or keeps it armed."""
        device = self._devices[motor]
        if device.before is None or isinstance(device.before, msg.Idle) or not _stands(device.command):
            return False
        return self.is_to_be_idle(motor) or _moves(device, device.before)

    def holds(self, motor: str) -> bool:
        """True if a device is not to be disarmed, and was sent last what neither turns it nor disarms it."""
        device = self._devices[motor]
        idle = device.before is None or isinstance(device.before, msg.Idle) or self.is_to_be_idle(motor)
        return not idle and device.before is not None and not _moves(device, device.before)

    # -- what may be sent ---------------------------------------------------------------------------

    def is_asked(self, now: Nanos, motor: str, kinds: Iterable[type[object]]) -> bool:
        """True if a request of one of these kinds to a device is under way."""
        device = self._devices.get(motor)
        return device is not None and any(device.under_way(now, kind) for kind in kinds)

    def is_to_stop(self, now: Nanos) -> bool:
        """True if all devices were asked to stop a short time ago."""
        return self._stop_at is not None and now - self._stop_at <= UNDER_WAY

    def objection(
        self, now: Nanos, one: Obeyed, reported: Reported, beside: Iterable[str] = ()
    ) -> Objection | None:
        """Return why a device must not obey this; None if it may.

        Args:
            now: the time [ns].
            one: what the device would obey.
            reported: by the device.
            beside: devices that obey the same frame: what one of them was asked for, others may get with it.
        """
        found = self._objection(now, one, reported)
        if found is None or isinstance(one, (*msg.COMMANDS, msg.Arm)) or not getattr(one, "motor", ""):
            return found
        alike: Any = one
        others = (replace(alike, motor=name) for name in beside if name != alike.motor)
        return None if any(self._objection(now, each, reported) is None for each in others) else found

    def is_id(self, now: Nanos, name: str, address: float) -> bool:
        """True if another device is to get this address."""
        ids = (each for at, each in self._ids if now - at <= UNDER_WAY)
        return any((set_id(each.serial), each.address) == (name, address) for each in ids)

    def _objection(self, now: Nanos, one: Obeyed, reported: Reported) -> Objection | None:
        name = getattr(one, "motor", "")
        device = self._devices.get(name)
        if device is not None and isinstance(one, msg.COMMANDS):
            if isinstance(one, msg.Idle):
                return None
            device.start = reported.position if device.start is None else device.start
            return _objection_to_command(now, device, one, reported, NUMBERS[type(one)])
        if isinstance(one, READS):
            return None
        if isinstance(one, msg.SetId):
            ids = [(each.serial, each.address) for at, each in self._ids if now - at <= UNDER_WAY]
            same = (one.serial, one.address) in ids
            return None if same else (NOT_MADE, f"SetId {one.serial:X} to {one.address}")
        if device is None:
            return "a command to a device that is not a motor of this robot", name
        match one:
            case msg.Arm():
                return (NOT_TO_ARM, "") if isinstance(device.command, msg.Idle) else None
            case msg.WriteParameter(_, parameter, value) | msg.Kept(_, parameter, value):
                if _is_declared(now, device, parameter, value, reported):
                    return None
                written = _is_to_write(now, device, parameter, value) or self.is_id(now, parameter, value)
                return None if written else (NOT_DECLARED, f"{parameter} = {value:g}")
            case msg.Reboot() if now <= device.saves:
                return None  # saving its configuration restarts it
            case msg.Home() if device.under_way(now, msg.Zero):
                return None  # some take their zero by homing where they stand
            case msg.ClearFault() if device.under_way(now, msg.Zero) or device.under_way(now, msg.SetAddress):
                return None  # some take it by a restart
            case msg.SetAddress(_, address):
                same = device.address == address and device.under_way(now, msg.SetAddress)
                return None if same else (NOT_MADE, f"SetAddress {address}")
        return None if device.under_way(now, type(one)) else (NOT_MADE, type(one).__name__)


def _is_declared(now: Nanos, device: _Given, name: str, value: float, reported: Reported) -> bool:
    """True if the spec declares that this is written: by itself, or for a request that is under way."""
    spec = device.spec
    declared = [*spec.set_up.get(name, ()), *((name,) if name in _KINDS else ())]
    for kind, written in spec.writes.items():
        declared += written.get(name, ()) if name in written and device.under_way(now, kind) else ()
    return any(_fits(now, device, each, value, reported) for each in declared)


def _fits(now: Nanos, device: _Given, declared: Declared, value: float, reported: Reported) -> bool:
    """True if a value is what is declared."""
    if isinstance(declared, str):
        return _holds(now, device, declared, value, reported)
    low, high = declared if isinstance(declared, tuple) else (declared, declared)
    if isinstance(high, type):
        return value == low and type(device.raw) is high
    return low - ROUNDED * abs(low) <= value <= high + ROUNDED * abs(high)


def _holds(now: Nanos, device: _Given, number: str, value: float, reported: Reported) -> bool:
    """True if a value may be this number of the device's set-point."""
    kind, name = _KINDS[number]
    zeros: dict[str, float] = dict.fromkeys(NUMBERS[kind], 0.0)
    command: Any = kind
    made = command(device.command.motor, **zeros | {name: value})
    if number in device.kept and device.close(made, name, device.kept[number]):
        return True
    return _objection_to_command(now, device, made, reported, (name,)) is None


def _is_to_write(now: Nanos, device: _Given, name: str, value: float) -> bool:
    """True if this was asked to be written: the parameter and the value."""
    asked = device.values.get(name)
    if asked is None or not device.under_way(now, msg.WriteParameter):
        return False
    return abs(value - asked) <= ROUNDED * abs(asked)


def _errors(spec: Spec) -> dict[tuple[type[Command], str], tuple[float, float]]:
    ranges = ((_KINDS[key], each) for key, each in spec.ranges.items() if key in _KINDS)
    return {number: (each.resolution, each.relative) for number, each in ranges}


def _stands(command: Command) -> bool:
    """True if a command is to come to rest, or to stay there."""
    if isinstance(command, msg.Velocity):
        return not command.velocity
    return isinstance(command, _RESTING)


def _moves(device: _Given, one: Command) -> bool:
    """True if a set-point turns a device, or pushes."""
    numbers = ("torque",) if isinstance(one, msg.Torque) else ("velocity",)
    return any(hasattr(one, name) and not device.close(one, name, 0.0) for name in numbers)


def _objection_to_command(
    now: Nanos, device: _Given, one: Command, reported: Reported, names: Iterable[str]
) -> Objection | None:
    """Return which number of a set-point is neither that of the device's command nor at rest."""
    command, before = device.command, device.before
    if isinstance(one, msg.Hold) and msg.Hold not in device.spec.commands:
        return NOT_COMMANDED, f"Hold, and it has {device.raw}"
    alike = type(one) is type(command)
    changing = now - device.since <= CHANGES and not _stands(command)
    # A velocity may go on from where the device is: by a position, again after an outage.
    turning = changing or isinstance(command, msg.Velocity)
    for name in names:
        has: float | None = getattr(command, name, None)
        if has is not None and (alike or turning or name == "torque") and device.close(one, name, has):
            continue
        if name != "position" and device.close(one, name, 0.0):
            continue
        value: float = getattr(one, name)
        last: float | None = getattr(before, name, None)
        if isinstance(one, msg.Torque):  # no loop of the device limits it: an older one drives it too fast
            # The feed-forward of a command before may be added to it, until the mode has changed.
            most = device.most_torque(one, has or 0.0, last or 0.0, now - TORQUE_DELAYS)
            if (changing and abs(value) <= most) or device.was(now, one, name, TORQUE_DELAYS):
                continue
            return _not_commanded(one, name, device)
        if last is not None and (changing or name == "position") and device.close(one, name, last):
            continue
        if (name == "position" or alike) and device.was(now, one, name):
            continue
        if changing and name == "torque" and abs(value) <= device.most_torque(one, has or 0.0, last or 0.0):
            continue  # some devices add a feed-forward, which follows the mode
        if name == "position" and _is_there(now, device, one, value, reported):
            continue
        return _not_commanded(one, name, device)
    return None


def _not_commanded(one: Command, name: str, device: _Given) -> Objection:
    return (
        NOT_COMMANDED,
        f"{type(one).__name__} with a {name} of {getattr(one, name):g}, and it has {device.raw}",
    )


def _is_there(now: Nanos, device: _Given, one: Command, value: float, reported: Reported) -> bool:
    """True if a position is where the device is: it begins there, or is held there."""
    place = reported.position
    if place is None or not reported.armed:
        return True
    if isinstance(device.command, msg.Position | msg.Impedance):
        return False
    stands = _stands(device.command)
    if stands and (device.place is None or device.close(one, "position", device.place)):
        return True
    ahead = abs(getattr(device.command, "velocity", 0.0)) * LATENCY / SECOND
    if stands and now - device.since > CHANGES:
        return False
    return any(abs(value - each) <= ahead + NEAR for each in (place, device.start) if each is not None)
