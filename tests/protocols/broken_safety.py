"""Plugins that are broken on purpose: motion begins or ends unsafely, silence is missed, faults go.

Rules. Each is the plain plugin, or ODrive's, with one class of it replaced; what is wrong is said by its
name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.odrive_can import RANGES
from protocols.odrive_can import plugin as odrive
from protocols.odrive_can.driver import OdriveDriver
from protocols.plain import codec
from protocols.plain.driver import PlainDriver
from protocols.plain.twin import PlainMotor
from protocols.plugin import Device, Plugin
from tests.protocols.broken import Sent, motors

Messages = Sequence[Command | Request]


class Knowing(PlainDriver):
    """Sound; remembers what it has told, for those below."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.modes: dict[str, Mode] = {}
        self.places: dict[str, float] = {}

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        for event in events:
            if isinstance(event, msg.State):
                self.modes[event.motor] = event.mode
            elif isinstance(event, msg.Feedback) and event.position is not None:
                self.places[event.motor] = event.position
        return events

    def say(self, word: Command | Request) -> Frame:
        """A word to a device, past everything that a driver should think of."""
        return codec.encode(self._addresses[getattr(word, "motor", "")], word)

    def owned(self, name: str) -> bool:
        return self._devices[self._addresses[name]].owned


# -- jump ----------------------------------------------------------------------------------------------


class FirstSetPointIsZero(Knowing):
    """The set-point is zero until the first one has been sent."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        fresh = [
            w.motor for w in words if isinstance(w, msg.Position) and self.modes.get(w.motor) != Mode.ARMED
        ]
        events, frames = super().send(now, words)
        return events, [*(self.say(msg.Position(name, 0.0)) for name in fresh if self.owned(name)), *frames]


class HoldsWhereItOnceWas(Knowing):
    """Hold is where the shaft was when it was first said in this life."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.held: dict[str, float] = {}

    def send(self, now: Nanos, words: Messages) -> Sent:
        for word in words:
            if isinstance(word, msg.Hold) and word.motor in self.places:
                self.held.setdefault(word.motor, self.places[word.motor])
        return super().send(now, [self.kept(word) for word in words])

    def kept(self, word: Command | Request) -> Command | Request:
        if isinstance(word, msg.Hold) and word.motor in self.held:
            return msg.Position(word.motor, self.held[word.motor])
        return word


# -- disarm --------------------------------------------------------------------------------------------


class SaysIdleOnce(PlainDriver):
    """Whether Idle has arrived is nobody's business."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.last: dict[str, Command] = {}

    def send(self, now: Nanos, words: Messages) -> Sent:
        said = [
            w for w in words if not (isinstance(w, msg.Idle) and isinstance(self.last.get(w.motor), msg.Idle))
        ]
        self.last |= {w.motor: w for w in words if isinstance(w, Command)}
        return super().send(now, said)


class IdlesOnlyWhatItHearsArmed(Knowing):
    """Idle waits until the device has been heard to be armed."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        received, self.modes = dict(self.modes), {}
        return super().send(
            now, [w for w in words if not isinstance(w, msg.Idle) or received.get(w.motor) == Mode.ARMED]
        )


class StopsOnlyItsOwn(PlainDriver):
    """An operator's stop does not reach what another host has armed."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        return super().send(now, [w for w in words if not isinstance(w, msg.Stop)])


# -- watchdog ------------------------------------------------------------------------------------------


class FeedsByItself(PlainDriver):
    """Nothing to say: then what was said last, so that the watchdog does not trip."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.last: dict[str, Command] = {}

    def send(self, now: Nanos, words: Messages) -> Sent:
        self.last |= {w.motor: w for w in words if isinstance(w, Command)}
        return super().send(now, words or list(self.last.values()))


class NeverTrips(PlainMotor):
    """The watchdog is promised, and forgotten."""

    def _watch(self, now: Nanos) -> None:
        if self._mode == Mode.ARMED:
            self._fed = now
        super()._watch(now)


