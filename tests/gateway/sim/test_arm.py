"""The arm in its world, over its motors' language: what it does with a load when somebody stops it, when its
brain fails, and the grasp."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

import numpy as np
import pytest

from brain.belief import BrainTask
from gateway.config import load_robot
from gateway.core.tick import Tick
from gateway.runtime.session import Session, open_session
from protocols import messages as msg
from protocols.messages import SECOND, Command, Mission, MoveTool, Reach

pytest.importorskip("mujoco")

UP = Reach((msg.Position("shoulder", -0.93), msg.Position("elbow", 2.5)))


@contextmanager
def arm() -> Iterator[tuple[Session, Iterator[Tick]]]:
    with open_session(load_robot("arm"), simulated=True, seed=0) as session, closing(session.run()) as ticks:
        yield session, ticks


def tip(session: Session) -> np.ndarray:
    """Return where the tip truly is."""
    assert session.twins is not None
    motors = session.robot.brain.body.joints
    shafts = [session.twins.world.shaft(motor)[0] for motor in motors]
    return np.array(session.robot.brain.body.points(shafts)[-1])  # type: ignore[attr-defined]


def run(ticks: Iterator[Tick], seconds: float) -> None:
    start = next(ticks).now
    for tick in ticks:
        if tick.now - start >= seconds * SECOND:
            break


def raised(session: Session, ticks: Iterator[Tick]) -> np.ndarray:
    """Raise the arm from its stops; return where its tip is."""
    run(ticks, 0.06)
    session.submit(Mission("up", (UP,)))
    run(ticks, 0.7)
    return tip(session)


def test_it_is_held_in_a_stop_after_its_release_and_when_the_brain_fails_until_the_run_is_ended() -> None:
    def broken(_: int, __: object, ___: Sequence[BrainTask], ____: str) -> Sequence[Command]:
        raise RuntimeError("out of ideas")

    with arm() as (session, ticks):
        before = raised(session, ticks)
        session.submit(msg.Stop("test"))
        run(ticks, 0.3)
        assert tip(session) == pytest.approx(before, abs=0.002)
        session.submit(msg.Release())
        run(ticks, 0.15)
        assert tip(session) == pytest.approx(before, abs=0.002)
        assert all(joint.armed for joint in session.joints.values())
        session.gateway.brain.step = broken  # type: ignore[method-assign, assignment]
        run(ticks, 0.3)
        assert tip(session) == pytest.approx(before, abs=0.002)
        why = "the brain has failed: RuntimeError: out of ideas"
        assert session.gateway.why_stopped() == why
        session.submit(msg.Release())
        run(ticks, 0.05)
        assert session.gateway.why_stopped() == why
    assert not session.gateway.still_armed()


class Heights:
    """In place of a recorder: the height of the tip at each tick."""

    def __init__(self, session: Session) -> None:
        self.session, self.z = session, list[float]()

    def record(self, *_: object, **__: object) -> None:
        self.z.append(float(tip(self.session)[2]))


def left(*ticks_of_reasons: int) -> list[float]:
    """Return the heights of the tip, after reasons to end the run with an arm that is stretched out: after so
    many ticks of the way out each."""
    with arm() as (session, ticks):
        raised(session, ticks)
        session.submit(Mission("out", (MoveTool(0.376, 0.0, 0.2, (0.0, np.pi, 0.0)),)))
        run(ticks, 1.5)
        heights = session.recorder = Heights(session)  # type: ignore[assignment]

        def take(*_: object) -> None:
            if len(heights.z) in ticks_of_reasons:
                session.leave("sooner")

        session.watch(take)
        session.leave("it is to end")
        assert not list(ticks)
        for joint in session.joints.values():
            assert (joint.mode, joint.faults) == (msg.Mode.READY, {})
    return heights.z


def test_at_the_end_of_a_run_it_is_lowered_and_only_a_third_reason_lets_go_of_it_at_once() -> None:
    lowered = left()
    assert lowered[0] - lowered[-1] > 0.1
    assert np.diff(lowered).min() > -0.6 * 0.005, "m/s; it falls with 1.4"
    assert left(10) == lowered
    assert len(left(10, 20)) < 80 < len(lowered)


def test_a_place_out_of_reach_fails_the_mission_with_the_reason() -> None:
    with arm() as (session, ticks):
        run(ticks, 0.06)
        session.submit(Mission("far", (MoveTool(1.0, 0.0, 0.3),)))
        run(ticks, 0.7)
        view = session.belief.mission
        assert view is not None
        assert view.phase == "failed"
        assert "out of reach: it comes no nearer than" in view.reason
        assert not any(joint.owned for joint in session.joints.values())
