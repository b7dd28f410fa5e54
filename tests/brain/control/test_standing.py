"""A body that would fall stands at rest, and holds what is armed when it is stopped; nothing else arms it."""

from __future__ import annotations

from brain.belief import Pose
from brain.bodies.plane import Commanded, Twist
from brain.control.motion import MotionControl, MotionInputs
from brain.control.pursuit import PursuitSettings
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Mode, Nanos
from tests.brain.bodies.test_quadruped import BODY

PERIOD: Nanos = 20 * MILLISECOND
HERE = Pose(0.0, 0.0, 0.0)
LYING = dict(zip(BODY.joints, (0.0, 1.4, -2.6) * 4, strict=True))


class Free:
    """A stop zone that sees nothing."""

    def is_too_fast(self, now: Commanded) -> bool:
        del now
        return False

    def allowed(self, before: Commanded, desired: Commanded, wanted: Twist, dt: float) -> Commanded:
        del before, wanted, dt
        return desired


class Rider:
    """Control of the quadruped, whose motors are armed by any command but Idle, and obey at once."""

    def __init__(self) -> None:
        self.motion = MotionControl(PursuitSettings(), BODY, (*BODY.joints, "mast"))
        self.now: Nanos = 0
        self.armed = False

    def step(
        self, seconds: float, drive: Twist | None = None, stopped: bool = False
    ) -> set[type[msg.Command]]:
        """Step for a time; return the kinds of the last commands of the legs."""
        for _ in range(round(seconds * SECOND / PERIOD)):
            self.now += PERIOD
            mode = Mode.ARMED if self.armed else Mode.READY
            for motor, position in LYING.items():
                self.motion.observe(
                    [msg.Feedback(motor, self.now, position), msg.State(motor, self.now, mode)]
                )
            if stopped:
                commands = self.motion.disarm()
            else:
                inputs = MotionInputs(HERE, HERE, 1.0, drive is not None, drive)
                commands = self.motion.step(self.now, inputs, Free())
            assert [one.motor for one in commands] == [*BODY.joints, "mast"]
            assert isinstance(commands[-1], msg.Idle)
            self.armed = not isinstance(commands[0], msg.Idle)
        return {type(one) for one in commands[:-1]}


def test_nothing_moves_before_there_is_a_task() -> None:
    rider = Rider()
    assert rider.step(1.0) == {msg.Idle}
    assert rider.step(0.1, stopped=True) == {msg.Idle}


def test_it_stands_at_rest() -> None:
    rider = Rider()
    assert rider.step(2.0, Twist(0.2)) == {msg.Impedance}
    assert rider.step(3.0) == {msg.Impedance}


def test_after_a_stop_it_holds_and_waits() -> None:
    rider = Rider()
    rider.step(2.0, Twist(0.2))
    assert rider.step(1.0, stopped=True) == {msg.Hold}
    assert rider.step(2.0) == {msg.Hold}, "it neither falls nor goes on by itself"
    assert rider.step(0.1, Twist(0.2)) == {msg.Impedance}


def test_what_was_disarmed_meanwhile_stays_so() -> None:
    rider = Rider()
    rider.step(2.0, Twist(0.2))
    rider.step(1.0, stopped=True)
    rider.armed = False
    assert rider.step(2.0) == {msg.Idle}
    assert rider.step(0.1, Twist(0.2)) == {msg.Impedance}
