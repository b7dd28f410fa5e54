"""Plugins that are broken on purpose: motion begins or ends unsafely, silence is not noticed, faults go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from protocols import messages as msg
from protocols.conformance.bench import Messages
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Message, Mode, Nanos, Request
from protocols.plain import table
from protocols.plain.driver import PlainAdapter
from protocols.plain.twin import PlainTwin
from protocols.plugin import Device
from protocols.toolkit.host import Host
from tests.protocols.broken import BROKEN, Sent, alters, found_by, motors
from tests.protocols.odrive_can.parts import OdriveDriver
from tests.protocols.plain.parts import PlainDriver
from tests.protocols.sound import with_spec


class Knowing(PlainDriver):
    """A right driver; it keeps what it was given and what it reported, for those below."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.modes: dict[str, Mode] = {}
        self.positions: dict[str, float] = {}
        self.last: dict[str, Command] = {}

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        for event in events:
            if isinstance(event, msg.State):
                self.modes[event.motor] = event.mode
            elif isinstance(event, msg.Feedback) and event.position is not None:
                self.positions[event.motor] = event.position
        return events

    def keep(self, messages: Messages) -> None:
        """Keep the commands in `last`."""
        self.last |= {m.motor: m for m in messages if isinstance(m, Command)}

    def encoded(self, message: Command | Request) -> Frame:
        """Return a message to a device, past all that a driver should check."""
        return table.encode(self.hosts[getattr(message, "motor", "")].address, message)

    def owned(self, name: str) -> bool:
        return self.hosts[name].owned


# -- jump ----------------------------------------------------------------------------------------------


@found_by("jump")
class FirstSetPointIsZero(Knowing):
    """The set-point is zero until the first one has been sent."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        positions = [m.motor for m in messages if isinstance(m, msg.Position)]
        fresh = [name for name in positions if self.modes.get(name) != Mode.ARMED]
        events, frames = super().send(now, messages)
        zeros = [self.encoded(msg.Position(name, 0.0)) for name in fresh if self.owned(name)]
        return events, [*zeros, *frames]


@found_by("jump")
class HoldsWhereItOnceWas(Knowing):
    """Hold is the position at which the shaft was when Hold was given for the first time ever."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.held: dict[str, float] = {}

    def send(self, now: Nanos, messages: Messages) -> Sent:
        for message in messages:
            if isinstance(message, msg.Hold) and message.motor in self.positions:
                self.held.setdefault(message.motor, self.positions[message.motor])
        return super().send(now, [self.kept(message) for message in messages])

    def kept(self, message: Command | Request) -> Command | Request:
        if isinstance(message, msg.Hold) and message.motor in self.held:
            return msg.Position(message.motor, self.held[message.motor])
        return message


@found_by("jump")
class FirstTorqueIsNotZero(Knowing):
    """The first set-point has the right position, and a little torque."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        positions = [m for m in messages if isinstance(m, msg.Position)]
        fresh = [m for m in positions if self.modes.get(m.motor) != Mode.ARMED]
        events, frames = super().send(now, messages)
        pushes = [self.encoded(replace(m, torque=0.005)) for m in fresh if self.owned(m.motor)]
        return events, [*pushes, *frames]


# -- disarm --------------------------------------------------------------------------------------------


class _Trusting(PlainAdapter):
    def release(self, now: Nanos, host: Host[set[int]]) -> Sequence[Frame]:
        return super().release(now, host) if host.since == now else ()


@found_by("disarm", "dropped")
class SendsIdleOnce(Knowing):
    """Does not check that Idle has arrived."""

    adapted = _Trusting


@found_by("commands", "disarm")
class IdlesOnlyReportedArmed(Knowing):
    """Idle waits until the device has been reported armed."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        modes, self.modes = self.modes, {}
        armed = [name for name, mode in modes.items() if mode is Mode.ARMED]
        return super().send(now, [m for m in messages if not isinstance(m, msg.Idle) or m.motor in armed])


