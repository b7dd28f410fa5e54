"""Recordings: every tick in an MCAP file, with ROS 2 views for other tools; and reading them back.

Exports: `Recorder` (writes), `prepare` (makes its start quick), `read_recording`, `Recording`, `Step` (read);
`recover.recover` repairs a file.
Must not import: `gateway.core.step`, `gateway.runtime` or anything that moves a robot.

Rules. Recording never delays the robot: the loop queues values, one thread writes them. The ticks in a file
are complete, protected by digests and in order; their numbers reveal a gap. Reading takes a file without an
end as far as it goes, and trusts no byte that its digest does not verify.

The file: profile "ros2"; attachment "robot.toml"; metadata "motor_gateway" (format, digest of the robot file)
and "facts" (versions, processor, …); channel /gateway/tick with `tick_codec.DEFINITION`, after each tick its
views. A message's log time is the tick's `now`, its publish time the stamp of its contents, its sequence the
number of the tick. Chunks are zstd (lz4 up to 0.18); everything can be read with `rosbags` as a bare .mcap.
"""

from gateway.recording.reader import Recording, Step, read_recording
from gateway.recording.writer import Recorder, prepare

__all__ = ["Recorder", "Recording", "Step", "prepare", "read_recording"]
