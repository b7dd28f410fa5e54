"""Steps between two of the brain, where devices speak only when asked: which step is which."""

from __future__ import annotations

from gateway import config
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
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

    def at(self, milliseconds: float, *instructions: Instruction) -> None:
        self.gateway.step(START + round(milliseconds * MILLISECOND), Inputs((), (), instructions))


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
