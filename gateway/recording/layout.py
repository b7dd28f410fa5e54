"""What writer and reader of a recording must agree on, beside the ticks' own bytes (`journal`)."""

from __future__ import annotations

from hashlib import blake2b

FORMAT = "1"
"""Of the ticks and metadata; a reader refuses another."""
MAGIC = b"\x89MCAP0\r\n"
ROBOT_FILE = "robot.toml"
"""The attachment with the robot file."""
METADATA = "motor_gateway"
FACTS = "facts"


def digest(data: bytes) -> str:
    """Of the robot file, as the metadata have it."""
    return blake2b(data, digest_size=16).hexdigest()
