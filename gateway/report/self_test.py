"""The judge is judged: what it must find is put into copies of a recording, and looked for.

Rules. Each check is of the same replay that `gateway judge` makes. The recording itself is only read. What
cannot be tried on it (no two frames in a step, say) is said, and counts as not shown.
"""

from __future__ import annotations

import copy
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import GatewayError
from gateway.recording import Step, read_recording
from gateway.replay import replay_recording
from gateway.replay.input_log import InputLog, RecordingFile, input_log
from gateway.report.run_inputs import digest


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was tried."""

    name: str
    shown: bool
    text: str
    """What was found"""

    @property
    def line(self) -> str:
        """It in a line."""
        return f"{'shown' if self.shown else 'NOT SHOWN'}: {self.name}: {self.text}"


def self_test(path: Path) -> list[Check]:
    """Try on a recording what the judge claims. Raises RecordingError if it is none of this gateway.

    Args:
        path: a recording that replays to the same bytes.
    """
    log = input_log(read_recording(path))
    return [_consumed(path), _from_a_state(log), *_spoilt(path, log)]


def _consumed(path: Path) -> Check:
    found = replay_recording(path)
    count = sum(len(tick.inputs.packets) for tick in read_recording(path).ticks)
    text = f"{found.given} of {count} frames given again, in {found.ticks} steps"
    why = found.objections()
    return Check(
        "as it is, it is the same, from all of its inputs",
        found.ok and found.given == count,
        f"{text}; {why[0]}" if why else text,
    )


def _from_a_state(log: InputLog) -> Check:
    """Run on from a copy of the state half way, after the first has gone to its end."""
    half, gateway = len(log.ticks) // 2, Gateway(log.robot)
    for now, inputs in log.ticks[:half]:
        gateway.step(now, inputs)
    saved = copy.deepcopy(gateway)
    ends = [[digest(one.step(now, inputs)) for now, inputs in log.ticks[half:]] for one in (gateway, saved)]
    text = f"{len(ends[0])} steps from the saved state of step {half} on"
    return Check("a run from a saved state ends the same", bool(ends[0]) and ends[0] == ends[1], text)


def _spoilt(path: Path, log: InputLog) -> Iterator[Check]:
    """Yield what is found of copies that are not as they were."""
    steps = list(read_recording(path).steps)
    spoilers: Sequence[tuple[str, Callable[[Path], str]]] = (
        ("a changed gear is found", lambda file: _geared(file, log, steps)),
        ("a swapped order of two frames is found", lambda file: _swapped(file, log, steps)),
        ("a flipped bit in a frame is found", lambda file: _flipped(file, path)),
        ("a lost step is found", lambda file: _lost(file, log, steps)),
        ("two runs in one file do not replay as one", lambda file: _twice(file, log, steps)),
    )
    for name, spoil in spoilers:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "spoilt.mcap")
            if why := spoil(file):
                yield Check(name, shown=False, text=why)
                continue
            try:
                objections = replay_recording(file).objections()
            except GatewayError as error:
                objections = [str(error).replace(str(file), "it")]
            told = objections[0].partition("\n")[0] if objections else "nothing is told"
            yield Check(name, bool(objections), told)


def _write(file: Path, log: InputLog, steps: Sequence[Step]) -> str:
    made = RecordingFile(file, log, {}, anew=False)
    for step in steps:
        made.copy(step.tick, step.views)
    made.finish()
    return ""


def _geared(file: Path, log: InputLog, steps: Sequence[Step]) -> str:
    """Write it with the gear of every motor in its robot file 1 % larger."""

    def larger(found: re.Match[str]) -> str:
        return f"{found[1]}{1.01 * float(found[2])!r}"

    text, count = re.subn(r"(?m)^([ \t]*gear[ \t]*=[ \t]*)([\d.]+)", larger, log.robot_text)
    return _write(file, replace(log, robot_text=text), steps) if count else "its robot file states no gear"


def _swapped(file: Path, log: InputLog, steps: Sequence[Step]) -> str:
    """Write it with two frames of one step in the other order, each with the stamp of the other."""
    for place, step in enumerate(steps):
        packets = step.tick.inputs.packets
        if len(packets) >= 2 and packets[0].frame != packets[1].frame and packets[0].bus == packets[1].bus:
            one, two = packets[:2]
            turned = (replace(two, t=one.t), replace(one, t=two.t), *packets[2:])
            inputs = replace(step.tick.inputs, packets=turned)
            spoilt = replace(step, tick=replace(step.tick, inputs=inputs))
            return _write(file, log, [*steps[:place], spoilt, *steps[place + 1 :]])
    return "no two frames of one bus came in one step"


def _flipped(file: Path, path: Path) -> str:
    """Copy it with one bit turned, in the middle of the file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    return ""


def _lost(file: Path, log: InputLog, steps: Sequence[Step]) -> str:
    half = len(steps) // 2
    return _write(file, log, [*steps[:half], *steps[half + 1 :]]) if half else "it has one step"


def _twice(file: Path, log: InputLog, steps: Sequence[Step]) -> str:
    """Write the run, and again behind it, as if it had begun anew."""
    by = steps[-1].tick.now - steps[0].tick.now + log.robot.period if steps else 0

    def later(tick: Tick) -> Tick:
        inputs = replace(
            tick.inputs, packets=tuple(replace(one, t=one.t + by) for one in tick.inputs.packets)
        )
        packets = tuple(replace(one, t=one.t + by) for one in tick.outputs.packets)
        return replace(tick, now=tick.now + by, inputs=inputs, outputs=replace(tick.outputs, packets=packets))

    again = (replace(step, tick=later(step.tick)) for step in steps)
    return _write(file, log, [*chain(steps, again)]) if steps else "it has no step"
