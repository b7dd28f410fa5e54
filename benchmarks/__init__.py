"""`./go bench [--json FILE] [--quick]`: what this program costs here, beside what else there is.

Rules. All of it is measured in one run. A target that is missed is reported, and no failure; what is not
installed is reported by name; what does not do its work raises.
"""

from __future__ import annotations

import json
import os
from argparse import Namespace
from collections.abc import Callable, Mapping

from benchmarks.measure import Effort, preemptions
from benchmarks.rows import Row, document, text


def bench(options: Namespace) -> int:
    """Measure everything, print the table, write the JSON document if one is asked for.

    Always returns 0. Raises OSError for a file that cannot be written, NotMeasured where something did not
    do its work."""
    from gateway.cli.terminal import progress
    from gateway.core.clock import stopwatch
    from gateway.recording import environment
    from protocols.messages import SECOND

    if options.json is not None:
        options.json.open("a").close()  # report now, not in two minutes, that it cannot be written
    effort = Effort(options.quick)
    began, before = stopwatch(), preemptions()
    rows = list[Row]()
    for done, (name, part) in enumerate(parts().items()):
        how_far = progress.text("parts", done, len(parts()), (stopwatch() - began) / SECOND)
        print(f"measuring: {name} … ({how_far})", flush=True)
        rows += part(effort)
    facts = environment.facts() | {
        "load average": " ".join(f"{load:.1f}" for load in os.getloadavg()),
        "processors": str(os.cpu_count()),
        "preemptions": str(preemptions() - before),
        "seconds": f"{(stopwatch() - began) / SECOND:.0f}",
    }
    print(head(facts, quick=options.quick))
    print(text(rows))
    if options.json is not None:
        made = document(rows, facts, quick=options.quick)
        options.json.write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return 0


def parts() -> dict[str, Callable[[Effort], list[Row]]]:
    """What is measured, in order. Processes first, while this one is still small."""
    from benchmarks.arms import arms
    from benchmarks.bridge import bridge
    from benchmarks.cars import cars
    from benchmarks.codec import codec
    from benchmarks.drive import driving
    from benchmarks.drivers import drivers
    from benchmarks.latency import latency
    from benchmarks.lines import lines
    from benchmarks.loops import loops
    from benchmarks.paths import paths
    from benchmarks.perceive import perceive
    from benchmarks.plans import plans
    from benchmarks.process import processes
    from benchmarks.steps import steps
    from benchmarks.view import view

    return {
        "start-up and memory": processes,
        "steps": steps,
        "loops": loops,
        "latency": latency,
        "drivers": drivers,
        "codec": codec,
        "an adapter": bridge,
        "a noisy line": lines,
        "filter and map": perceive,
        "paths": paths,
        "plans": plans,
        "a car": cars,
        "arms": arms,
        "a drive": driving,
        "the live view": view,
    }


def head(facts: Mapping[str, str], *, quick: bool) -> str:
    """What the figures were measured on, in a few lines."""
    python, load = facts["python"].split()[0], facts["load average"]
    processor = facts.get("processor model name", facts["machine"])
    packages = ", ".join(
        f"{name} {facts[f'package {name}']}" for name in ("numpy", "filterpy") if f"package {name}" in facts
    )
    return "\n".join(
        [
            "",
            f"{processor}, {facts['processors']} processors, {facts['platform']}",
            f"Python {python}, {packages}, BLAS {facts['numpy blas']}",
            f"load average {load}; preempted {facts['preemptions']} times in {facts['seconds']} s",
            *(["--quick: these figures are rough"] if quick else []),
            "ratio: theirs by ours. Above 1, ours is quicker, smaller, or fits that many times into a tick.",
            "",
        ]
    )
