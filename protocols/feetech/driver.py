"""The host's end: what a servo is sent in each phase, and what its answers report.

Rules. A servo that is not commanded is only read. Set-points are sync writes, which nobody answers: one frame
for all servos. What a servo must hold before it is armed is written until it reads back so, and then only is
it given a goal, where it stands: a goal alone makes most servos go there, whether they were armed or not. All
motions are read together; a servo that breaks the chain is asked alone until it answers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from protocols import messages as msg
from protocols.feetech import table as ft
from protocols.feetech.options import MODES, Options
from protocols.feetech.table import BLOCKS, IDS, Values
from protocols.frames import Frame
from protocols.line import BITS, Answer, Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.requests import SLICE
from protocols.toolkit.serial import Stream
from protocols.toolkit.turns import Turns

STATE: Nanos = 100 * MILLISECOND
"""Period in which the state is asked for;"""
UNSURE: Nanos = 20 * MILLISECOND
"""while it is not known, or about to change."""
STEP: Nanos = 20 * MILLISECOND
"""Period of the parts of a request."""
ONCE: Nanos = 300 * MILLISECOND
"""Period in which other requests are sent again: a middle is stored each time."""
STORED = 40
"""Registers below are kept without supply, where Lock is 0."""
UNANSWERED: Nanos = MILLISECOND
"""What a question that nobody answers costs beyond that"""
LATE = 60_000
"""ns by which an answer may come later than the servo's delay"""
BLOCKS_SET_UP = ("who", "state")
"""What is read back of the set-up"""
MEASURED = (
    "Present_Position", "Present_Velocity", "Present_Voltage", "Present_Temperature", "Present_Current"
)  # fmt: skip
GOALS = {0: "Goal_Position", 1: "Goal_Velocity", 2: "Goal_Time"}
"""The set-point's register by mode."""


@dataclass(slots=True)
class Servo:
    """What is known of one servo beyond its phase. Plain data."""

    rate: int
    """bit/s of its line"""
    id: int
    """At which it is asked: another one than in the robot file, once it was changed."""
    known: Values = field(default_factory=dict)
    """What its registers held when they were last read."""
    next_at: dict[str, Nanos] = field(default_factory=dict)
    """By block, when it is asked for next."""
    written_at: Nanos | None = None
    """When the set-up was first written since it was last forgotten,"""
    confirmed: bool = False
    """and that it has read back so since then."""
    alone: bool = False
    """It broke the chain of a sync read, and is asked alone."""
    turns: Turns = field(default_factory=Turns)

    @property
    def delay(self) -> int:
        """Time [ns] before it answers."""
        delay = self.known.get("Return_Delay_Time", 254) * 2000
        return min(delay, ft.LONGEST_DELAY) + LATE

    def due(self, now: Nanos, block: str, period: Nanos) -> bool:
        """True if a block was not asked for in this time: it is now."""
        at = self.next_at.get(block)
        if at is not None and now < min(at, now + period):
            return False
        self.next_at[block] = now + period if at is None or now - at > period else at + period
        return True

    def rest(self, *blocks: str) -> None:
        """Note that these blocks are not asked for now."""
        for block in blocks:
            self.next_at.pop(block, None)

    @property
    def next(self) -> Nanos:
        """Return when something is asked for next."""
        return min(self.next_at.values(), default=0)

    def write(self, now: Nanos) -> None:
        """Note that the set-up is written."""
        self.written_at = now if self.written_at is None else self.written_at

    def hears(self, t: Nanos, values: Values, wanted: Values) -> None:
        """Record what registers hold."""
        self.known |= values
        if "Torque_Enable" in values and self.written_at is not None and t > self.written_at:
            self.confirmed = not self.different(wanted)

    def different(self, wanted: Values) -> list[str]:
        """Return what does not hold this, as far as is known."""
        return [name for name, value in wanted.items() if self.known.get(name) != value]

    def forget(self) -> None:
        """Forget all of it: it may have restarted, or been replaced."""
        self.known, self.written_at, self.confirmed, self.alone = {}, None, False, False
        self.next_at = {}
        self.turns = Turns()

    def recount(self) -> None:
        """Count turns anew: its zero is another one."""
        self.turns = Turns()

    def ask_alone(self, *, alone: bool) -> None:
        """Note whether it is asked alone."""
        self.alone = alone

    def move_to(self, number: int) -> None:
        """Note that it has another id."""
        self.id = number


