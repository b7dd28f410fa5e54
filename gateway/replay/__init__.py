"""Replay: a recording's inputs through the present code, and every output compared with the recorded one.

Exports: `replay_recording` (with the recorded or another robot), `Comparison`, `Difference`; `compare` for
another step function; `Watch` and `Observe`, of who watches; `Player`, with `Playback`, goes to and fro in a
recording; `SignalLog` has a run as numbers, `log_of` makes it of a recording; `Beside` and `first_difference`
compare two, `partings` their signals. Must not import: `gateway.runtime`, `gateway.buses`; there is neither
clock nor bus.
"""

from gateway.replay.apart import partings
from gateway.replay.beside import Beside, first_difference
from gateway.replay.compare import Comparison, Difference, Observe, Watch, compare, replay_recording
from gateway.replay.player import Playback, Player
from gateway.replay.signal_log import SignalLog, log_of

__all__ = [
    "Beside",
    "Comparison",
    "Difference",
    "Observe",
    "Playback",
    "Player",
    "SignalLog",
    "Watch",
    "compare",
    "first_difference",
    "log_of",
    "partings",
    "replay_recording",
]
