"""What a robot file declares of a motor, held against its file: messages, numbers in SI, values that go with
commands; and what the device makes of the messages.

Rules. Every mistake is found, all at once, by the key of the options. A set-point counts for the device when
what goes `beside` it and what enables it were received, too. A message whose counter does not go on, or whose
checksum is wrong, changes nothing at either end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, TypeAlias

from protocols import messages as msg
from protocols.bounds import Invalid, Wrong, named_text
from protocols.dbc.checksums import CHECKSUMS
from protocols.dbc.database import Message, Raw, Signal, messages_of
from protocols.dbc.options import UNITS, Commanded, Fed, Options
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Nanos, Obeyed
from protocols.plugin import Device, FaultInfo, Range
from protocols.suggest import did_you_mean
from protocols.toolkit.table import BINARY32

Assignments: TypeAlias = Mapping[str, Mapping[str, Raw]]
"""By message: raw numbers by signal"""
KINDS: Mapping[str, type[Command]] = MappingProxyType(
    {"position": msg.Position, "velocity": msg.Velocity, "torque": msg.Torque}
)
PERIODS = 1.0, 60_000.0
"""ms of a message"""
FAULT = 1
FAULTS: Mapping[int, FaultInfo] = {
    FAULT: FaultInfo(
        "the device reports a fault",
        "the value of its signal says which: the device's manual, or the names in the file",
        "as the device's manual has it; then clear",
        latching=False,
    )
}


@dataclass(frozen=True, slots=True)
class Number:
    """A quantity in a signal: its value in SI is `raw * factor + offset`."""

    message: str
    signal: Signal
    factor: float
    offset: float

    @property
    def key(self) -> str:
        """Its name."""
        return f"{self.message}.{self.signal.name}"

    def raw(self, value: float) -> Raw:
        """Return the raw number that is nearest to a value, within those that the signal has."""
        low, high = self._raws()
        return self._rounded(min(max((value - self.offset) / self.factor, low), high))

    def sensed(self, value: float) -> Raw:
        """Return the raw number that a device reports of a value: it saturates with its bits alone."""
        low, high = self.signal.ends()
        return self._rounded(min(max((value - self.offset) / self.factor, low), high))

    def _rounded(self, raw: float) -> Raw:
        return raw if self.signal.real else round(raw)

    def value(self, raw: Raw) -> float:
        """Return the value of a raw number."""
        return raw * self.factor + self.offset + 0.0

    def measured(self, raw: Raw) -> float | None:
        """Return the value of a raw number that was received; None at an end of its range: it may as well be
        beyond it; and where it is not finite. A magnitude of 0 is a value: nothing is below it."""
        low, high = self.signal.ends()
        value = self.value(raw)
        return value if low < raw < high or value == 0.0 else None

    def _raws(self) -> tuple[float, float]:
        """Return the least and the most raw number, as far as the file bounds it."""
        signal, (low, high) = self.signal, self.signal.ends()
        if signal.least is not None and signal.most is not None:
            ends = sorted((each - signal.offset) / signal.factor for each in (signal.least, signal.most))
            low, high = max(low, ends[0] - 1e-9), min(high, ends[1] + 1e-9)
        return low, high

    def range(self, *, inside: int = 0) -> Range:
        """Return the range; `inside`: of a measurement, without the ends."""
        low, high = self.signal.ends() if inside else self._raws()
        if self.signal.real:
            low, high = (1e-3 * each if abs(each) > 1e6 else each for each in (low, high))
            ends = sorted(self.value(each) / max(1.0, abs(self.factor)) for each in (low, high))
            error = 2.0**-10 if self.signal.bits == 16 else BINARY32
            return Range(ends[0], ends[1], 1e-12, error)
        raws = [
            end if self.value(end) == 0.0 else end + step for end, step in ((low, inside), (high, -inside))
        ]
        ends = sorted(map(self.value, raws))
        return Range(ends[0], ends[1], 0.501 * abs(self.factor))


@dataclass(frozen=True, slots=True)
class SetPoint:
    """How a command is sent."""

    number: Number
    beside: Assignments


@dataclass(frozen=True, slots=True)
class Declared:
    """What is declared of one motor. A constant."""

    messages: Mapping[str, Message]
    to_device: tuple[str, ...]
    from_device: tuple[str, ...]
    setpoints: Mapping[type[Command], SetPoint]
    enable: Assignments
    idle: Assignments
    clear: Assignments
    fed: Mapping[str, Number]
    state: tuple[Number, tuple[Raw, ...], Raw] | None
    """Where it is told, its raw numbers while it is armed, and one while it is not"""
    fault: tuple[Number, Raw] | None
    """The same, and the raw number without one"""
    periods: Mapping[str, Nanos]

    def __deepcopy__(self, memo: object) -> Declared:
        """It is a constant."""
        return self

    def message(self, frame: Frame, names: Sequence[str]) -> Message | None:
        """Return the message, among these, with the id of a frame."""
        if not isinstance(frame, CanFrame):
            return None
        found = (self.messages[name] for name in names)
        return next((one for one in found if (one.id, one.extended) == (frame.id, frame.extended)), None)

    def constants(self) -> Iterator[tuple[str, str, Raw]]:
        """Yield message, signal and raw number of all that is sent beside set-points."""
        for one in (self.enable, self.idle, self.clear, *(each.beside for each in self.setpoints.values())):
            for message, signals in one.items():
                for signal, raw in signals.items():
                    yield message, signal, raw


# -- read ------------------------------------------------------------------------------------------------


class _Reader:
    """One motor's options, and what is wrong with them."""

    def __init__(self, options: Options, address: int) -> None:
        self.options, self.address = options, address
        self.wrong: list[Wrong] = []
        self.name, text = named_text(options.file)
        self.used: dict[str, None] = {}
        self.taken: dict[tuple[str, str], str] = {}
        """By message and signal: the key of what it is used for"""
        try:
            self.all = messages_of(self.name, text)
        except ValueError as error:
            raise Invalid(("options.file", str(error))) from error

    def object(self, key: str, text: str) -> None:
        """Note a mistake at a key of the options."""
        self.wrong.append((f"options.{key}", text))

    def take(self, there: tuple[Message, Signal], key: str) -> None:
        """Note what a signal is used for."""
        self.taken[there[0].name, there[1].name] = key

    def message(self, key: str, name: str) -> Message | None:
        """Return a message by its name."""
        name = name.strip().replace("{}", str(self.address))
        if name not in self.all:
            self.object(key, f"there is no message {name!r} in {self.name}{did_you_mean(name, self.all)}")
            return None
        self.used[name] = None
        return self.all[name]

    def signal(self, key: str, name: str) -> tuple[Message, Signal] | None:
        """Return a signal by the name of its message and its own."""
        head, dot, tail = name.strip().rpartition(".")
        if not dot:
            self.object(key, f'found {name!r}, expected "MESSAGE.SIGNAL"')
            return None
        message = self.message(key, head)
        if message is None:
            return None
        tail = tail.replace("{}", str(self.address))
        if tail not in message.signals:
            hint = did_you_mean(tail, message.signals)
            self.object(key, f"there is no signal {tail!r} in {message.name} of {self.name}{hint}")
            return None
        return message, message.signals[tail]

    def raw(self, key: str, signal: Signal, text: str) -> Raw | None:
        """Return the raw number of a value: a physical one, or a name."""
        text = text.strip()
        named = {name: raw for raw, name in signal.choices}
        if text in named:
            return named[text]
        try:
            value = int(text, 0) if text[:2].lower() == "0x" else float(text)
            exact = (value - signal.offset) / signal.factor
            raw: Raw = exact if signal.real else round(exact)
        except (ValueError, ArithmeticError):  # among them of what is not finite
            one_of = f", or one of {', '.join(named)}" if named else ""
            self.object(key, f"found {text!r}, expected a number{one_of}{did_you_mean(text, named)}")
            return None
        low, high = signal.ends()
        if not low <= raw <= high:
            least, most = sorted(each * signal.factor + signal.offset for each in (low, high))
            self.object(key, f"{text} does not fit into {signal.name}: it has {least:g} to {most:g}")
            return None
        if signal.factor == 1.0 and not signal.real and raw != exact:
            self.object(key, f"{text} is no value of {signal.name}, which has whole steps")
            return None
        return raw

    def assignments(self, key: str, texts: Sequence[str]) -> Assignments:
        """Return what values are given to signals."""
        found: dict[str, dict[str, Raw]] = {}
        for text in texts:
            name, equals, value = text.partition("=")
            if not equals:
                message = self.message(key, name) if "." not in name else None
                if message is not None and message.signals:
                    self.object(key, f'found {text!r}, expected "MESSAGE.SIGNAL = VALUE"')
                elif message is not None:
                    found.setdefault(message.name, {})
                elif "." in name:
                    self.object(key, f'found {text!r}, expected "MESSAGE.SIGNAL = VALUE"')
                continue
            there = self.signal(key, name)
            raw = self.raw(key, there[1], value) if there else None
            if there is not None and raw is not None:
                found.setdefault(there[0].name, {})[there[1].name] = raw
                self.take(there, key)
        return found

    def number(self, key: str, quantity: str, fed: Fed) -> Number | None:
        """Return the quantity in a signal."""
        there = self.signal(f"{key}.signal", fed.signal)
        of, one = UNITS[fed.unit]
        if of not in ("", quantity):
            units = ", ".join(unit for unit, (what, _) in UNITS.items() if what == quantity)
            self.object(f"{key}.unit", f"{fed.unit!r} is no unit of a {quantity}: expected {units}")
        if there is None:
            return None
        message, signal = there
        self.take(there, key)
        unit = one * fed.scale
        if signal.factor * unit == 0.0:
            self.object(f"{key}.signal", f"{signal.name} has a factor of 0 in {self.name}")
            return None
        return Number(message.name, signal, signal.factor * unit, signal.offset * unit)

    def setpoint(self, key: str, commanded: Commanded) -> SetPoint | None:
        """Return how a command is sent."""
        number = self.number(key, key, commanded)
        beside = self.assignments(f"{key}.beside", commanded.beside)
        return None if number is None else SetPoint(number, beside)

    def protection(self) -> dict[str, Message]:
        """Return the messages that are used, with their counters and checksums."""
        found = {name: self.all[name] for name in self.used}
        for text in self.options.counters:
            if there := self._protecting("counters", text):
                before = found.get(there[0].name, there[0])
                if before.counter not in ("", there[1].name):
                    self.object("counters", f"{before.name} has two: {before.counter}, {there[1].name}")
                found[there[0].name] = replace(before, counter=there[1].name)
        for text in self.options.checksums:
            name, _, kind = (part.strip() for part in text.partition("="))
            there = self._protecting("checksums", name)
            if kind not in CHECKSUMS:
                known = ", ".join(CHECKSUMS)
                self.object("checksums", f"{text!r}: expected one of {known}{did_you_mean(kind, CHECKSUMS)}")
            elif there is not None:
                before = found.get(there[0].name, there[0])
                if before.checksum is not None and before.checksum[0] != there[1].name:
                    self.object("checksums", f"{before.name} has two: {before.checksum[0]}, {there[1].name}")
                found[there[0].name] = replace(before, checksum=(there[1].name, CHECKSUMS[kind]))
        return found

    def _protecting(self, key: str, name: str) -> tuple[Message, Signal] | None:
        """Return a signal that is nothing but a counter or a checksum, by its name."""
        there = self.signal(key, name)
        if there is None:
            return None
        other = self.taken.setdefault((there[0].name, there[1].name), key)
        if there[1].real:
            self.object(key, f"{name!r} is no integer")
        elif other != key:
            self.object(key, f"{name!r} is named by {other}, too: expected a signal of its own")
        else:
            return there
        return None

    def periods(self) -> dict[str, Nanos]:
        """Return the periods of messages with one of their own."""
        found = {}
        for text in self.options.periods:
            name, _, value = text.partition("=")
            message = self.message("periods", name)
            try:
                if message is not None and PERIODS[0] <= float(value) <= PERIODS[1]:
                    found[message.name] = round(float(value) * MILLISECOND)
                    continue
            except ValueError:
                pass
            if message is not None:
                least, most = PERIODS
                self.object("periods", f'{text!r}: expected "MESSAGE = {least:g} to {most:g}" ms')
        return found


