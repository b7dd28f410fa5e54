"""Following errors: what is noticed of a joint that does not do what it is commanded, and when; and what is
no fault.

Motors of a bench under their twins in simulated time; `tests/gateway/core/test_drives.py` drives every robot
of the office, which a false alarm would stop.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

import pytest

from gateway.buses.virtual.bus import HOST
from gateway.buses.virtual.medium import Transmission
from gateway.config import resources
from gateway.core.arming import DISARMING
from gateway.core.faults import INCONSISTENT, NO_TORQUE, NOT_FOLLOWED, RUNS_AWAY, STILL_ARMED
from gateway.core.following import NOTICED_WITHIN
from gateway.core.joint import Joint, JointSettings
from gateway.core.limits import Limits
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos
from tests.gateway.core.test_joint import spec
from tests.gateway.rig import BENCH, Rig

MS = MILLISECOND
STEP = 5 * MS
GEAR = 8.0
Encoder: TypeAlias = Callable[[Feedback, Feedback], Feedback]
"""What is measured instead of the truth, from the first truth and the present one, at the device's shaft."""


def place(first: Feedback, true: Feedback) -> tuple[float, float]:
    """Return the first and the present position."""
    return first.position or 0.0, true.position or 0.0


ENCODERS: dict[str, Encoder] = {
    "stuck encoder": lambda first, true: replace(true, position=first.position, velocity=0.0),
    "frozen feedback": lambda first, _true: first,
    "jumping encoder": lambda _first, true: replace(true, position=(true.position or 0.0) + 1.0 * GEAR),
    "scaled position": lambda f, t: replace(t, position=0.5 * sum(place(f, t))),
    "reversed encoder": lambda f, t: replace(
        t, position=2.0 * place(f, t)[0] - place(f, t)[1], velocity=-(t.velocity or 0.0)
    ),
}
TORQUES: dict[str, float] = {"no torque": 0.0, "runaway": -2.0}
"""N·m on the shaft, whatever the device gives."""


def break_motor(rig: Rig, fault: str) -> None:
    """Let the left motor have a fault from now on."""
    first: list[Feedback] = []

    def measured(motor: str, true: Feedback) -> Feedback:
        if motor != "left":
            return true
        first.append(true) if not first else None
        return ENCODERS[fault](first[0], true)

    if fault in ENCODERS:
        rig.world.tamper.measured = measured
    else:
        rig.world.tamper.torques = lambda torques: torques | {"left": TORQUES[fault]}


def found(rig: Rig, motor: str = "left") -> list[int]:
    """Return the codes of a joint's faults."""
    return [fault.code for fault in rig.gateway.joints[motor].faults.values()]


TURN, MOVE = msg.Velocity("left", 8.0), msg.Position("left", 12.0)


@pytest.mark.sample(9)
@pytest.mark.parametrize("command", [TURN, MOVE], ids=["velocity", "position"])
@pytest.mark.parametrize(
    ("fault", "moving"),
    [(fault, True) for fault in NOTICED_WITHIN]
    + [(fault, False) for fault in NOTICED_WITHIN if fault != "jumping encoder"],  # that happens under way
)
def test_a_motor_that_does_not_obey_is_noticed_within_the_declared_time(
    fault: str, command: Command, moving: bool
) -> None:
    rig = Rig(BENCH)
    rig.run(0.5)
    if moving:
        rig.run(0.5, command)
    break_motor(rig, fault)
    begin = rig.clock.now()
    latched: list[Nanos] = []

    def at(_tick: object) -> None:
        if found(rig) and not latched:
            latched.append(rig.clock.now())

    rig.run(2.0, command, at=at)
    assert {NOT_FOLLOWED, RUNS_AWAY, INCONSISTENT} & set(found(rig)), found(rig)
    assert latched[0] - begin <= NOTICED_WITHIN[fault] + (0 if moving else 100 * MS)  # to begin to move
    assert rig.gateway.joints["left"].mode is not Mode.ARMED


def blocked(rig: Rig, seconds: float) -> None:
    """Keep the left shaft from turning for a time."""
    shaft: Any = rig.world.world._shafts._shafts["left"]
    damping, until = shaft.file.damping, rig.clock.now() + round(seconds * SECOND)

    def torques(given: dict[str, float]) -> dict[str, float]:
        shaft.file = replace(shaft.file, damping=100.0 if rig.clock.now() < until else damping)
        return given

    rig.world.tamper.torques = torques


