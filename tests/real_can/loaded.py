"""What the processes of these tests are forked with (programs.py): slow modules, loaded once.

They are put out of the garbage collector's sight, which would look through them in every process."""

from __future__ import annotations

import gc
from importlib import import_module

ROOMS = "__main__ commands session operator views recording judge twin_process world.rover"
BUSES = "can serial pty adapter_pty twin"
MODULES = [
    "filterpy.kalman",
    "mujoco",
    "pytest",  # the main module of those who fork
    "rosbags.typesys.stores.ros2_jazzy",
    *(f"protocols.{name}" for name in ("cia402", "moteus", "odrive_can", "plain")),
    *(f"gateway.{name}" for name in ROOMS.split()),
    *(f"gateway.buses.{name}" for name in BUSES.split()),
]

for _name in MODULES:
    import_module(_name)
gc.collect()
gc.freeze()
