"""The simulated world as buses: `open_world` makes a `TwinWorld`, whose `buses` look like real ones.

Imports protocols' plugins and `gateway.sim`; no runtime, no driver, no brain.
"""

from __future__ import annotations

from gateway.buses.virtual.bus import SimulatedDevice, TwinBus, TwinWorld, open_world

__all__ = ["SimulatedDevice", "TwinBus", "TwinWorld", "open_world"]