@found_by("disarm")
class HoldsToDisarm(Knowing):
    """Idle begins with Hold, so that the shaft comes to rest first."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        idle = [m.motor for m in messages if isinstance(m, msg.Idle) and self.owned(m.motor)]
        armed = [name for name in idle if self.modes.get(name) is Mode.ARMED]
        return events, [*(self.encoded(msg.Hold(name)) for name in armed), *frames]


@found_by("disarm")
class ForgetsWhatItReleased(PlainDriver):
    """What confirmed Idle once is not told Idle again, whatever arms it."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        for host in self.hosts.values():
            host.once_commanded = host.owned
        return super().send(now, messages)


@alters("disarm")
def stops_only_its_own(message: Message) -> Message | None:
    """An operator's stop does not reach what another host has armed."""
    return None if isinstance(message, msg.Stop) else message


# -- watchdog ------------------------------------------------------------------------------------------


@found_by("watchdog")
class FeedsByItself(Knowing):
    """Without a command it repeats the last one, so that the watchdog does not trip."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        self.keep(messages)
        return super().send(now, messages or list(self.last.values()))


@found_by("watchdog")
class NeverTrips(PlainTwin):
    """The watchdog is promised, and forgotten."""

    def _watch(self, now: Nanos) -> None:
        if self.mode is Mode.ARMED:
            self.feed(now)
        super()._watch(now)


@found_by("watchdog")
class TripsEarly(PlainTwin):
    """The watchdog trips after half of the declared time."""

    def _watch(self, now: Nanos) -> None:
        fed = self.fed
        self.fed = fed - 47 * MILLISECOND
        super()._watch(now)
        self.fed = fed


# -- offline -------------------------------------------------------------------------------------------


@found_by("offline")
class NeverReportsOffline(PlainDriver):
    """The time of silence is stored, and never checked."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        for host in self.hosts.values():
            host.received_at = now
        return super().send(now, messages)


@found_by("offline")
class ReadsTheLastStateForEver(Knowing):
    """Every read succeeds, with the last state if there is no newer one."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        return [*(msg.Feedback(name, now, at) for name, at in self.positions.items()), *events], frames


@found_by("offline")
class ReadsZeroAtFirst(Knowing):
    """Every read succeeds, with zero if there was none yet."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        zeros = [msg.Feedback(name, now, 0.0) for name in self.hosts if name not in self.positions]
        return [*zeros, *events], frames


@found_by("offline", "replies")
class WaitsForEver(PlainDriver):
    """Sends and reports nothing more until every device has replied."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.waits: Nanos | None = None

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        received = [host.received_at for host in self.hosts.values()]
        if not any(at is None or t - at > 100 * MILLISECOND for at in received):
            self.waits = None
        return events

    def send(self, now: Nanos, messages: Messages) -> Sent:
        if self.waits is not None and now - self.waits > 100 * MILLISECOND:
            return [], []
        self.waits = now if self.waits is None else self.waits
        return super().send(now, messages)


@found_by("offline")
class AcceptsItsOwnFrames(OdriveDriver):
    """What it has sent, returned by the bus, is a sign of life of the device."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        for host in self.hosts.values():
            if isinstance(frame, CanFrame) and not frame.extended and frame.id >> 5 == host.address:
                host.received_at = t
        return events