@pytest.mark.parametrize(("seconds", "faults"), [(0.25, []), (0.6, [NOT_FOLLOWED])])
def test_a_threshold_that_blocks_a_motor_briefly_is_no_fault(seconds: float, faults: list[int]) -> None:
    rig = Rig(BENCH)
    rig.run(0.5)
    rig.run(0.5, TURN)
    blocked(rig, seconds)
    rig.run(1.5, TURN)
    assert found(rig) == faults


def delayed(_bus: str, one: Transmission) -> tuple[Transmission, ...]:
    """Delay every report by 30 ms."""
    return (one if one.sender == HOST else replace(one, t=one.t + 30 * MS),)


def lossy() -> Callable[[str, Transmission], tuple[Transmission, ...]]:
    """Return a bus that loses one frame in ten."""
    rng = random.Random(1)
    return lambda _bus, one: () if rng.random() < 0.1 else (one,)


PROGRAMME: list[Callable[[str], Command]] = [
    lambda m: msg.Velocity(m, 20.0),
    lambda m: msg.Velocity(m, -20.0),
    lambda m: msg.Position(m, 1.5),
    lambda m: msg.Velocity(m, 0.3),
    lambda m: msg.Position(m, -30.0),
    lambda m: msg.Torque(m, 2.0),
    lambda m: msg.Torque(m, -2.0),
    msg.Hold,
    lambda m: msg.Velocity(m, 20.0),
    msg.Idle,
    lambda m: msg.Position(m, 2.0),
]
"""Set-points that change in kind and size under way, also from a coasting shaft."""


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("robot", "bus"),
    [
        *(("bench", bus) for bus in ("good", "delayed", "lossy", "duplicates")),
        ("bench05", "good"),
        ("twelve", "good"),
    ],
)
def test_a_motor_that_obeys_has_no_following_error(robot: str, bus: str) -> None:
    rig = Rig(resources.find("robots", robot).read_text("utf-8"))
    rig.run(0.5)
    rig.world.tamper.transmission = {
        "good": None,
        "delayed": delayed,
        "lossy": lossy(),
        "duplicates": lambda _bus, one: (one, one),
    }[bus]
    motors = list(rig.gateway.joints)[:2]
    for command in PROGRAMME[: 4 if robot == "twelve" else None]:
        rig.run(0.5, *map(command, motors))
        codes = {code for motor in motors for code in found(rig, motor)}
        assert not codes & {NOT_FOLLOWED, RUNS_AWAY, INCONSISTENT, NO_TORQUE, STILL_ARMED}, command


@pytest.mark.parametrize("stop_action", ["idle", "hold", "brake"])
def test_a_stop_that_does_not_reach_the_motor_is_reported(stop_action: str) -> None:
    """Nothing that is sent arrives; the feedback is fine. The left one's fault stops the right motor."""
    text = BENCH.replace("gear = 8.0", f'gear = 8.0\nstop_action = "{stop_action}"')
    rig = Rig(text.replace('on_fault = "continue"', ""))
    rig.run(0.5)
    rig.run(0.5, TURN, msg.Velocity("right", 8.0))
    rig.world.tamper.transmission = lambda _bus, one: () if one.sender == HOST else (one,)
    rig.gateway.joints["left"].latch(msg.Fault("left", rig.clock.now(), 1, "OVERCURRENT"))
    braking = rig.gateway.joints["left"].braking_time
    rig.run((braking + 2 * DISARMING) / SECOND)
    assert abs(rig.velocity("right")) > 7.0
    for motor in ("left", "right"):
        faults = rig.gateway.joints[motor].faults.values()
        assert {f.remedy.partition(";")[0] for f in faults if f.code == STILL_ARMED} == {"cut its supply"}


# -- a joint alone: what its reports show, at its own gear of 2 ------------------------------------------


