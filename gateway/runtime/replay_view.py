"""Recordings in the live view: played, paused, stepped, sought; one, or two beside each other.

Work is sliced by counted ticks, so that pages are answered in between; what is left of the time goes into the
comparison, whose keyframes make seeking quick. Two recordings are at the same time since their beginnings.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf

from brain.belief import Belief
from gateway.core.tick import Tick
from gateway.replay.beside import Beside
from gateway.replay.compare import Difference
from gateway.replay.player import Playback, Player
from gateway.runtime.ros_bridge import ShownBridge
from gateway.view import Access, Address, Scene, View
from gateway.view.requests import ViewAnswer
from gateway.view.scene import Json
from protocols.messages import MILLISECOND, SECOND, Nanos

SLICE = 20
"""Ticks that are played, or compared, before pages are polled again."""
IDLE: Nanos = 10 * MILLISECOND
"""Between two polls if there is nothing to do."""
RATES = (0.05, 100.0)
"""Lowest and highest rate."""
MOST_STEPS = 1000
"""Ticks of one step."""
SHOWN = 20
"""Differences that are listed."""
PASSED = 100
"""Ticks before the one that was sought that are taken note of: with the newest scans."""
INTO: Nanos = SECOND
"""How long after the first command a recording is opened."""


@dataclass(slots=True)
class _Shown:
    """One recording."""

    player: Player
    scene: Scene = field(init=False)
    under_way: bool = False
    """Whether it is on its way to where a page sought, or stepped: until then, all stays as it was."""
    passed: deque[tuple[Tick, Belief]] = field(default_factory=lambda: deque(maxlen=PASSED))
    """Of the way."""
    tick: Tick | None = None
    """Which is shown, as the code of today makes it."""

    def pass_on(self) -> None:
        """Keep a tick of the way."""
        tick, outputs = self.player.tick, self.player.outputs
        if tick is not None and outputs is not None:
            self.passed.append((replace(tick, outputs=outputs), self.player.gateway.belief()))

    def due(self, since_start: Nanos) -> Nanos:
        """Return a time since the beginning as one of the recording."""
        return min(self.player.start + since_start, self.player.end)


class ReplayView:
    """Recordings with their pages. `slice` does some work; whoever calls it has the clock.

    Args:
        players: one, or two that are shown beside each other.
        address: where to listen.
        access: who may connect.
        graph: makes the first recording's place in ROS 2's graph.

    Raises:
        UserError: the address cannot be opened.
    """

    def __init__(
        self,
        players: Sequence[Player],
        address: Address,
        access: Access,
        graph: Callable[[Scene], ShownBridge] | None = None,
    ) -> None:
        self._shown = [_Shown(player) for player in players]
        for one in self._shown:
            one.scene = Scene(one.player.gateway, "replay", partial(self._facts, one))
        self._playback = Playback(0, 0)
        """Held while a recording is under way; it plays at once in a graph, which has no button."""
        self._steps = 0
        """Ticks to be stepped once none is under way."""
        self._stepping = False
        """Whether they are under way by steps: where they arrive is the position then."""
        self._beside = Beside(*(each.recording for each in players)) if len(players) == 2 else None
        self._compared = False
        """Whether the two are compared with each other."""
        self._now: Nanos = 0
        self._unopened = graph is None
        """Whether it is still to be shown where something happens: nobody has asked for another place."""
        self._graph = graph(Scene(players[0].gateway, "replay", dict)) if graph is not None else None
        self._playback = self._playback.changed(0, playing=self._graph is not None)
        self._view = View([one.scene for one in self._shown], address, access, acts={"play": self._play})
        self.url = self._view.url

    @property
    def graph(self) -> str:
        """Its name in ROS 2's graph; "" if it is not there."""
        return self._graph.name if self._graph is not None else ""

    def close(self) -> None:
        """Send every client the end, and leave the graph."""
        self._view.close()
        if self._graph is not None:
            self._graph.close()

    @property
    def _longest(self) -> Nanos:
        return max(one.player.end - one.player.start for one in self._shown)

    @property
    def _under_way(self) -> bool:
        return any(one.under_way for one in self._shown)

    @property
    def position(self) -> Nanos:
        """The time since the beginning that is due."""
        return self._playback.target(self._now)

    def slice(self, now: Nanos) -> Nanos:
        """Answer pages, play what is due, and compare on. Returns when it wants to be called again."""
        self._now = now
        if self._under_way:
            self._playback = self._playback.changed(now, position=self._playback.position)
        self._view.poll(now)  # a recording takes no instructions
        self._open()
        busy = self._arrive()
        if not busy:
            if self.position >= self._longest and self._playback.playing:
                self._playback = self._playback.changed(now, position=self._longest, playing=False)
            for number, one in enumerate(self._shown):
                busy = self._play_on(number, one) or busy
        if not busy and self._beside is not None and not self._compared:
            self._compared = self._beside.advance(SLICE)
            busy = True
        for one in self._shown:
            if not busy and one.player.prepared < 1.0:
                one.player.prepare(SLICE)
                busy = True
        self._view.show(now)
        return now if busy else now + IDLE

    def _open(self) -> None:
        """Show where a motor is commanded first, once that is known; a recording without is shown from 0."""
        players = [one.player for one in self._shown]
        begun = [one.begun - one.start for one in players if one.begun is not None]
        if self._unopened and (begun or all(one.prepared == 1.0 for one in players)):
            self._seek(min((min(begun) + INTO) / SECOND, self._longest / SECOND) if begun else 0.0)

    def _arrive(self) -> bool:
        """Go on to where a page sought, or stepped; return whether any recording is still under way."""
        for number, one in enumerate(self._shown):
            for _ in range(SLICE if one.under_way else 0):
                before = one.player.tick
                if one.player.advance(1):
                    one.under_way = False
                    self._take(number, one)
                    break
                if one.player.tick is not before:
                    one.pass_on()
        if self._under_way:
            return True
        if self._stepping:
            first = self._shown[0].player
            self._playback = self._playback.changed(self._now, position=first.now - first.start)
            self._stepping = False
        if self._steps:
            for one in self._shown:
                one.player.step(self._steps)
                one.under_way = True
            self._steps, self._stepping = 0, True
            return True
        return False

    def _play_on(self, number: int, one: _Shown) -> bool:
        """Play some ticks; return whether some are left."""
        player, until = one.player, one.due(self.position)
        for _ in range(SLICE):
            before = player.tick
            done = player.advance(1, until)
            if player.tick is not before:
                self._take(number, one)
            if done:
                return False
        return True

    def _take(self, number: int, one: _Shown) -> None:
        """Show where it is, with what the ticks on the way brought."""
        player = one.player
        if player.tick is None or player.outputs is None:
            return
        if one.scene.gateway is not player.gateway:
            one.scene.adopt(player.gateway)
        for tick, belief in one.passed:
            one.scene.observe(tick, belief)
        one.passed.clear()
        one.tick = replace(player.tick, outputs=player.outputs)
        self._view.take(one.tick, player.gateway.belief(), number)
        if self._graph is not None and number == 0:
            self._graph.take(one.tick, player.gateway.belief(), player.gateway)

    def _facts(self, one: _Shown) -> Json:
        player, playback = one.player, self._playback
        return {
            "ticks": one.tick.number if one.tick is not None else 0,
            "recording": str(player.recording.path),
            "recordings": len(self._shown),
            "playback": {
                "playing": playback.playing,
                "rate": playback.rate,
                "t": (one.tick.now - player.start) / SECOND if one.tick is not None else 0.0,
                "due": self.position / SECOND,
                "under_way": one.under_way,
                "length": (player.end - player.start) / SECOND,
                "prepared": player.prepared,
                "differences": [
                    {"t": each.since / SECOND, "kind": kind, "text": each.text}
                    for kind, each in self._differences(player)
                ],
            },
        }

    def _differences(self, player: Player) -> list[tuple[str, Difference]]:
        """Return the first between two recordings, then those between this one and the code of today."""
        between = self._beside.first if self._beside is not None and self._compared else None
        found = [] if between is None else [(f"{between.kind}, beside the other recording", between)]
        return [*found, *((each.kind, each) for each in player.differences[:SHOWN])]

    def _play(self, asked: object) -> ViewAnswer:
        """Do what a page asks of the playback: each of its keys, the first that is wrong is answered."""
        if not isinstance(asked, dict):
            return ViewAnswer(ok=False, text="play: an object is expected")
        acts: dict[str, Callable[[float], None]] = {
            "playing": self._set_playing,
            "rate": self._set_rate,
            "seek": self._seek,
            "step": self._step,
        }
        for key, value in asked.items():
            if key not in acts:
                return ViewAnswer(ok=False, text=f"play: {', '.join(acts)} are expected, not {key!r}")
            if not isinstance(value, int | float) or not -inf < value < inf:  # an int may be no float
                return ViewAnswer(ok=False, text=f"play: {key} must be a finite number")
            acts[key](value)
        return ViewAnswer(ok=True, text="")

    def _set_playing(self, value: float) -> None:
        self._unopened = False
        self._playback = self._playback.changed(self._now, playing=bool(value))

    def _set_rate(self, value: float) -> None:
        rate = min(max(value, RATES[0]), RATES[1])
        self._playback = self._playback.changed(self._now, rate=rate)

    def _seek(self, value: float) -> None:
        self._unopened = False
        position = round(min(max(0.0, value), self._longest / SECOND) * SECOND)
        self._playback = self._playback.changed(self._now, position=position)
        self._steps, self._stepping = 0, False
        for one in self._shown:
            one.player.seek(one.due(position))
            one.passed.clear()
            one.under_way = True

    def _step(self, value: float) -> None:
        """Step every recording, and pause."""
        self._set_playing(0.0)
        self._steps = max(-MOST_STEPS, min(MOST_STEPS, self._steps + round(value)))
