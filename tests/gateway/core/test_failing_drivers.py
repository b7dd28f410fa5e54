"""A driver that raises for good: every way out disarms its devices by their own stop, sent at once.

Rules. Whole gateways on twins, in virtual time; what fails, when, the way out and what is lost are drawn from
a seed. The judge is the device's own state at the end.
"""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Callable, Iterable
from itertools import product
from typing import Any

import pytest

from gateway.buses.virtual.medium import Transmission
from gateway.core.faults import DRIVER_FAILED
from gateway.core.guard import STOPS_AGAIN
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Mode
from tests.gateway.core.test_lines import command_of, fail, of_file
from tests.gateway.rig import Rig
from tests.gateway.runtime.test_leaving import DRIVEN
from tests.sampled import sampled

FAILS = (
    ("send",),
    ("answer", "receive"),
    ("answer", "receive", "send"),
    ("answer", "awaits", "bus", "due", "receive", "send"),
)


def lossy(share: float, chance: random.Random) -> Callable[[str, Transmission], Iterable[Transmission]]:
    """Lose a share of what is sent, either way."""
    return lambda _, one: () if chance.random() < share else (one,)


def step_fails(*_: object) -> object:
    raise ZeroDivisionError


def leave(rig: Rig, way: str, chance: random.Random) -> None:
    """Take a way out."""
    match way:
        case "later":
            rig.run(0.5 * chance.random())
        case "stopped":
            rig.run(0.5 * chance.random(), msg.Stop())
        case "hurried":
            rig.reasons += ["one", "and another"]
        case "the step fails":
            rig.gateway.step = step_fails  # type: ignore[method-assign, assignment]  # the fault
            with pytest.raises(ZeroDivisionError):
                rig.run(0.1)
    rig.leave()


@pytest.mark.sample(12)
@pytest.mark.parametrize(("seed", "name"), sampled(product(range(20), DRIVEN), 9))
def test_no_way_out_leaves_a_motor_armed_whose_driver_raises_for_good(seed: int, name: str) -> None:
    chance = random.Random(seed * 1009 + DRIVEN.index(name))
    rig = Rig(of_file(name, stop_action=chance.choice(["idle", "brake"])))
    rig.run(0.2)
    rig.world.tamper.transmission = lossy(chance.choice([0.0, 0.0, 0.1, 0.3]), chance)
    turned = [command_of(rig.robot, each, chance.uniform(0.05, 0.6)) for each in rig.robot.motors]
    rig.run(chance.choice([0.0, 0.01, 0.03, 0.1, 0.5]) + 0.01 * chance.random(), *turned)
    # A device that reports nothing answers nothing: of its driver only `send` is called.
    fails = chance.choice(
        FAILS if any(not each.open_loop for each in rig.gateway.joints.values()) else FAILS[:1]
    )
    for one in rig.gateway._drivers:
        for method in fails:
            setattr(one.driver, method, fail)
    leave(rig, chance.choice(["at once", "later", "stopped", "hurried", "the step fails"]), chance)
    armed = [each for each in rig.robot.motors if rig.world.twin(each).mode is Mode.ARMED]  # type: ignore[attr-defined]
    assert armed == []


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", sampled(DRIVEN, 2))
def test_what_a_device_whose_driver_raises_for_good_is_sent_next_is_its_own_stop(name: str) -> None:
    rig = Rig(of_file(name, stop_action="idle"))
    rig.run(0.2)
    rig.run(0.6, *(command_of(rig.robot, each) for each in rig.robot.motors))
    stops = {each: motor.spec.stop[0] for each, motor in rig.robot.motors.items()}
    for one in rig.gateway._drivers:
        one.driver.send = fail  # type: ignore[method-assign]  # the fault
    ticks = rig.run(0.04)
    began = next(tick.now for tick in ticks if any("has failed" in note.text for note in tick.outputs.notes))
    assert {code for each in rig.gateway.joints.values() for code, _ in each.faults} == {DRIVER_FAILED}
    reads = next(iter(rig.robot.motors.values())).spec.read_only
    sent = [packet.frame for tick in ticks if tick.now >= began for packet in tick.outputs.packets]
    assert {frame for frame in sent if not reads(frame)} == set(stops.values())
    rig.leave()


def test_a_driver_that_would_end_the_program_is_a_fault_as_any_other() -> None:
    rig = Rig(of_file("diffbot", stop_action="idle"))
    rig.run(0.2)
    rig.run(0.6, *(command_of(rig.robot, each) for each in rig.robot.motors))
    (one,) = rig.gateway._drivers
    one.driver.send = lambda *_: sys.exit(3)  # type: ignore[method-assign]  # the fault
    notes = [note.text for tick in rig.run(0.1) for note in tick.outputs.notes]
    assert any("has failed" in text and "SystemExit: 3" in text for text in notes)
    rig.leave()
    assert not [each for each in rig.robot.motors if rig.world.twin(each).mode is Mode.ARMED]  # type: ignore[attr-defined]