class Fed:
    """A joint that gets feedback at every step, and a command."""

    def __init__(self, **settings: Any) -> None:
        limits = Limits(velocity=10.0, acceleration=50.0, torque=2.0)
        self.joint = Joint("m", JointSettings(limits, gear=2.0, **settings), spec())
        self.now: Nanos = 0
        self.feed(0.0, 0.0)
        self.joint.on_event(msg.State("m", 0, Mode.ARMED))

    def feed(self, position: float | None, velocity: float | None, torque: float | None = None) -> None:
        """Report, at the output shaft."""
        position, velocity = (None if value is None else 2.0 * value for value in (position, velocity))
        torque = None if torque is None else torque / 2.0
        self.joint.on_event(Feedback("m", self.now, position, velocity, torque))

    def run(
        self, seconds: float, command: Command | None, reports: Callable[[float], tuple[float | None, ...]]
    ) -> list[int]:
        """Run with what is reported as a function of the time [s] from now on; return the codes of faults."""
        for step in range(1, round(seconds * SECOND) // STEP + 1):
            self.now += STEP
            self.feed(*reports(step * STEP / SECOND))
            self.joint.command(self.now, command, stopped=command is None)
        return [fault.code for fault in self.joint.faults.values()]


CRAWL = msg.Velocity("m", 1.0)


@pytest.mark.parametrize(
    ("command", "reports", "faults"),
    [
        (CRAWL, lambda t: (t, 1.0), []),
        (CRAWL, lambda t: (t + 0.4 * (t > 1.0), 1.0), [INCONSISTENT]),
        (CRAWL, lambda t: (t + 0.05 * (t > 1.0), 1.0), []),  # within its bound
        (CRAWL, lambda t: (min(t, 1.0), 1.0), [INCONSISTENT]),
        (CRAWL, lambda t: (0.2 * t, 0.2), [NOT_FOLLOWED]),
        (CRAWL, lambda t: (4.0 * t, 4.0), [RUNS_AWAY]),
        (CRAWL, lambda t: (-3.0 * t, -3.0), [RUNS_AWAY]),
        (CRAWL, lambda t: (None, 1.0), []),  # a device that reports no position
        (msg.Torque("m", 1.0), lambda _: (0.0, 0.0, 1.0), []),
        (msg.Torque("m", 1.0), lambda _: (0.0, 0.0, 0.2), [NO_TORQUE]),
        (msg.Torque("m", 1.0), lambda _: (0.0, 0.0, None), []),  # one that measures none
        (msg.Torque("m", 0.0), lambda t: (17.0 * t, 17.0, 0.0), [RUNS_AWAY]),
        (msg.Hold("m"), lambda t: (t, 1.0), [NOT_FOLLOWED]),
        (msg.Impedance("m", 0.0, 0.0, 0.0, 0.1, 0.1), lambda t: (t, 1.0), []),
    ],
)
def test_what_the_reports_of_an_armed_joint_show(
    command: Command, reports: Callable[[float], tuple[float | None, ...]], faults: list[int]
) -> None:
    assert Fed().run(2.0, command, reports)[:1] == faults  # then it is still armed


def turning(begin: float, t: float) -> tuple[float, float]:
    """Return position and velocity of a joint that turns at 8 rad/s, a time [s] after `begin`."""
    return 8.0 * (begin + t), 8.0


@pytest.mark.parametrize("stall", [50, 80, 100, 150, 300])
def test_reports_that_were_read_late_and_all_at_once_are_no_fault(stall: int) -> None:
    """Reports without stamps of their own, on a busy machine: a burst with the time at which it is read."""
    fed, t = Fed(feedback_timeout=SECOND), 0.0
    for _ in range(20):
        fed.run(0.2, msg.Velocity("m", 8.0), partial(turning, t))
        t += 0.2
        fed.now += stall * MS
        for late in range(0, stall, 5):
            fed.feed(*turning(t, late / 1000.0))
        t += stall / 1000.0
        fed.joint.command(fed.now, msg.Velocity("m", 8.0), stopped=False)
    assert fed.joint.faults == {}


@pytest.mark.parametrize("stall", [60, 90, 150, 300])
def test_reports_that_catch_up_over_some_steps_are_no_fault(stall: int) -> None:
    """What sends them stood still, too: two come in each step, with the time at which they are read, until
    all of the stall is made up for."""
    fed, t = Fed(feedback_timeout=SECOND), 0.0
    for _ in range(10):
        fed.run(0.5, msg.Velocity("m", 8.0), partial(turning, t))
        t += 0.5
        fed.now += stall * MS
        for _ in range(stall // 5):
            for _ in range(2):
                t += 0.005
                fed.feed(*turning(t, 0.0))
            fed.joint.command(fed.now, msg.Velocity("m", 8.0), stopped=False)
            fed.now += STEP
        assert fed.joint.faults == {}


def test_a_jump_is_noticed_soon_after_a_stall() -> None:
    fed = Fed(feedback_timeout=SECOND)
    fed.run(0.5, CRAWL, lambda t: (t, 1.0))
    fed.now += 90 * MS
    fed.run(1.0, CRAWL, lambda t: (0.6 + t, 1.0))
    assert fed.run(0.4, CRAWL, lambda t: (2.0 + t, 1.0)) == [INCONSISTENT]


@pytest.mark.parametrize("request_", [msg.Zero("m"), msg.Home("m"), msg.Reboot("m")], ids=repr)
def test_a_position_that_was_given_another_value_on_request_is_no_jump(request_: msg.Request) -> None:
    fed = Fed()
    assert fed.run(0.5, msg.Hold("m"), lambda _: (5.0, 0.0)) == []
    fed.joint.on_request(fed.now, request_)
    assert fed.run(0.5, msg.Hold("m"), lambda _: (0.0, 0.0)) == []
    fed.joint.on_answer(fed.now, type(request_).__name__, done=True)
    assert fed.run(0.5, msg.Hold("m"), lambda _: (0.0, 0.0)) == []
    assert fed.run(0.5, msg.Hold("m"), lambda _: (5.0, 0.0)) == [INCONSISTENT]


def test_requests_that_are_refused_do_not_put_off_the_judgement() -> None:
    fed, fast = Fed(), msg.Velocity("m", 5.0)
    for _ in range(20):
        fed.joint.on_request(fed.now, msg.Zero("m"))
        fed.run(0.005, fast, lambda _: (fed.now / SECOND * 0.1, 0.1))
        fed.joint.on_answer(fed.now, "Zero", done=False)
        faults = fed.run(0.045, fast, lambda _: (fed.now / SECOND * 0.1, 0.1))
    assert faults[:1] == [NOT_FOLLOWED]


def test_a_device_that_reports_rarely_is_judged_as_well() -> None:
    rare = replace(spec(), feedback_period=200 * MS)
    made = Joint("m", JointSettings(Limits(10.0, 50.0, 2.0), feedback_timeout=SECOND), rare)
    made.on_event(Feedback("m", 0, 0.0, 0.0))
    made.on_event(msg.State("m", 0, Mode.ARMED))
    for now in range(STEP, SECOND, STEP):
        if now % (200 * MS) == 0:
            made.on_event(Feedback("m", now, 0.0, 0.0))
        made.command(now, msg.Velocity("m", 5.0), stopped=False)
    assert [fault.code for fault in made.faults.values()][:1] == [NOT_FOLLOWED]


def test_a_request_that_is_never_answered_does_not_end_the_judgement_for_good() -> None:
    fed = Fed()
    fed.joint.on_request(0, msg.Home("m"))
    assert fed.run(59.0, msg.Hold("m"), lambda t: (t, 1.0)) == []
    assert fed.run(2.0, msg.Hold("m"), lambda t: (59.0 + t, 1.0))[:1] == [NOT_FOLLOWED]


def test_a_held_joint_that_moves_on_under_a_stop_is_sent_idle_and_reported() -> None:
    fed = Fed(stop_action="hold")
    fed.run(0.5, CRAWL, lambda t: (t, 1.0))
    assert set(fed.run(1.0, None, lambda t: (0.5 + t, 1.0))) == {STILL_ARMED}
    assert fed.joint.command(fed.now + STEP, None, stopped=True) == msg.Idle("m")


def test_a_shaft_that_is_driven_after_it_was_disarmed_is_reported() -> None:
    fed = Fed()
    fed.run(0.1, CRAWL, lambda t: (t, 1.0))
    fed.joint.command(fed.now, None, stopped=True)
    fed.joint.on_event(msg.State("m", fed.now, Mode.READY))
    assert fed.run(2.0, None, lambda t: (9.0 * t, 9.0)) == []  # it may coast
    assert fed.run(0.1, None, lambda t: (13.0 * t, 13.0)) == [STILL_ARMED]


def test_bit_identical_reports_of_a_commanded_joint_are_noticed_in_half_the_time() -> None:
    assert Fed().run(0.3, msg.Velocity("m", 5.0), lambda _: (0.0, 0.0)) == [NOT_FOLLOWED]
    assert Fed().run(0.3, msg.Velocity("m", 5.0), lambda t: (1e-4 * t, 0.0)) == []
