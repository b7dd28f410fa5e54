"""The host's end of servos on a bus, whose registers are read and written by address.

Rules. What is written in one step to several devices is one sync write, which nobody answers; what became of
it is read back. The motion of all is one chain of answers; at whom it breaks is asked alone until it answers,
so that those behind it lose one reading. Blocks are asked for in periods, and not while what they hold is
known and stays. A request writes registers one after the other, each read back; what a request has not asked
for does not answer it, since it may be from before.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias, TypeVar

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import BITS, Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.host import Host, Phase, Report, counted_once
from protocols.toolkit.memory_map import GoalRegister, MemoryMap, Target, Values
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.requests import ANSWER
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo_packets import WRITE, Packet, ServoPackets, Status, Targets

LONGEST, DELAY_UNIT = 254, 2_000
"""Steps of the longest Return_Delay_Time, which is that of a device that has not told its own; ns of one."""
EARLY: Nanos = 100_000
"""How much before its time something is asked for, rather than a step later."""
ONCE: Nanos = 300 * MILLISECOND
"""Period in which Zero is sent again: it is stored each time."""
BACK = " back"
"""End of the subject of what is read for a request."""


@dataclass(slots=True)
class Known:
    """What is known of one device beyond its phase. Plain data."""

    id: int
    """At which it is asked: another one than in the robot file, once it was changed."""
    goal: GoalRegister
    """Its set-point's register, in the mode that the options have."""
    set_up: Mapping[str, int]
    """What its registers must hold before it is armed."""
    values: Values = field(default_factory=dict)
    """What its registers hold, since it was last forgotten."""
    read_at: dict[str, Nanos] = field(default_factory=dict)
    """Since when what is held is known, by block."""
    asked_at: dict[str, Nanos] = field(default_factory=dict)
    """When a block was last asked for. Also of other things that are done in periods."""
    alone: bool = False
    """A chain of answers broke at it."""

    def due(self, what: str, period: Nanos) -> Nanos:
        """Return when something is to be done again."""
        return self.asked_at.get(what, -period) + period

    def ask(self, now: Nanos, what: str, period: Nanos = 0) -> None:
        """Note that it is done; with its period: in the rhythm that it has, unless that was lost."""
        due = self.asked_at.get(what, now - period) + period
        self.asked_at[what] = due if abs(now - due) <= period else now

    def put(self, t: Nanos, block: str, values: Values) -> None:
        """Record what is read."""
        self.values |= values
        self.read_at[block] = t

    def different(self, wanted: Mapping[str, int]) -> dict[str, int]:
        """Return what of this is not known to be so."""
        return {name: value for name, value in wanted.items() if self.values.get(name) != value}

    def ask_alone(self, *, alone: bool) -> None:
        """Note whether it is asked alone."""
        self.alone = alone

    def move_to(self, number: int) -> None:
        """Note that it has another id."""
        self.id = number

    def forget(self) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.values.clear()
        self.read_at.clear()
        self.alone = False


class Answered(NamedTuple):
    """What a device answered to a write."""

    register: str
    refusal: str


K = TypeVar("K", bound=Known)
Motion: TypeAlias = tuple[float | None, float | None]
"""Position and velocity, None where it is not known."""


