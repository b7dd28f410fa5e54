"""The inputs of a run as a value, from which all else follows; and new recordings made of it.

Rules. What is done to a recording (trimmed, minimised, made anonymous, given a fault) is done to its inputs;
the outputs are then what the code of today makes of them. So every recording that comes of it replays to the
same bytes from its beginning, on a gateway that begins anew: no state is ever stored or read.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from brain.belief import Belief
from gateway.config import parse_robot
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs, Tick
from gateway.errors import RecordingError
from gateway.recording import Recording, environment
from gateway.recording.new_file import EXISTS, publish
from gateway.recording.ros_views import ViewMessage, Views
from gateway.recording.tick_writer import TickWriter
from gateway.replay.compare import on_known_buses
from protocols.messages import Nanos

log = logging.getLogger("gateway")

MOST_TICKS = 400_000
"""Ticks that are taken into memory: half an hour at 200 Hz."""
MADE_FROM = "made from"
"""The fact of a recording that says of which other it was made, and how"""


class Given(NamedTuple):
    """What goes into one step."""

    now: Nanos
    inputs: Inputs

    def later(self, by: Nanos) -> Given:
        """Return it at a later time [ns]; earlier, if that is negative."""
        packets = tuple(replace(packet, t=packet.t + by) for packet in self.inputs.packets)
        return Given(self.now + by, replace(self.inputs, packets=packets))


@dataclass(frozen=True, slots=True)
class InputLog:
    """A robot, and the inputs of each of its steps."""

    robot_text: str
    robot: Robot
    facts: Mapping[str, str]
    """Of the recording that it was read from"""
    ticks: Sequence[Given]

    def with_ticks(self, ticks: Iterable[Given]) -> InputLog:
        """Return the same robot with other inputs."""
        return replace(self, ticks=tuple(ticks))


def input_log(recording: Recording, robot: Robot | None = None) -> InputLog:
    """Read the inputs of a recording; those on buses that the robot does not have are left out. One that was
    cut off is taken as far as it goes, which is told.

    Args:
        recording: of this gateway.
        robot: another robot than the recorded one.

    Raises:
        ConfigError: the recorded robot file is not valid any more.
        RecordingError: it is unreadable, or too long to be held in memory.
    """
    if (recording.indexed or 0) > MOST_TICKS:
        text = f"{recording.indexed} ticks, more than the {MOST_TICKS} that are held in memory"
        raise RecordingError(f"{recording.path}: {text}; `gateway trim` cuts a part out")
    if not recording.whole:
        log.warning("%s: it was cut off before its end: what is there of it is taken", recording.path)
    robot = robot or parse_robot(recording.robot_text, f"{recording.path}: robot.toml")
    given = [Given(tick.now, on_known_buses(tick.inputs, robot.buses)) for tick in recording.ticks]
    return InputLog(robot.text, robot, recording.facts, given)


def run(
    log: InputLog, watch: Callable[[Gateway], None] = lambda _gateway: None
) -> Iterator[tuple[Tick, Belief]]:
    """Yield each tick as the code of today makes it, from a new gateway on, and the belief after it.

    `watch` is called with the gateway before its first step. What the step raises comes through."""
    gateway = Gateway(log.robot)
    watch(gateway)
    for number, (now, inputs) in enumerate(log.ticks):
        yield Tick(number, now, inputs, gateway.step(now, inputs)), gateway.belief()


def inputs_alone(log: InputLog) -> Iterator[tuple[Tick, Belief | None]]:
    """Yield the ticks without what came of them, as another version of the program is given them."""
    return ((Tick(number, *given, Outputs()), None) for number, given in enumerate(log.ticks))


class RecordingFile:
    """A new recording, which gets its name when it is whole.

    Raises:
        RecordingError: it exists, or cannot be written.
    """

    def __init__(self, path: Path, log: InputLog, facts: Mapping[str, str], *, anew: bool = True) -> None:
        """Begin it. `facts` are added to those of the recording that it is made of; with `anew` the outputs
        are made by the program of today, and it says so."""
        if os.path.lexists(path):
            raise RecordingError(f"{path}: {EXISTS}")
        self._open = True
        self._path, self._part = path, path.with_name(f"{path.name}.part")
        made_by = environment.facts() if anew else {}
        kept = {key: value for key, value in log.facts.items() if not anew or key not in made_by}
        mounts = {name: sensor.mount for name, sensor in log.robot.sensors.items()}
        self._views = Views(mounts)
        self._writer = TickWriter(self._part, log.robot_text, {**kept, **made_by, **facts}, self._views)

    def add(
        self, tick: Tick, belief: Belief | None, keep: Callable[[ViewMessage], bool] | None = None
    ) -> None:
        """Add a tick with the views of it that are to be kept (None: all); without a belief it has none."""

        def views() -> Iterable[ViewMessage]:
            made = [] if belief is None else self._views.messages(tick, belief)
            return made if keep is None else filter(keep, made)

        self._check(self._writer.put(tick, views))

    def copy(self, tick: Tick, views: Sequence[ViewMessage]) -> None:
        """Add a tick and views as they are."""
        self._check(self._writer.put(tick, lambda: views))

    def finish(self) -> None:
        """Write its end, and give it its name."""
        self._open = False
        self._check(self._writer.finish())
        try:
            publish(self._part, self._path)
        except OSError as error:
            self.abandon()
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror}") from error

    def abandon(self) -> None:
        """Remove what there is of it, unless it is finished."""
        if self._open:
            self._open = False
            self._writer.finish()
        with suppress(OSError):
            self._part.unlink(missing_ok=True)

    def _check(self, problem: str) -> None:
        if problem:
            self.abandon()
            raise RecordingError(f"{self._path}: cannot be written: {problem}")


def write_run(path: Path, log: InputLog, facts: Mapping[str, str]) -> None:
    """Write a recording of what the code of today makes of inputs; if a step fails, up to that step's inputs.

    Raises RecordingError if it exists or cannot be written."""
    file, runs = RecordingFile(path, log, facts), run(log)
    try:
        for place in range(len(log.ticks)):
            try:
                tick, belief = next(runs)
            except Exception:  # noqa: BLE001 -- of the code of today: its inputs are what is wanted
                file.copy(Tick(place, *log.ticks[place], Outputs()), ())
                break
            file.add(tick, belief)
    except BaseException:
        file.abandon()
        raise
    file.finish()
