"""A player of a recording: its ticks through the code of today, with pause, step, seek and rate.

Rules. What is played is what a replay from the first tick to here would have done, to the byte, whatever was
played before. The recording is compared once, from its first tick on, and keyframes are kept on this way; the
position that is shown never passes the part that is compared, and goes on from the nearest keyframe. Work is
counted in ticks, so whoever shows it can do something else in between. Time is an argument.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Self

from gateway.config import parse_robot
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Outputs, Tick
from gateway.errors import RecordingError
from gateway.recording import Recording, Step, environment
from gateway.recording.reader import FilePlace
from gateway.recording.ros_views import Views, typestore
from gateway.replay.compare import Comparer, Comparison, Difference, on_known_buses
from gateway.replay.keyframes import Frame, Keyframes, StateCodec, folder_name
from protocols.messages import Idle, Nanos

log = logging.getLogger("gateway")


class _Saved(NamedTuple):
    """What a keyframe holds."""

    played: int
    place: FilePlace | None
    """Of the tick that was played last; None: none was."""
    gateway: Gateway
    comparer: Comparer
    begun: Nanos | None
    """`Player.begun`."""


class _Target(NamedTuple):
    """Where to go: to the last tick at this time or before it, after so many ticks at most."""

    now: Nanos = sys.maxsize
    played: int = sys.maxsize


class _Reading:
    """Reads a recording tick by tick, and sees one ahead."""

    def __init__(self, recording: Recording, played: int = 0, place: FilePlace | None = None) -> None:
        self.played = played
        """Number of ticks taken."""
        self.last: Step | None = None
        self.following: Step | None = None
        """None at the end."""
        self.error: RecordingError | None = None
        """Why nothing follows, if the recording is damaged there."""
        self._steps: Iterator[Step] = recording.steps if place is None else recording.steps_from(place)
        self._look()
        if place is not None:
            self.last = self.following
            self._look()

    def take(self) -> Step | None:
        """Go on by a tick, and return it; None at the end."""
        if self.following is None:
            return None
        self.played += 1
        self.last = self.following
        self._look()
        return self.last

    def follows(self, target: _Target) -> bool:
        """True if there is a tick more on the way there."""
        following = self.following
        return following is not None and following.tick.now <= target.now and self.played < target.played

    def stop(self) -> None:
        """End here."""
        self.following = None

    def _look(self) -> None:
        try:
            self.following = next(self._steps, None)
        except RecordingError as error:
            self.following, self.error = None, error


class Player:
    """Plays a recording through the code of today.

    Args:
        recording: what `read_recording` returned.
        robot: another robot than the recorded one.
        cache: folder for the keyframes, this user's alone; None: motor-gateway/keyframes in the user's cache.

    Raises:
        ConfigError: the recorded robot file is not valid any more.
    """

    def __init__(self, recording: Recording, robot: Robot | None = None, cache: Path | None = None) -> None:
        self.recording = recording
        self.robot = robot or parse_robot(recording.robot_text, f"{recording.path}: robot.toml")
        self._facts = environment.facts()
        self._bytes = max(1, recording.path.stat().st_size)
        self.gateway = Gateway(self.robot)
        """As it is after `tick`. Another object after a seek."""
        self.outputs: Outputs | None = None
        """What the code of today made of `tick`; the recorded outputs are in the tick itself. None before the
        first."""
        self._reading = _Reading(recording)
        first = self._reading.following
        self.start: Nanos = first.tick.now if first else 0
        """Time of the first tick [ns]."""
        self._target = _Target(now=self.start)
        store = typestore()
        mounts = {name: sensor.mount for name, sensor in self.robot.sensors.items()}
        comparer = self._comparer_of(self.gateway, Views(mounts, store))
        saved = _Saved(0, None, self.gateway, comparer, None)
        self._codec = StateCodec(saved, [recording, self.robot, store, store.types])
        name = folder_name(recording, self.robot.text, self._facts, self._codec)
        self._frames = Keyframes(name, cache)
        self._first = self._codec.dump(saved)
        self._compare_from(self._last_saved() or self._codec.load(self._first))

    # -- where it is --------------------------------------------------------------------------------

    @property
    def tick(self) -> Tick | None:
        """The last tick played, as it was recorded; None before the first."""
        return self._reading.last.tick if self._reading.last else None

    @property
    def now(self) -> Nanos:
        """Time of the last tick played; before the first, `start` [ns]."""
        return self._reading.last.tick.now if self._reading.last else self.start

    @property
    def end(self) -> Nanos:
        """Time of the last tick [ns]: by the file's index; once all is compared, of the last readable one."""
        last = self._ahead.last
        return self.recording.end if self._ahead.following or last is None else last.tick.now

    @property
    def prepared(self) -> float:
        """How much of the recording is compared, from 0 to 1: all of it."""
        if self._ahead.following is None:
            return 1.0
        last = self._ahead.last
        return last.place.at[0] / self._bytes if last else 0.0

    @property
    def differences(self) -> tuple[Difference, ...]:
        """The first difference of each kind in what is compared so far, in order of time."""
        return self._comparer.in_order()

    @property
    def comparison(self) -> Comparison:
        """The result of the comparison so far; as `replay_recording` once `prepare` has returned 1."""
        ended = self._ahead.following is None
        return self._comparer.result(self.recording.indexed if ended else None, self.robot.text, self._facts)

    # -- playing ------------------------------------------------------------------------------------

    def seek(self, t: Nanos) -> None:
        """Begin to go to the last tick at a time or before it, at least to the first; `advance` gets there.

        Returns soon: it goes to the nearest keyframe, if there is one, and steps nothing."""
        self._go(_Target(now=max(t, self.start)))

    def step(self, ticks: int = 1) -> None:
        """Begin to go on by so many ticks from where it is, or back; at most to the end, or to the first.

        Returns soon, as `seek`."""
        played = self._reading.played + ticks
        self._go(_Target(played=max(1, played) if ticks < 0 else played))

    def advance(self, budget_ticks: int, until: Nanos | None = None) -> bool:
        """Play on to a time, with a bounded amount of work.

        Args:
            budget_ticks: so many ticks are stepped or compared at most; call again for the rest.
            until: the time up to which to play [ns]; None: to where the last `seek` or `step` goes, and the
                ticks on the way need not all be played.

        Returns:
            bool: True if nothing is left to be played up to there.
        """
        target = self._target if until is None else _Target(now=until)
        while self._ahead.follows(target):
            if budget_ticks <= 0:
                return False
            budget_ticks -= 1
            self._compare_tick()
        if until is None:
            self._jump()
        while self._reading.follows(target) and self._reading.played < self._ahead.played:
            if budget_ticks <= 0:
                return False
            budget_ticks -= 1
            self._play_tick()
        return True

    def prepare(self, budget_ticks: int) -> float:
        """Compare on, and keep keyframes on the way, while no more is asked for: what is shown stays.

        Args:
            budget_ticks: so many ticks at most.

        Returns:
            float: `prepared`.
        """
        for _ in range(budget_ticks):
            if not self._compare_tick():
                break
        return self.prepared

    def close(self) -> None:
        """Remove keyframes that are not kept for the next time."""
        self._frames.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- the part that is compared --------------------------------------------------------------------

    def _comparer_of(self, gateway: Gateway, views: Views) -> Comparer:
        robot = self.robot
        return Comparer(
            self.recording,
            gateway.step,
            gateway.belief,
            lambda bus: decoder_of(robot, bus),
            views,
            robot.buses,
            follow=True,
        )

    def _compare_from(self, saved: _Saved) -> None:
        self.begun = saved.begun
        """When a motor was commanded first, in what is compared; None: none was yet."""
        self._ahead = _Reading(self.recording, saved.played, saved.place)
        self._compared, self._comparer = saved.gateway, saved.comparer
        if self._ahead.following is None:
            self._comparer.end(self._ahead.error)

    def _compare_tick(self) -> bool:
        """Compare the next tick; False at the end."""
        following = self._ahead.following
        if following is None:
            return False
        try:
            self._comparer.take(following)
        except Exception as error:  # noqa: BLE001 -- whatever it is, what was played before can be looked at
            self._comparer.differ("packets", f"the code of today fails: {type(error).__name__}: {error}")
            self._ahead.stop()
            return False
        self._ahead.take()
        if self.begun is None and any(
            not isinstance(one.sent, Idle) for one in self._compared.joints.values()
        ):
            self.begun = following.tick.now
        if self._ahead.following is None:
            self._comparer.end(self._ahead.error)
        if self._ahead.following is None or self._ahead.played % self._frames.spacing == 0:
            self._keep(following)
        return True

    def _keep(self, step: Step) -> None:
        saved = _Saved(self._ahead.played, step.place, self._compared, self._comparer, self.begun)
        try:
            data = self._codec.dump(saved)
        except Exception as error:  # noqa: BLE001 -- the state of a third party's plugin may hold anything
            log.info("keyframe not kept: %s", error)
            return
        self._frames.put(Frame(saved.played, step.tick.now), data)

    # -- the position that is shown -------------------------------------------------------------------

    def _play_tick(self) -> None:
        step = self._reading.take()
        if step is not None:
            inputs = on_known_buses(step.tick.inputs, self.robot.buses)
            self.outputs = self.gateway.step(step.tick.now, inputs)

    def _go(self, target: _Target) -> None:
        self._target = target
        beyond = self._reading.played > target.played or self.now > target.now
        if beyond and self._reading.last is not None:
            self._restore(self._frames.last(now=target.now, played=target.played))
        else:
            self._jump()

    def _jump(self) -> None:
        """Go to the last keyframe on the way, if that is further on."""
        frame = self._frames.last(now=self._target.now, played=self._target.played)
        if frame is not None and self._reading.played < frame.played <= self._ahead.played:
            self._restore(frame)

    def _restore(self, frame: Frame | None) -> None:
        """Go to a keyframe; to an earlier one, or to the start, if it cannot be read."""
        saved = None
        while frame is not None and (saved := self._saved(frame)) is None:
            frame = self._frames.last(played=frame.played)
        saved = saved or self._codec.load(self._first)
        self._reading = _Reading(self.recording, saved.played, saved.place)
        self.gateway, self.outputs = saved.gateway, saved.comparer.outputs

    def _last_saved(self) -> _Saved | None:
        while (frame := self._frames.last()) is not None:
            if (saved := self._saved(frame)) is not None:
                return saved
        return None

    def _saved(self, frame: Frame) -> _Saved | None:
        data = self._frames.get(frame)
        return None if data is None else self._codec.load(data)


@dataclass(frozen=True, slots=True)
class Playback:
    """How a recording is to be shown: which time at which time. Values; the caller has the clock."""

    position: Nanos
    """Time in the recording,"""
    since: Nanos
    """at this time of the caller's clock."""
    rate: float = 1.0
    """Seconds of the recording per second."""
    playing: bool = False

    def target(self, now: Nanos) -> Nanos:
        """Return the time in the recording that is due."""
        return self.position + round((now - self.since) * self.rate) if self.playing else self.position

    def changed(
        self,
        now: Nanos,
        *,
        position: Nanos | None = None,
        rate: float | None = None,
        playing: bool | None = None,
    ) -> Playback:
        """Return it with a change from now on: elsewhere, at another rate, paused or playing."""
        return replace(
            self,
            position=self.target(now) if position is None else position,
            since=now,
            rate=self.rate if rate is None else rate,
            playing=self.playing if playing is None else playing,
        )