OTHERS = {
    "send": (None, 7, ((),), ((), "run"), ((), (None,)), (("event",), ())),
    "receive": (7, ("event",), (None,)),
    "due": ("soon", 0.5),
}
"""What a plugin of somebody returns by mistake."""


@pytest.mark.parametrize(
    ("method", "returned"), [(method, each) for method, given in OTHERS.items() for each in given], ids=repr
)
def test_a_driver_that_returns_something_else_is_a_fault_of_its_motors_alone(
    method: str, returned: object
) -> None:
    """Defect: what is no frame failed in the text of the guard's fault, and ended the run of all drivers."""
    rig = Rig(of_file("diffbot", stop_action="idle"))
    rig.run(0.1)
    rig.run(0.3, *(command_of(rig.robot, each) for each in rig.robot.motors))
    (one,) = rig.gateway._drivers
    setattr(one.driver, method, lambda *_: returned)
    notes = [note.text for tick in rig.run(0.05) for note in tick.outputs.notes]
    assert any("has failed" in text and "Error: " in text for text in notes)
    rig.leave()
    assert not [each for each in rig.robot.motors if rig.world.twin(each).mode is Mode.ARMED]  # type: ignore[attr-defined]


def test_feedback_that_is_not_finite_is_told_once_a_second_not_at_every_step() -> None:
    rig = Rig(of_file("diffbot", stop_action="idle"))
    rig.run(0.1)
    (one,) = rig.gateway._drivers
    setattr(one.driver, "receive", lambda t, _: (msg.Feedback("left", t, position=math.nan),))  # noqa: B010
    notes = [note for tick in rig.run(0.3) for note in tick.outputs.notes if "finite" in note.text]
    assert [(each.source, each.text) for each in notes] == [
        ("left", "feedback: refused: its position is nan, and must be finite")
    ]


def test_what_a_driver_yields_counts_as_what_it_returns() -> None:
    """A generator can be gone through once: to look at it must not use it up."""
    rig = Rig(of_file("diffbot"))
    (one,) = rig.gateway._drivers
    receive, send = one.driver.receive, one.driver.send

    def sent(now: int, messages: Any) -> Any:
        events, frames = send(now, messages)
        return iter(events), iter(frames)

    one.driver.receive = lambda t, frame: iter(receive(t, frame))  # type: ignore[method-assign,assignment,return-value]
    one.driver.send = sent  # type: ignore[method-assign]
    ticks = [*rig.run(0.1), *rig.run(0.3, *(command_of(rig.robot, each) for each in rig.robot.motors))]
    armed = {note.source for tick in ticks for note in tick.outputs.notes if note.text.startswith("armed")}
    assert armed == set(rig.robot.motors)


def test_a_line_whose_driver_returns_something_else_is_released() -> None:
    rig = Rig(of_file("diffbot_ddsm", stop_action="idle"))
    rig.run(0.1)
    rig.run(0.3, *(command_of(rig.robot, each) for each in rig.robot.motors))
    (one,) = rig.gateway._drivers
    one.driver.answer = lambda *_: ("event",)  # type: ignore[attr-defined]  # the fault
    notes = [note.text for tick in rig.run(0.05) for note in tick.outputs.notes]
    assert any("has failed" in text and "TypeError: 'event' is returned" in text for text in notes)
    rig.leave()
    assert not [each for each in rig.robot.motors if rig.world.twin(each).mode is Mode.ARMED]  # type: ignore[attr-defined]


def test_a_driver_that_raises_once_does_not_drop_what_its_motor_is_to_hold() -> None:
    """The next step can pass the stop action on, and a set-point that holds its place is left alone."""
    rig = Rig(of_file("diffbot", stop_action="hold"))
    rig.run(0.2)
    rig.run(0.6, *(command_of(rig.robot, each) for each in rig.robot.motors))
    (one,) = rig.gateway._drivers
    send = one.driver.send
    one.driver.send = fail  # type: ignore[method-assign]  # the fault
    rig.run(0.005)
    one.driver.send = send  # type: ignore[method-assign]
    rig.run(0.5)
    assert {each.mode for each in rig.gateway.joints.values()} == {Mode.ARMED}
    one.driver.send = fail  # type: ignore[method-assign]
    rig.run((STOPS_AGAIN + 100 * MILLISECOND) / SECOND)
    assert {each.mode for each in rig.gateway.joints.values()} == {Mode.ARMED}
    rig.leave()
