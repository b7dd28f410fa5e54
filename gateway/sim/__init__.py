"""The physics behind the twins: a robot in its world, in virtual time.

`load_world` reads a world file, `World` simulates it: a planar base in MuJoCo (`rover`), or bare motor shafts
(`shafts`), with lidar and IMU (`sensors`). Knows no protocol, bus or gear ratio. MuJoCo is imported here
alone, and only when a scene is simulated. Must not import buses, drivers or the step.
"""

from __future__ import annotations

from gateway.sim.files import BenchFile, SceneFile, WorldFile
from gateway.sim.load import WorldError, load_world, parse_world
from gateway.sim.world import World

__all__ = ["BenchFile", "SceneFile", "World", "WorldError", "WorldFile", "load_world", "parse_world"]