class ServoAdapter(Adapter[K]):
    """The options of a device have `table` (its `MemoryMap`, with the blocks "motion" and "state"),
    `operating_mode`, `goal_in` and `set_up` of it, `ampere` and `newton_metre` (what one step of the current
    is in A and N·m; 0: not known), `feedback_ms` and `offline_ms`."""

    kind: type[K]
    """What is known of one device"""

    packets: ServoPackets
    clearing_disarms = True
    switch: str = "Torque_Enable"
    """The register that arms"""
    id: str = "ID"
    rate: str = "Baud_Rate"
    """The register that changes the rate of the line: it is acknowledged, and not read back."""
    zeroed: str = "Homing_Offset"
    """The register that Zero changes"""
    commanded: Collection[str] = ()
    """Registers that commands write, not requests"""
    late: Nanos = 0
    """How much later than after its delay an answer may come"""
    supply: str
    """The register of the supply [0.1 V]"""
    silence: Nanos
    """Time after which an id is known to be without a device"""
    again: Nanos = 100 * MILLISECOND
    """Period in which a request is sent again"""
    details: Mapping[str, str] = {}
    """What is still to be done when a register was written"""

    # -- the protocol's own -------------------------------------------------------------------------------

    def delay(self, host: Host[K]) -> Nanos:
        """Return how long a device waits before it answers, at most."""
        return min(host.own.values.get("Return_Delay_Time", LONGEST), LONGEST) * DELAY_UNIT + self.late

    def who(self, number: int) -> Exchange:
        """Return the read-only question by which a scan finds a device: in the background, so that those
        that move are read meanwhile."""
        raise NotImplementedError

    def note(self, question: Packet, data: bytes) -> str:
        """Return what the answer to that question says of a device; "" if it is another answer."""
        return ""

    def refusal(self, error: int) -> str:
        """Return why a device does not do what it was sent, "" if it does."""
        return ""

    def faults_in(self, host: Host[K], error: int, values: Values) -> Collection[int] | None:
        """Return the faults that an answer shows; None if it shows none, nor that there are none."""
        return None

    def shaft(self, t: Nanos, host: Host[K], values: Values) -> Motion | None:
        """Return position and velocity by the registers of the motion; None if these are not of it."""
        raise NotImplementedError

    def wanted(self, host: Host[K]) -> Iterable[tuple[str, Nanos]]:
        """Return the blocks that are asked for now, and in which period."""
        raise NotImplementedError

    def chain(self, host: Host[K]) -> str | None:
        """Return with which others a device is asked for its motion; None: it is asked alone."""
        return ""

    def chained(self, chain: str, wanted: Targets, about: str, delay: Nanos) -> Exchange:
        """Return the question for the motion of several devices."""
        return self.packets.asks(wanted, about, delay)

    def changes(self, host: Host[K], name: str, value: float) -> Sequence[tuple[str, float]]:
        """Return the registers that are written one after the other to change one."""
        return ((name, value),)

    def change(self, host: Host[K], name: str, value: float) -> Exchange:
        """Return what writes one of them."""
        (at, data), own = self.table(host).runs({name: value})[0], host.own
        place = self.packets.place.pack(at)
        return self.packets.tells(own.id, WRITE, place + data, f"{own.id} {name}", self.delay(host))

    def clears(self, now: Nanos, host: Host[K]) -> Sequence[Frame]:
        """Return what clears the faults of a device, as far as they do not pass by themselves."""
        return ()

    def zeroing(self, host: Host[K]) -> tuple[Sequence[Frame], int | None] | str:
        """Return what makes the present position zero, and what `zeroed` then holds (None: any); or why
        that cannot be."""
        return "the device cannot do that on this bus"

    # -- devices and received bytes -----------------------------------------------------------------------

    def __init__(self) -> None:
        self._stream = Stream(self.packets.framing)
        self._writes: dict[tuple[Rank, int, int], dict[int, bytes]] = {}
        """What is written in this step, by rank, address and size: the data by device."""
        self._chains: dict[str, dict[int, tuple[Target, Nanos]]] = {}
        """Who is asked for its motion in this step: what is read, and how long it waits before."""
        self._moved: dict[int, str] = {}
        """Names of devices by the id that they were given."""
        self._pace = self.silence
        self._reads_back = False
        """Whether what is decoded was read for a request."""

    @staticmethod
    def table(host: Host[K]) -> MemoryMap:
        """Return the registers of a device."""
        table: MemoryMap = host.options.table
        return table

    def own(self, device: Device) -> K:
        self._pace = max(self._pace, self.silence + 24 * BITS * SECOND // (device.line_rate or 1_000_000))
        options = device.options
        return self.kind(device.address, options.goal_in(options.operating_mode), options.set_up)

    def forget(self, now: Nanos, host: Host[K]) -> None:
        host.own.forget()

    def interrupted(self) -> None:
        self._stream.drop()

    def _host(self, number: int, driver: MotorDriver[K]) -> Host[K] | None:
        """Return the device with an id: also one that has it since a request gave it."""
        return driver.hosts.get(self._moved.get(number, "")) or driver.at.get(number)

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[K]) -> Sequence[Report[K] | Rx]:
        """Return who is there: what nobody asked for, or what came too late, does not say of what it is."""
        if not isinstance(frame, bytes):
            return (Rx.IGNORED,)
        return [self._message(t, each, Packet(0, 0, b""), {}, driver) for each in self._stream.feed(frame)]

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[K]
    ) -> Sequence[Report[K] | Rx]:
        question = self.packets.question(asked)
        wanted = self.packets.targets(question)
        self._reads_back = asked.about.endswith(BACK)
        at_once, data = self.packets.answered(wanted, question, data)
        reports = [self._status(t, each, question, wanted, driver) for each in at_once]
        if question.instruction in self.packets.joint:
            reports = counted_once(reports)
        self.interrupted()
        reports += [self._message(t, each, question, wanted, driver) for each in self._stream.feed(data)]
        self.interrupted()  # what has no end is no beginning of the next answer
        if asked.about.startswith("motion"):
            self._find_break(reports, list(wanted), driver)
        return reports

    def _find_break(
        self, reports: Iterable[Report[K] | Rx], order: Sequence[int], driver: MotorDriver[K]
    ) -> None:
        """Note at whom a chain of answers broke: those behind it do not answer, as they wait for it."""
        answered = {each.host.own.id for each in reports if isinstance(each, Report) and each.host}
        silent = next((number for number in order if number not in answered), None)
        if silent is not None and (host := self._host(silent, driver)):
            host.own.ask_alone(alone=True)

    def _message(
        self, t: Nanos, message: bytes | Rx, question: Packet, wanted: Targets, driver: MotorDriver[K]
    ) -> Report[K] | Rx:
        if isinstance(message, Rx):
            return message
        status = self.packets.status(self.packets.unpacked(message))
        # What is no status is an echo, or another host's.
        return Rx.IGNORED if status is None else self._status(t, status, question, wanted, driver)

    def _status(
        self, t: Nanos, status: Status, question: Packet, wanted: Targets, driver: MotorDriver[K]
    ) -> Report[K] | Rx:
        """Return what a status reports that answers a question."""
        answering, error, data = status
        host, note = self._host(answering, driver), self.note(question, data)
        if host is None:
            return Report(None, answering, note=note) if note and driver.scanning() else Rx.IGNORED
        own, number = host.own, host.address
        at, size = wanted.get(answering, (0, 0))
        values: Values = {}
        refusal = self.refusal(error)
        if size and len(data) == size and not refusal:
            values = self.table(host).values(at, data)
            own.put(t, self._block(host, (at, size)), values)
            own.ask_alone(alone=False)
            if self._moved.get(values.get(self.id, -1)) == host.name:
                own.move_to(values[self.id])
        faults = self.faults_in(host, error, values)
        mode, detail = Mode.FAULT if faults else None, ""
        if self.switch in values and not faults:
            armed = values[self.switch]
            mode, detail = (Mode.ARMED, "torque on") if armed else (Mode.READY, "torque off")
        content = None
        if question.instruction == WRITE and answering == question.id:
            name = self.table(host).by_number.get(self.packets.writes(question)[0][1])
            content = Answered(name.name if name else "", refusal)
        feedback = self._feedback(t, host, values) if values else None
        parameters = {name: float(value) for name, value in values.items()} if self._reads_back else {}
        return Report(
            host, number, mode, detail, faults, feedback, content=content, parameters=parameters, note=note
        )

    def _feedback(self, t: Nanos, host: Host[K], values: Values) -> Feedback | None:
        """Return what registers measure of the motion; None if these do not."""
        shaft = self.shaft(t, host, values)
        if shaft is None:
            return None
        volts, degrees = values.get(self.supply), values.get("Present_Temperature")
        counts, torque = values.get("Present_Current"), host.options.newton_metre
        return Feedback(
            host.name,
            t,
            *shaft,
            None if counts is None or not torque else counts * torque,
            None if counts is None else counts * host.options.ampere,
            None if volts is None else volts * 0.1,
            None if degrees is None else float(degrees),
        )

    def _block(self, host: Host[K], target: Target) -> str:
        blocks = self.table(host).blocks
        return next((name for name, each in blocks.items() if each == target), "")

    # -- written, by itself -------------------------------------------------------------------------------

    def put(self, host: Host[K], values: Mapping[str, float], rank: Rank = Rank.SET_POINT) -> None:
        """Write registers with the next sync writes, neighbours at once."""
        for at, data in self.table(host).runs(values):
            self._writes.setdefault((rank, at, len(data)), {})[host.own.id] = data

    def set_point(self, host: Host[K], command: Command) -> None:
        """Write the set-point of a command in the mode that the options have: of Hold, where it was held."""
        goal = host.own.goal
        held = (host.position if host.held is None else host.held) or 0.0
        position = getattr(command, "position", held)
        value = getattr(command, "velocity", 0.0) if goal.command is msg.Velocity else position
        value = getattr(command, "torque", 0.0) if goal.command is msg.Torque else value
        self.put(host, {goal.register: goal.raw(value)})

    def release(self, now: Nanos, host: Host[K]) -> Sequence[Frame]:
        self.put(host, {self.switch: 0}, Rank.RELEASE)
        return self.ask(now, host, "state")

    def target(self, host: Host[K], block: str) -> Target:
        """Return where a block lies."""
        return self.table(host).blocks[block]

    def ask(self, now: Nanos, host: Host[K], block: str, rank: Rank = Rank.QUESTION) -> list[Frame]:
        """Return the question for a block of registers of one device."""
        own = host.own
        own.ask(now, block)
        about = f"{own.id} {block}"
        return [self.packets.asks({own.id: self.target(host, block)}, about, self.delay(host), rank)]

    @staticmethod
    def settled(host: Host[K]) -> bool:
        """True if the state of a device is known, and not about to change."""
        return host.phase in (Phase.ARMED, Phase.FREE) and host.mode is not None

    def poll(self, now: Nanos, host: Host[K]) -> Sequence[Frame]:
        frames: list[Frame] = []
        own = host.own
        for block, period in self.wanted(host):
            if now < own.due(block, period) - EARLY:
                continue
            own.ask(now, block, period)
            chain = self.chain(host) if block == "motion" and not own.alone else None
            if chain is not None:
                asked = self.target(host, block), self.delay(host)
                self._chains.setdefault(chain, {})[own.id] = asked
            else:
                rank = Rank.QUESTION if block == "motion" else Rank.BACKGROUND
                about = f"{own.id} {block}"
                wanted = {own.id: self.target(host, block)}
                frames.append(self.packets.asks(wanted, about, self.delay(host), rank))
        return frames

    def poll_due(self, host: Host[K]) -> Nanos:
        return min(host.own.due(*each) for each in self.wanted(host))

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        """Return what is written to several devices at once, and the question for the motion of all."""
        frames: list[Frame] = [
            Exchange(frame, None, rank, f"{at}+{size} {number}")
            for (rank, at, size), data in self._writes.items()
            for number, frame in enumerate(self.packets.sync_writes(at, data))
        ]
        for chain, asked in self._chains.items():
            wanted = {number: target for number, (target, _) in asked.items()}
            about = f"motion {','.join(map(str, wanted))}"  # it replaces no question to others
            frames.append(self.chained(chain, wanted, about, sum(delay for _, delay in asked.values())))
        self._writes, self._chains = {}, {}
        return frames

    # -- requests -----------------------------------------------------------------------------------------

    def questions(self, driver: MotorDriver[K]) -> Iterable[Frame]:
        return map(self.who, self.packets.addresses)

    def begin(
        self, now: Nanos, request: Request, host: Host[K] | None, driver: MotorDriver[K]
    ) -> Pending[K] | str:
        if isinstance(request, msg.Scan):
            twice = 2 * tuple(self.questions(driver))
            end = now + self._pace * len(twice) + ANSWER
            return Pending(request, request.bus, now, end, now, None, twice, self._pace)
        if host is None:
            return super().begin(now, request, host, driver)
        notes: dict[str, object] = {}
        wrong, period = "the device cannot do that on this bus", self.again
        match request:
            case msg.ClearFault():
                frames, half = tuple(self.clears(now, host)), self.clearing // 2
                return Pending(request, host.name, now, now + self.clearing, now, host, frames, half)
            case msg.ReadParameter(_, name):
                wrong = self.table(host).wrong(name)
            case msg.WriteParameter(_, name, value):
                wrong = self._not_written(host, name, value, driver)
                notes = {"left": () if wrong else self.changes(host, name, value)}
            case msg.Zero():
                zeroing, period = self.zeroing(host), ONCE
                wrong = zeroing if isinstance(zeroing, str) else ""
                notes = {} if isinstance(zeroing, str) else {"frames": zeroing[0], "holds": zeroing[1]}
        return wrong or Pending(request, host.name, now, now + SECOND, now, host, (), period, notes)

    def _not_written(self, host: Host[K], name: str, value: float, driver: MotorDriver[K]) -> str:
        """Return why a register is not written for a request, "" if it is."""
        wrong = self.table(host).wrong(name, value)
        if wrong or name in self.commanded:
            return wrong or f"{name} is commanded, not written"
        other = driver.at.get(int(value), host) if name == self.id else host
        return "" if other is host else f"{name} {value:g} is that of {other.name}"

    def frames(self, now: Nanos, pending: Pending[K]) -> Sequence[Frame]:
        host = pending.host
        if host is None:  # as many as the line may have asked since then, however seldom it is stepped
            return pending.frames[pending.sent : 1 + (now - pending.began) // self._pace]
        match pending.request:
            case msg.ReadParameter(_, name):
                return (self._back(host, name),)
            case msg.WriteParameter():
                name, value = pending.notes["left"][0]
                change = self.change(host, name, value)
                if name == self.rate:
                    return (change,)
                if name == self.id:
                    self._moved[round(value)] = host.name
                    return change, self._back(host, name, round(value))
                return change, self._back(host, name)
            case msg.Zero():
                return *pending.notes["frames"], self._back(host, self.zeroed)
        return pending.frames

    def _back(self, host: Host[K], name: str, number: int | None = None) -> Exchange:
        """Return what reads a register for a request; `number`: the id at which it answers."""
        at = host.own.id if number is None else number
        target = self.table(host).target(name)
        return self.packets.asks({at: target}, f"{at} {name}{BACK}", self.delay(host))

    def answer(self, t: Nanos, pending: Pending[K], report: Report[K]) -> Event | None:
        request, notes, has = pending.request, pending.notes, report.parameters
        written = report.content if isinstance(report.content, Answered) else Answered("", "")
        if isinstance(request, msg.Zero):
            if written.refusal:
                return pending.refuse(t, written.refusal)
            if "zeroed" not in notes:  # where it stands says nothing before
                if self.zeroed in has and notes["holds"] in (None, has[self.zeroed]):
                    notes.update(zeroed=True)
                return None
        if not isinstance(request, msg.WriteParameter):
            return super().answer(t, pending, report)
        (name, value), *left = notes["left"]
        if written.register == name and written.refusal:
            return pending.refuse(t, written.refusal)
        if has.get(name) != value and not (name == self.rate == written.register):
            return None
        notes.update(left=left or notes["left"])
        stored = pending.host is not None and self.table(pending.host).is_stored(request.parameter)
        detail = self.details.get(request.parameter, "stored" if stored else "")
        return None if left else pending.done(t, detail)