REMEMBERED = 256


@lru_cache(REMEMBERED)
def declared(options: Options, address: int) -> Declared:
    """Return what is declared of a motor. Raises Invalid with every mistake."""
    reader = _Reader(options, address)
    given = {key: one for key in KINDS if (one := getattr(options, key)) is not None}
    setpoints = {KINDS[key]: found for key, one in given.items() if (found := reader.setpoint(key, one))}
    lists = {key: reader.assignments(key, getattr(options, key)) for key in ("enable", "idle", "clear")}
    to_device = tuple(reader.used)
    fed = _fed(reader)
    state, fault = _state(reader), _fault(reader)
    from_device = {
        one.message: None for one in (*fed.values(), *(each[0] for each in (state, fault) if each))
    }
    periods, messages = reader.periods(), reader.protection()
    made = Declared(
        messages,
        to_device,
        tuple(from_device),
        setpoints,
        **lists,
        fed=fed,
        state=state,
        fault=fault,
        periods=periods,
    )
    _check(reader, made, given)
    if reader.wrong:
        raise Invalid(*dict.fromkeys(reader.wrong))
    return made


def _fed(reader: _Reader) -> dict[str, Number]:
    feedback = reader.options.feedback
    names = ("position", "velocity", "torque", "current", "voltage", "temperature")
    given = {name: one for name in names if (one := getattr(feedback, name)) is not None}
    made = {name: reader.number(f"feedback.{name}", name, one) for name, one in given.items()}
    return {name: one for name, one in made.items() if one is not None}