class TripsEarly(PlainMotor):
    """The watchdog takes half of the declared time."""

    def _watch(self, now: Nanos) -> None:
        fed = self._fed
        self._fed = fed - 47 * MILLISECOND
        super()._watch(now)
        self._fed = fed


# -- blind ---------------------------------------------------------------------------------------------


class NeverMissesADevice(PlainDriver):
    """The time of silence is stored, and never looked at."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        for seat in self._devices.values():
            seat.received = now
        return super().send(now, words)


class ReadsTheLastStateForEver(Knowing):
    """Every read succeeds, with the last state if there is no newer one."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        return [*(msg.Feedback(name, now, place) for name, place in self.places.items()), *events], frames


class ReadsZeroAtFirst(Knowing):
    """Every read succeeds, with zero if there was none yet."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        zeros = [msg.Feedback(name, now, 0.0) for name in self._addresses if name not in self.places]
        return [*zeros, *events], frames


class WaitsForEver(PlainDriver):
    """Says and tells nothing more until every device has answered."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.waits: Nanos | None = None

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        seats = self._devices.values()
        if any(seat.received is None or t - seat.received > 100 * MILLISECOND for seat in seats):
            return events
        self.waits = None
        return events

    def send(self, now: Nanos, words: Messages) -> Sent:
        if self.waits is not None and now - self.waits > 100 * MILLISECOND:
            return [], []
        self.waits = now if self.waits is None else self.waits
        return super().send(now, words)


class HearsItself(OdriveDriver):
    """What it has sent, given back by the bus, is a sign of life of the device."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        if isinstance(frame, CanFrame) and not frame.extended and frame.id >> 5 in self.axes:
            self.axes[frame.id >> 5].received_at = t
        return events


class LosesTheFirst(OdriveDriver):
    """What comes first empties the line, and is gone."""

    begun = False

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        begun, self.begun = self.begun, True
        return super().receive(t, frame) if begun else []


class IgnoresAFullQueue(OdriveDriver):
    """That the bus has no room is printed, and what was dropped counts as said."""

    def bus(self, t: Nanos, state: BusState) -> None:
        if state is not BusState.FULL:
            super().bus(t, state)


# -- faults --------------------------------------------------------------------------------------------


class IgnoresTheFaultBits(PlainDriver):
    """The state is told, what is wrong is not."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return [event for event in super().receive(t, frame) if not isinstance(event, msg.Fault)]


class KnowsNoCure(PlainDriver):
    """Faults are told by number and name."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        return [replace(e, remedy="") if isinstance(e, msg.Fault) else e for e in events]


class ClearsAtEachModeSwitch(Knowing):
    """Every change of the kind of command begins with clearing faults."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.kinds: dict[str, type[Command]] = {}

    def send(self, now: Nanos, words: Messages) -> Sent:
        before = dict(self.kinds)
        self.kinds |= {w.motor: type(w) for w in words if isinstance(w, Command)}
        switched = [name for name, kind in self.kinds.items() if before.get(name, kind) is not kind]
        events, frames = super().send(now, words)
        return events, [*(self.say(msg.ClearFault(name)) for name in switched), *frames]


