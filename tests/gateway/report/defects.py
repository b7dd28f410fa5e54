"""Ten real defects, each as what one line of the sources becomes, in a copy of them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[3]
ROOMS = ("protocols", "brain", "gateway")
DECOYS = ("brain/planning/polyline.py",)
"""What changes too, by a comment: a change that makes no difference"""


class Defect(NamedTuple):
    """One defect."""

    name: str
    recording: str
    """Which of the test's recordings shows it"""
    file: str
    line: str
    becomes: str
    signal: str
    """A signal that parts, among the first"""
    since: tuple[float, float]
    """s within which it is"""


# fmt: off
DEFECTS = [
    Defect("a sign", "turn", "gateway/core/gearing.py",
           "return msg.Velocity(motor, velocity * ratio, torque / ratio)",
           "return msg.Velocity(motor, -velocity * ratio, torque / ratio)", "left", (1.2, 1.4)),
    Defect("a unit", "turn", "protocols/odrive_can/driver.py",
           "motion = Feedback(host.name, t, position * math.tau, velocity * math.tau)",
           "motion = Feedback(host.name, t, position * math.tau, velocity)", "left.velocity", (1.2, 1.6)),
    Defect("an off-by-one tick", "turn", "gateway/core/joint.py",
           "dt = max(0, min(now - self._out_at, self.settings.command_timeout)) / SECOND",
           "dt = 2 * max(0, min(now - self._out_at, self.settings.command_timeout)) / SECOND",
           "left.command.velocity", (1.2, 1.4)),
    Defect("a swapped wheel", "goal", "brain/bodies/differential.py",
           "return Setpoint(left / self.wheel_radius), Setpoint(right / self.wheel_radius)",
           "return Setpoint(right / self.wheel_radius), Setpoint(left / self.wheel_radius)",
           "left.command.velocity", (0.1, 1.0)),
    Defect("an unlatched fault", "turn", "gateway/core/faults.py",
           "            self.latched[key] = fault\n", "            pass\n", "left.faults", (1.7, 2.5)),
    Defect("a limit not applied", "turn", "gateway/core/limits.py",
           "            velocity = faster(before, goal, dt, limits)\n",
           "            velocity = goal\n", "left.command.velocity", (1.2, 1.4)),
    Defect("a stale age", "turn", "gateway/core/measured.py",
           "return self.received_at is None or now - self.received_at > self._timeout",
           "return self.received_at is None", "left.faults", (1.7, 2.5)),
    Defect("a mirrored scan", "goal", "brain/perception/mount.py",
           "return _beams(self, scan.angle_min, scan.angle_increment, len(scan.ranges))",
           "return _beams(self, -scan.angle_min, -scan.angle_increment, len(scan.ranges))",
           "base", (0.1, 2.0)),
    Defect("a lost frame", "goal", "gateway/core/step.py",
           "in self._other_hosts.among(packets):\n",
           "in self._other_hosts.among(packets):\n"
           "            self._taken = (getattr(self, '_taken', 0) + 1) % 256  # of 8 bits: 0 is none\n"
           "            if not self._taken:\n"
           "                continue\n",
           "left", (0.4, 0.8)),
    Defect("a wrong gear", "turn", "gateway/core/joint.py",
           "            gear * settings.sign,", "            (gear + 1.0) * settings.sign,",
           "left", (0.0, 1.4)),
]
# fmt: on


def versions(folder: Path, defect: Defect) -> tuple[Path, Path]:
    """Return a folder with the sources, and one with the defect in it and a change that is none."""
    before, after = folder / "before", folder / "after"
    for target in (before, after):
        for room in ROOMS:
            ignored = shutil.ignore_patterns("__pycache__", "fixtures")
            shutil.copytree(ROOT / room, target / room, ignore=ignored)
    file = after / defect.file
    text = file.read_text()
    assert text.count(defect.line) == 1, defect
    file.write_text(text.replace(defect.line, defect.becomes))
    for name in DECOYS:
        decoy = after / name
        decoy.write_text(decoy.read_text() + "\n# a comment\n")
    return before, after
