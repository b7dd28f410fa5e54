"""The host's end: what devices are sent in each phase, and what their answers report.

Rules. What is written to several devices is one sync write, which nobody answers; what became of it is read
back. The motion of all is one chain of answers: sync read, or bulk read where they are of several kinds. Who
breaks the chain is asked alone until it answers, so that those behind it lose one reading. Before a device is
armed its stored registers are read: it must be the model, and in the mode, that the robot file has.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from protocols import messages as msg
from protocols.dynamixel import packets as dx
from protocols.dynamixel import table as dt
from protocols.dynamixel.memory import OFFSET_OF_ONE_TURN
from protocols.dynamixel.options import Options
from protocols.frames import Frame
from protocols.line import BITS, Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.requests import ANSWER
from protocols.toolkit.serial import Stream

SLOWEST: Nanos = 254 * dt.DELAY_UNIT
"""Return_Delay_Time of a device that has not told it"""
REBOOT: Nanos = 3 * SECOND
"""Time for ClearFault: a device restarts, and is read again."""
FRESH: Nanos = 500 * MILLISECOND
"""Age of what registers are known to hold, up to which a device is armed upon it."""
AGAIN: Nanos = 100 * MILLISECOND
"""Time after which a stored register is written again."""
STEP_EARLY: Nanos = 100_000
"""How much before its time something is done, rather than a step later."""
MOST = (1 << 31) - 1
"""Steps at which a position or velocity ends"""
BACK = " back"
"""End of the subject of what is read for a request"""
NEAR, MOVING = 0.003, 0.05
"""rad between shaft and set-point of a device that is armed, and s of its velocity beside"""


@dataclass(slots=True)
class Own:
    """What is known of one device beyond its phase. Plain data."""

    known: dict[str, int] = field(default_factory=dict)
    """What its registers hold, since it was last forgotten,"""
    known_at: dict[str, Nanos] = field(default_factory=dict)
    """by block, since when, and"""
    asked_at: dict[str, Nanos] = field(default_factory=dict)
    """when it was last asked for (or, of "write", when stored registers were written)."""
    alert: bool = False
    """Its last answer says that it has a hardware error."""
    alone: bool = False
    """The chain of answers broke at it."""

    def due(self, block: str, period: Nanos) -> Nanos:
        """Return when a block is to be asked for again."""
        return self.asked_at.get(block, -period) + period - STEP_EARLY

    def ask(self, now: Nanos, what: str) -> None:
        """Record that a block is asked for."""
        self.asked_at[what] = now

    def heard(self, error: int) -> None:
        """Record an answer of its own."""
        self.alert = bool(error & dx.ALERT)

    def put(self, t: Nanos, block: str, values: Mapping[str, int]) -> None:
        """Record what is read."""
        self.known.update(values)
        self.known_at[block], self.alone = t, False

    def breaks(self) -> None:
        """Record that a chain of answers broke at it."""
        self.alone = True

    def forget(self) -> None:
        """Forget everything: it may have restarted."""
        self.known.clear()
        self.known_at.clear()
        self.alone = self.alert = False

    @property
    def delay(self) -> Nanos:
        """The longest that it waits before it answers."""
        time = self.known.get("Return_Delay_Time")
        return SLOWEST if time is None else time * dt.DELAY_UNIT


class DynamixelAdapter(Adapter[Own]):
    """What devices are sent, and what they report."""

    name = dt.NAME
    faults = dt.ALL_FAULTS
    not_armed = dt.NOT_ARMED
    clearing_disarms = True

    def __init__(self) -> None:
        self._stream = Stream(dx.FRAMING)
        self._writes: dict[tuple[Rank, str, int, int], dict[int, bytes]] = {}
        """What is written in this step, by rank, subject, address and length: the data by device."""
        self._chains: dict[bool, dict[int, tuple[dx.Target, Nanos]]] = {}
        """Who is asked for its motion in this step, fast or not: what is read, and how long it waits."""
        self._ping: Nanos = 5 * MILLISECOND

    # -- devices and received bytes -----------------------------------------------------------------

    def own(self, device: Device) -> Own:
        rate = device.line_rate or dt.BAUD_RATES[3]
        self._ping = 3 * MILLISECOND + 24 * BITS * SECOND // rate
        return Own()

    def timing(self, options: Options) -> Timing:
        return Timing(round(options.offline_ms * MILLISECOND), arming=3 * SECOND)

    def forget(self, now: Nanos, host: Host[Own]) -> None:
        host.own.forget()

    def interrupted(self) -> None:
        self._stream.drop()

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Own]) -> Sequence[Report[Own] | Rx]:
        if not isinstance(frame, bytes):
            return (Rx.IGNORED,)
        return [self._status(t, each, {}, None, driver) for each in self._stream.feed(frame)]

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[Own]
    ) -> Sequence[Report[Own] | Rx]:
        question = dx.unpack(asked[:-2])
        wanted = dx.targets(question)
        reports: list[Report[Own] | Rx] = []
        if question.instruction in dx.FAST:
            statuses, end = dx.blocks(data, wanted)
            found = [self._report(t, one, wanted, question, driver) for one in statuses]
            # One packet, whoever is in it: the others are counted with its first device.
            reports += [
                replace(one, counted=not at) if isinstance(one, Report) else one
                for at, one in enumerate(found)
            ]
            data = data[end:]
        self.interrupted()
        reports += [self._status(t, each, wanted, question, driver) for each in self._stream.feed(data)]
        self.interrupted()  # what has no end is no beginning of the next answer
        if not asked.about.endswith(BACK):  # it may have been read before it was written
            reports = [replace(each, parameters={}) if isinstance(each, Report) else each for each in reports]
        if asked.about.startswith("motion"):
            self._find_break(reports, wanted, driver)
        return reports

    def _find_break(
        self, reports: Iterable[Report[Own] | Rx], wanted: dx.Targets, driver: MotorDriver[Own]
    ) -> None:
        """Note at whom a chain of answers broke: those behind it do not answer, as they wait for it."""
        heard = {each.address for each in reports if isinstance(each, Report)}
        order = list(wanted)
        last = max((at for at, each in enumerate(order) if each in heard), default=-1)
        if last + 1 < len(order):
            driver.at[order[last + 1]].own.breaks()

    def _status(
        self,
        t: Nanos,
        message: bytes | Rx,
        wanted: dx.Targets,
        question: dx.Packet | None,
        driver: MotorDriver[Own],
    ) -> Report[Own] | Rx:
        if isinstance(message, Rx):
            return message
        one = dx.unpack(message)
        if one.instruction != dx.STATUS:
            return Rx.IGNORED  # an echo, or another host's
        if not one.parameters:
            return Rx.MALFORMED if one.id in driver.at else Rx.IGNORED
        return self._report(t, one, wanted, question, driver)

    def _report(
        self,
        t: Nanos,
        one: dx.Packet,
        wanted: dx.Targets,
        question: dx.Packet | None,
        driver: MotorDriver[Own],
    ) -> Report[Own] | Rx:
        """Return what a status reports; `question`: the packet that it answers, if it was asked for."""
        host, error, data = driver.at.get(one.id), one.parameters[0], one.parameters[1:]
        if question and question.instruction == dx.PING and len(data) == 3:
            return self._found(one.id, data, host, driver)
        if host is None:
            return Rx.IGNORED
        host.own.heard(error)
        if wrong := error & ~dx.ALERT:
            at = question.parameters[:2] if question and question.instruction == dx.WRITE else b""
            register = host.options.table.by_number.get(int.from_bytes(at, "little")) if at else None
            text = dt.ERRORS.get(wrong, f"error {wrong}")
            return Report(host, one.id, content=(register.name, text) if register else None)
        target = wanted.get(one.id)
        if target is None or not data:
            return Report(host, one.id)
        return self._block(t, host, target[0], data) if len(data) == target[1] else Rx.MALFORMED

    def _found(
        self, address: int, data: bytes, host: Host[Own] | None, driver: MotorDriver[Own]
    ) -> Report[Own] | Rx:
        for pending in driver.queue:
            if pending.request == msg.WriteParameter(pending.name, "ID", float(address)) and pending.host:
                return Report(pending.host, address, written="ID")
        if not driver.scanning():
            return Rx.IGNORED
        return Report(host, address, note=dx.note(data))

    def _block(self, t: Nanos, host: Host[Own], start: int, data: bytes) -> Report[Own]:
        """Return what is read from a run of registers."""
        options = host.options
        table: dt.ControlTable = options.table
        form, names = table.feedback
        block = next((name for name, target in table.blocks.items() if target == (start, len(data))), "")
        indirect = not block and len(data) == form.size
        values = dict(zip(names, form.unpack(data), strict=True)) if indirect else table.values(start, data)
        host.own.put(t, "state" if indirect else block, values)
        if block and block != "state":
            return Report(
                host, host.address, parameters={name: float(value) for name, value in values.items()}
            )
        mode, faults, detail = None, None, ""
        if indirect or block:
            bits, tripped = values["Hardware_Error_Status"], values["Bus_Watchdog"] == dt.TRIPPED
            faults = [bit for bit in dt.FAULTS if bits & bit] + [dt.WATCHDOG] * tripped
            mode = Mode.FAULT if faults else Mode.ARMED if values["Torque_Enable"] else Mode.READY
            detail = "torque on" if values["Torque_Enable"] else "torque off"
        parameters = {name: float(value) for name, value in values.items()} if block else {}
        feedback = self._feedback(t, host, values)
        return Report(host, host.address, mode, detail, faults, feedback, parameters=parameters)

    def _feedback(self, t: Nanos, host: Host[Own], values: Mapping[str, int]) -> Feedback:
        options: Options = host.options
        model, position = options.of, values["Present_Position"]
        # Disarmed it counts on beyond its turn, and begins anew when it is armed: there it has no place.
        counts, speed = position - model.zero, values["Present_Velocity"]
        known = (
            -model.counts <= 2 * counts < model.counts if options.mode == "position" else abs(position) < MOST
        )
        place = counts * model.count if known else None
        current = values.get("Present_Current")
        volts, degrees = values.get("Present_Input_Voltage"), values.get("Present_Temperature")
        return Feedback(
            host.name,
            t,
            place,
            speed * model.step if abs(speed) < MOST else None,
            None if current is None else current * options.newton_metre,
            None if current is None else current * model.ampere,
            None if volts is None else volts * 0.1,
            None if degrees is None else float(degrees),
        )

    # -- commands -------------------------------------------------------------------------------------

    def refuse(self, host: Host[Own], command: Command) -> str:
        options, known = host.options, host.own.known
        number = known.get("Model_Number", options.of.number)
        if number != options.of.number:
            return f"it is another model than the robot file has: {dt.BY_NUMBER.get(number, number)}"
        if (
            host.mode is Mode.ARMED
            and known.get("Operating_Mode", options.operating_mode) != options.operating_mode
        ):
            return f"it runs in Operating_Mode {known['Operating_Mode']}: disarm it first"
        for name, ours, option in (
            ("Velocity_Limit", options.velocity if options.mode == "velocity" else 0, "max_velocity"),
            ("Current_Limit", options.current if "current" in options.mode else 0, "max_current"),
        ):
            if known.get(name, ours) < ours:
                return f"its {name} is {known[name]}, and must be {ours}, or {option} lower"
        if isinstance(command, msg.Position) and options.mode == "position":
            raw, model = command.position / options.of.count + options.of.zero, options.of
            least, most = known.get("Min_Position_Limit", raw), known.get("Max_Position_Limit", raw)
            if not least - 1 < raw < most + 1:
                ends = [(end - model.zero) * model.count for end in (least, most)]
                return f"position {command.position:.4g} lies outside its {ends[0]:.4g} … {ends[1]:.4g}"
        return ""

    def ready(self, host: Host[Own]) -> bool:
        return {"stored", "state"} <= host.own.known_at.keys()

    def arm(self, now: Nanos, host: Host[Own], command: Command) -> Sequence[Frame]:
        own, options = host.own, host.options
        if options.indirect and "indirect" not in own.known_at:
            return self._read(now, host, "indirect")
        wrong = self._wrong(host)
        stored = wrong.pop("Operating_Mode", None)
        if stored is not None:
            if now - own.asked_at.get("write", -AGAIN) >= AGAIN:
                own.ask(now, "write")
                self._write(host, {"Operating_Mode": stored}, "mode", Rank.QUESTION)
            return self._read(now, host, "stored")
        goal, there, near = dt.GOALS[options.operating_mode], 0, 0.0
        if goal == "Goal_Position":  # it is armed where it stands
            there = round((host.position or 0.0) / options.of.count) + options.of.zero
            near = (NEAR + MOVING * abs(own.known["Present_Velocity"] * options.of.step)) / options.of.count
        if abs(own.known.get(goal, 1 << 31) - there) > near:
            wrong[goal] = there
        if wrong:
            self._write(host, wrong, "set-up")
        elif now - own.known_at["state"] <= FRESH:
            self._write(host, {"Torque_Enable": 1}, "torque")
        indirect = any(name.startswith("Indirect") for name in wrong)
        return [*self._read(now, host, "state"), *(self._read(now, host, "indirect") if indirect else ())]

    def _wrong(self, host: Host[Own]) -> dict[str, int]:
        """Return what of its set-up is not so."""
        known = host.own.known
        return {name: value for name, value in host.options.set_up.items() if known.get(name) != value}

    def command(self, now: Nanos, host: Host[Own], command: Command) -> Sequence[Frame]:
        options, own, frames = host.options, host.own, list[Frame]()
        model = options.of
        match command:
            case msg.Velocity(_, speed):
                raw = round(speed / model.step)
            case msg.Torque(_, torque):
                raw = round(torque / options.newton_metre)
            case _:
                place = getattr(command, "position", host.position if host.held is None else host.held) or 0.0
                raw = round(place / model.count) + model.zero
                raw = min(raw, model.counts - 1) if options.mode == "position" and model.zero else raw
        self._write(host, {dt.GOALS[options.operating_mode]: raw}, "goal")
        # One that runs already may have been set up by another host.
        if now >= own.due("set-up", AGAIN) and own.known_at.keys() >= {"stored", "state"}:
            own.ask(now, "set-up")
            alive = {n: v for n, v in self._wrong(host).items() if n in ("Bus_Watchdog", "Goal_Current")}
            if alive:
                self._write(host, alive, "set-up")
                frames += self._read(now, host, "state")
        return frames

    def release(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        self._write(host, {"Torque_Enable": 0}, "release", Rank.RELEASE)
        return self._read(now, host, "state")

    def _write(
        self, host: Host[Own], values: Mapping[str, int], about: str, rank: Rank = Rank.SET_POINT
    ) -> None:
        """Write registers with the next sync writes, neighbours at once."""
        table: dt.ControlTable = host.options.table
        runs: list[tuple[int, bytes]] = []
        for name in sorted(values, key=lambda each: table.by_name[each].number):
            at, data = table.by_name[name].number, table.pack(name, values[name])
            if runs and runs[-1][0] + len(runs[-1][1]) == at:
                runs[-1] = runs[-1][0], runs[-1][1] + data
            else:
                runs.append((at, data))
        for at, data in runs:
            self._writes.setdefault((rank, about, at, len(data)), {})[host.address] = data

    # -- by itself ------------------------------------------------------------------------------------

    def _read(
        self, now: Nanos, host: Host[Own], block: str, rank: Rank = Rank.QUESTION, about: str = ""
    ) -> list[Frame]:
        """Return the question for a block of registers of one device."""
        host.own.ask(now, block)
        target = self._motion(host) if block == "motion" else host.options.table.blocks[block]
        about = f"{host.address} {block}{about}"
        return [dx.question(dx.READ, {host.address: target}, rank, about, host.own.delay)]

    def _motion(self, host: Host[Own]) -> dx.Target:
        """Return where a device has its motion: with its state, where the indirect addresses are known to be
        set."""
        own, options = host.own, host.options
        table: dt.ControlTable = options.table
        if options.indirect and "indirect" in own.known_at and "stored" in own.known_at:
            places = tuple(own.known.get(f"Indirect_Address_{k + 1}") for k in range(len(table.indirect)))
            if places == table.indirect:
                return dt.data_of(options.of, own.known["Firmware_Version"]), len(places)
        return table.motion

    def poll(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        own, frames = host.own, list[Frame]()
        for block, due in self._dues(host):
            if now < due:
                continue
            if block == "motion" and not own.alone:
                own.ask(now, block)
                self._chains.setdefault(host.options.fast, {})[host.address] = self._motion(host), own.delay
            else:
                rank = Rank.QUESTION if block == "motion" else Rank.BACKGROUND
                frames += self._read(now, host, block, rank)
        return frames

    def _dues(self, host: Host[Own]) -> list[tuple[str, Nanos]]:
        """Return what is to be asked of a device now and then, and when."""
        own, options = host.own, host.options
        period = round(options.feedback_ms * MILLISECOND)
        dues = (
            [("stored", own.due("stored", max(period, 20 * MILLISECOND)))]
            if "stored" not in own.known_at
            else []
        )
        settled = host.phase in (Phase.ARMED, Phase.FREE) and host.mode is not None
        hurry = not settled or own.alert != bool(host.active)
        known = own.known_at.keys()
        if options.indirect and "indirect" not in known and "stored" in known:
            dues.append(("indirect", own.due("indirect", max(period, 20 * MILLISECOND))))
        complete = self._motion(host)[1] > host.options.table.motion[1]
        slow = round(options.state_ms * MILLISECOND) * (10 if complete else 1)
        dues.append(("state", own.due("state", max(period, 20 * MILLISECOND) if hurry else slow)))
        if host.mode is not None and not host.offline:
            dues.append(("motion", own.due("motion", period)))
        return dues

    def poll_due(self, host: Host[Own]) -> Nanos:
        return min(due for _, due in self._dues(host))

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        """Return what is written to several devices at once, and the question for the motion of all."""
        frames: list[Frame] = []
        for (rank, about, at, _), data in self._writes.items():
            frames.append(Exchange(dx.sync_write(at, data), None, rank, f"{about} {at}"))
        self._writes.clear()
        for fast, chain in self._chains.items():
            wanted = {address: target for address, (target, _) in chain.items()}
            alike = len(set(wanted.values())) == 1
            one_by_one = dx.SYNC_READ if alike else dx.BULK_READ
            at_once = dx.FAST_SYNC_READ if alike else dx.FAST_BULK_READ
            delay = sum(each for _, each in chain.values())
            instruction = at_once if fast else one_by_one
            about = f"motion {','.join(map(str, wanted))}"  # it replaces no question to others
            frames.append(dx.question(instruction, wanted, Rank.QUESTION, about, delay))
        self._chains.clear()
        return frames

    # -- requests -------------------------------------------------------------------------------------

    def questions(self, driver: MotorDriver[Own]) -> Iterable[Frame]:
        for address in dt.ADDRESSES:
            yield dx.question(dx.PING, {address: (0, 3)}, Rank.QUESTION, f"{address} ping", SLOWEST)

    def begin(
        self, now: Nanos, request: Request, host: Host[Own] | None, driver: MotorDriver[Own]
    ) -> Pending[Own] | str:
        if isinstance(request, msg.Scan):
            twice = 2 * tuple(self.questions(driver))
            end = now + self._ping * len(twice) + ANSWER
            return Pending(request, request.bus, now, end, now, None, twice, self._ping)
        if host is None:
            return super().begin(now, request, host, driver)
        table: dt.ControlTable = host.options.table
        at, deadline, offset = host.address, now + 3 * ANSWER, self._offset(host)
        match request:
            case msg.ClearFault():
                self.forget(now, host)
                asks = dx.question(dx.REBOOT, {at: (0, 0)}, Rank.QUESTION, f"{at} reboot", host.own.delay)
                return Pending(request, host.name, now, now + REBOOT, now, host, (asks,), REBOOT // 2)
            case msg.ReadParameter(_, name):
                if wrong := table.wrong(name):
                    return wrong
                frames = self._back(now, host, name)
            case msg.WriteParameter(_, name, value):
                if wrong := table.wrong(name, value):
                    return wrong
                if name in dt.COMMANDED:
                    return f"{name} is commanded, not written"
                frames = self._change(now, host, name, value)
            case msg.Zero():
                if isinstance(offset, str):
                    return offset
                frames = self._change(now, host, "Homing_Offset", offset)
            case _:
                return super().begin(now, request, host, driver)
        notes = {"offset": offset} if isinstance(request, msg.Zero) else {}
        return Pending(request, host.name, now, deadline, now, host, tuple(frames), AGAIN, notes)

    def frames(self, now: Nanos, pending: Pending[Own]) -> Sequence[Frame]:
        scans = pending.host is None
        return pending.frames[pending.sent : pending.sent + 1] if scans else pending.frames

    def _change(self, now: Nanos, host: Host[Own], name: str, value: float) -> list[Frame]:
        """Return what writes a register, and reads it back."""
        table: dt.ControlTable = host.options.table
        at, data = host.address, struct.pack("<H", table.by_name[name].number) + table.pack(name, value)
        write = dx.question(dx.WRITE, {at: (0, 0)}, Rank.QUESTION, "", host.own.delay, data)
        if name == "ID":  # it answers there from now on
            return [write, dx.question(dx.PING, {int(value): (0, 3)}, Rank.QUESTION, "", SLOWEST)]
        return [write, *self._back(now, host, name)] if name != "Baud_Rate" else [write]

    def _back(self, now: Nanos, host: Host[Own], name: str) -> list[Frame]:
        """Return what reads a register (with its block) for a request."""
        table: dt.ControlTable = host.options.table
        number = table.by_name[name].number
        block = next(block for block, (at, size) in table.blocks.items() if at <= number < at + size)
        return self._read(now, host, block, Rank.QUESTION, BACK)

    def _offset(self, host: Host[Own]) -> int | str:
        """Return the Homing_Offset with which it stands at zero, or why there is none."""
        known, options = host.own.known, host.options
        model: dt.Model = options.of
        if host.position is None or "Homing_Offset" not in known:
            return "its position is not known"
        offset = int(known["Homing_Offset"]) - round(host.position / model.count)
        most = OFFSET_OF_ONE_TURN * model.counts // 4096 if options.mode == "position" else model.far
        if abs(offset) > most:
            return (
                f"Homing_Offset would be {offset}: in this mode it counts to {most} only; mount the horn anew"
            )
        return offset

    def answer(self, t: Nanos, pending: Pending[Own], report: Report[Own]) -> Event | None:
        request = pending.request
        if report.content is not None and isinstance(request, msg.WriteParameter | msg.Zero):
            name, text = report.content
            if name == getattr(request, "parameter", "Homing_Offset"):
                return pending.refuse(t, text)
        if isinstance(request, msg.WriteParameter) and request.parameter == "Baud_Rate":
            plain = report.mode is None and report.feedback is None and not report.parameters
            return pending.done(t, "it answers at the new rate from now on") if plain else None
        if isinstance(request, msg.Zero) and "zeroed" not in pending.notes:
            # Where it stands tells nothing before the offset is written, and read back.
            if report.parameters.get("Homing_Offset") == pending.notes["offset"]:
                pending.notes.update(zeroed=True)
            return None
        if isinstance(request, msg.ClearFault) and "stored" not in pending.host.own.known_at:  # type: ignore[union-attr]
            return None  # it has not restarted yet, or is not known again
        return super().answer(t, pending, report)
