"""The host's end: what boards are sent and asked in each phase, and what their answers report.

Rules. Any set-point drives a motor, and no message reports that it is driven. What a motor was sent last is
what its board has acknowledged; and a duty that is not 0, though it was not sent anything, is another
host's. The serial timeout, which any message feeds, is written and read back before a motor is armed by a
speed of 0; after a silence that it may have ended, the duty decides. A serial timeout that has another
value is a board that has restarted. Set-points of both motors of a board go in one message. Counts of 32
bits are continued beyond them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.roboclaw import table as rt
from protocols.roboclaw.options import MOST, Options
from protocols.toolkit.boards import SIDES, both
from protocols.toolkit.host import Host, Report, counted_once
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import NEVER, MotorDriver, Pending, Rx
from protocols.toolkit.questions import Questions
from protocols.toolkit.requests import ANSWER
from protocols.toolkit.table import Values

PROTECTED = {"timeout": "the driver writes it before it arms (timeout_ms)"}
SELDOM = 10
"""Supply, current and temperature are asked for so many times less often than the state."""
POLLED = {
    "GETERROR": 1,
    "GETPWMS": 1,
    "GETTIMEOUT": SELDOM,
    "GETMBATT": SELDOM,
    "GETCURRENTS": 2,
    "GETTEMP": SELDOM,
}
"""Questions about a whole board, and in how many periods each is asked."""
SET_POINTS = {"SPEED": Rank.SET_POINT, "SPEEDACCELDECCELPOS": Rank.SET_POINT, "DUTY": Rank.RELEASE}
"""What drives motors, in the order in which it is sent"""
SILENT = 3
"""Answers in a row that are lost before a board is silent."""
HALF, WHOLE = 1 << 31, 1 << 32


@dataclass(slots=True)
class Board:
    """What is known of a board, and what its motors are to do in this step. Plain data."""

    address: int
    options: Options
    timeout: int | None = None
    """As read back, in 0.1 s."""
    answered_at: Nanos = -NEVER
    lost: int = SILENT
    """Answers that have not come since one did."""
    asked: Questions = field(default_factory=Questions)
    wanted: dict[str, dict[int, Mapping[str, int]]] = field(default_factory=dict)
    """Numbers by message, without its side, and by side"""

    @property
    def silent(self) -> bool:
        """True if nothing is to be expected of it: it is asked for one thing only."""
        return self.lost >= SILENT

    def forget(self) -> None:
        """Forget what it reported."""
        self.timeout = None
        self.asked.forget()

    def on_answer(self, t: Nanos, data: bytes) -> None:
        """Note an answer; b"": that it has not come."""
        self.lost = 0 if data else self.lost + 1
        self.answered_at = t if data else self.answered_at

    def keep(self, timeout: int) -> None:
        """Note its serial timeout as read back."""
        self.timeout = timeout

    def want(self, name: str, side: int, **values: int) -> None:
        """Note what a motor is to do in this step."""
        self.wanted.setdefault(name, {})[side] = values

    def due(self, name: str) -> Nanos:
        """Return when a question is due that is not of one motor alone."""
        return self.asked.due(name, POLLED[name] * self.options.poll_ms * MILLISECOND)

    def message(self, name: str, rank: Rank = Rank.QUESTION, /, **values: float) -> Exchange:
        """Return a message, with what comes back."""
        frame = rt.PACKETS.encoder(name)(self.address, **values)
        return Exchange(frame, self.options.answer(frame), rank, f"{self.address} {name}")

    def ask(self, now: Nanos, name: str, rank: Rank = Rank.QUESTION) -> Exchange:
        """Return a question."""
        self.asked.ask(now, name)
        return self.message(name, rank)

    def set_points(self) -> Iterable[Exchange]:
        """Return what the motors are to do, of both in one message where they do the same."""
        wanted, self.wanted = self.wanted, {}
        for name, rank in SET_POINTS.items():
            motors = wanted.get(name, {})
            once = {"buffer": 1} if name.endswith("POS") else {}
            if len(motors) == len(SIDES):
                yield self.message(f"MIXED{name}", rank, **both(motors), **once)
            else:
                for side, each in motors.items():
                    yield self.message(f"M{side}{name}", rank, **each, **once)


@dataclass(slots=True)
class Motor:
    """What is known of one motor beyond its phase. Plain data."""

    board: Board
    side: int
    first: bool
    """It is the first of its board in the robot file: it asks what is of both."""
    driven: bool = False
    """It has acknowledged a set-point, and nothing since that ends it."""
    duty: int | None = None
    status: int | None = None
    counts: int | None = None
    """Of its encoder, continued beyond 32 bits."""
    held: dict[str, tuple[Nanos, Values]] = field(default_factory=dict)
    """Its parameters, and when they were read, by question"""

    def forget(self) -> None:
        """Forget what it reported: the board may have restarted, or been replaced."""
        self.driven, self.duty, self.status, self.counts = False, None, None, None
        self.board.forget()

    def state(self) -> tuple[Mode | None, str, list[int]]:
        """Return its mode, None: not known yet; a name for it; and the codes of its faults."""
        if self.status is None or self.duty is None:
            return None, "", []
        faults, warnings = rt.of_side(self.status, self.side)
        mode = Mode.FAULT if faults else Mode.ARMED if self.driven or self.duty else Mode.READY
        names = [rt.FAULTS[code].name for code in faults] or ["driven" if mode is Mode.ARMED else "released"]
        return mode, ", ".join(names + [f"warning: {each}" for each in warnings]), faults

    def count(self, raw: int) -> int:
        """Return the position in counts: as near to the one before as the 32 bits allow."""
        before = self.counts
        if before is None:
            self.counts = raw - WHOLE if raw >= HALF else raw
        else:
            self.counts = before + (raw - before + HALF) % WHOLE - HALF
        return self.counts

    def lapse(self, t: Nanos) -> None:
        """Take it that the serial timeout may have passed, if nothing was answered for so long: its duty is
        asked for."""
        if self.driven and t - self.board.answered_at > self.board.options.timeout_ms * MILLISECOND:
            self.driven, self.duty = False, None
            self.board.asked.forget("GETPWMS")

    def obeyed(self, name: str) -> None:
        """Note that a message was acknowledged."""
        if name in ("MIXEDDUTY", self.message("M#DUTY")):
            self.driven, self.duty = False, 0
        elif name.startswith(("MIXED", self.message("M#"))):
            self.driven = True
        elif name == self.message("SETM#ENCCOUNT"):
            self.counts = None

    def take(self, t: Nanos, name: str, values: Values) -> dict[str, float | None]:
        """Note what the board answers; return what that measures, as fields of `Feedback`."""
        unit = self.board.options.unit
        if values.keys() <= rt.PARAMETERS.keys():
            self.held[name] = t, values
        match name:
            case "GETM1ENC" | "GETM2ENC":
                return {"position": self.count(values["count"]) * unit}
            case "GETM1SPEED" | "GETM2SPEED":
                speed = values["speed"]  # some firmware has the sign in the next byte alone
                speed = -speed if values["backwards"] & 1 and speed > 0 else speed
                return {"velocity": speed * unit if abs(speed) < MOST else None}
            case "GETPWMS":
                self.duty = values[f"duty{self.side}"]
            case "GETERROR":
                self.status = values["status"]
            case "GETTIMEOUT":
                known, timeout = self.board.timeout, values["timeout"]
                if known is not None and timeout != self.board.options.timeout:
                    self.driven = False  # it has restarted
                self.board.keep(timeout)
            case "GETCURRENTS" | "GETMBATT" | "GETTEMP":
                return {key.rstrip("12"): v for key, v in values.items() if key[-1] not in f"{3 - self.side}"}
        return {}

    def message(self, kind: str) -> str:
        """Return the name of a message to or about this motor alone."""
        return kind.replace("#", str(self.side))


class RoboclawAdapter(LineAdapter[Motor]):
    """What boards are sent, and what they report."""

    name = "roboclaw"
    faults, not_armed, latch, clearing = rt.ALL_FAULTS, rt.NOT_ARMED, True, SECOND

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__()
        self._boards: dict[int, Board] = {}
        for device in devices:
            at = rt.BOARDS.board(device.address)
            board = self._boards.setdefault(at, Board(at, device.options))
            if board.options.timeout_ms != device.options.timeout_ms:
                raise ValueError(f"{device.name}: both motors of a board have the same timeout_ms")
        self._first = {rt.BOARDS.board(each.address): each.name for each in reversed(devices)}

    def own(self, device: Device) -> Motor:
        at = rt.BOARDS.board(device.address)
        return Motor(self._boards[at], rt.BOARDS.side(device.address), self._first[at] == device.name)

    # -- received -------------------------------------------------------------------------------------

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[Motor]
    ) -> Sequence[Report[Motor] | Rx]:
        hosts = [host for host in driver.hosts.values() if host.own.board.address == asked[0]]
        self.answered()
        board = self._boards.get(asked[0])
        if board is not None and not data:
            board.on_answer(t, data)
        if not data or rt.find_answer(asked, data) != (0, len(data)):
            return (Rx.MALFORMED if hosts else Rx.IGNORED,) if data else ()
        for host in hosts:
            host.own.lapse(t)
        if board is not None:
            board.on_answer(t, data)
        if rt.is_question(asked):
            name, values = rt.read_answer(asked, data)
            if name == "GETVERSION":
                return self._found(asked[0], values["version"], driver)
            side = next((int(each) for each in name if each in "12"), 0)
            reports = [self._answered(t, host, name, values) for host in hosts if side in (0, host.own.side)]
        else:
            decoded = rt.PACKETS.in_frame(bytes(asked))[0][0]
            assert decoded is not None
            reports = [self._obeyed(host, decoded.name) for host in hosts]
        return counted_once(reports)

    def _found(self, address: int, version: str, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        motors = {side: rt.BOARDS.motor(address, side) for side in SIDES}
        if not driver.scanning() and driver.at.keys().isdisjoint(motors.values()):
            return (Rx.IGNORED,)
        return counted_once(
            Report(driver.at.get(at), at, note=f"motor {side} of {version}") for side, at in motors.items()
        )

    @staticmethod
    def _report(host: Host[Motor], **others: Any) -> Report[Motor]:  # noqa: ANN401 -- fields
        mode, detail, faults = host.own.state()
        return Report(host, host.address, mode, detail, faults if mode else None, **others)

    def _obeyed(self, host: Host[Motor], name: str) -> Report[Motor]:
        """Return what an acknowledgement reports."""
        host.own.obeyed(name)
        return self._report(host, written={"WRITENVM": rt.SAVE, "SETCONFIG": rt.CONFIG}.get(name, ""))

    def _answered(self, t: Nanos, host: Host[Motor], name: str, values: Values) -> Report[Motor]:
        measured = host.own.take(t, name, values)
        feedback = Feedback(host.name, t, **measured) if measured else None
        parameters = values if name in host.own.held else {}
        return self._report(host, feedback=feedback, parameters=parameters)

    # -- sent -----------------------------------------------------------------------------------------

    def ready(self, host: Host[Motor]) -> bool:
        own = host.own
        return own.duty is not None and own.status is not None and own.board.timeout is not None

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        board = host.own.board
        if board.timeout != board.options.timeout:
            written = board.message("SETTIMEOUT", Rank.SET_POINT, timeout=board.options.timeout)
            return written, board.ask(now, "GETTIMEOUT")
        board.want("SPEED", host.own.side, speed=0)
        return ()

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        own, options = host.own, host.options
        own.lapse(now)
        if own.duty is None:
            return ()
        if isinstance(command, msg.Velocity):
            own.board.want("SPEED", own.side, speed=round(command.velocity / options.unit))
            return ()
        place = host.held if isinstance(command, msg.Hold) else getattr(command, "position", None)
        position = round(((place or 0.0) / options.unit + HALF) % WHOLE - HALF)
        ramp = {"accel": options.acceleration, "speed": options.max_qpps, "deccel": options.acceleration}
        own.board.want("SPEEDACCELDECCELPOS", own.side, **ramp, position=position)
        return ()

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own.board.want("DUTY", host.own.side, duty=0)
        return ()

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        own, board = host.own, host.own.board
        if board.silent:
            waits = not own.first or now < board.due("GETERROR")
            return () if waits else (board.ask(now, "GETERROR"),)
        asked: list[Exchange] = []
        encoder, speed = own.message("GETM#ENC"), own.message("GETM#SPEED")
        if now >= self._motion_due(host):
            asked += [board.ask(now, encoder), board.ask(now, speed)]
        if own.first:
            asked += [board.ask(now, name, Rank.BACKGROUND) for name in POLLED if now >= board.due(name)]
        return asked

    def poll_due(self, host: Host[Motor]) -> Nanos:
        own, board = host.own, host.own.board
        if board.silent:
            return board.due("GETERROR") if own.first else NEVER
        at = self._motion_due(host)
        return min(at, *(board.due(name) for name in POLLED)) if own.first else at

    @staticmethod
    def _motion_due(host: Host[Motor]) -> Nanos:
        period = host.options.feedback_ms * MILLISECOND
        return host.own.board.asked.due(host.own.message("GETM#ENC"), period)

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        return [each for board in self._boards.values() for each in board.set_points()]

    # -- requests -------------------------------------------------------------------------------------

    def questions(self, driver: MotorDriver[Motor]) -> Iterable[Frame]:
        options = next(iter(driver.hosts.values())).options
        return (Board(at, options).message("GETVERSION") for at in rt.BOARDS.addresses)

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        wrong = rt.REGISTERS.wrong_request(request, rt.SAVE, PROTECTED)
        if wrong is None and not isinstance(request, msg.Zero):
            return super().begin(now, request, host, driver)
        if wrong or host is None:
            return wrong or ""
        # Its memory wears out: it is asked to save once.
        again = NEVER if getattr(request, "parameter", "") == rt.SAVE else ANSWER // 4
        return Pending(request, host.name, now, now + 2 * ANSWER, now, host, (), again)

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        if pending.host is None:
            return super().frames(now, pending)
        own = pending.host.own
        board = own.board
        match pending.request:
            case msg.ClearFault():
                reset = (own.status or 0) & rt.ESTOP
                resets = (board.message("RESETESTOP"),) if reset else ()
                return *resets, board.ask(now, "GETERROR")
            case msg.Zero():
                zero = board.message(own.message("SETM#ENCCOUNT"), count=0)
                return zero, board.ask(now, own.message("GETM#ENC"))
            case msg.WriteParameter(_, name) if name == rt.SAVE:
                return (board.message("WRITENVM", key=rt.NVM_KEY),)
            case msg.ReadParameter(_, name) | msg.WriteParameter(_, name):
                written, read = map(own.message, rt.PARAMETERS[name])
                at, held = own.held.get(read, (-NEVER, {}))
                asked = board.ask(now, read)
                if isinstance(pending.request, msg.ReadParameter) or at <= pending.began:
                    return (asked,)
                change = board.message(written, **held | {name: pending.request.value})
                return (change,) if name == rt.CONFIG else (change, asked)
        return ()