class PollsByClearing(Knowing):
    """A device in fault that is to be commanded is asked for its state by clearing its fault."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        wanted = [w.motor for w in words if isinstance(w, Command) and not isinstance(w, msg.Idle)]
        asked = [name for name in wanted if self.modes.get(name) == Mode.FAULT]
        clears = [] if now % (50 * MILLISECOND) else [self.say(msg.ClearFault(name)) for name in asked]
        return events, [*clears, *frames]


class ForgetsItsFault(PlainMotor):
    """The firmware takes Idle for the end of a fault."""

    def _obey(self, t: Nanos, command: Command) -> None:
        if isinstance(command, msg.Idle) and self._mode == Mode.FAULT:
            self._fault = None
            self._enter(t, Mode.READY)
        super()._obey(t, command)


# -- unclaimed, attach, scan -------------------------------------------------------------------------------


class ConfiguresUnasked(Knowing):
    """Sees to it that the device is set up as it should be, whoever runs it; and tells nobody."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.set_up: list[str] = []
        self.answered: list[str] = []

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = list(super().receive(t, frame))
        for event in [
            e for e in events if isinstance(e, msg.Done) and e.request == msg.WriteParameter.__name__
        ]:
            if event.name in self.set_up and event.name not in self.answered:
                self.answered.append(event.name)
                events.remove(event)
        return events

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        fresh = [w.motor for w in words if isinstance(w, msg.Idle) and w.motor not in self.set_up]
        self.set_up += fresh
        return events, [*frames, *(self.say(msg.WriteParameter(name, "supply", 24.0)) for name in fresh)]


class DisarmsToArm(Knowing):
    """The first command to a device is Idle, to begin from a known state."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        before = [name for name in self._addresses if self.owned(name)]
        events, frames = super().send(now, words)
        fresh = [name for name in self._addresses if self.owned(name) and name not in before]
        return events, [*(self.say(msg.Idle(name)) for name in fresh), *frames]


class ScansByArming(Knowing):
    """Who moves is there."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        scans = any(isinstance(word, msg.Scan) for word in words)
        return events, [*frames, *(self.say(msg.Hold(name)) for name in self._addresses if scans)]


class ScansByClearing(Knowing):
    """A device in fault might not answer: so none is left in it."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        scans = any(isinstance(word, msg.Scan) for word in words)
        return events, [*(self.say(msg.ClearFault(name)) for name in self._addresses if scans), *frames]


def _driver(kind: type[PlainDriver]) -> Plugin:
    return replace(motors, name=kind.__name__, driver=kind)


def _twin(kind: type[PlainMotor]) -> Plugin:
    return replace(motors, name=kind.__name__, twin=lambda device, _: kind(device))


def _can(kind: type[OdriveDriver]) -> Plugin:
    return replace(odrive, name=kind.__name__, driver=lambda devices: kind(devices, RANGES))


BROKEN_SAFETY: tuple[tuple[Plugin, tuple[str, ...]], ...] = (
    (_driver(FirstSetPointIsZero), ("jump",)),
    (_driver(HoldsWhereItOnceWas), ("jump",)),
    (_driver(SaysIdleOnce), ("disarm", "dropped")),
    (_driver(IdlesOnlyWhatItHearsArmed), ("commands", "disarm")),
    (_driver(StopsOnlyItsOwn), ("disarm",)),
    (_driver(FeedsByItself), ("watchdog",)),
    (_twin(NeverTrips), ("watchdog",)),
    (_twin(TripsEarly), ("watchdog",)),
    (_driver(NeverMissesADevice), ("blind",)),
    (_driver(ReadsTheLastStateForEver), ("blind",)),
    (_driver(ReadsZeroAtFirst), ("blind",)),
    (_driver(WaitsForEver), ("blind", "replies")),
    (_can(HearsItself), ("blind",)),
    (_can(LosesTheFirst), ("counts", "strangers")),
    (_can(IgnoresAFullQueue), ("dropped",)),
    (_driver(IgnoresTheFaultBits), ("faults",)),
    (_driver(KnowsNoCure), ("faults",)),
    (_driver(ClearsAtEachModeSwitch), ("finite", "faults")),
    (_driver(PollsByClearing), ("faults",)),
    (_twin(ForgetsItsFault), ("faults",)),
    (_driver(ConfiguresUnasked), ("unclaimed",)),
    (_driver(DisarmsToArm), ("attach",)),
    (_driver(ScansByArming), ("scan",)),
    (_driver(ScansByClearing), ("scan",)),
)
"""Each with all the clauses that find it."""
