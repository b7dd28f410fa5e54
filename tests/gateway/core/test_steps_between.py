"""Steps between two of the brain, where devices speak only when asked: which step is which."""

from __future__ import annotations

from gateway import config
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols.ddsm import table as ds
from protocols.frames import Packet
from protocols.messages import MILLISECOND, SECOND, Drive, Instruction, Nanos

START = 1000 * SECOND
PERIOD: Nanos = 5 * MILLISECOND


class Asked:
    """When the brain was asked."""

    def __init__(self, robot: str) -> None:
        self.gateway = Gateway(config.load_robot(robot))
        assert self.gateway.robot.period == PERIOD
        self.times: list[float] = []
        brain = self.gateway.brain
        think = brain.step

        def step(now: Nanos, *given: object) -> object:
            self.times.append((now - START) / MILLISECOND)
            return think(now, *given)  # type: ignore[arg-type]

        brain.step = step  # type: ignore[assignment,method-assign]

    def at(self, milliseconds: float, *instructions: Instruction, answered: str = "") -> list[bytes]:
        """Make a step, in which what was asked last on a bus is answered; return what is sent."""
        now, packets = START + round(milliseconds * MILLISECOND), tuple[Packet, ...]()
        if answered and (out := self.gateway.lines[answered].out) is not None:
            numbers = dict.fromkeys(("mode", "current", "speed", "temperature", "coarse", "error"), 1)
            answer = ds.answer("DDSM115", ds.QUERY, out.exchange[0], **numbers)
            packets = (Packet(now, answered, answer),)
        sent = self.gateway.step(now, Inputs((), packets, instructions)).packets
        return [packet.frame for packet in sent if isinstance(packet.frame, bytes)]


def test_one_that_is_late_does_not_skip_the_next() -> None:
    asked = Asked("diffbot_ddsm")
    for at in (0.0, 1.2, 5.9, 7.0, 10.0, 12.0, 26.0, 30.0):
        asked.at(at)
    assert asked.times == [0.0, 5.9, 10.0, 26.0, 30.0]


def test_an_instruction_asks_it_at_once_and_moves_no_other() -> None:
    asked = Asked("diffbot_ddsm")
    asked.at(0.0)
    asked.at(3.0, Drive(0.1, 0.0))
    for at in (4.0, 5.0, 6.0, 10.0):
        asked.at(at)
    assert asked.times == [0.0, 3.0, 5.0, 10.0]


def test_a_driver_on_another_bus_is_not_kept_waiting() -> None:
    asked = Asked("diffbot_ddsm")
    for at in (0.0, 5.0, 10.0):
        asked.at(at)
    others = [one for one in asked.gateway._drivers if one.bus not in asked.gateway.lines]
    assert others
    for one in others:
        one.driver.due = lambda: START + 12 * MILLISECOND  # type: ignore[method-assign]
    for at in (11.0, 12.0, 15.0):
        asked.at(at)
    assert asked.times == [0.0, 5.0, 10.0, 12.0, 15.0]


def test_an_answer_that_comes_when_it_is_due_goes_first_and_once() -> None:
    """The next question is out before the brain is asked, which is due at once then."""
    asked = Asked("diffbot_ddsm")
    (bus,) = asked.gateway.lines
    first = asked.at(0.0)
    second = asked.at(5.0, answered=bus)
    assert asked.times == [0.0]
    assert asked.gateway.due() == START + 5 * MILLISECOND
    assert len(second) == len(first) == 1
    assert second != first
    asked.at(5.1, answered=bus)
    assert asked.times == [0.0, 5.1]
    asked.at(9.9)
    assert asked.times == [0.0, 5.1, 9.9]
