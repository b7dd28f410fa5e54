"""One recording of the matrix: a robot moves for a second, and has a bad day on the way."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from gateway.recording import read_recording
from gateway.recording.layout import NEVER, VIEWS_FROM
from gateway.recording.matrix import FACTS, Cell, Levels
from gateway.recording.ros_views import Views
from gateway.recording.tick_writer import TickWriter
from gateway.runtime.scenario import Accidents
from gateway.runtime.scenario_file import parse_faults
from gateway.runtime.session import Session, open_session
from protocols.messages import SECOND, Drive, Instruction, Mission, Nanos, Position, Reach
from tests.matrix.robots import first_motor, robot_of

LASTS, AT, FOR = 1.15, 0.75, 0.35
"""s: of the run; when the bad day begins, and how long it is"""
SEED = 1
PERIOD: Nanos = SECOND // 10
"""Between two commands by hand"""
FAR = 0.15
"""rad, or m of a cylinder, that a joint is asked to move"""


def record(levels: Levels, cell: Cell, path: Path) -> None:
    """Make the recording of a cell; the same bytes each time, but for what it says of where it was made."""
    robot = robot_of(levels, cell.language, cell.body)
    on = first_motor(robot, cell.language)
    cause = levels.bad_days[cell.bad_day]
    fault = f'[faults.bad_day]\nat = {AT}\ncause = "{cause}"\non = "{on}"\nseconds = {FOR}\n'
    scenario = parse_faults(fault, Path("bad_day.toml"), robot, LASTS, SEED)
    with TemporaryDirectory() as folder:
        made = Path(folder, "made.mcap")
        with open_session(robot, simulated=True, record=made, seed=SEED, world=scenario.world) as session:
            accidents, hand = Accidents(scenario, session), _Hand(session, on)
            with closing(session.run(LASTS, poll=lambda: [*hand.poll(), *accidents.poll()])) as ticks:
                for _ in ticks:
                    pass
        of = dict(zip(FACTS, cell, strict=True))
        _packed(made, path, of | {"fixture made by": f"python -m tests.matrix, seed {SEED}"})


class _Hand:
    """A person who asks the robot to move."""

    def __init__(self, session: Session, motor: str) -> None:
        self._session, self._motor = session, motor
        robot = session.robot
        self._drives = robot.brain.abilities(robot.motors).base is not None
        self._next: Nanos | None = None

    def poll(self) -> Sequence[Instruction]:
        """Return what is asked now."""
        now = self._session.clock.now()
        if self._next is not None and now < self._next:
            return ()
        if self._drives:
            self._next = now + PERIOD
            return (Drive(0.25, 0.1),)
        begun, self._next = self._next is not None, now + SECOND // 4
        if not begun:
            return ()
        self._next = now + 100 * SECOND
        feedback = self._session.joints[self._motor].feedback
        at = feedback.position if feedback is not None else None
        return (Mission("move", (Reach((Position(self._motor, (at or 0.0) + FAR),)),)),)


def _packed(made: Path, path: Path, more: dict[str, str]) -> None:
    """Write a recording without its views, in long chunks: a third of its size."""
    recording = read_recording(made)
    facts = recording.facts | more | {VIEWS_FROM: NEVER}
    del facts["platform"]  # nothing depends on it
    writer = TickWriter(path, recording.robot_text, facts, Views(), small=True)
    problems = [writer.put(tick, tuple) for tick in recording.ticks] + [writer.finish()]
    if any(problems):
        path.unlink()
        raise OSError("; ".join(filter(None, problems)))
