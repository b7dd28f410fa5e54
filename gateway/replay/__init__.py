"""Replay: a recording's inputs through the present code, and every output compared with the recorded one.

Exports: `replay_recording` (with the recorded or another robot), `Comparison`, `Difference`; `compare` for
another step function; `Watch` and `Observe`, of who watches. Must not import: `gateway.runtime`,
`gateway.buses`; there is neither clock nor bus.
"""

from gateway.replay.compare import Comparison, Difference, Observe, Watch, compare, replay_recording

__all__ = ["Comparison", "Difference", "Observe", "Watch", "compare", "replay_recording"]
