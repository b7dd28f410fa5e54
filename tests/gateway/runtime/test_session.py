"""A session as a program uses it: instructions in, ticks out; every way out leaves the motors disarmed."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

import gateway as gw
from gateway.monitor.lines import LineTroubles
from gateway.monitor.silence import Silence
from gateway.runtime.drive_doctor import DriveDoctor
from gateway.runtime.real_devices import Latencies
from gateway.runtime.session import Session


def turning(session: Session) -> None:
    """Command the left motor as soon as it is ready."""
    if session.joints["left"].mode is gw.Mode.READY:
        session.submit(gw.Velocity("left", 5.0))


def position(session: Session) -> float:
    """The left joint's, in rad."""
    return session.joints["left"].feedback.position or 0.0


def disarmed(session: Session) -> bool:
    """True if every motor reports that it is."""
    return all(joint.mode is gw.Mode.READY for joint in session.joints.values())


def test_leaving_the_loop_disarms() -> None:
    with gw.open_session("bench", simulated=True) as session:
        for _ in session.run():
            turning(session)
            if session.joints["left"].mode is gw.Mode.ARMED and session.stats.ticks > 300:
                break
        session.close()
        assert disarmed(session)
        assert position(session) > 1.0


def test_an_error_in_the_caller_disarms() -> None:
    sessions = []

    def fail() -> None:
        with gw.open_session("bench", simulated=True) as session:
            sessions.append(session)
            for tick in session.run():
                turning(session)
                if tick.seconds > 1.0:
                    raise RuntimeError("of the caller")

    with pytest.raises(RuntimeError, match="of the caller"):
        fail()
    assert disarmed(sessions[0])


def test_a_second_run_goes_on_and_the_recording_of_both_replays(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for _ in session.run(1.0):
            turning(session)
        first = position(session)
        assert disarmed(session)
        for _ in session.run(1.0):
            turning(session)
        assert position(session) > first + 2.0
    ticks = list(gw.read_recording(path).ticks)
    assert [tick.number for tick in ticks] == list(range(len(ticks)))
    assert gw.replay_recording(gw.read_recording(path)).ok


def test_a_signal_does_not_interrupt_the_stop_action(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the loop was left by an error, and it is the session that ends the run."""
    default, handlers = signal.getsignal(signal.SIGINT), []
    with gw.open_session("bench", simulated=True) as session:
        ticks = session.run()
        for _ in range(400):
            next(ticks)
            turning(session)
        step = session.gateway.step

        def observed(now: int, inputs: gw.Inputs) -> gw.Outputs:
            handlers.append(signal.getsignal(signal.SIGINT))
            return step(now, inputs)

        monkeypatch.setattr(session.gateway, "step", observed)
    assert handlers
    assert default not in handlers
    assert disarmed(session)


@pytest.mark.parametrize("reason", ["enough", "the run ends"])
def test_a_stop_of_the_operator_outlasts_the_run(reason: str) -> None:
    with gw.open_session("bench", simulated=True) as session:
        session.submit(gw.Stop(reason))
        list(session.run(0.3))
        for _ in session.run(0.5):
            turning(session)
        assert session.gateway.why_stopped() == reason
        assert position(session) == pytest.approx(0.0, abs=1e-6)
        session.submit(gw.Release())
        for _ in session.run(0.5):
            turning(session)
        assert position(session) > 0.5


def test_what_cannot_be_opened_is_an_error_in_words(tmp_path: Path) -> None:
    (tmp_path / "there.mcap").touch()
    robot = gw.with_interfaces(gw.load_robot("bench"), {"can0": "virtual:x"})
    for options, text in (
        ({"robot": "bench", "record": tmp_path / "there.mcap"}, "exists already"),
        ({"robot": robot, "simulated": True}, "can0 is on a real interface"),
        ({"robot": "bnech"}, "did you mean 'bench'"),
    ):
        with pytest.raises(gw.UserError, match=text), gw.open_session(**options):
            pass


def test_what_a_robot_can_never_do_is_refused_when_it_is_submitted() -> None:
    wrong = (
        ("bench", gw.Goal(1.0, 2.0), "Goal: 'bench' has no base to drive"),
        ("bench", gw.Velocity("lefd", 1.0), "Velocity: no motor 'lefd': .* did you mean 'left'"),
        ("bench", gw.Mission("m", (gw.Turn(1.0),)), "Mission: step 1: turn: there is no base to drive"),
        (
            "pan_tilt",
            gw.Mission("m", (gw.Reach((gw.Torque("pan", 0.1),)),)),
            "Mission: step 1: .*pan: it takes no Torque, but Hold, Idle, Position",
        ),
        ("diffbot", gw.Velocity("left", 1.0), "Velocity: 'left' moves the base: use goal or drive"),
        ("diffbot", gw.Drive(0.0, 0.0, 0.1), "Drive: the base of 'diffbot' does not move sideways"),
    )
    for name, asked, text in wrong:
        with gw.open_session(name, simulated=True) as session:
            with pytest.raises(gw.UserError, match=text):
                session.submit(gw.ClearFault("left"), asked)
            assert not session._submitted


@pytest.mark.parametrize("observer", [Silence, LineTroubles, DriveDoctor, Latencies])
def test_an_observer_ends_no_run_by_failing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, observer: type
) -> None:
    """Nor does it keep a tick from the recording."""
    path = tmp_path / "failed.mcap"
    monkeypatch.setattr(observer, "take", lambda self, *_: self.no_such_thing)
    with gw.open_session("bench", simulated=True, record=path) as session:
        ticks = [tick.number for tick in session.run(1.0)]
        assert (session.driving is None) == (observer is DriveDoctor)
    assert len(ticks) == 200
    assert sum("no longer looked" in message for message in caplog.messages) == 1
    assert len(list(gw.read_recording(path).ticks)) >= 200