class FeetechAdapter(Adapter[Servo]):
    """What servos are sent, and what they report."""

    name = ft.NAME
    faults, latch, not_armed = ft.ALL_FAULTS, True, ft.NOT_ARMED
    clearing, clearing_disarms = 2 * SECOND, True
    zero_tolerance = 0.02

    def __init__(self) -> None:
        self._stream = Stream(ft.FRAMING)
        self._writes: dict[tuple[Rank, int, int], dict[int, bytes]] = {}
        """What the frames of this step write: by what they are for, first register and size, the data of
        each servo. In the order in which they are sent."""
        self._group: dict[int, Host[Servo]] = {}
        """Servos whose motion is to be asked for at once."""

    def own(self, device: Device) -> Servo:
        return Servo(device.line_rate, device.address)

    def timing(self, options: Options) -> Timing:
        return Timing(round(options.offline_ms * MILLISECOND))

    def forget(self, now: Nanos, host: Host[Servo]) -> None:
        host.own.forget()

    def interrupted(self) -> None:
        self._stream.drop()

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Servo]) -> Sequence[Report[Servo] | Rx]:
        """Return who is there: what nobody asked for, or what came too late, does not say of what it is."""
        if not isinstance(frame, bytes):
            return (Rx.IGNORED,)
        found = self._stream.feed(frame)
        return [each if isinstance(each, Rx) else self._stray(ft.unpacked(each), driver) for each in found]

    @staticmethod
    def _stray(one: ft.Packet, driver: MotorDriver[Servo]) -> Report[Servo] | Rx:
        host = driver.at.get(one.id)
        return Rx.IGNORED if host is None else Report(host, host.address)

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[Servo]
    ) -> Sequence[Report[Servo] | Rx]:
        instruction = asked[4]
        to = (asked[2],) if instruction != ft.SYNC_READ else tuple(asked[7:-1])
        places = () if instruction not in (ft.READ, ft.SYNC_READ) else (asked[5], asked[6])
        if places == BLOCKS["motion"] and (moved := self._motions(t, to, data, driver)):
            return moved
        if (whole := ft.answers(to, places[1] if places else 0, data)) is not None:
            at = places[0] if places else -1
            return [self._report(t, self._asked(asked, one.id, driver), one, at, driver) for one in whole]
        found = self._stream.feed(data)
        self.interrupted()
        reports: list[Report[Servo] | Rx] = []
        answered: set[int] = set()
        for each in found:
            if isinstance(each, Rx):
                reports.append(each)
                continue
            one = ft.unpacked(each)
            if one.id not in to or one.id in answered or (places and len(one.data) != places[1]):
                reports.append(self._stray(one, driver))
                continue
            answered.add(one.id)
            host = self._asked(asked, one.id, driver)
            reports.append(self._report(t, host, one, places[0] if places else -1, driver))
        if instruction == ft.SYNC_READ and len(answered) < len(to):
            silent = next(each for each in to if each not in answered)
            driver.at[silent].own.ask_alone(alone=True)  # those behind it have waited for it
        return reports

    def _motions(
        self, t: Nanos, to: Sequence[int], data: bytes, driver: MotorDriver[Servo]
    ) -> list[Report[Servo]]:
        """Return what whole answers to the question for motion report; [] if they are not."""
        reports: list[Report[Servo]] = []
        for at, number in enumerate(to):
            host = driver.at.get(number)
            part = data[ft.MOTION_SIZE * at : ft.MOTION_SIZE * (at + 1)]
            found = None if host is None else host.options.of_model.family.motion(number, part)
            if host is None or found is None or len(data) != ft.MOTION_SIZE * len(to):
                return []
            error, place, speed, _, volts, degrees = found
            host.own.ask_alone(alone=False)
            faults, feedback = ft.faults_in(error), self._measured(t, host, place, speed, volts, degrees)
            mode = Mode.FAULT if faults else None
            reports.append(Report(host, number, mode, faults=faults, feedback=feedback))
        return reports

    def _asked(self, asked: Exchange, number: int, driver: MotorDriver[Servo]) -> Host[Servo] | None:
        """Return whose answer it is: also of a servo that has another id now."""
        _, _, moved_from = asked.about.partition(" moved from ")
        return driver.at.get(int(moved_from) if moved_from else number)

    def _report(
        self, t: Nanos, host: Host[Servo] | None, one: ft.Packet, at: int, driver: MotorDriver[Servo]
    ) -> Report[Servo] | Rx:
        who = ft.identified(one.data) if at == 0 and len(one.data) >= 5 else ""
        if host is None:
            return Report(None, one.id, note=who) if who and driver.scanning() else Rx.IGNORED
        own, faults = host.own, ft.faults_in(one.instruction)
        mode = Mode.FAULT if faults else None
        own.ask_alone(alone=False)
        if at < 0 or (who and len(one.data) < BLOCKS["who"][1]):
            content = None if who else "acknowledged"
            return Report(host, host.address, mode, faults=faults, note=who, content=content)
        values = host.options.of_model.family.values(at, one.data)
        own.hears(t, values, host.options.written)
        detail = ""
        if "Torque_Enable" in values and not faults:
            mode = Mode.ARMED if values["Torque_Enable"] else Mode.READY
            detail = "torque on" if values["Torque_Enable"] else "torque off"
        parameters = {} if at == BLOCKS["motion"][0] else {n: float(v) for n, v in values.items()}
        feedback = (
            self._measured(t, host, *(values.get(n) for n in MEASURED))
            if values.keys() >= set(MEASURED[:-1])
            else None
        )
        return Report(host, host.address, mode, detail, faults, feedback, parameters=parameters, note=who)

    @staticmethod
    def _measured(
        t: Nanos,
        host: Host[Servo],
        place: int,
        speed: int,
        volts: int,
        degrees: int,
        current: int | None = None,
    ) -> Feedback:
        options: Options = host.options
        model = options.of_model
        velocity = None if abs(speed) >= 0x7FFF else speed * model.step
        if options.mode == "position":
            low, high = model.ends
            position = (place - model.middle) * model.step if low < place < high else None
        else:  # it goes on beyond the turn in which it is reported
            within = (place % model.steps - model.middle) * model.step
            position = host.own.turns.add(t, within, velocity, math.pi)
        amperes = None if current is None else current * 6.5e-3
        return Feedback(host.name, t, position, velocity, None, amperes, volts * 0.1, float(degrees))

    # -- commanded ------------------------------------------------------------------------------------

    def refuse(self, host: Host[Servo], command: Command) -> str:
        number, has = host.options.of_model.number, host.own.known.get("Model_Number")
        if not number or has in (None, number):
            return ""
        other = ft.NUMBERS.get(has or 0, "a model that is not known here")
        return f"Model_Number is {has} ({other}), not {number}, that of a {host.options.model}"

    def ready(self, host: Host[Servo]) -> bool:
        return host.position is not None and "Model_Number" in host.own.known

    def arm(self, now: Nanos, host: Host[Servo], command: Command) -> Sequence[Frame]:
        own = host.own
        if not own.confirmed:
            self._set_up(now, host)
        else:
            position = isinstance(command, msg.Hold | msg.Position) and host.position is not None
            still = msg.Hold(host.name) if position else msg.Velocity(host.name, 0.0)
            self._goal(host, still)
            self._put(host, {"Torque_Enable": 1})
        blocks = (
            ("state",) if "Return_Delay_Time" not in own.different(host.options.written) else BLOCKS_SET_UP
        )
        return [self._ask(host, block, Rank.QUESTION) for block in blocks]

    def command(self, now: Nanos, host: Host[Servo], command: Command) -> Sequence[Frame]:
        if not host.own.confirmed:
            wanted = host.options.written.get("Operating_Mode", 0)
            if host.own.known.get("Operating_Mode", 0) != wanted:  # another host's: it must stop first
                return self.release(now, host)
            self._set_up(now, host)
        self._goal(host, command)
        return ()

    def _set_up(self, now: Nanos, host: Host[Servo]) -> None:
        host.own.write(now)
        for name, value in host.options.written.items():
            self._put(host, {name: value})

    def _goal(self, host: Host[Servo], command: Command) -> None:
        options: Options = host.options
        model, value = options.of_model, 0.0
        match command:
            case msg.Position(_, position):
                value = position / model.step + model.middle
            case msg.Hold():
                held = host.position if host.held is None else host.held
                value = min(max((held or 0.0) / model.step + model.middle, 0), model.steps - 1)
            case msg.Velocity(_, velocity):
                value = velocity / model.step
            case msg.Torque(_, torque):
                value = torque / options.stall_torque * 1000.0
        self._put(host, {GOALS[MODES[options.mode]]: value})

    def _put(self, host: Host[Servo], values: dict[str, float], rank: Rank = Rank.SET_POINT) -> None:
        """Write registers of a servo with the next frames: each in one frame with those of the others."""
        family = host.options.of_model.family
        for name, value in values.items():
            register = family.registers[name]
            each = self._writes.setdefault((rank, register.at, register.size), {})
            each[host.own.id] = family.data(name, value)

    def release(self, now: Nanos, host: Host[Servo]) -> Sequence[Frame]:
        self._put(host, {"Torque_Enable": 0}, Rank.RELEASE)
        return (self._ask(host, "state", Rank.QUESTION),)

    # -- asked ----------------------------------------------------------------------------------------

    def _ask(self, host: Host[Servo], block: str, rank: Rank) -> Exchange:
        own, blocks = host.own, host.options.of_model.family.blocks
        return ft.asks((own.id,), blocks[block], f"{own.id} {block}", own.delay, rank)

    def poll(self, now: Nanos, host: Host[Servo]) -> Sequence[Frame]:
        own, options = host.own, host.options
        frames: list[Frame] = []
        settled = host.mode is not None and host.phase in (Phase.ARMED, Phase.FREE) and own.known
        if own.due(now, "state", STATE if settled or host.offline else UNSURE):
            frames.append(self._ask(host, "state", Rank.BACKGROUND))
        if host.mode is None or host.offline:
            own.rest("who", "motion")
            return frames
        if "Model_Number" in own.known:
            own.rest("who")
        elif own.due(now, "who", UNSURE):
            frames.append(self._ask(host, "who", Rank.BACKGROUND))
        if own.due(now, "motion", round(options.feedback_ms * MILLISECOND)):
            if options.sync_read and options.of_model.sync_read and not own.alone:
                self._group[own.id] = host
            else:
                frames.append(self._ask(host, "motion", Rank.QUESTION))
        return frames

    def poll_due(self, host: Host[Servo]) -> Nanos:
        return host.own.next

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        frames: list[Exchange] = []
        for (rank, at, _), each in self._writes.items():
            for number, portion in enumerate(ft.slices(each.items())):
                frames.append(Exchange(ft.writes(at, portion), None, rank, f"{at} {number}"))
        self._writes = {}
        group, self._group = self._group, {}
        if group:
            delay = sum(host.own.delay for host in group.values())
            frames.append(ft.asks(tuple(group), BLOCKS["motion"], "motion", delay))
        return frames

    # -- requests -------------------------------------------------------------------------------------

    def questions(self, driver: MotorDriver[Servo]) -> Iterable[Frame]:
        # Ids without a servo: one in each round, or those that move are silent meanwhile.
        delay = ft.LONGEST_DELAY + LATE
        return [ft.asks((n,), (0, 5), f"scan {n}", delay, Rank.BACKGROUND) for n in IDS]

    def begin(
        self, now: Nanos, request: Request, host: Host[Servo] | None, driver: MotorDriver[Servo]
    ) -> Pending[Servo] | str:
        if host is None:
            begun = super().begin(now, request, host, driver)
            return self._paced(begun, driver) if isinstance(begun, Pending) else begun
        family, stop = host.options.of_model.family, self._stopping(host)
        wrong = "the device cannot do that on this bus"
        match request:
            case msg.ClearFault():
                return Pending(request, host.name, now, now + self.clearing, now, host, stop, self.clearing)
            case msg.Zero():
                wrong = "" if family.name == "sts" else "a servo of this family has no offset"
            case msg.ReadParameter(_, name):
                wrong = family.wrong(name)
            case msg.WriteParameter(_, name, value):
                wrong = family.wrong(name, value)
        period = STEP if isinstance(request, msg.WriteParameter) else ONCE
        return wrong or Pending(request, host.name, now, now + SECOND, now, host, (), period)

    @staticmethod
    def _paced(scan: Pending[Servo], driver: MotorDriver[Servo]) -> Pending[Servo]:
        """Return a scan that asks no faster than its line and ids without a servo let it."""
        rate = min((host.own.rate for host in driver.hosts.values() if host.own.rate), default=1_000_000)
        each = 20 * BITS * SECOND // rate + ft.LONGEST_DELAY + UNANSWERED
        period = max(scan.period, SLICE * each)
        deadline = scan.deadline + (period - scan.period) * (1 + len(scan.frames) // SLICE)
        return replace(scan, period=period, deadline=deadline)

    def _stopping(self, host: Host[Servo]) -> tuple[Frame, ...]:
        return (Exchange(disarms(host.own.id), None, Rank.RELEASE),)

    def frames(self, now: Nanos, pending: Pending[Servo]) -> Sequence[Frame]:
        host = pending.host
        if host is None or isinstance(pending.request, msg.ClearFault):
            return pending.slice() if host is None else pending.frames
        match pending.request:
            case msg.ReadParameter(_, name):
                return (self._read(host, name),)
            case msg.WriteParameter(_, name, value):
                return self._write(host, pending, name, value)
        host.own.recount()
        middle = ft.writes(40, {host.own.id: bytes((ft.MIDDLE_HERE,))})
        return Exchange(middle), self._read(host, "Homing_Offset")

    def _read(self, host: Host[Servo], name: str) -> Exchange:
        register, own = host.options.of_model.family.registers[name], host.own
        about = f"{own.id} {name}" + (f" moved from {host.address}" if own.id != host.address else "")
        return ft.asks((own.id,), (register.at, register.size), about, own.delay)

    def _write(self, host: Host[Servo], pending: Pending[Servo], name: str, value: float) -> Sequence[Frame]:
        """Return the next part: what is stored is unlocked, written, and locked again, each read back."""
        family, own = host.options.of_model.family, host.own
        stored = family.registers[name].at < STORED
        step = pending.notes.setdefault("step", "unlock" if stored else "write")
        what, how = {"unlock": ("Lock", 0.0), "write": (name, value), "lock": ("Lock", 1.0)}[step]
        at, data = family.registers[what].at, family.data(what, how)
        if (step, name) == ("write", "Baud_Rate"):  # its answer: it may be the last at this rate
            frame = ft.packet(own.id, ft.WRITE, bytes((at,)) + data)
            return (Exchange(frame, Answer(6, ft.Statuses((own.id,), 0), own.delay), about=f"{own.id} rate"),)
        written = Exchange(ft.writes(at, {own.id: data}))
        if (step, name) == ("write", "ID"):
            own.move_to(round(value))
        return written, self._read(host, what)

    def answer(self, t: Nanos, pending: Pending[Servo], report: Report[Servo]) -> msg.Event | None:
        request, step, has = pending.request, pending.notes.get("step"), report.parameters
        if isinstance(request, msg.Zero):  # what was measured before says nothing
            if "Homing_Offset" in has and report.feedback is None:
                pending.notes.update(written=True)
            return super().answer(t, pending, report) if "written" in pending.notes else None
        if not isinstance(request, msg.WriteParameter):
            return super().answer(t, pending, report)
        name, value = request.parameter, request.value
        if step == "unlock" and has.get("Lock") == 0.0:
            pending.notes.update(step="write")
        elif step == "write" and name == "Baud_Rate" and not has and report.content == "acknowledged":
            return pending.done(t, "restart it, and give the bus this rate")
        elif step == "write" and has.get(name) == value:
            if pending.host is None or pending.host.options.of_model.family.registers[name].at >= STORED:
                return pending.done(t)
            pending.notes.update(step="lock")
        elif step == "lock" and has.get("Lock") == 1.0:
            return pending.done(
                t, "give it this address in the robot file, too" if name == "ID" else "stored"
            )
        return None


def disarms(number: int) -> bytes:
    """Return what takes the torque off one servo; nobody answers."""
    return ft.writes(40, {number: b"\x00"})
