"""The host's end over a serial line: what is asked of each axis, how it is armed, and what it answers.

Rules. An answer has no address: it is taken for what was asked, and an answer that nobody asked for is not
taken at all. State and errors are one question, so that they belong together. What arms an axis is one frame:
its state, the input mode, a set-point that does not move it, the requested state. Until the firmware line is
known, and while a reason is being asked for, nothing moves.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from typing import TypeAlias

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import Answer, Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Nanos, Request
from protocols.odrive_ascii import table as at
from protocols.odrive_ascii.options import Options
from protocols.odrive_can import errors
from protocols.odrive_can.options import COMMANDS
from protocols.odrive_can.setpoints import armed_of, control_mode, inputs, outcome, refusal
from protocols.odrive_can.table import (
    CLOSED_LOOP,
    DIALECTS,
    HOMING,
    IDLE,
    PROCEDURES,
    SAVE,
    Dialect,
    InputMode,
    state_text,
)
from protocols.plugin import Device
from protocols.toolkit.host import Host, Phase, Report, Timing, counted_once
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import ARMED, MotorDriver, Pending, Rx
from protocols.toolkit.questions import Questions
from protocols.toolkit.requests import subject
from protocols.toolkit.serial import Stream

DELAY: Nanos = 5 * MILLISECOND
"""Until an answer begins at the latest."""
AGAIN: Nanos = 20 * MILLISECOND
"""Period of questions for the reason of a fault, and of what arms, while it is not answered."""
SOON: Nanos = 2 * MILLISECOND
"""Until an axis that was to arm is asked whether it did."""
RETRY: Nanos = 10 * MILLISECOND
"""Period of questions that are asked until they are answered."""
INFO = "i"
INFO_LINES = 3
ATTEMPTS = 2
"""Times that closed loop was requested in vain, after which the result counts."""
SCAN: Nanos = 600 * MILLISECOND
SCAN_AGAIN: Nanos = 200 * MILLISECOND
READ: Nanos = 600 * MILLISECOND
HOME: Nanos = 120 * SECOND
HOME_AGAIN: Nanos = 500 * MILLISECOND
RESTART: Nanos = 8 * SECOND
RESTARTED: Nanos = 300 * MILLISECOND
"""Silence that shows a restart."""

LETTERS = {"Set_Input_Vel": "v", "Set_Input_Torque": "c", "Set_Input_Pos": "p"}
"""Of set-points, by the message over CAN"""
_VERSION = re.compile(r"Firmware version: (\d+)\.(\d+)\.(\d+)")
_SERIAL = re.compile(r"Serial number: ([0-9A-Fa-f]{1,16})")
_PROPERTY = re.compile(r"[A-Za-z_][A-Za-z0-9_.]{0,99}")


class Axis:
    """What is known of one axis beyond its phase. Plain data."""

    def __init__(self, options: Options) -> None:
        self.expected = options.firmware
        self.wrong = 0
        """Code of the fault that its firmware is not what was expected; until cleared."""
        self.attempts = 0
        self.next_attempt: Nanos = 0
        self.failure = 0
        """Code of the result that ended arming; until cleared, or Idle."""
        self.asked = Questions()
        self.forget()

    def forget(self) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.line = self.version = ""
        self.state = self.errors = self.result = 0
        self.words: dict[str, int] = {}
        """Error words of the components, by message (0.5.x); and the reason why it disarmed (0.6.x)."""
        self.reason = 0
        self.awaited: tuple[str, ...] = ()
        """Properties that say why it is not armed, which are being asked for."""
        self.attempts = self.next_attempt = 0

    @property
    def dialect(self) -> Dialect:
        """The firmware line as the host uses it."""
        return DIALECTS[self.line]

    def identify(self, version: str) -> None:
        """Note its firmware."""
        line = version.rpartition(".")[0]
        self.version, self.line = version, line if line in at.PROPERTIES else ""
        if not self.line:
            self.wrong = errors.FIRMWARE_OTHER
        elif self.expected not in ("auto", line):
            self.wrong = errors.FIRMWARE_05 if line == "0.5" else errors.FIRMWARE_06

    def on_status(self, state: int, bits: int, fell: bool) -> None:
        """Note state and error bits; `fell`: it left closed loop by itself."""
        self.state, before, self.errors = state, self.errors, bits
        if state == CLOSED_LOOP:
            self.attempts = self.reason = 0
        names, flagged = at.PROPERTIES[self.line], self.dialect.word
        if self.line == "0.6" and fell:
            self.awaited = (names["reason"], names["result"])
        elif self.line == "0.5" and flagged is not None:
            parts = [part for error, part in at.FLAGS.items() if bits & flagged.bits[error]]
            self.words = {part: self.words.get(part, 0) for part in parts}
            if bits & ~before:
                self.awaited = tuple(names[part] for part in parts)

    def on_value(self, name: str, value: float | None) -> None:
        """Note the value of a property of it; None: it is not known."""
        self.awaited = tuple(each for each in self.awaited if each != name)
        names = {path: kind for kind, path in at.PROPERTIES.get(self.line, {}).items()}
        kind = names.get(name, "")
        if kind in self.words and value is not None:
            self.words[kind] = int(value)
        elif kind == "reason" and value is not None:
            self.reason = int(value)
        elif kind == "result" and value is not None:
            self.result = int(value)

    def questions(self, name: str) -> list[str]:
        """Return what asks the axis of this name for its state, and (0.6.x) how its last procedure ended."""
        names = at.PROPERTIES[self.line]
        asked = "current_state", names["errors"], names.get("result")
        return [f"r {name}{each}" for each in asked if each]

    def codes(self) -> Collection[int]:
        """Return the codes of all that is wrong with it."""
        reason = errors.ERRORS.codes(self.reason & ~errors.INITIALIZING)
        found = self.dialect.codes(self.errors, self.words) if self.errors or self.words else []
        return [*dict.fromkeys([*found, *reason])]

    def mode(self) -> msg.Mode:
        """Return what it is to the host."""
        return self.dialect.mode(self.state, self.errors, bool(self.errors))

    def on_attempt(self, t: Nanos, retry: Nanos, result: int) -> None:
        """Note that what arms it was sent, and the result of the attempt before."""
        bad = result not in errors.INCONCLUSIVE and result in errors.RESULT_NAMES
        if self.attempts >= ATTEMPTS - 1 and bad and self.state != CLOSED_LOOP:
            self.failure = errors.PROCEDURE + result
        self.attempts, self.next_attempt = self.attempts + 1, t + retry
        self.asked.set_due("state", t + SOON)

    def on_lost(self, t: Nanos) -> None:
        """Note that the answer to what arms it was lost: others may have their turn first."""
        self.next_attempt = t + AGAIN

    def release(self) -> None:
        """Note that it is to be disarmed."""
        self.attempts = self.next_attempt = self.failure = 0

    def clear(self) -> None:
        """Handle an operator's ClearFault: it may arm again."""
        if self.wrong:
            self.forget()
        self.wrong = self.failure = self.reason = self.attempts = 0
        self.words, self.awaited = {}, ()