def _state(reader: _Reader) -> tuple[Number, tuple[Raw, ...], Raw] | None:
    told = reader.options.feedback.state
    there = reader.signal("feedback.state.signal", told.signal) if told else None
    if told is None or there is None:
        return None
    reader.take(there, "feedback.state")
    armed = [reader.raw("feedback.state.armed", there[1], text) for text in told.armed]
    ready = reader.raw("feedback.state.ready", there[1], told.ready)
    if not armed:
        reader.object("feedback.state.armed", "expected at least one value")
    if ready is not None and ready in armed:
        reader.object("feedback.state.ready", f"{told.ready} is among armed, too")
    found = tuple(raw for raw in armed if raw is not None)
    return (Number(there[0].name, there[1], 1.0, 0.0), found, ready) if found and ready is not None else None


def _fault(reader: _Reader) -> tuple[Number, Raw] | None:
    faulty = reader.options.feedback.fault
    there = reader.signal("feedback.fault.signal", faulty.signal) if faulty else None
    none = reader.raw("feedback.fault.none", there[1], faulty.none) if faulty and there else None
    if there is not None:
        reader.take(there, "feedback.fault")
    return None if there is None or none is None else (Number(there[0].name, there[1], 1.0, 0.0), none)


def _check(reader: _Reader, made: Declared, given: Mapping[str, Any]) -> None:
    """Object to what is missing, and to what contradicts itself."""
    options, say = reader.options, reader.object
    feedback = options.feedback
    if not given:
        say(
            "velocity",
            f"missing; expected a table of at least one of {', '.join(KINDS)}: which signal commands it",
        )
    if not options.idle:
        say("idle", 'missing; expected the safe command, such as ["COMMAND.ENABLE = 0"]')
    if feedback.position is None and feedback.velocity is None:
        say("feedback", "missing; expected a signal of the velocity, or of the position")
    if "position" in given and (feedback.position is None or feedback.within_turn):
        say(
            "position",
            "a position is commanded only where it is fed back, over all turns (feedback.position)",
        )
    for name in sorted(set(made.to_device) & set(made.from_device)):
        say("feedback", f"{name} is sent to the motor: what is sent is no feedback")
    for name in reader.used:
        if name not in made.to_device and name not in made.from_device:
            say("counters", f"{name} is neither sent nor fed back: leave it away")
    for key, one in zip(given, made.setpoints.values(), strict=False):
        for other, values in (("enable", made.enable), (f"{key}.beside", one.beside)):
            if one.number.key in _flat(values):
                say(other, f"{one.number.key} is what commands the {key}: it has no other value")
    if len(made.setpoints) > 1:
        besides = [_flat(one.beside) for one in made.setpoints.values()]
        if any(_fits_both(a, b) for at, a in enumerate(besides) for b in besides[:at]):
            say(next(iter(given)), "several commands: what goes beside each must differ in a signal (a mode)")
    idle = _flat(made.idle)
    if made.enable and idle and all(idle.get(key, raw) == raw for key, raw in _flat(made.enable).items()):
        say("idle", "it leaves enabled what enable enables")
    if not made.enable:
        for key, one in zip(given, made.setpoints.values(), strict=False):
            if options.idle and one.number.key not in idle:
                say("idle", f"without enable it must say what {key} is then: {one.number.key!r} has no value")


