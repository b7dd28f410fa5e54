"""Obedience: what the ear hears, the device does; what the ear does not hear, the device does not do.

Rules. Devices are caught in three states (ready, armed and holding still, in fault) and copied there. A copy
gets wires that the ear makes nothing of, and must go on as one that did not get them: the same torques, and
the same messages, but for direct answers, or messages that tell a driver the same. Another copy gets a wire
in which the ear hears a word, and must do that: arm and push the right way, let go, clear. Shafts stand still
meanwhile, and the host says what it said.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.conformance import bench as play
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, STEP, Bench
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, shown
from protocols.conformance.fault_injection import kinds_of, liveliest, resting
from protocols.frames import Frame
from protocols.messages import Command, Event, Mode, Nanos, Request
from protocols.plugin import CommandDecoder, Driver, Twin

PLACE = 0.75
"""rad where every shaft stands."""
LISTENED = 1200
"""Steps after which a driver knows its devices."""
SILENT = 150
"""Wires without a word that are tried in each state, as many of each message, ..."""
HEARD = 6
"""... and wires with words, of each kind of word."""
EACH = 3
"""Silent wires in one step."""
LATER = 25
"""Steps in which what a device keeps for a later message has become a word."""
NEXT = 30
"""Steps of the host in which the ear must make of it what it would have."""
WATCHED = 40
"""Steps for which a device is watched afterwards."""
ANSWERED = 20
"""Steps in which a device has answered."""
REPORTED = 600
"""Steps in which a device has told that it is no longer in fault, or where its zero is now."""
NEAR = 1e-3
"""rad that count as the same place."""
NONE = 1e-9
"""N·m that count as none."""


@dataclass(frozen=True, slots=True)
class _State:
    """Devices in some state; to be copied, never run. And what their host says to them from now on."""

    title: str
    driver: Driver | None
    """None: it cannot be copied."""
    decoder: CommandDecoder
    twins: tuple[Twin, ...]
    now: Nanos
    down: tuple[tuple[Frame, ...], ...]
    armed: bool
    faulty: bool


@dataclass(frozen=True, slots=True)
class _Run:
    """What a device did, step by step."""

    torques: tuple[float, ...]
    up: tuple[tuple[Frame, ...], ...]


def decoder_and_twin_agree(case: Case) -> Verdict:
    """Wires of a day, damaged ones and random ones, to devices in different states."""
    if not case.spec.commands:
        return Inapplicable("the spec lists no commands: the device obeys nothing that moves")
    samples = _samples(case)
    for state in _states(case):
        silent, received = _sorted_by_decoder(case, state, samples)
        failure = _undone(state, silent) or _done(case, state, received)
        if failure:
            return failure
    return None


def _samples(case: Case) -> list[Frame]:
    """Wires of both directions, at least one of each message to a device; damaged ones; random ones."""
    named = {tuple(case.plugin.messages(frame)): frame for said in case.day for frame in reversed(said.down)}
    random = case.random()
    real = random.shuffled(noise.conversation(case))
    said = [*named.values(), *real[: case.part(len(real))]]
    mutated = [play.with_data(frame, noise.damaged(play.data_of(frame), random)) for frame in said]
    return [*said, *mutated, *noise.frames(case, case.part(150))]


# -- states --------------------------------------------------------------------------------------------


def _states(case: Case) -> Iterator[_State]:
    stage = _still(case)
    for _ in range(LISTENED):
        stage.step()
        if all(stage.armed.get(name) is Mode.READY for name in NAMES):
            break
    stage.steps(10)
    yield _caught("ready", stage, ())
    kind = liveliest(case.spec) or kinds_of(case.spec)[0]
    words = [resting(kind, case.spec, name, PLACE) for name in NAMES]
    by_name = {word.motor: word for word in words}
    if not stage.arm(lambda name: by_name[name]):
        return
    stage.steps(10, words)
    yield _caught("armed", stage, words)
    if case.spec.faults:
        for twin in stage.twins:
            twin.provoke(min(case.spec.faults))
        stage.steps(300)
        yield _caught("in fault", stage, ())


def _still(case: Case) -> Bench:
    stage = case.start()
    for shaft in stage.shafts.values():
        shaft.locked, shaft.position = True, PLACE
    return stage


def _caught(title: str, stage: Bench, words: Sequence[Command]) -> _State:
    """The devices as they are, and what the host goes on to say to them."""
    decoder, twins, now = copy.deepcopy(stage.decoder), copy.deepcopy(stage.twins), stage.now
    driver: Driver | None = None
    with contextlib.suppress(Exception):  # another clause's finding
        driver = copy.deepcopy(stage.driver)
    modes = {stage.armed.get(name) for name in NAMES}
    down = tuple(stage.step(words).down for _ in range(2 * SILENT // EACH + ANSWERED + WATCHED))
    return _State(title, driver, decoder, tuple(twins), now, down, Mode.ARMED in modes, title == "in fault")


def _next_words(state: _State, decoder: CommandDecoder) -> list[Command | Request]:
    """What an ear makes of what the host says next."""
    trial = copy.deepcopy(decoder)
    return [
        word
        for step, frames in enumerate(state.down[:NEXT])
        for frame in frames
        for word in trial.decode(state.now + (step + 1) * STEP, frame)
    ]


def _sorted_by_decoder(
    case: Case, state: _State, samples: Sequence[Frame]
) -> tuple[list[Frame], list[Frame]]:
    """Wires of which the ear makes nothing, one after the other; and wires in which it hears a word."""
    silent: dict[tuple[str, ...], list[Frame]] = {}
    received: dict[tuple[str, ...], list[Frame]] = {}
    for frame in samples:
        words = copy.deepcopy(state.decoder).decode(state.now, frame)
        if words:
            received.setdefault(tuple(type(word).__name__ for word in words), []).append(frame)
        else:
            silent.setdefault(tuple(case.plugin.messages(frame)), []).append(frame)
    quiet = [
        frame
        for frame in _some(silent, max(case.part(SILENT) // max(len(silent), 1), 3))
        if _unheard(state, [frame])
    ]
    while not _unheard(state, quiet):  # together they may make a word, as pieces of a stream do
        quiet = quiet[: len(quiet) // 2]
    return quiet, _some(received, HEARD)


def _unheard(state: _State, frames: Sequence[Frame]) -> bool:
    """Whether these add no word to what the ear hears of the host, at once or in the next steps."""
    decoder, usual = copy.deepcopy(state.decoder), copy.deepcopy(state.decoder)
    for step in range(-(-len(frames) // EACH) + LATER):
        now = state.now + (step + 1) * STEP
        if any(decoder.decode(now, frame) for frame in frames[step * EACH : (step + 1) * EACH]):
            return False
        down = state.down[step] if step < len(state.down) else ()
        if [list(decoder.decode(now, frame)) for frame in down] != [
            list(usual.decode(now, frame)) for frame in down
        ]:
            return False
    return True


def _some(kinds: dict[tuple[str, ...], list[Frame]], most: int) -> list[Frame]:
    """At most so many of each kind."""
    return [frame for frames in kinds.values() for frame in frames[:: max(len(frames) // most, 1)][:most]]


def _run(state: _State, extra: Sequence[Sequence[Frame]], at: int, count: int, fed: bool) -> _Run:
    """A copy of one device for so many steps, with extra wires, and with what its host says or without."""
    twin, now, name = copy.deepcopy(state.twins[at]), state.now, NAMES[at]
    torques, up = [], []
    for step in range(count):
        now += STEP
        for frame in (
            *(extra[step] if step < len(extra) else ()),
            *(state.down[step] if fed and step < len(state.down) else ()),
        ):
            twin.receive(now, frame)
        shown: list[Event] = [msg.Feedback(name, now, PLACE, 0.0)]
        given, frames = twin.step(now, shown)
        torques.append(math.fsum(torque.torque for torque in given))
        up.append(tuple(frames))
    return _Run(tuple(torques), tuple(up))


# -- what is not heard ---------------------------------------------------------------------------------


def _undone(state: _State, silent: Sequence[Frame]) -> Failure | None:
    for at in range(len(NAMES)):
        if not _goes_astray(state, silent, at):
            continue

        def fails(frames: Sequence[Frame], at: int = at) -> bool:
            return _unheard(state, frames) and bool(_goes_astray(state, frames, at))

        few = play.fewest(silent, fails)
        text = f"{NAMES[at]}, {state.title}: the ear hears no word, and yet {_goes_astray(state, few, at)}"
        return Failure(text, (_plainest(state, few[0], at),) if len(few) == 1 else tuple(few))
    return None


def _goes_astray(state: _State, frames: Sequence[Frame], at: int) -> str:
    """What a device does otherwise that got these wires besides; "" if nothing."""
    extra = [frames[i : i + EACH] for i in range(0, len(frames), EACH)]
    count = len(extra) + ANSWERED + WATCHED
    without, other = _run(state, (), at, count, fed=True), _run(state, extra, at, count, fed=True)
    for step, (left, right) in enumerate(zip(without.torques, other.torques, strict=True)):
        if left != right:
            return f"it gives {right:.6g} N·m instead of {left:.6g} after {step + 1} ms"
    said = _said_otherwise(without, other, len(extra) + ANSWERED)
    return said if said and not _told_alike(state, without, other) else ""


def _said_otherwise(without: _Run, other: _Run, answered: int) -> str:
    """What is said by one and not by the other, but for answers; "" if nothing."""
    missing = Counter(w for said in without.up[:answered] for w in said)
    missing -= Counter(w for said in other.up[:answered] for w in said)
    if missing:
        return f"it does not say {shown(next(iter(missing)))} as it would have"
    for one, two in zip(without.up[answered:], other.up[answered:], strict=True):
        if one != two:
            said = next((w for w in (*one, *two) if (w in one) != (w in two)), "the same in another order")
            return f"it says something else later: {shown(said)}"
    return ""


def _told_alike(state: _State, one: _Run, other: _Run) -> bool:
    """Whether a driver makes the same of all that a device said: its mode, its faults, where its shaft is."""
    if state.driver is None:
        return False
    (modes, places), (their_modes, their_places) = (
        _reported(state.driver, state, one),
        _reported(state.driver, state, other),
    )
    apart = [abs(a - b) for a, b in zip(places[-1:], their_places[-1:], strict=False)]
    return modes == their_modes and all(distance < NEAR for distance in apart)


def _reported(driver: Driver, state: _State, run: _Run) -> tuple[list[object], list[float]]:
    """The last mode, the faults, and the positions that are told."""
    driver, now = copy.deepcopy(driver), state.now
    mode, faults, places = None, list[object](), list[float]()
    for frames in run.up:
        now += STEP
        for event in (event for frame in frames for event in driver.receive(now, frame)):
            if isinstance(event, msg.State):
                mode = event.mode
            elif isinstance(event, msg.Fault):
                faults.append(event.code)
            elif isinstance(event, msg.Feedback) and event.position is not None:
                places.append(event.position)
    return [mode, *faults], places


def _plainest(state: _State, frame: Frame, at: int) -> Frame:
    def fails(other: Frame) -> bool:
        return _unheard(state, [other]) and bool(_goes_astray(state, [other], at))

    return play.shortest(frame, fails) if fails(frame) else frame


# -- what is heard -------------------------------------------------------------------------------------


def _done(case: Case, state: _State, received: Sequence[Frame]) -> Failure | None:
    for frame in received:
        words = tuple(copy.deepcopy(state.decoder).decode(state.now, frame))
        for at, name in enumerate(NAMES):
            about = [word for word in words if getattr(word, "motor", "") == name]
            if not about:
                continue
            wrong = _not_done(case, state, about[-1], frame, at)
            if wrong:
                return Failure(f"{name}, {state.title}: {wrong}", (frame,), words)
    return None


def _not_done(case: Case, state: _State, word: Command | Request, frame: Frame, at: int) -> str:
    """What a device did not do of what it was told; "" if it did."""
    clears = isinstance(word, msg.ClearFault) and state.faulty
    if clears or (isinstance(word, msg.Zero) and not state.armed and not state.faulty):
        same = _run(state, [[frame]], at, REPORTED, fed=False) == _run(state, (), at, REPORTED, fed=False)
        return "it goes on as if it had not heard" if same else ""
    torque = _run(state, [[frame]], at, WATCHED, fed=False).torques[-1]
    if isinstance(word, msg.Idle | msg.Estop | msg.Reboot):
        return "" if abs(torque) <= NONE else f"it is to let go, and gives {torque:.6g} N·m"
    if not isinstance(word, Command) or state.faulty or not play.within(word, case.spec.ranges):
        return ""
    wanted = _push(word)
    if wanted and torque * wanted <= 0.0:
        return f"it hears the command, and gives {torque:.6g} N·m"
    return ""


def _push(word: Command) -> float:
    """Which way a shaft at rest at PLACE is to be pushed by a command; 0 where that is not plain."""
    along: list[float] = []
    if isinstance(word, msg.Torque):
        along = [word.torque if abs(word.torque) > 1e-3 else 0.0]
    elif isinstance(word, msg.Velocity):
        along = [word.velocity if abs(word.velocity) > 0.5 else 0.0, word.torque]
    elif isinstance(word, msg.Position):
        away = word.position - PLACE
        along = [away if abs(away) > 0.1 else 0.0, word.velocity, word.torque]
    elif isinstance(word, msg.Impedance):
        push = word.stiffness * (word.position - PLACE) + word.damping * word.velocity + word.torque
        along = [push if abs(push) > 1e-3 else 0.0]
    elif isinstance(word, msg.Hold):
        along = []
    pushes = [value for value in along if value]
    same = bool(along) and bool(along[0]) and all(value * along[0] > 0.0 for value in pushes)
    return along[0] if same else 0.0
