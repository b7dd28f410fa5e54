"""The report of a recording: its inputs through the code of today, watched and compared on the way."""

from __future__ import annotations

import re
from pathlib import Path

from brain.belief import Belief
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.recording import Recording, read_recording
from gateway.replay import Comparison, Observe, Watch, replay_recording
from gateway.report.collect import Collector
from gateway.report.page import Facts, picture, write


def write_report(
    recording: Recording | Path | str,
    file: Path | str,
    robot: Robot | None = None,
    watch: Watch | None = None,
) -> Comparison:
    """Write a report of a recording: map, plots, figures, log, and whether a replay gives the same bytes.

    Args:
        recording: what `read_recording` returned, or the path of a recording. Its inputs are run through the
            code of today, several times as fast as they were recorded.
        file: the HTML file to write; one that exists is replaced.
        robot: another robot than the recorded one.
        watch: as for `replay_recording`.

    Returns:
        Comparison: the result of the replay.

    Raises:
        ConfigError: the recorded robot file is not valid any more.
        RecordingError: it is no recording, or unreadable.
        UserError: the file cannot be written.
    """
    recording, collector, comparison = _collected(recording, robot, watch)
    write(Path(file), collector, recorded_facts(recording, comparison))
    return comparison


def draw_map(recording: Recording | Path | str, robot: Robot | None = None) -> str:
    """Return the map of a recording: what was planned, where the robot believed to be, where it ended.

    Args:
        recording: as for `write_report`.
        robot: another robot than the recorded one.

    Returns:
        SVG, for a file or for a notebook (`IPython.display.SVG`).

    Raises:
        ConfigError: the recorded robot file is not valid any more.
        RecordingError: it is no recording, or unreadable.
        UserError: there is nothing to draw, as of a robot without a base.
    """
    return picture(_collected(recording, robot, None)[1])


def _collected(
    recording: Recording | Path | str, robot: Robot | None, watch: Watch | None
) -> tuple[Recording, Collector, Comparison]:
    """Replay a recording, and collect its signals."""
    if not isinstance(recording, Recording):
        recording = read_recording(recording)
    collectors: list[Collector] = []

    def both(gateway: Gateway) -> Observe:
        collector = Collector(gateway)
        collectors.append(collector)
        others = watch(gateway) if watch is not None else None

        def take(tick: Tick, belief: Belief) -> None:
            collector.take(tick, belief)
            if others is not None:
                others(tick, belief)

        return take

    comparison = replay_recording(recording, robot, both)
    return recording, collectors[0], comparison


def recorded_facts(recording: Recording, comparison: Comparison) -> Facts:
    """Return what the report of a replay states beside what the ticks show."""
    rows = [("recording", str(recording.path)), *versions(recording.facts)]
    return Facts("replay", comparison.ok, comparison.text(), tuple(rows))


def versions(facts: dict[str, str]) -> list[tuple[str, str]]:
    """Return date, program, packages and processor of the facts of a recording."""
    return [
        (re.sub("^(package|plugin|processor) ", "", name), value)
        for name, value in facts.items()
        if not name.endswith((" flags", " Features"))
    ]
