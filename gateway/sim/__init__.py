"""The physics behind the twins: a robot in its world, in virtual time.

`load_world` and `load_plant` read a world file and what the robot truly is, `World` simulates both: a scene
in MuJoCo (`scene`) with a base on wheels (`rover`), or bare motor shafts (`shafts`), with lidar and IMU
(`sensors`). Knows no protocol, bus or gear ratio. MuJoCo is imported here alone, and only when a scene is
simulated. Must not import buses, drivers or the step.
"""

from __future__ import annotations

from gateway.sim.files import BenchFile, SceneFile, WorldFile
from gateway.sim.load import WorldError, load_plant, load_world, parse_plant, parse_world
from gateway.sim.plant_files import PlantFile, WheeledFile
from gateway.sim.world import World

__all__ = [
    "BenchFile",
    "PlantFile",
    "SceneFile",
    "WheeledFile",
    "World",
    "WorldError",
    "WorldFile",
    "load_plant",
    "load_world",
    "parse_plant",
    "parse_world",
]
