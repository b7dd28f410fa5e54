"""What hindered a drive, from its recording alone.

Rules. A recording of ours is replayed: what its brain believed is then known, and `DriveDoctor` looks at each
step. Another program's shows what its sensors say of each other (`calibrate`), and what of its stamps cannot
be.
"""

from __future__ import annotations

from pathlib import Path

from brain.perception.perception import Perception
from gateway.bench import verdict
from gateway.bench.calibrate import calibrate
from gateway.bench.driven import Driven, of_file
from gateway.config import load_robot, parse_robot
from gateway.core.step import Gateway
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay import Observe, replay_recording
from gateway.rosbag import is_bag
from gateway.runtime.doctor import Finding
from gateway.runtime.drive_doctor import DriveDoctor, explained, from_file


def recorded(path: Path, robot_file: str | None = None) -> list[Finding]:
    """Return what hindered a recorded drive. Raises GatewayError: it cannot be read."""
    if is_bag(path):
        return _foreign(of_file(path, robot_file))
    recording = read_recording(path)
    robot = load_robot(robot_file) if robot_file else parse_robot(recording.robot_text, str(path))
    watching: list[DriveDoctor] = []

    def watch(_: Gateway) -> Observe:
        watching.append(DriveDoctor(robot))
        return watching[0].take

    replay_recording(recording, robot, watch)
    return watching[0].findings() if watching else from_file(robot)


def _foreign(driven: Driven) -> list[Finding]:
    """Return what another program's recording shows of itself."""
    try:
        return explained(driven.robot, verdict.named(calibrate(driven)))
    except UserError as error:  # no scans, or too few
        text = str(error)
    perception = Perception(
        driven.body, driven.mounts, driven.robot.brain.perception, saved=driven.robot.brain.saved
    )
    for event in driven.events():
        perception.observe(event.t, [event])
        perception.finish(event.t)
    found = [one.reason for one in perception.contradictions()]
    return explained(driven.robot, [text, *found])
