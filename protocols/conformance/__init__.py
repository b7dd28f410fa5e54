"""The contract that every plugin must pass. Ships with the interface; needs no pytest.

    from protocols.conformance import check, table
    results = check(plugin)
    print(table(results))

Rules. A clause is a function; a failure is a value with the shortest bytes and words that show it, and
comes again with the same seed. The kit knows a plugin only through `protocols.plugin`: it builds devices
named alpha, beta and stranger at the addresses 1, 2 and 3 (or those given), with the plugin's default
settings, once with its default options and once for each other value of an option that is a Literal or
a bool. Driver and twins then talk in virtual time, with a simple shaft, over a wire on which nothing goes
wrong unless a clause says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from protocols.conformance.answers import requests_are_answered
from protocols.conformance.bench import ADDRESSES
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, shown, variants
from protocols.conformance.checksums import bad_checksums_change_nothing
from protocols.conformance.dropped import dropped_commands_are_repeated
from protocols.conformance.duplicates import duplicate_address_is_noticed
from protocols.conformance.faults import faults_latch
from protocols.conformance.normal import only_normal_numbers
from protocols.conformance.obeyed import decoder_and_twin_agree
from protocols.conformance.passivity import (
    nothing_non_finite,
    only_declared_frames,
    strangers_change_nothing,
    uncommanded_is_read_only,
)
from protocols.conformance.reference_vectors import motion_is_in_reference_vectors
from protocols.conformance.replies import one_stalls_no_other
from protocols.conformance.roundtrip import commands_survive, measurements_survive
from protocols.conformance.safety import begins_where_it_is, idle_disarms
from protocols.conformance.silence import silence_loses_feedback
from protocols.conformance.state import copies_go_on, same_in_same_out
from protocols.conformance.takeover import load_is_held, scan_only_looks
from protocols.conformance.traffic import frames_are_counted, no_bytes_raise, streams_may_be_cut
from protocols.conformance.watchdog import silence_trips
from protocols.frames import Frame
from protocols.messages import Message
from protocols.plugin import Plugin

__all__ = ["CLAUSES", "Clause", "Outcome", "Result", "check", "table", "variants"]


@dataclass(frozen=True, slots=True)
class Clause:
    """One promise of the contract."""

    name: str
    text: str
    """The promise in a sentence."""
    check: Callable[[Case], Verdict]


CLAUSES: tuple[Clause, ...] = (
    Clause("commands", "commands survive the wire within the declared resolution", commands_survive),
    Clause(
        "measurements", "measurements survive the wire, of the right device and time", measurements_survive
    ),
    Clause("bytes", "no bytes raise, at either end", no_bytes_raise),
    Clause(
        "counts", "every wire is counted once; what is not understood changes nothing", frames_are_counted
    ),
    Clause("streams", "a serial stream may be cut anywhere", streams_may_be_cut),
    Clause("strangers", "foreign traffic is counted and changes nothing", strangers_change_nothing),
    Clause("unclaimed", "until commanded, only read-only wires go out", uncommanded_is_read_only),
    Clause("declared", "nothing is said outside the declared kinds and ids of wires", only_declared_frames),
    Clause("finite", "what is not finite or out of range passes neither down nor up", nothing_non_finite),
    Clause("repeatable", "the same inputs give the same outputs, in the same order", same_in_same_out),
    Clause("copies", "a copy made between any two calls goes on the same", copies_go_on),
    Clause("jump", "the first command after arming equals the measured position", begins_where_it_is),
    Clause("disarm", "Idle and the words of a stop disarm from every state", idle_disarms),
    Clause("watchdog", "silence of the host trips the watchdog and is told; commands feed it", silence_trips),
    Clause(
        "blind",
        "a silent device is told to be offline in time, and nothing is made up",
        silence_loses_feedback,
    ),
    Clause("faults", "faults are told with their text, latch, and go by ClearFault alone", faults_latch),
    Clause("attach", "a fresh driver takes a device over without dropping its load", load_is_held),
    Clause("scan", "discovery finds the devices, and neither enables nor clears", scan_only_looks),
    Clause("dropped", "what the bus dropped when it was full is said again", dropped_commands_are_repeated),
    Clause("normal", "−0.0 and denormals are said and told as 0.0", only_normal_numbers),
    Clause("checksums", "a message in which a bit is wrong changes nothing", bad_checksums_change_nothing),
    Clause("obeyed", "the device does what its ear hears, and nothing else", decoder_and_twin_agree),
    Clause("twice", "an address that two devices hold is noticed", duplicate_address_is_noticed),
    Clause("replies", "a reply lost, late, doubled or out of order stalls nobody else", one_stalls_no_other),
    Clause(
        "vectors", "each message that moves a motor has an independent vector", motion_is_in_reference_vectors
    ),
    Clause("answers", "each request has one answer; what is told and heard is whole", requests_are_answered),
)

Outcome = Literal["passed", "failed", "not applicable"]


@dataclass(frozen=True, slots=True)
class Result:
    """What a clause found."""

    clause: str
    outcome: Outcome
    text: str
    """The promise, or what is wrong, or why it does not apply."""
    seed: int
    """With which it comes again."""
    frames: tuple[Frame, ...] = ()
    words: tuple[Message, ...] = ()
    """The counterexample."""


def check(
    plugin: Plugin,
    seed: int = 0,
    addresses: tuple[int, int, int] = ADDRESSES,
    clauses: Sequence[Clause] = CLAUSES,
) -> tuple[Result, ...]:
    """What each clause finds in a plugin. Never raises, whatever the plugin does.

    `addresses` are those of two devices of one driver and of a stranger, for a language that cannot
    have 1, 2 and 3."""
    cases = [Case(plugin, options, seed, addresses) for options in variants(plugin)]
    return tuple(_judge(clause, cases) for clause in clauses)


def table(results: Sequence[Result]) -> str:
    """The results as text: a line for each clause, and under a failure what shows it."""
    width = max((len(result.clause) for result in results), default=0)
    lines = []
    for result in results:
        lines.append(f"{result.clause:<{width}}  {result.outcome:<14}  {result.text}")
        if result.outcome == "failed":
            evidence = [
                *map(shown, result.frames),
                *map(repr, result.words),
                f"again with seed {result.seed}",
            ]
            lines += [f"{'':<{width}}  {'':<14}    {item}" for item in evidence]
    return "\n".join(lines)


def _judge(clause: Clause, cases: Sequence[Case]) -> Result:
    """The first failure in any case; else passed if it applies to one of them."""
    reasons: list[str] = []
    for case in cases:
        verdict = _verdict(clause, case)
        if isinstance(verdict, Failure):
            text = f"{verdict.text} [{case.options}]" if case is not cases[0] else verdict.text
            return Result(clause.name, "failed", text, case.seed, verdict.frames, verdict.words)
        if isinstance(verdict, Inapplicable):
            reasons.append(verdict.reason)
    if len(reasons) == len(cases):
        return Result(clause.name, "not applicable", reasons[0], cases[0].seed)
    return Result(clause.name, "passed", clause.text, cases[0].seed)


def _verdict(clause: Clause, case: Case) -> Verdict:
    try:
        return clause.check(case)
    except Exception as error:  # noqa: BLE001 -- a third party's plugin may raise anything, anywhere
        trace = error.__traceback__
        while trace and trace.tb_next:
            trace = trace.tb_next
        where = f"{trace.tb_frame.f_code.co_qualname}, line {trace.tb_lineno}" if trace else "?"
        return Failure(f"the plugin raises {type(error).__name__}: {error} ({where})")
