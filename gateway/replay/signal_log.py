"""What happened as numbers: a row for each tick, as numpy arrays, CSV, or a pandas data frame.

Rules. All joints and the base are columns of one table whose rows are the ticks, so that any two can be drawn
or subtracted. What is not known at a tick is NaN. Memory is bounded: beyond its rows the oldest are left out,
and it is told how many.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brain.belief import Belief
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.recording import Recording
from gateway.replay.compare import Observe, replay_recording
from protocols import messages as msg
from protocols.messages import SECOND
from protocols.suggest import did_you_mean

if TYPE_CHECKING:
    from gateway.core.joint import Joint

QUANTITIES = {
    "velocity": "rad/s",
    "position": "rad",
    "torque": "N·m",
    "current": "A",
    "temperature": "°C",
    "voltage": "V",
}
"""Measured quantities of a joint, with their units."""
COMMANDED: dict[type[msg.Command], tuple[str, ...]] = {
    msg.Position: ("position",),
    msg.Velocity: ("velocity",),
    msg.Torque: ("torque",),
    msg.Impedance: ("position", "velocity", "torque"),
}
"""What a command asks for; a feed-forward is no set-point."""
ROWS = 200_000
"""About 17 minutes at 200 Hz; with two joints 60 MB."""
FIRST_ROWS = 1024
_SENT = {"position": "rad", "velocity": "rad/s", "torque": "N·m"}
_BASE = {"x": "m", "y": "m", "yaw": "rad", "linear": "m/s", "lateral": "m/s", "angular": "rad/s"}
_NAN = float("nan")


class SignalLog:
    """The signals of a run, by name: "left.velocity", "left.command.velocity", "left.age", "base.x" …

    A joint has what its feedback has (position, velocity, torque, current, voltage, temperature), what it was
    last commanded to (command.position, …), the age of its feedback and the number of its latched faults; the
    base has the believed pose in the frame "map" and the believed velocity. Units: `units`.
    """

    def __init__(self, gateway: Gateway, rows: int = ROWS) -> None:
        """Make an empty log of a robot; `rows` ticks are kept at most."""
        if not isinstance(rows, int) or not 1 <= rows <= 10_000_000:
            raise UserError(f"a log of {rows!r} rows: expected an integer from 1 to 10000000")
        self._gateway, self._rows = gateway, rows
        self.units: Mapping[str, str] = _columns(gateway)
        """Unit by signal, in the order of the columns; "" of a number without one"""
        self._table = np.empty((min(FIRST_ROWS, rows), 1 + len(self.units)))
        self._taken = 0

    def take(self, tick: Tick, belief: Belief) -> None:
        """Take a tick, and the belief after it: of `Session.watch`."""
        size = len(self._table)
        if self._taken >= size < self._rows:
            more = np.empty((min(size, self._rows - size), self._table.shape[1]))
            self._table = np.concatenate((self._table, more))
        row = [tick.now / SECOND]
        for joint in self._gateway.joints.values():
            row += _of_joint(joint, tick.now)
        estimate = belief.estimate
        if estimate is None:
            row += [_NAN] * len(_BASE)
        else:
            pose = estimate.pose
            row += [pose.x, pose.y, pose.yaw, estimate.linear, estimate.lateral, estimate.angular]
        self._table[self._taken % len(self._table)] = row
        self._taken += 1

    def __len__(self) -> int:
        """Return the number of rows."""
        return min(self._taken, len(self._table))

    @property
    def left_out(self) -> int:
        """How many of the oldest rows were left out, since there were more than it keeps."""
        return self._taken - len(self)

    @property
    def t(self) -> NDArray[np.float64]:
        """The times of the rows [s], on the session's clock."""
        return self._ordered()[:, 0]

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the values of a signal, one for each time of `t`; raise UserError for an unknown one."""
        names = list(self.units)
        if name not in names:
            hint = did_you_mean(name, names)
            raise UserError(f"no signal {name!r}{hint}; there are: {', '.join(names)}")
        return self._ordered()[:, 1 + names.index(name)]

    def to_csv(self, file: Path | str) -> None:
        """Write the rows to a new file; the first line has names and units, empty is what is not known.

        Raises:
            UserError: it exists, or cannot be written.
        """
        heads = [f"{name} [{unit}]" if unit else name for name, unit in self.units.items()]
        try:
            with Path(file).open("x", newline="", encoding="utf-8") as stream:
                write = csv.writer(stream)
                write.writerow(["t [s]", *heads])
                write.writerows([["" if v != v else f"{v:.9g}" for v in row] for row in self._ordered()])
        except OSError as error:
            raise UserError(f"{file}: cannot be written: {error.strerror}") from error

    def to_dataframe(self) -> Any:  # noqa: ANN401 -- pandas is no dependency
        """Return a pandas DataFrame whose index is the time [s]; raise UserError without pandas."""
        try:
            import pandas as pd
        except ImportError as error:
            raise UserError("a data frame needs pandas: pip install pandas; to_csv needs nothing") from error
        rows = self._ordered()
        index = pd.Index(rows[:, 0], name="t")
        return pd.DataFrame(rows[:, 1:], index=index, columns=list(self.units))

    def _ordered(self) -> NDArray[np.float64]:
        if self._taken <= len(self._table):
            return self._table[: self._taken]
        return np.roll(self._table, -(self._taken % len(self._table)), axis=0)


def log_of(recording: Recording | Path | str, robot: Robot | None = None) -> SignalLog:
    """Return the signals of a whole recording, whose inputs are run through the code of today.

    Args:
        recording: what `read_recording` returned, or a path.
        robot: another robot than the recorded one.

    Returns:
        SignalLog: a row for each tick.

    Raises:
        ConfigError: the recorded robot file is not valid any more.
        RecordingError: it is no recording, or unreadable.
        UserError: it is neither a recording nor a path.
    """
    logs: list[SignalLog] = []

    def watch(gateway: Gateway) -> Observe:
        logs.append(SignalLog(gateway))
        return logs[0].take

    replay_recording(recording, robot, watch)
    return logs[0]


def _columns(gateway: Gateway) -> dict[str, str]:
    found: dict[str, str] = {}
    for name in gateway.joints:
        found |= {f"{name}.{quantity}": unit for quantity, unit in QUANTITIES.items()}
        found |= {f"{name}.command.{quantity}": unit for quantity, unit in _SENT.items()}
        found |= {f"{name}.age": "s", f"{name}.faults": ""}
    return found | {f"base.{quantity}": unit for quantity, unit in _BASE.items()}


def _of_joint(joint: Joint, now: int) -> list[float]:
    feedback, command, age = joint.feedback, joint.sent, joint.feedback_age(now)
    asked = COMMANDED.get(type(command), ())
    values = [getattr(feedback, quantity) for quantity in QUANTITIES]
    values += [getattr(command, quantity) if quantity in asked else None for quantity in _SENT]
    values += [None if age is None else age / SECOND, len(joint.faults)]
    return [_NAN if value is None else value for value in values]
