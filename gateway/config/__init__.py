"""The robot file (TOML) → a `Robot`; a mission file → a `Mission`: all mistakes at once, before any motion.

Knows the settings of protocols, joints and brain only by their own dataclasses. Must not import buses,
recordings, simulation or the runtime.
"""

from __future__ import annotations

from gateway.config.describe import IF_IT_DIES, describe, if_it_dies
from gateway.config.mission import cannot, load_mission, parse_mission
from gateway.config.robot_file import load_robot, parse_robot, with_interfaces
from gateway.config.validate import cautions

__all__ = [
    "IF_IT_DIES",
    "cannot",
    "cautions",
    "describe",
    "if_it_dies",
    "load_mission",
    "load_robot",
    "parse_mission",
    "parse_robot",
    "with_interfaces",
]
