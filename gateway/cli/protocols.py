"""`gateway protocols`: list the installed protocols, check them against the contract, or start a new one.

Rules. Everything is read from the plugin itself: its spec with default options and settings, and with each
other value of an option that is a choice (`protocols.conformance.variants`). No protocol is known here by
name. A plugin whose spec raises is named, and affects no other.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from textwrap import wrap

from gateway.cli import arguments, scaffold
from gateway.errors import ProtocolNotFound
from protocols.conformance import addresses_of, check, table, variants
from protocols.messages import COMMANDS, MILLISECOND
from protocols.plugin import (
    Broken,
    Device,
    FeedbackKind,
    Plugin,
    Spec,
    UnknownProtocol,
    Watchdog,
    load,
    load_all,
)

WIDTH = 110
LABEL_WIDTH = 11


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    what = parser.add_subparsers(dest="what", metavar="check | new")
    text = "run the contract on protocols, and print the result of each clause"
    check_parser = what.add_parser("check", help=text, description=f"{text.capitalize()}.")
    arguments.add_verbosity(check_parser)
    check_parser.add_argument(
        "names", nargs="*", metavar="NAME", help="protocols to check (default: every installed one)"
    )
    check_parser.add_argument(
        "--seed",
        type=arguments.integer("a number from 0 to 2**63 - 1", 0, 2**63 - 1),
        default=0,
        metavar="N",
        help="seed of the contract's samples (default: 0)",
    )
    text = "write a folder with a complete plugin for an invented device, to be filled in"
    new = what.add_parser("new", help=text, description=f"{text.capitalize()}.")
    arguments.add_verbosity(new)
    new.add_argument("name", metavar="NAME", help="name of the protocol in robot files: my_motor")
    kind = new.add_mutually_exclusive_group(required=True)
    kind.add_argument("--bus", choices=scaffold.BUSES, help="a motor's, on this kind of bus")
    text = "that of a sensor that streams on a serial line of its own"
    kind.add_argument("--sensor", dest="bus", action="store_const", const="sensor", help=text)
    new.add_argument(
        "--into",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="where the folder NAME is made (default: here)",
    )


def run(options: Namespace) -> int:
    """Return 1 if an installed protocol is broken, or does not keep the contract."""
    if options.what == "check":
        return _check(options)
    if options.what == "new":
        print(scaffold.next_steps(scaffold.new(options.name, options.bus, options.into)))
        return 0
    plugins, broken = load_all()
    print("\n".join(listing(plugins)))
    _print_broken(broken)
    return 1 if broken else 0


def _print_broken(broken: Sequence[Broken]) -> None:
    for one in broken:
        print(f"{one.name}: left out: {one.distribution} is broken: {one.reason}", file=sys.stderr)


# -- the contract -----------------------------------------------------------------------------------


def _check(options: Namespace) -> int:
    broken: tuple[Broken, ...] = ()
    try:
        plugins = tuple(load(name) for name in dict.fromkeys(options.names))
    except UnknownProtocol as error:
        raise ProtocolNotFound(str(error)) from error
    if not plugins:
        plugins, broken = load_all()
    passed = [_keeps_contract(plugin, options.seed, failures_only=options.quiet > 0) for plugin in plugins]
    if len(plugins) + len(broken) > 1:
        print(f"{sum(passed)} of {len(plugins) + len(broken)} protocols keep the contract")
    _print_broken(broken)
    return 0 if all(passed) and not broken else 1


def _keeps_contract(plugin: Plugin, seed: int, *, failures_only: bool) -> bool:
    """Print the contract's results for a plugin as soon as they are known; True if no clause failed."""
    heading = f"{plugin.name}: {plugin.title}"
    print(f"{heading}\n{'-' * min(len(heading), WIDTH)}", flush=True)
    results = check(plugin, seed)
    shown = [result for result in results if result.outcome == "failed" or not failures_only]
    if shown:
        print(table(shown))
    counts = Counter(result.outcome for result in results)
    summary = (
        f"{counts['passed']} passed, {counts['failed']} failed, {counts['not applicable']} not applicable"
    )
    print(f"{plugin.name}: {summary} (seed {seed})\n", flush=True)
    return not counts["failed"]


# -- the list ---------------------------------------------------------------------------------------


def listing(plugins: Sequence[Plugin]) -> list[str]:
    """Return a block of lines for each protocol, separated by empty lines."""
    blocks = [_block(plugin) for plugin in plugins]
    return [line for block in blocks for line in (*block, "")][:-1]


def _block(plugin: Plugin) -> list[str]:
    lines = [plugin.name, *_row("devices", plugin.title)]
    try:
        specs = [
            plugin.spec(Device("motor", addresses_of(plugin)[0], options, plugin.settings()))
            for options in variants(plugin)
        ]
    except Exception as error:  # noqa: BLE001 -- a third party's spec may raise anything
        return [*lines, *_row("spec", f"raises {type(error).__name__}: {error}")]
    mixed = len({spec.kind for spec in specs}) > 1

    def of_kind(spec: Spec, text: str) -> str:
        return f"{spec.kind}: {text}" if mixed else text

    first = {spec.kind: spec for spec in reversed(specs)}.values()  # another may acknowledge that it is off
    lines += _row("bus", _distinct(spec.bus for spec in specs))
    lines += _row("commands", _commands(specs))
    lines += _row("feedback", _distinct(of_kind(spec, _feedback(spec)) for spec in specs))
    lines += _row("watchdog", _distinct(of_kind(spec, _watchdog(spec.watchdog)) for spec in first))
    return lines + _row("trust", plugin.trust)


def _row(label: str, text: str) -> list[str]:
    first = f"  {label:<{LABEL_WIDTH - 2}}"
    indent = " " * LABEL_WIDTH
    lines = wrap(text, WIDTH, initial_indent=first, subsequent_indent=indent, break_on_hyphens=False)
    return lines or [first.rstrip()]


def _distinct(texts: Iterable[str]) -> str:
    """Return the texts of the variants, each once, in their order."""
    return "; ".join(dict.fromkeys(texts))


def _commands(specs: Sequence[Spec]) -> str:
    known = [kind.__name__ for kind in COMMANDS if any(kind in spec.commands for spec in specs)]
    if not known:
        return "none: sensors"
    sensors = any(spec.kind == "sensor" for spec in specs)
    return f"{', '.join(known)}{' (and sensors)' if sensors else ''}"


def _feedback(spec: Spec) -> str:
    if spec.feedback is FeedbackKind.NONE:
        return "none: open loop"
    return f"{spec.feedback} every {spec.feedback_period / MILLISECOND:g} ms"


def _watchdog(watchdog: Watchdog) -> str:
    if watchdog.enabled and watchdog.timeout is not None:
        return f"{watchdog.timeout / MILLISECOND:g} ms"
    return "off as the device comes" if watchdog.timeout is not None or watchdog.note else "none"
