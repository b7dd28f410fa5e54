"""The robot file (TOML) turned into a `Robot`: every mistake in it at once, before anything moves.

Exports load_robot, parse_robot, with_interfaces, devices, describe. Knows the protocols' and the
brain's settings only by their own dataclasses. Must not import buses, recordings, or the runtime.
"""

from gateway.config.describe import describe
from gateway.config.robot_file import devices, load_robot, parse_robot, with_interfaces
from gateway.config.validate import cautions

__all__ = ["cautions", "describe", "devices", "load_robot", "parse_robot", "with_interfaces"]
