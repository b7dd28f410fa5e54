"""Obedience: a device does what its command decoder decodes, and nothing else.

Rules. Devices are copied in three states: ready, armed and holding still, in fault. A copy gets frames of
which the decoder makes nothing, and must go on as one that did not get them: the same torques, and the same
messages, but for direct replies, or messages from which a driver reports the same. Another copy gets a frame
that decodes to a message, and must do that: arm and push the right way, disarm, clear. Shafts are locked
meanwhile, and the host goes on as before.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from protocols import messages as msg
from protocols.conformance import bench as tools
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, STEP, Messages
from protocols.conformance.case import Case, Failure, Inapplicable, shown
from protocols.conformance.fault_injection import liveliest, resting
from protocols.frames import Frame
from protocols.messages import Command, Event, Mode, Nanos, Obeyed
from protocols.plugin import CommandDecoder, Driver, Range, Twin

PLACE = 0.75
"""rad where every shaft stands."""
LISTENED = 1200
"""Steps after which a driver knows its devices."""
UNDECODED = 150
"""Frames without a decoded message that are tried in each state, as many of each kind, ..."""
DECODED = 6
"""... and frames with one, of each type of message."""
EACH = 3
"""Undecoded frames in one step."""
LATER = 25
"""Steps within which what a device keeps for a later frame has become a message."""
WATCHED = 40
"""Steps for which a device is watched afterwards."""
ANSWERED = 20
"""Steps within which a device has replied."""
REPORTED = 600
"""Steps within which a device has reported that it is no longer in fault, or its new zero."""
NEAR = 1e-3
"""rad that count as the same position."""
NONE = 1e-9
"""N·m that count as zero."""


@dataclass(frozen=True, slots=True)
class _State:
    """Devices in some state, to be copied, never run; and what their host sends from now on."""

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


def decoder_and_twin_agree(case: Case) -> None:
    """Valid, damaged and random frames have the decoded effect on devices in different states."""
    if not case.spec.commands:
        raise Inapplicable("the spec lists no commands: the device obeys nothing that moves")
    samples = _samples(case)
    for state in _states(case):
        undecoded, decoded = _sorted(case, state, samples)
        _undecoded_frames_do_nothing(state, undecoded)
        _decoded_frames_are_obeyed(case, state, decoded)


def _samples(case: Case) -> list[Frame]:
    """Return frames of both directions, at least one of each message to a device; damaged and random ones."""
    named = {
        tuple(case.plugin.messages(frame)): frame for step in case.baseline for frame in reversed(step.down)
    }
    random = case.random()
    shuffled = random.shuffled(noise.valid_frames(case))
    valid = [*named.values(), *shuffled[: case.share(len(shuffled))]]
    damaged = [tools.with_data(frame, noise.damaged(tools.data_of(frame), random)) for frame in valid]
    return [*valid, *damaged, *noise.frames(case, case.share(150))]


# -- states --------------------------------------------------------------------------------------------


def _states(case: Case) -> Iterator[_State]:
    bench = case.start()
    for shaft in bench.shafts.values():
        shaft.locked, shaft.position = True, PLACE
    for _ in range(LISTENED):
        bench.step()
        if all(bench.modes.get(name) is Mode.READY for name in NAMES):
            break
    bench.steps(10)
    yield _copied("ready", bench, ())
    kind = liveliest(case.spec)
    commands = {name: resting(kind, case.spec, name, PLACE) for name in NAMES}
    if not bench.arm(lambda name: commands[name]):
        return
    bench.steps(10, list(commands.values()))  # on a line of questions, what arms may wait for its turn
    for name in NAMES:
        if name not in bench.armed:
            raise Failure(f"{name} is armed, and Arm was decoded of no frame", (), [commands[name]])
    yield _copied("armed", bench, list(commands.values()))
    if case.spec.faults:
        for twin in bench.twins:
            twin.provoke(min(case.spec.faults))
        bench.steps(300)
        yield _copied("in fault", bench, ())


def _copied(title: str, bench: tools.Bench, messages: Messages) -> _State:
    """Copy the devices as they are, and keep what the host goes on to send."""
    decoder, twins, now = copy.deepcopy(bench.decoder), copy.deepcopy(bench.twins), bench.now
    driver: Driver | None = None
    with contextlib.suppress(Exception):  # the clause "copies" reports it
        driver = copy.deepcopy(bench.driver)
    modes = {bench.modes.get(name) for name in NAMES}
    down = tuple(bench.step(messages).down for _ in range(2 * UNDECODED // EACH + ANSWERED + WATCHED))
    return _State(title, driver, decoder, tuple(twins), now, down, Mode.ARMED in modes, title == "in fault")


def _sorted(case: Case, state: _State, samples: Sequence[Frame]) -> tuple[list[Frame], list[Frame]]:
    """Return the frames of which the decoder makes nothing, also in a row; and those that it decodes."""
    undecoded: dict[tuple[str, ...], list[Frame]] = {}
    decoded: dict[tuple[str, ...], list[Frame]] = {}
    for frame in samples:
        messages = copy.deepcopy(state.decoder).decode(state.now, frame)
        if messages:
            decoded.setdefault(tuple(type(message).__name__ for message in messages), []).append(frame)
        else:
            undecoded.setdefault(tuple(case.plugin.messages(frame)), []).append(frame)
    most = max(case.share(UNDECODED) // max(len(undecoded), 1), 3)
    silent = [frame for frame in _some(undecoded, most) if _adds_nothing(state, [frame])]
    while not _adds_nothing(state, silent):  # together they may make a message, as pieces of a stream do
        silent = silent[: len(silent) // 2]
    return silent, _some(decoded, DECODED)


def _adds_nothing(state: _State, frames: Sequence[Frame]) -> bool:
    """True if these add no message to what the decoder makes of the host, at once or in the next steps."""
    decoder, usual = copy.deepcopy(state.decoder), copy.deepcopy(state.decoder)
    for step in range(-(-len(frames) // EACH) + LATER):
        now = state.now + (step + 1) * STEP
        if any(decoder.decode(now, frame) for frame in frames[step * EACH : (step + 1) * EACH]):
            return False
        down = state.down[step] if step < len(state.down) else ()
        decoded = [list(decoder.decode(now, frame)) for frame in down]
        if decoded != [list(usual.decode(now, frame)) for frame in down]:
            return False
    return True


def _some(kinds: dict[tuple[str, ...], list[Frame]], most: int) -> list[Frame]:
    """Return at most this many of each kind."""
    return [frame for frames in kinds.values() for frame in frames[:: max(len(frames) // most, 1)][:most]]


def _run(state: _State, extra: Sequence[Sequence[Frame]], at: int, count: int, hosted: bool) -> _Run:
    """Run a copy of one device, with extra frames, and with the frames of its host or without."""
    twin, now, name = copy.deepcopy(state.twins[at]), state.now, NAMES[at]
    torques, up = [], []
    for step in range(count):
        now += STEP
        for frame in (
            *(extra[step] if step < len(extra) else ()),
            *(state.down[step] if hosted and step < len(state.down) else ()),
        ):
            twin.receive(now, frame)
        applied, frames = twin.step(now, [msg.Feedback(name, now, PLACE, 0.0)])
        torques.append(math.fsum(torque.torque for torque in applied))
        up.append(tuple(frames))
    return _Run(tuple(torques), tuple(up))


# -- frames without a decoded message ----------------------------------------------------------------------


def _undecoded_frames_do_nothing(state: _State, frames: Sequence[Frame]) -> None:
    for at, name in enumerate(NAMES):

        def fails(frames: Sequence[Frame], at: int = at) -> bool:
            return _adds_nothing(state, frames) and bool(_effect(state, frames, at))

        if not _effect(state, frames, at):
            continue
        few = tools.fewest(frames, fails)
        text = f"{name}, {state.title}: nothing is decoded, and yet {_effect(state, few, at)}"
        if len(few) == 1 and fails(few):
            few = [tools.shortest(few[0], lambda frame: fails([frame]))]
        raise Failure(text, few)


def _effect(state: _State, frames: Sequence[Frame], at: int) -> str:
    """Return what a device that gets these frames as well does otherwise, "" if nothing."""
    extra = [frames[i : i + EACH] for i in range(0, len(frames), EACH)]
    count = len(extra) + ANSWERED + WATCHED
    without, other = _run(state, (), at, count, hosted=True), _run(state, extra, at, count, hosted=True)
    for step, (left, right) in enumerate(zip(without.torques, other.torques, strict=True)):
        if left != right:
            return f"it applies {right:.6g} N·m instead of {left:.6g} after {step + 1} ms"
    difference = _sent_otherwise(without, other, len(extra) + ANSWERED)
    return difference if difference and not _reports_equal(state, without, other) else ""


def _sent_otherwise(without: _Run, other: _Run, answered: int) -> str:
    """Return what is sent by one and not by the other, but for replies; "" if nothing."""
    missing = Counter(frame for frames in without.up[:answered] for frame in frames)
    missing -= Counter(frame for frames in other.up[:answered] for frame in frames)
    if missing:
        return f"it does not send {shown(next(iter(missing)))} as it would have"
    for one, two in zip(without.up[answered:], other.up[answered:], strict=True):
        if one != two:
            frame = next((f for f in (*one, *two) if (f in one) != (f in two)), "the same in another order")
            return f"it sends something else later: {shown(frame)}"
    return ""


def _reports_equal(state: _State, one: _Run, other: _Run) -> bool:
    """True if a driver reports the same of both: the mode, the faults, and the last position."""
    if state.driver is None:
        return False
    status, positions = _reported(state.driver, state, one)
    their_status, their_positions = _reported(state.driver, state, other)
    apart = [abs(a - b) for a, b in zip(positions[-1:], their_positions[-1:], strict=False)]
    return status == their_status and all(distance < NEAR for distance in apart)


def _reported(driver: Driver, state: _State, run: _Run) -> tuple[list[object], list[float]]:
    """Return the last mode with the faults, and the positions, as a driver reports them."""
    events = _events(driver, state, run)
    modes = [event.mode for event in events if isinstance(event, msg.State)]
    faults = [event.code for event in events if isinstance(event, msg.Fault)]
    measured = [event.position for event in events if isinstance(event, msg.Feedback)]
    return [*modes[-1:], *faults], [position for position in measured if position is not None]


def _events(driver: Driver, state: _State, run: _Run) -> list[Event]:
    """Return what a copy of a driver reports of what a device sent."""
    driver, now = copy.deepcopy(driver), state.now
    steps = enumerate(run.up, 1)
    return [e for at, frames in steps for frame in frames for e in driver.receive(now + at * STEP, frame)]


# -- frames with a decoded message -------------------------------------------------------------------------


def _decoded_frames_are_obeyed(case: Case, state: _State, frames: Sequence[Frame]) -> None:
    for frame in frames:
        messages = copy.deepcopy(state.decoder).decode(state.now, frame)
        for at, name in enumerate(NAMES):
            about = [message for message in messages if getattr(message, "motor", "") == name]
            wrong = _disobeyed(case, state, about[-1], frame, at) if about else ""
            wrong = wrong or _armed_otherwise(state, about, frame, at)
            if wrong:
                raise Failure(f"{name}, {state.title}: {wrong}", (frame,), messages)


def _disobeyed(case: Case, state: _State, message: Obeyed, frame: Frame, at: int) -> str:
    """Return what a device did not do of a decoded message, "" if it did."""
    clears = isinstance(message, msg.ClearFault) and state.faulty
    if clears or (isinstance(message, msg.Zero) and not state.armed and not state.faulty):
        asked = case.spec.line != "free"  # then it reports nothing without a host
        given, without = (_run(state, extra, at, REPORTED, hosted=asked) for extra in ([[frame]], []))
        return "it goes on as if it had not received it" if given == without else ""
    torque = _run(state, [[frame]], at, WATCHED, hosted=False).torques[-1]
    if isinstance(message, msg.Idle | msg.Estop | msg.Reboot):
        return "" if abs(torque) <= NONE else f"it should disarm, and applies {torque:.6g} N·m"
    if not isinstance(message, Command) or state.faulty or not tools.within(message, case.spec.ranges):
        return ""
    wanted = push(message, case.spec.ranges)
    if wanted and torque * wanted <= 0.0:
        return f"it receives the command, and applies {torque:.6g} N·m"
    return ""


def _armed_otherwise(state: _State, messages: Sequence[Obeyed], frame: Frame, at: int) -> str:
    """Return how a frame arms a ready device that should not, or the other way round, "" if it is right."""
    if state.armed or state.faulty or any(isinstance(message, msg.Home) for message in messages):
        return ""
    run = _run(state, [[frame]], at, len(state.down), hosted=True)
    if any(isinstance(message, msg.Arm) for message in messages):
        events = _events(state.driver, state, run) if state.driver else []
        modes = [event.mode for event in events if isinstance(event, msg.State)]
        return "Arm is decoded, and it is never reported armed" if modes and Mode.ARMED not in modes else ""
    torque = next((torque for torque in run.torques if abs(torque) > NONE), 0.0)
    return f"Arm is not decoded, and it applies {torque:.6g} N·m" if torque else ""


def push(command: Command, ranges: dict[str, Range]) -> float:
    """Return a number with the sign in which a command pushes a shaft at rest at PLACE; 0.0: unclear.

    A velocity and a torque that are zero but for their resolutions push nowhere."""
    along: list[float] = []
    for name, key in tools.numbers(type(command), ranges):
        if name in ("velocity", "torque") and abs(getattr(command, name)) <= ranges[key].resolution:
            change: dict[str, Any] = {name: 0.0}
            command = replace(command, **change)
    if isinstance(command, msg.Torque):
        along = [command.torque if abs(command.torque) > 1e-3 else 0.0]
    elif isinstance(command, msg.Velocity):
        along = [command.velocity if abs(command.velocity) > 0.5 else 0.0, command.torque]
    elif isinstance(command, msg.Position):
        away = command.position - PLACE
        along = [away if abs(away) > 0.1 else 0.0, command.velocity, command.torque]
    elif isinstance(command, msg.Impedance):
        spring = command.stiffness * (command.position - PLACE)
        total = spring + command.damping * command.velocity + command.torque
        fine = {name: ranges[key].resolution for name, key in tools.numbers(msg.Impedance, ranges)}
        gains = (("position", command.stiffness), ("velocity", command.damping), ("torque", 1.0))
        error = sum(gain * fine.get(name, 0.0) for name, gain in gains)
        along = [total if abs(total) > 1e-3 + 2.0 * error else 0.0]
    if not along or not along[0]:
        return 0.0
    return along[0] if all(value * along[0] > 0.0 for value in along if value) else 0.0
