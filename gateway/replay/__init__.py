"""Replay: a recording's inputs through the present code, and every output compared with the recorded one.

Exports: `replay_recording` (with the recorded or another robot), `Comparison`, `Difference`; `compare` for
another step function; `Watch` and `Observe`, of who watches; `Player`, with `Playback`, goes to and fro in a
recording; `Beside` and `first_difference` compare two. Must not import: `gateway.runtime`, `gateway.buses`;
there is neither clock nor bus.
"""

from gateway.replay.beside import Beside, first_difference
from gateway.replay.compare import Comparison, Difference, Observe, Watch, compare, replay_recording
from gateway.replay.player import Playback, Player

__all__ = [
    "Beside",
    "Comparison",
    "Difference",
    "Observe",
    "Playback",
    "Player",
    "Watch",
    "compare",
    "first_difference",
    "replay_recording",
]
