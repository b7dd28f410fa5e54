"""Slow modules that the processes of these tests are forked with (programs.py), loaded once.

They are excluded from garbage collection, which would traverse them in every process."""

from __future__ import annotations

import gc
from importlib import import_module

MODULES = [
    "filterpy.kalman",
    "mujoco",
    "pytest",  # the main module of those who fork
    "rosbags.typesys.stores.ros2_jazzy",
    *(f"protocols.{name}" for name in ("cia402", "moteus", "odrive_can", "plain")),
    "gateway.cli.main",
    "gateway.operator",
    "gateway.recording",
    "gateway.replay.compare",
    "gateway.runtime.session",
    "gateway.runtime.twin_process",
    "gateway.buses.adapters.adapter_pty",
    "gateway.buses.socketcan.bus",
    "gateway.buses.virtual",
    "gateway.sim.rover",
]

for _name in MODULES:
    import_module(_name)
gc.collect()
gc.freeze()
