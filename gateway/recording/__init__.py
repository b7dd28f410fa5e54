"""Recordings: every tick in an MCAP file, with what shows it to others; and reading one back.

Rules. Writing never hinders the robot: the loop hands over values, one thread writes them. The ticks in a
file are whole, sealed and in the order in which they happened; their own numbers tell if one is missing.
Reading takes a file without an end as far as it goes, and never believes a byte that its digest does not
prove.

The file: profile "ros2"; attachment "robot.toml"; metadata "motor_gateway" (the format, the digest of the
robot file) and "facts" (versions, processor, …); channel /gateway/tick with `journal.DEFINITION`, after each
tick its views. A message's log time is the tick's `now`, its publish time the stamp of what it shows, its
sequence the number of the tick. Chunks are lz4; all can be read with `rosbags` as a bare .mcap.
"""

from gateway.recording.reader import Recording, Step, read
from gateway.recording.writer import Recorder

__all__ = ["Recorder", "Recording", "Step", "read"]
