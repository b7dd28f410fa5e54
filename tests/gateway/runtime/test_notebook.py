"""The API as a notebook uses it: without `with`, from a thread, from asyncio, as numbers; and wrong."""

from __future__ import annotations

import asyncio
import csv
import subprocess
import sys
from collections.abc import Callable
from contextlib import aclosing
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

import gateway as gw
from gateway.runtime.session import Session
from protocols import messages as msg

ROOT = Path(__file__).parents[3]


def disarmed(session: Session) -> bool:
    return all(joint.mode is gw.Mode.READY for joint in session.joints.values())


def drive(session: Session, seconds: float = 2.0) -> int:
    ticks = 0
    for _ in session.run(seconds):
        session.submit(gw.Velocity("left", 2.0))
        ticks += 1
    return ticks


def test_a_session_is_opened_and_closed_by_hand() -> None:
    session = gw.open_session("bench", simulated=True)
    assert drive(session) == 400
    session.close()
    session.close()
    assert disarmed(session)
    with session:
        pass


def test_what_is_forgotten_is_closed_when_the_program_ends(tmp_path: Path) -> None:
    """The recording has its end, and what was armed is not any more."""
    code = f"""
import gateway as gw
session = gw.open_session("bench", simulated=True, record={str(tmp_path / "forgotten.mcap")!r})
for tick in session.run():
    session.submit(gw.Velocity("left", 2.0))
    if tick.seconds > 1.0:
        break
"""

    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    recording = gw.read_recording(tmp_path / "forgotten.mcap")
    assert recording.whole
    events = [one for tick in recording.ticks for one in tick.outputs.events]
    modes = [one.mode for one in events if isinstance(one, msg.State) and one.motor == "left"]
    assert gw.Mode.ARMED in modes
    assert modes[-1] is gw.Mode.READY


def test_from_a_thread() -> None:
    took: list[int] = []

    def work() -> None:
        with gw.open_session("bench", simulated=True) as session:
            took.append(drive(session))

    thread = Thread(target=work)
    thread.start()
    thread.join()
    assert took == [400]


def test_what_another_thread_steps_is_not_closed_under_it_but_ends_with_its_stop_action() -> None:
    session = gw.open_session("bench", simulated=True)
    inside, tried = Event(), Event()

    def wait() -> list[gw.Velocity]:
        if session.stats.ticks == 300:
            inside.set()
            assert tried.wait(60.0)
        return [gw.Velocity("left", 2.0)]

    thread = Thread(target=lambda: [*session.run(poll=wait)])
    thread.start()
    assert inside.wait(60.0)
    with pytest.raises(gw.UserError, match="another thread steps this session"):
        session.close()
    tried.set()
    thread.join(60.0)
    assert not thread.is_alive()
    assert (session.joints["left"].feedback.position or 0.0) > 0.5
    assert disarmed(session)
    session.close()


def test_from_asyncio_beside_another_task() -> None:
    async def both() -> tuple[int, int]:
        others = 0

        async def other() -> None:
            nonlocal others
            while True:
                others += 1
                await asyncio.sleep(0)

        beside = asyncio.create_task(other())
        ticks = 0
        with gw.open_session("bench", simulated=True) as session:
            async with aclosing(session.run_async(1.0)) as running:
                async for _ in running:
                    ticks += 1
            assert disarmed(session)
        beside.cancel()
        return ticks, others

    ticks, others = asyncio.run(both())
    assert ticks == 200
    assert others > 50


def test_a_cancelled_task_has_sent_its_stop_action() -> None:
    async def main(session: Session) -> None:
        async def run() -> None:
            async with aclosing(session.run_async()) as running:
                async for tick in running:
                    session.submit(gw.Velocity("left", 2.0))
                    if tick.seconds > 1.0:
                        task.cancel()

        task = asyncio.create_task(run())
        await asyncio.gather(task, return_exceptions=True)
        assert task.cancelled()

    with gw.open_session("bench", simulated=True) as session:
        asyncio.run(main(session))
        assert (session.joints["left"].feedback.position or 0.0) > 0.5
        assert disarmed(session)


def test_a_log_has_a_row_for_each_tick_and_a_recording_has_the_same(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with gw.open_session("diffbot", simulated=True, record=path) as session:
        log = session.log()
        session.submit(gw.Goal(1.0, 0.3))
        for _ in session.run(3.0):
            pass
        assert session.pose is not None
        assert log["base.x"][-1] == session.pose.x
    recorded = gw.log_of(path)
    assert list(recorded.units) == list(log.units)
    assert len(recorded) == len(log) > 600  # and those in which the run ended
    for name in log.units:
        assert np.array_equal(recorded[name], log[name], equal_nan=True), name
    assert log.units["left.velocity"] == "rad/s"
    assert np.nanmax(log["left.age"]) < 0.02
    assert np.all(np.diff(log.t) > 0.0)


def test_a_log_that_is_full_leaves_out_the_oldest_and_tells_how_many(tmp_path: Path) -> None:
    with gw.open_session("bench", simulated=True) as session:
        whole, short = session.log(), session.log(rows=150)
        drive(session)
    assert whole.left_out == 0
    assert short.left_out == len(whole) - 150
    assert np.array_equal(short.t, whole.t[-150:])
    file = tmp_path / "short.csv"
    short.to_csv(file)
    with file.open() as stream:
        head, *rows = csv.reader(stream)
    assert head[:2] == ["t [s]", "left.velocity [rad/s]"]
    assert len(rows) == 150
    assert float(rows[-1][1]) == pytest.approx(short["left.velocity"][-1], rel=1e-8)
    with pytest.raises(gw.UserError, match="exists"):
        short.to_csv(file)


def test_a_data_frame_needs_pandas_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with gw.open_session("bench", simulated=True) as session:
        log = session.log()
        drive(session, 0.1)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(gw.UserError, match="pip install pandas"):
        log.to_dataframe()


# fmt: off
WRONG: list[tuple[Callable[[Session, Any], object], object, str]] = [
    (lambda _, v: gw.open_session(v), 5, "robot: found 5, a int; expected a Robot, its name"),
    (lambda _, v: gw.open_session(v), "difbot", "diffbot"),
    (lambda _, v: gw.open_session("bench", record=v), 5, "record: found 5"),
    (lambda _, v: gw.open_session("bench", seed=v), 1.5, "seed: found 1.5, a float; expected an integer"),
    (lambda s, v: s.run(v), "8", "seconds: found '8', a str; expected a number of seconds"),
    (lambda s, v: s.run(v), float("nan"), "seconds: found nan, expected a number from 0"),
    (lambda s, v: s.run(v), True, "seconds: found True, a bool"),
    (lambda s, v: s.submit(v), (1.5, 0.5), "instructions: found .1.5, 0.5., a tuple; expected a task"),
    (lambda s, v: s.submit(v), gw.Goal(1.0, 1.0), "no base to drive"),
    (lambda s, v: s.log(v), -1, "a log of -1 rows: expected an integer"),
    (lambda s, v: s.log()[v], "left.velocty", "no signal 'left.velocty'.*left.velocity"),
    (lambda _, v: gw.log_of(v), 5, "recording: found 5"),
]
# fmt: on


@pytest.mark.parametrize(("call", "value", "text"), WRONG)
def test_what_is_wrong_is_told_at_the_call(
    call: Callable[[Session, Any], object], value: object, text: str
) -> None:
    with (
        gw.open_session("bench", simulated=True) as session,
        pytest.raises(gw.UserError, match=f"(?s){text}"),
    ):
        call(session, value)