def _flat(assignments: Assignments) -> dict[str, Raw]:
    return {f"{message}.{name}": raw for message, one in assignments.items() for name, raw in one.items()}


def _fits_both(one: Mapping[str, Raw], other: Mapping[str, Raw]) -> bool:
    """True if no signal differs in both."""
    return all(other.get(key, raw) == raw for key, raw in one.items()) or not (one.keys() & other.keys())


# -- obeyed ----------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Memory:
    """What a motor keeps of the messages to it."""

    name: str
    declared: Declared
    armed: bool = False
    values: dict[str, Raw] = field(default_factory=dict)
    """The last raw number of each signal, by message and signal"""

    def disarm(self) -> None:
        """Lose the power: by a timeout, a fault."""
        self.armed = False

    def obey(self, frame: Frame) -> Sequence[Obeyed]:
        """Return what the motor does on a frame."""
        of = self.declared
        message = of.message(frame, of.to_device)
        raws = message.decode(frame) if message is not None and isinstance(frame, CanFrame) else None
        if message is None or raws is None or not isinstance(frame, CanFrame):
            return ()
        if message.counter:
            key = f"{message.name}.{message.counter}"
            if self.values.get(key) == raws[message.counter]:
                return ()
        self.values |= {f"{message.name}.{name}": raw for name, raw in raws.items()}
        if message.stray(frame):
            return (msg.Kept(self.name, f"bits of {message.name} that no signal has", 1.0),)
        cleared = message.name in of.clear and self._holds(of.clear)
        did: list[Obeyed] = [msg.ClearFault(self.name)] if cleared else []
        return [*did, *self._driven(message, raws)]

    def _driven(self, message: Message, raws: Mapping[str, Raw]) -> Sequence[Obeyed]:
        """Return what becomes of the motor by a message."""
        of = self.declared
        if message.name in of.idle and self._holds(of.idle):
            self.armed = False
            return (msg.Idle(self.name),)
        armed = self._holds(of.enable)
        kind, one = self._commanded()
        if one is not None and not of.enable:
            armed = self.armed or (one.number.signal.name in raws and one.number.message == message.name)
        did: list[Obeyed] = []
        if self.armed and not armed:
            did.append(msg.Idle(self.name))
        arms = armed and not self.armed
        self.armed = armed
        if arms:
            did.append(msg.Arm(self.name))
        concerned = one is not None and (
            arms or message.name == one.number.message or message.name in one.beside
        )
        carries = one is not None and message.name == one.number.message
        did += self._kept(message, raws, carries=carries and armed)
        if armed and one is not None and kind is not None and concerned and one.number.key in self.values:
            did.append(_made(kind, self.name, one.number.value(self.values[one.number.key])))
        return did

    def _kept(self, message: Message, raws: Mapping[str, Raw], *, carries: bool) -> list[Obeyed]:
        """Return what it keeps of a message: modes, and set-points that wait."""
        found: dict[tuple[str, float], None] = {}
        for name, signal, _ in self.declared.constants():
            if name == message.name and signal in raws:
                found[f"{name}.{signal}", float(raws[signal])] = None
        waits = [] if carries else [*self.declared.setpoints.items()]
        for kind, one in waits:
            if one.number.message == message.name and one.number.signal.name in raws:
                found[_number(kind), one.number.value(raws[one.number.signal.name])] = None
                found.pop((one.number.key, float(raws[one.number.signal.name])), None)
        numbers = {one.number.key for one in self.declared.setpoints.values()}
        return [msg.Kept(self.name, name, value) for name, value in found if name not in numbers]

    def _holds(self, assignments: Assignments) -> bool:
        values = self.values
        return all(
            values.get(f"{message}.{name}") == raw
            for message, one in assignments.items()
            for name, raw in one.items()
        )

    def _commanded(self) -> tuple[type[Command] | None, SetPoint | None]:
        """Return the command that what goes beside it makes of set-points now."""
        found = [(kind, one) for kind, one in self.declared.setpoints.items() if self._holds(one.beside)]
        return found[0] if found else (None, None)


def _number(kind: type[Command]) -> str:
    return f"{kind.__name__}.{kind.__name__.lower()}"


def _made(kind: type[Command], name: str, value: float) -> Command:
    made: Any = kind
    command: Command = made(name, value)
    return command


def memory_of(device: Device) -> Memory:
    """Return a motor as it is when switched on."""
    return Memory(device.name, declared(device.options, device.address))