AxisHost: TypeAlias = Host[Axis]
AxisDriver: TypeAlias = MotorDriver[Axis]
AxisReport: TypeAlias = Report[Axis]


class AsciiAdapter(LineAdapter[Axis]):
    """What axes are sent, and what they report."""

    name = "odrive_ascii"
    faults = errors.FAULTS
    not_armed = errors.NOT_ARMED
    needs_idle = (msg.Reboot, msg.Home)
    clearing = SECOND

    def __init__(self) -> None:
        super().__init__(at.FROM_DEVICE)

    def own(self, device: Device) -> Axis:
        return Axis(device.options)

    def timing(self, options: Options) -> Timing:
        arming = 5 * options.arm_retry_ms * MILLISECOND
        return Timing(options.offline_ms * MILLISECOND, release=50 * MILLISECOND, arming=arming)

    # -- received -------------------------------------------------------------------------------------

    def heard(self, t: Nanos, asked: Exchange, data: bytes, driver: AxisDriver) -> Sequence[AxisReport | Rx]:
        questions = at.questions(asked)
        found = Stream(at.FROM_DEVICE).messages(data)
        texts = [each.decode("ascii") for each in found if at.belongs(asked, each)]
        count = INFO_LINES if asked.startswith(b"i") else len(questions)
        arms = at.LINES.names(asked)[-1:] == ("w requested_state",)
        name = asked.about.rpartition(" ")[2]
        if not questions or len(texts) < count:
            if arms and name in driver.hosts:
                driver.hosts[name].own.on_lost(t)
            return (Rx.MALFORMED,) if data else ()
        if asked.startswith(b"i"):
            return self._on_info(texts, driver)
        answers = {words[-1]: text for words, text in zip(questions, texts, strict=False)}
        axis = re.search(rb"(?:^|\n)f (\d)|axis(\d)", asked)
        address = int(axis[1] or axis[2]) if axis is not None else next(iter(driver.at))
        host = driver.hosts.get(name) or driver.at.get(address)
        if host is None:
            return (Rx.IGNORED,)
        if questions[0][0] == "f":
            return (self._motion(t, host, texts[0]),)
        return (self._values(t, host, answers, arms=arms),)

    def _on_info(self, texts: Sequence[str], driver: AxisDriver) -> Sequence[AxisReport | Rx]:
        """Take what the board reports of itself, for each of its axes; it names none of them."""
        version = next((found for text in texts if (found := _VERSION.match(text))), None)
        serial = next((found for text in texts if (found := _SERIAL.match(text))), None)
        if version is None:
            return (Rx.MALFORMED,)
        firmware = ".".join(version.groups())
        for host in driver.hosts.values():
            if not host.own.version:
                host.own.identify(firmware)
        if serial is None:
            return (Rx.EXPECTED,)
        number = int(serial[1], 16)
        return counted_once(
            Report(None, each, serial=number, note=f"{host.name}, firmware {firmware}")
            for each, host in driver.at.items()
        )

    def _motion(self, t: Nanos, host: AxisHost, text: str) -> AxisReport | Rx:
        numbers = [float(part) + 0.0 for part in text.split(" ")] if not text.startswith(at.WRONG) else []
        if len(numbers) != 2 or not all(map(math.isfinite, numbers)):
            return Rx.MALFORMED
        position, velocity = (turns * math.tau for turns in numbers)
        return Report(host, host.address, feedback=Feedback(host.name, t, position, velocity))

    def _values(self, t: Nanos, host: AxisHost, answers: dict[str, str], *, arms: bool) -> AxisReport:
        """Return what the values of properties report."""
        axis, prefix = host.own, f"axis{host.address}."
        whole = axis.line == "0.6"
        numbers = {name: at.plain(text, whole=whole) for name, text in answers.items()}
        read = {name: value for name, value in numbers.items() if value is not None and math.isfinite(value)}
        values = {name.removeprefix(prefix): read.get(name) for name in answers if name.startswith(prefix)}
        names = at.PROPERTIES.get(axis.line, {})
        state, bits = values.pop("current_state", None), values.pop(names.get("errors", ""), None)
        known = state is not None and bits is not None and bool(axis.line)
        if state is not None and bits is not None and axis.line:
            fell = host.phase is Phase.ARMED and int(state) != CLOSED_LOOP
            axis.on_status(int(state), int(bits), fell)
        for name, value in values.items():
            axis.on_value(name, value)
        if arms:
            axis.on_attempt(t, host.options.arm_retry_ms * MILLISECOND, axis.result)
        measured = {each: values.get(names.get(each, "")) for each in ("current", "temperature")}
        found = {name: value for name, value in measured.items() if value is not None}
        codes, detail = axis.codes(), state_text(axis.state, axis.result)
        return Report(
            host,
            host.address,
            axis.mode() if known else None,
            detail,
            codes if known or codes else None,
            Feedback(host.name, t, **found) if found else None,
            content=answers,
            parameters=read,
        )

    def notice(self, now: Nanos, host: AxisHost) -> Sequence[Event]:
        wrong = host.own.wrong or host.own.failure
        return host.trip(now, wrong) if wrong and not host.tripped else ()

    # -- sent -----------------------------------------------------------------------------------------

    def refuse(self, host: AxisHost, command: Command) -> str:
        return refusal(command)

    def ready(self, host: AxisHost) -> bool:
        axis = host.own
        unable = axis.awaited or axis.failure or axis.errors or axis.wrong or axis.state in PROCEDURES
        return bool(axis.line) and not unable

    def arm(self, now: Nanos, host: AxisHost, command: Command) -> Sequence[Frame]:
        axis, name = host.own, f"axis{host.address}."
        if now < axis.next_attempt:
            return ()
        lines = axis.questions(name)
        asked = len(lines)
        lines.append(f"w {name}controller.config.input_mode {int(InputMode.PASSTHROUGH)}")
        # Position control takes the present position as its input: so this is the same until it is sent.
        lines.append(_set_point(host, msg.Velocity(host.name, 0.0)))
        lines.append(f"w {name}controller.config.control_mode {int(control_mode(command))}")
        lines.append(f"w {name}requested_state {CLOSED_LOOP}")
        return (_exchange(lines, asked, Rank.SET_POINT, f"closed loop {host.name}"),)

    def command(self, now: Nanos, host: AxisHost, command: Command) -> Sequence[Frame]:
        return (_exchange([_set_point(host, command)], 0, Rank.SET_POINT, f"command {host.name}"),)

    def release(self, now: Nanos, host: AxisHost) -> Sequence[Frame]:
        host.own.release()
        # Firmware keeps its inputs: what arms it later must not find a velocity or torque there.
        lines = [
            _set_point(host, msg.Velocity(host.name, 0.0)),
            f"w axis{host.address}.requested_state {IDLE}",
        ]
        return (_exchange(lines, 0, Rank.RELEASE, f"release {host.name}"),)

    # -- by itself ------------------------------------------------------------------------------------

    def poll(self, now: Nanos, host: AxisHost) -> Sequence[Frame]:
        axis, options, name = host.own, host.options, f"axis{host.address}."
        frames: list[Frame] = []
        if not axis.version and axis.asked.take(now, INFO, RETRY):
            frames.append(WHO)
        if axis.asked.take(now, "f", options.feedback_ms * MILLISECOND):
            # 0.5.x watches its host while it is idle too.
            rests = axis.line == "0.5" and host.phase is Phase.FREE
            lines = [f"u {host.address}"] * rests + [f"f {host.address}"]
            frames.append(_exchange(lines, 1, Rank.QUESTION, f"f {host.name}"))
        if not axis.line:
            return frames
        names = at.PROPERTIES[axis.line]
        if axis.asked.take(now, "state", options.state_ms * MILLISECOND):
            lines = [f"r {name}current_state", f"r {name}{names['errors']}"]
            frames.append(_exchange(lines, 2, Rank.QUESTION, f"state {host.name}"))
        if axis.awaited and axis.asked.take(now, "why", AGAIN):
            lines = [f"r {name}{each}" for each in axis.awaited]
            frames.append(_exchange(lines, len(lines), Rank.QUESTION, f"why {host.name}"))
        if options.poll_ms and axis.asked.take(now, "slow", options.poll_ms * MILLISECOND):
            lines = [f"r {name}{names['current']}", f"r {name}{names['temperature']}"]
            frames.append(_exchange(lines, 2, Rank.BACKGROUND, f"slow {host.name}"))
        return frames

    def poll_due(self, host: AxisHost) -> Nanos:
        return host.own.asked.due("f", host.options.feedback_ms * MILLISECOND)

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: AxisHost | None, driver: AxisDriver
    ) -> Pending[Axis] | str:
        if isinstance(request, msg.Scan):
            return Pending(request, request.bus, now, now + SCAN, now, None, (WHO,), SCAN_AGAIN)
        if host is None:
            return "the device cannot do that on this line"
        timeout, period = READ, 120 * MILLISECOND
        match request:
            case msg.ClearFault():
                host.own.clear()
                host.report_again()
                frame = _exchange(["sc"], 0, Rank.QUESTION, f"sc {host.name}")
            case msg.Reboot() | msg.WriteParameter(_, "save_configuration"):
                if getattr(request, "value", 1.0) != 1.0:
                    return f"{SAVE} takes 1"
                beside = armed_of(driver.hosts.values())
                if beside:
                    reason = f"it restarts its whole board, and {beside} is armed"
                    return ARMED if beside == host.name else f"{reason}: command Idle first"
                letters = "sr" if isinstance(request, msg.Reboot) else "ss"
                frame, timeout = _exchange([letters], 0, Rank.QUESTION, letters), RESTART
                period = 2 * RESTART
            case msg.Home():
                if not host.own.line:
                    return "its firmware is not known"
                prefix = f"axis{host.address}."
                lines, about = host.own.questions(prefix), f"home {host.name}"
                begins = [f"w {prefix}requested_state {HOMING}", *lines]
                looks = _exchange(lines, len(lines), Rank.QUESTION, about)
                frames = _exchange(begins, len(lines), Rank.QUESTION, about), looks
                return Pending(request, host.name, now, now + HOME, now, host, frames, HOME_AGAIN)
            case msg.ReadParameter(_, name) | msg.WriteParameter(_, name) if not _PROPERTY.fullmatch(name):
                return f"{name!r} is no property"
            case msg.ReadParameter(_, name):
                frame = _exchange([f"r {name}"], 1, Rank.QUESTION, f"r {name} {host.name}")
            case msg.WriteParameter(_, name, value):
                if name.endswith(COMMANDS):
                    return f"{name} is a command, and no parameter"
                lines = [f"w {name} {_value(value)}", f"r {name}"]
                frame = _exchange(lines, 1, Rank.QUESTION, f"w {name} {host.name}")
            case _:
                return "the device cannot do that on this line"
        return Pending(request, subject(request), now, now + timeout, now, host, (frame,), period)

    def frames(self, now: Nanos, pending: Pending[Axis]) -> Sequence[Frame]:
        if not isinstance(pending.request, msg.Home):
            return super().frames(now, pending)
        begins, looks = pending.frames  # a procedure that has begun would begin anew
        return (looks if pending.notes.get("ran") else begins,)

    def answer(self, t: Nanos, pending: Pending[Axis], report: AxisReport) -> Event | None:
        request, axis = pending.request, report.host.own if report.host is not None else None
        content: dict[str, str] = report.content or {}
        match request:
            case msg.Reboot() | msg.WriteParameter(_, "save_configuration"):
                up = report.mode is not None and pending.notes.get("up")
                pending.notes.update(up=pending.restarted(t, RESTARTED) or pending.notes.get("up"))
                return pending.done(t, "it has restarted, and every axis of its board") if up else None
            case msg.ClearFault():
                clear = report.mode is not None and axis is not None and not axis.errors
                return pending.done(t, "and every axis of its board") if clear else None
            case msg.Home() if axis is not None and report.host is not None and report.mode is not None:
                prefix = f"axis{report.host.address}."
                whole = all(line.removeprefix("r ") in content for line in axis.questions(prefix))
                text = ", ".join((report.detail, *(self.faults[each].name for each in axis.codes())))
                faulty = bool(axis.errors)
                return outcome(t, pending, axis.state, axis.result, text, faulty=faulty) if whole else None
            case msg.ReadParameter(_, name) | msg.WriteParameter(_, name) if name in content:
                if name not in report.parameters:
                    return pending.refuse(t, f"it answers {content[name]!r}")
        return super().answer(t, pending, report)

    def give_up(self, now: Nanos, pending: Pending[Axis]) -> str:
        if isinstance(pending.request, msg.Reboot):
            return "it showed no sign of a restart"
        if isinstance(pending.request, msg.Home):
            return "it did not end" if pending.notes.get("ran") else "it did not begin"
        return super().give_up(now, pending)


def _set_point(host: AxisHost, command: Command) -> str:
    """Return the line of a command."""
    name, values = inputs(command, host.held)
    return " ".join((LETTERS[name], str(host.address), *map(at.number, values.values())))


def _value(value: float) -> str:
    return f"{int(value)}" if value == int(value) else f"{value:.9g}"


def _exchange(lines: Sequence[str], count: int, rank: Rank, about: str) -> Exchange:
    """Return lines as one exchange, of which so many are answered."""
    frame = b"".join(map(at.line, lines))
    answer = Answer(count * at.LONGEST, at.finds(count), DELAY) if count else None
    return Exchange(frame, answer, rank, about)


WHO = Exchange(
    at.line(INFO),
    Answer(INFO_LINES * at.LONGEST, at.finds(INFO_LINES), DELAY),
    Rank.BACKGROUND,
    "who is there",
)
