"""The host's end: what the channel of a servo is sent, and what its board reports of it.

Rules. A pulse drives a servo, a target of 0 ends its pulses; no message confirms either, but the board is
asked which pulse it makes: whether there is one is all that is known. Hold goes on with the pulse that was
sent last, or that another host has left, and else with that of position 0. The board's own ramp is written
before the first pulse, and again while there is one, since nobody knows whether it has come. Reading the
errors of a board clears them: it is asked for them only once a servo of it was commanded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import Exchange, Rank
from protocols.maestro import table as mt
from protocols.maestro.options import Options
from protocols.messages import MILLISECOND, Command, Mode, Nanos
from protocols.plugin import Device
from protocols.toolkit.host import Host, Report, counted_once
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import MotorDriver, Rx
from protocols.toolkit.questions import Questions

AGAIN: Nanos = 500 * MILLISECOND
"""Period of the board's own ramp while there is a pulse, and of the question for its errors"""
ANSWERS: Nanos = 3 * MILLISECOND
"""The longest time until an answer begins: the board is busy with its servos for a while"""


@dataclass(slots=True)
class Servo:
    """What is known of one channel. Plain data; pulses in quarters of a microsecond."""

    sent: int | None = None
    """Its last target but 0"""
    made: int | None = None
    """The pulse that the board makes, as it reports it; 0: none"""
    errors: int = 0
    """Of its board, since they were last asked for"""
    asked: Questions = field(default_factory=Questions)

    def forget(self) -> None:
        """Forget what the board reported."""
        self.made = None
        self.asked.forget()

    def send(self, target: int) -> None:
        """Note a target."""
        self.sent = target

    def see(self, made: int) -> None:
        """Note the pulse that the board makes."""
        self.made = made

    def fail(self, errors: int) -> None:
        """Note the errors of its board."""
        self.errors = errors

    def state(self) -> tuple[Mode | None, str]:
        """Return its mode; None: not known yet."""
        if self.made is None:
            return None, ""
        pulses = "open loop: pulses" if self.made else "open loop: no pulses"
        wrong = f"{pulses}; {mt.errors(self.errors)}" if self.errors else pulses
        return Mode.ARMED if self.made else Mode.READY, wrong


class MaestroAdapter(LineAdapter[Servo]):
    """What the channels of boards are sent, and what these report."""

    name = "maestro"
    blind = True
    """It is commanded without a position: it has none."""

    def own(self, device: Device) -> Servo:
        return Servo()

    def ready(self, host: Host[Servo]) -> bool:
        return host.own.made is not None

    # -- received -------------------------------------------------------------------------------------

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[Servo]
    ) -> Sequence[Report[Servo] | Rx]:
        first = next(iter(driver.hosts.values()))
        question = mt.PACKETS[first.options.crc].in_frame(bytes(asked))[0][0]
        if question is None or mt.number(bytes(asked), data) is None:
            return super().heard(t, asked, data, driver)
        value, at = int.from_bytes(data[:2], "little"), question.address
        if question.name == "GETPOSITION":
            driver.at[at].own.see(value)
            return (self._report(driver.at[at]),)
        boards = [each for each in driver.hosts.values() if mt.board(each.address) == mt.board(at)]
        for each in boards:
            each.own.fail(value)
        return counted_once(map(self._report, boards))

    @staticmethod
    def _report(host: Host[Servo]) -> Report[Servo]:
        mode, detail = host.own.state()
        return Report(host, host.address, mode, detail)

    # -- sent -----------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Servo], command: Command) -> Sequence[Frame]:
        return self.command(now, host, command)

    def command(self, now: Nanos, host: Host[Servo], command: Command) -> Sequence[Frame]:
        options: Options = host.options
        if isinstance(command, msg.Position):
            pulse = options.pulse(command.position)
        else:
            before = host.own.sent or host.own.made
            pulse = options.centre_us if not before else options.within(before * mt.QUARTER)
        host.own.send(round(pulse / mt.QUARTER))
        frames: list[Frame] = []
        if host.own.asked.take(now, "ramp", AGAIN):
            frames += [self._message(host, name, value) for name, value in options.set_up.items()]
        return [*frames, self._message(host, "SETTARGET", host.own.sent or 0)]

    def release(self, now: Nanos, host: Host[Servo]) -> Sequence[Frame]:
        host.own.asked.forget("ramp")
        return (self._message(host, "SETTARGET", 0, Rank.RELEASE),)

    @staticmethod
    def _message(host: Host[Servo], name: str, value: int, rank: Rank = Rank.SET_POINT) -> Exchange:
        frame = mt.PACKETS[host.options.crc].encode(name, host.address, value=value)
        return Exchange(frame, None, rank, f"{host.address} {name}")

    def poll(self, now: Nanos, host: Host[Servo]) -> Sequence[Frame]:
        options, asked = host.options, host.own.asked
        names = ["GETPOSITION"] if asked.take(now, "GETPOSITION", options.feedback_ms * MILLISECOND) else []
        if host.once_commanded and asked.take(now, "GETERRORS", AGAIN):
            names.append("GETERRORS")
        return [self._question(host, name) for name in names]

    @staticmethod
    def _question(host: Host[Servo], name: str) -> Exchange:
        at = host.address if name == "GETPOSITION" else mt.BOARD * mt.board(host.address)
        frame = mt.PACKETS[host.options.crc].encode(name, at)
        rank = Rank.QUESTION if name == "GETPOSITION" else Rank.BACKGROUND
        return Exchange(frame, mt.answer(ANSWERS), rank, f"{at} {name}")

    def poll_due(self, host: Host[Servo]) -> Nanos:
        return host.own.asked.due("GETPOSITION", host.options.feedback_ms * MILLISECOND)