@found_by("stale")
class KeepsTheCommand(Knowing):
    """What was commanded while the device was absent is sent when it is ready again."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.absent: set[str] = set()
        self.back: list[str] = []

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        self.back = [n for n, mode in self.modes.items() if mode is Mode.READY and n in self.absent]
        self.absent -= set(self.back)
        return events

    def send(self, now: Nanos, messages: Messages) -> Sent:
        self.keep(messages)
        events, frames = super().send(now, messages)
        self.absent |= {e.motor for e in events if isinstance(e, msg.State) and e.mode is Mode.OFFLINE}
        back, self.back = self.back, []
        return events, [*frames, *(self.encoded(self.last[name]) for name in back if name in self.last)]


@found_by("counts", "foreign")
class LosesTheFirst(OdriveDriver):
    """The first frame flushes the input, and is lost."""

    begun = False

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        begun, self.begun = self.begun, True
        return super().receive(t, frame) if begun else []


@found_by("dropped")
class IgnoresAFullQueue(OdriveDriver):
    """That the queue is full is printed, and what was dropped counts as sent."""

    def bus(self, t: Nanos, state: BusState) -> None:
        if state is not BusState.FULL:
            super().bus(t, state)

    def send(self, now: Nanos, messages: Messages) -> Sent:
        for host in self.hosts.values():
            host.own._mode_at = now  # nor is the mode sent again by the clock
        return super().send(now, messages)


# -- faults --------------------------------------------------------------------------------------------


@alters("faults")
def ignores_the_fault_bits(event: Message) -> Message | None:
    """The state is reported, the faults are not."""
    return None if isinstance(event, msg.Fault) else event


@alters("faults")
def reports_no_remedy(event: Message) -> Message:
    """Faults are reported by number and name."""
    return replace(event, remedy="") if isinstance(event, msg.Fault) else event


@found_by("finite", "faults")
class ClearsAtEachModeSwitch(Knowing):
    """Every change of the type of command begins with clearing faults."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        before = dict(self.last)
        self.keep(messages)
        switched = [name for name, m in self.last.items() if type(before.get(name, m)) is not type(m)]
        events, frames = super().send(now, messages)
        return events, [*(self.encoded(msg.ClearFault(name)) for name in switched), *frames]


@found_by("faults")
class PollsByClearing(Knowing):
    """A device in fault that is to be commanded is polled for its state by clearing its fault."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        commanded = [m.motor for m in messages if isinstance(m, Command) and not isinstance(m, msg.Idle)]
        faulty = [name for name in commanded if self.modes.get(name) == Mode.FAULT]
        clears = [] if now % (50 * MILLISECOND) else [self.encoded(msg.ClearFault(name)) for name in faulty]
        return events, [*clears, *frames]


@found_by("faults")
class ForgetsItsFault(PlainTwin):
    """The firmware takes Idle for the end of a fault."""

    def disarm(self) -> None:
        self.clear()
        super().disarm()


# -- passive, attach, scan -----------------------------------------------------------------------------


class ConfiguresUnasked(Knowing):
    """Configures the device as its spec declares, whichever host runs it, and does not report it."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.set_up: list[str] = []
        self.answered: list[str] = []

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = list(super().receive(t, frame))
        for event in tuple(events):
            if not isinstance(event, msg.Done) or event.request != msg.WriteParameter.__name__:
                continue
            if event.name in self.set_up and event.name not in self.answered:
                self.answered.append(event.name)
                events.remove(event)
        return events

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        fresh = [m.motor for m in messages if isinstance(m, msg.Idle) and m.motor not in self.set_up]
        self.set_up += fresh
        return events, [*frames, *(self.encoded(msg.WriteParameter(name, "supply", 24.0)) for name in fresh)]


BROKEN.append(
    (
        replace(
            motors,
            name="ConfiguresUnasked",
            driver=ConfiguresUnasked,
            spec=with_spec(motors, set_up={"supply": (24.0,)}),
        ),
        ("passive",),
    )
)


@found_by("attach")
class DisarmsToArm(Knowing):
    """The first command to a device is Idle, to begin from a known state."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        before = [name for name in self.hosts if self.owned(name)]
        events, frames = super().send(now, messages)
        fresh = [name for name in self.hosts if self.owned(name) and name not in before]
        return events, [*(self.encoded(msg.Idle(name)) for name in fresh), *frames]


class ScansActively(Knowing):
    """Scans by a message to each device."""

    scan: type[msg.Hold | msg.ClearFault]

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        scans = any(isinstance(message, msg.Scan) for message in messages)
        return events, [*frames, *(self.encoded(self.scan(name)) for name in self.hosts if scans)]


@found_by("scan")
class ScansByArming(ScansActively):
    """A device that moves is there."""

    scan = msg.Hold


@found_by("scan")
class ScansByClearing(ScansActively):
    """A device in fault might not answer: so its fault is cleared."""

    scan = msg.ClearFault
