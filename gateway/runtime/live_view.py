"""The live view of a session: what a page sees of it beside the robot, and a recording that is switched.

A recording that begins while the robot moves shows what happened from then on; its replay cannot be compared,
since the state that it began with is not in it. `--record` records from the start.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from gateway import recording
from gateway.core.clock import Clock, PacedClock, date, stopwatch
from gateway.core.tick import Tick
from gateway.errors import GatewayError
from gateway.view import Access, Address, Scene, View
from gateway.view.requests import READ_ONLY, ViewAnswer
from gateway.view.scene import Json
from gateway.vision.camera import Seen
from protocols.messages import MILLISECOND, SECOND, Instruction, Nanos

if TYPE_CHECKING:
    from brain.belief import Belief
    from gateway.buses.virtual import TwinWorld
    from gateway.core.robot import Robot
    from gateway.core.step import Gateway
    from gateway.recording import Recorder
    from gateway.runtime.timing import LoopStats

LOAD_PERIOD: Nanos = SECOND // 2
"""Over which the load of a bus is averaged, at least."""
MAX_POLLS = 16
"""Polls in one step of a loop in slow motion: it steps less often, and clients are to wait no longer."""


class Viewed(Protocol):
    """What a view needs of a session."""

    robot: Robot
    gateway: Gateway
    clock: Clock
    stats: LoopStats
    recorder: Recorder | None
    twins: TwinWorld | None

    def start_recording(self, path: Path | str) -> None:
        """Record from the next step on. Raises RecordingError and UserError."""

    def stop_recording(self) -> None:
        """End the recording."""


class SessionView:
    """A view of a session, fed by it."""

    def __init__(self, session: Viewed, where: Address, access: Access, *, steer: bool) -> None:
        self._session, self._steer = session, steer
        self._busy = dict(session.stats.transmission_times())
        self._loads: dict[str, float] = {}
        self._since: Nanos = 0
        paced = session.clock if isinstance(session.clock, PacedClock) else None
        self._now = paced.machine.now if paced else stopwatch
        self._most = MAX_POLLS if paced else 1
        self._polled: Nanos = 0
        recording.prepare()  # for who switches it on, while the robot moves
        self._view = View(
            [Scene(session.gateway, "live", self._facts, self._pictures)],
            where,
            access,
            steer=steer,
            acts={"record": self._record},
        )
        self.url = self._view.url
        self.ends, self.close = self._view.ends, self._view.close

    def poll(self) -> list[Instruction]:
        """Return what is asked of the robot: as many polls as there were periods since. Never waits."""
        now = self._now()
        due = (now - self._polled) // self._session.robot.period
        self._polled = now
        return [one for _ in range(max(1, min(due, self._most))) for one in self._view.poll(now)]

    def take(self, tick: Tick, belief: Belief) -> None:
        """Show a tick."""
        if tick.now - self._since >= LOAD_PERIOD:
            busy, span = dict(self._session.stats.transmission_times()), tick.now - self._since
            self._loads = {bus: (t - self._busy.get(bus, 0)) / span for bus, t in busy.items()}
            self._busy, self._since = busy, tick.now
        self._view.take(tick, belief)
        self._view.show(self._now())

    def _pictures(self) -> Mapping[str, Seen]:
        """Return what simulated cameras see; of real ones only their markers come here."""
        twins = self._session.twins
        return {} if twins is None else twins.world.images()

    def _facts(self) -> Json:
        stats, recorder = self._session.stats, self._session.recorder
        return {
            "ticks": stats.ticks,
            "missed": stats.missed,
            "longest": stats.longest_step / MILLISECOND,
            "pace": round(stats.pace, 2),
            "timing": stats.trouble,
            "sent": stats.sent,
            "load": {bus: round(load, 4) for bus, load in self._loads.items()},
            "recording": str(recorder.path) if recorder is not None else "",
            "trouble": recorder.trouble if recorder is not None else "",
        }

    def _record(self, on: object) -> ViewAnswer:
        """Switch the recording on or off."""
        if not self._steer:
            return ViewAnswer(ok=False, text=READ_ONLY)
        session = self._session
        try:
            if on and session.recorder is None:
                name = f"{session.robot.name}-{date()[:19].replace(':', '')}.mcap"
                session.start_recording(name)
                return ViewAnswer(ok=True, text=f"recording: {name}")
            if not on and session.recorder is not None:
                path = session.recorder.path
                session.stop_recording()
                return ViewAnswer(ok=True, text=f"recorded: {path}")
        except GatewayError as error:
            return ViewAnswer(ok=False, text=str(error))
        return ViewAnswer(ok=True, text="nothing to do")
