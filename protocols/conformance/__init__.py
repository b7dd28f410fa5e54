"""The contract that every plugin must pass. Ships with the plugin interface; needs no pytest.

    from protocols.conformance import check, table
    results = check(plugin)
    print(table(results))

Rules. A clause is a function that raises Failure, with the shortest frames and messages that show what is
wrong, or Inapplicable; it does the same again with the same seed. A plugin is known only through
`protocols.plugin`: the devices are named alpha, beta and stranger, with the addresses 1, 2 and 3 (or those
that it can have), with the plugin's default settings and options. Each other value of an option that is a
Literal or a bool gets the clauses that it can matter to. Driver and twins then run in virtual time, with a
simple shaft, on a bus without faults unless a clause injects some. Must not import any protocol, nor numpy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias
from zlib import crc32

from protocols.conformance import (
    asked,
    duplicates,
    faults,
    lines,
    losses,
    numbers,
    obeyed,
    passivity,
    reference_vectors,
    requests,
    roundtrip,
    safety,
    state,
    takeover,
    timeouts,
    traffic,
)
from protocols.conformance.case import Case, Failure, Inapplicable, addresses_of, shown, variants
from protocols.frames import Frame
from protocols.messages import Message
from protocols.plugin import Plugin

__all__ = ["CLAUSES", "Clause", "Outcome", "Result", "addresses_of", "check", "table", "variants"]


Topic: TypeAlias = Literal["numbers", "conversation"]
"""What an option may change: ranges of numbers; what is sent when, or anything else of the spec."""
SELDOM = 4
"""A clause that options do not matter to is checked with one in so many of their values, by the seed, and
with about one where there are more values."""


@dataclass(frozen=True, slots=True)
class Clause:
    """One requirement of the contract."""

    name: str
    text: str
    """The requirement in a sentence."""
    check: Callable[[Case], None]
    """Raises Failure or Inapplicable."""
    topics: tuple[Topic, ...] = ()
    """What an option must change to matter to it."""


# fmt: off
CLAUSES: tuple[Clause, ...] = (
    Clause("commands", "commands arrive within the declared resolution",
           roundtrip.commands_arrive, ("numbers", "conversation")),
    Clause("measurements", "measurements arrive within the declared resolution, of the right device and time",
           roundtrip.measurements_arrive, ("numbers", "conversation")),
    Clause("scales", "an option that decides what a number means is declared", roundtrip.scales_are_declared,
           ("numbers",)),
    Clause("saturated", "a value beyond its range is not reported as measured",
           roundtrip.beyond_its_range_is_not_measured, ("numbers",)),
    Clause("bytes", "no bytes raise an exception, at either end", traffic.no_bytes_raise),
    Clause("counts", "every frame is counted once; what is not accepted changes nothing",
           traffic.frames_are_counted),
    Clause("streams", "a serial stream may be cut anywhere", traffic.streams_may_be_cut),
    Clause("foreign", "foreign traffic is counted and changes nothing",
           passivity.foreign_traffic_changes_nothing),
    Clause("passive", "until commanded, only read-only frames are sent",
           passivity.uncommanded_is_read_only, ("conversation",)),
    Clause("asked", "only what is read-only, commanded, requested or declared as set-up is sent",
           asked.only_what_was_asked, ("conversation",)),
    Clause("declared", "only frames of the declared kinds and ids are sent",
           passivity.only_declared_frames, ("conversation",)),
    Clause("finite", "numbers that are not finite or out of range are neither sent nor reported",
           numbers.only_finite_numbers, ("numbers",)),
    Clause("repeatable", "equal inputs give equal outputs, in the same order",
           state.equal_inputs_give_equal_outputs),
    Clause("copies", "state can be copied between any two calls", state.copies_behave_the_same),
    Clause("jump", "the first command after arming equals the measured position",
           safety.arming_does_not_jump, ("conversation",)),
    Clause("disarm", "Idle disarms from every state, alone and after Hold, Stop and Leave",
           safety.idle_disarms, ("conversation",)),
    Clause("watchdog", "a silent host trips the watchdog, which is reported; commands feed it",
           timeouts.silent_host_trips_watchdog, ("conversation",)),
    Clause("offline", "a silent device is reported offline in time, without invented feedback",
           timeouts.silent_device_is_offline, ("conversation",)),
    Clause("stale", "a command given to an absent device does not arm it when it comes back",
           timeouts.absent_device_is_not_armed_later, ("conversation",)),
    Clause("faults", "faults are reported with their text, latch, and are cleared by ClearFault only",
           faults.faults_latch, ("conversation",)),
    Clause("attach", "a new driver takes over a running device without dropping its load",
           takeover.load_is_held, ("conversation",)),
    Clause("scan", "a scan finds the devices, and neither enables nor clears", takeover.scan_is_read_only),
    Clause("dropped", "what a full transmit queue dropped is sent again",
           losses.dropped_commands_are_repeated, ("conversation",)),
    Clause("normal", "−0.0 and denormals are sent and reported as 0.0",
           numbers.only_normal_numbers, ("numbers",)),
    Clause("checksums", "a message with a wrong bit changes nothing", traffic.wrong_bits_change_nothing),
    Clause("obeyed", "the device does what its command decoder decodes, and nothing else",
           obeyed.decoder_and_twin_agree),
    Clause("duplicates", "a duplicate address is detected", duplicates.duplicate_address_is_detected),
    Clause("replies", "a reply that is lost, late, duplicated or reordered delays no other device",
           losses.one_delays_no_other),
    Clause("vectors", "each message that moves a motor has an independent reference vector",
           reference_vectors.motion_is_in_reference_vectors, ("conversation",)),
    Clause("answers", "each request is answered; events and decoded messages are well-formed",
           requests.requests_are_answered),
    Clause("once", "each request has exactly one answer: Done, Refused or Parameter",
           requests.requests_are_answered_once),
    Clause("settings", "what is listed as configuration is read, and written where it is not protected",
           requests.configuration_is_read_and_written),
    Clause("turns", "on a line of questions and answers, never two send at once", lines.one_sends),
    Clause("awaited", "an exchange is over when its answer is, and none is awaited in vain",
           lines.answers_as_declared, ("conversation",)),
    Clause("lost", "an answer that is lost costs one reading", lines.lost_costs_one),
    Clause("dead", "a device that is gone takes at most half of its line from the others",
           lines.dead_costs_little),
    Clause("newest", "what waits for a slow line is bounded, and the newest set-point is sent",
           lines.newest_wins, ("conversation",)),
    Clause("later", "what waited when Idle was given does not arm a device after it", lines.not_later),
    Clause("wrong", "an answer that is late, doubled, another's, cut or behind garbage trips nothing",
           lines.wrong_answers_are_none),
)
# fmt: on

Outcome: TypeAlias = Literal["passed", "failed", "not applicable"]


@dataclass(frozen=True, slots=True)
class Result:
    """The outcome of one clause."""

    clause: str
    outcome: Outcome
    text: str
    """The requirement, or what is wrong, or why it does not apply."""
    seed: int
    """The seed that gives the same result again."""
    frames: tuple[Frame, ...] = ()
    messages: tuple[Message, ...] = ()
    """The counterexample."""


def check(
    plugin: Plugin,
    seed: int = 0,
    addresses: tuple[int, int, int] | None = None,
    clauses: Sequence[Clause] = CLAUSES,
    options: Sequence[object] = (),
    brief: bool = False,
) -> tuple[Result, ...]:
    """Check each clause on a plugin. Never raises, whatever the plugin does.

    `addresses` are those of two devices of one driver and of a stranger; None: see `addresses_of`.
    `options` are those that it is checked with; (): each of `variants`. `brief`: a sample of the trials of
    each clause is made, as a test that runs often."""
    places = addresses or addresses_of(plugin)
    cases = [Case(plugin, each, seed, places, brief) for each in options or variants(plugin)]
    return tuple(_check(clause, cases) for clause in clauses)


def table(results: Sequence[Result]) -> str:
    """Return the results as text: a line for each clause, and under a failure its counterexample."""
    width = max((len(result.clause) for result in results), default=0)
    lines = []
    for result in results:
        lines.append(f"{result.clause:<{width}}  {result.outcome:<14}  {result.text}")
        if result.outcome == "failed":
            evidence = [*map(shown, result.frames), *map(repr, result.messages)]
            evidence.append(f"again with seed {result.seed}")
            lines += [f"{'':<{width}}  {'':<14}    {item}" for item in evidence]
    return "\n".join(lines)


def _check(clause: Clause, cases: Sequence[Case]) -> Result:
    """Return the first failure in any case; else "passed" if the clause applies to one of them."""
    reasons: list[str] = []
    checked = 0
    for case in cases:
        try:
            if not _matters(clause, case, cases):
                continue
            checked += 1
            clause.check(case)
        except Inapplicable as inapplicable:
            reasons.append(str(inapplicable))
        except Exception as error:  # noqa: BLE001 -- a third party's plugin may raise anything, anywhere
            failure = error if isinstance(error, Failure) else Failure(_raised(error))
            text = failure.text if case is cases[0] else f"{failure.text} [{case.options}]"
            return Result(clause.name, "failed", text, case.seed, failure.frames, failure.messages)
    if len(reasons) == checked:
        reason = reasons[0] if reasons else "none of these options matters to it"
        return Result(clause.name, "not applicable", reason, cases[0].seed)
    return Result(clause.name, "passed", clause.text, cases[0].seed)


def _matters(clause: Clause, case: Case, cases: Sequence[Case]) -> bool:
    """True if a clause is checked with these options."""
    usual, number = cases[0], crc32(f"{clause.name} {case.options}".encode()) + case.seed
    if case.whole or number % max(SELDOM, len(cases)) == 0:
        return True
    if "numbers" in clause.topics and case.counts_otherwise(usual):
        return True
    return "conversation" in clause.topics and case.converses_otherwise(usual)


def _raised(error: Exception) -> str:
    trace = error.__traceback__
    while trace and trace.tb_next:
        trace = trace.tb_next
    where = f"{trace.tb_frame.f_code.co_qualname}, line {trace.tb_lineno}" if trace else "?"
    return f"the plugin raises {type(error).__name__}: {error} ({where})"
