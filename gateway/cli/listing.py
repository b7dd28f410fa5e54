"""The installed device languages, each in a few lines: what a person must know before choosing one.

Rules. Everything is asked of the plugin itself, as it comes: its spec with default options and settings, and
with each other value of an option that chooses (`protocols.conformance.variants`). Nothing stands here by
name. A plugin whose spec does not answer is named, and hinders nobody.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from textwrap import wrap

from protocols.conformance import variants
from protocols.messages import COMMANDS, MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Spec, Watchdog

ADDRESS = 1
"""Of the device that a spec is asked for; every language so far has it."""
WIDTH = 110
LABEL = 11


def listing(plugins: Sequence[Plugin]) -> list[str]:
    """A block of lines for each language, with an empty line between them."""
    blocks = [_block(plugin) for plugin in plugins]
    return [line for block in blocks for line in (*block, "")][:-1]


def _block(plugin: Plugin) -> list[str]:
    lines = [f"{plugin.name}", *_row("devices", plugin.title)]
    try:
        specs = [
            plugin.spec(Device("motor", ADDRESS, options, plugin.settings())) for options in variants(plugin)
        ]
    except Exception as error:  # noqa: BLE001 -- a third party's spec may raise anything
        return [*lines, *_row("spec", f"raises {type(error).__name__}: {error}")]
    lines += _row("bus", _each(spec.bus for spec in specs))
    lines += _row("commands", _commands(specs))
    mixed = len({spec.kind for spec in specs}) > 1
    lines += _row("feedback", _each(_of(spec, _feedback(spec), mixed) for spec in specs))
    first = {spec.kind: spec for spec in reversed(specs)}.values()  # an option may acknowledge that it is off
    lines += _row("watchdog", _each(_of(spec, _watchdog(spec.watchdog), mixed) for spec in first))
    return lines + _row("trust", plugin.trust)


def _row(label: str, text: str) -> list[str]:
    first = f"  {label:<{LABEL - 2}}"
    return wrap(text, WIDTH, initial_indent=first, subsequent_indent=" " * LABEL) or [first.rstrip()]


def _each(answers: Iterable[str]) -> str:
    """What the variants answer, each answer once, in the order of the variants."""
    return "; ".join(dict.fromkeys(answers))


def _of(spec: Spec, answer: str, mixed: bool) -> str:
    """With the kind of device, where a language speaks to motors and to sensors."""
    return f"{spec.kind}: {answer}" if mixed else answer


def _commands(specs: Sequence[Spec]) -> str:
    known = [kind.__name__ for kind in COMMANDS if any(kind in spec.commands for spec in specs)]
    sensors = any(spec.kind == "sensor" for spec in specs)
    return ", ".join(known) + (" (and sensors)" if sensors and known else "" if known else "none: sensors")


def _feedback(spec: Spec) -> str:
    if spec.feedback is FeedbackKind.NONE:
        return "none: open loop"
    return f"{spec.feedback} every {spec.feedback_period / MILLISECOND:g} ms"


def _watchdog(watchdog: Watchdog) -> str:
    if watchdog.enabled and watchdog.timeout is not None:
        return f"{watchdog.timeout / MILLISECOND:g} ms"
    return "off as the device comes" if watchdog.timeout is not None or watchdog.note else "none"
