"""What a busy machine does to a run, and what helps: figures for docs/real-time.md.

    python -m benchmarks.busy stop [--busy 20]        a robot of twins with its page: pace, and time to stop
    python -m benchmarks.busy realtime [--busy 8]     ticks missed on real buses, without and with --realtime

Rules. Busy processes only count, at ordinary priority. The gateway runs as a user starts it. A stop is timed
by a page: from asking for it until the page is shown that it is in force. For missed ticks the devices are a
process of their own (`gateway twin`), always with real-time priority: what is measured is the host alone.
"""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gateway.core.clock import WallClock
from gateway.view import parse_address
from protocols.messages import MILLISECOND, SECOND, Nanos
from tests.gateway.processes import Process
from tests.gateway.view.clients import Browser

PATIENCE = 120.0
"""s"""


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep so many processes counting while inside."""
    made = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for one in made:
            one.kill()
        for one in made:
            one.wait()


class Page:
    """A page of a run, and the time that it takes to be shown something."""

    def __init__(self, url: str) -> None:
        self.clock = WallClock()
        self.browser = Browser(parse_address(url.partition("//")[2].partition("/")[0]))

    def until(self, what: Callable[[dict[str, Any]], bool]) -> Nanos:
        """Return how long it took until a state was shown of which something is true."""
        began, seen = self.clock.now(), len(self.browser.of("state"))
        while not any(what(one) for one in self.browser.of("state")[seen:]):
            self.browser.poll()
            self.clock.wait(self.clock.now() + MILLISECOND)
            assert self.clock.now() - began < PATIENCE * SECOND, self.browser.of("state")[-1]
        return self.clock.now() - began

    def ask(self, line: str) -> None:
        """Ask for something."""
        self.browser.send({"ask": line})
        self.browser.poll()


def stop(count: int, seconds: float) -> None:
    """Print the pace of the demo's robot beside busy processes, and how long each stop took."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        arguments = ("run", "diffbot", "--view", "127.0.0.1:0", "--steer")
        demo = stack.enter_context(Process(Path(folder), *arguments))
        url = re.search(r"http://\S+", demo.until("live view: http", seconds=PATIENCE))
        assert url is not None
        stack.enter_context(busy(count))
        began, page = WallClock(), Page(url[0])
        shown = page.until(lambda _: True)
        took: list[Nanos] = []
        while began.now() < seconds * SECOND and len(took) < 20:
            page.ask("goal 3 0.5")
            page.until(lambda state: abs((state["twist"] or [0.0])[0] or 0.0) > 0.02)
            page.ask("stop")
            took.append(page.until(lambda state: state["stop"]))
            page.ask("release")
            page.until(lambda state: not state["stop"])
            demo.look()
        state = page.browser.of("state")[-1]
        page.browser.close()
        print(f"{count} busy processes: shown after {shown / SECOND:.2f} s; {state['ticks']} ticks,")
        print(f"{state['t']:.1f} s of the world in {began.now() / SECOND:.1f} s, pace {state['pace']},")
        print(f"longest step {state['longest']:.0f} ms")
        times = sorted(t / MILLISECOND for t in took)
        print(f"{len(took)} stops: median {times[len(times) // 2]:.0f} ms, longest {times[-1]:.0f} ms")
        demo.end(signal.SIGTERM)


def realtime(count: int, seconds: float) -> None:
    """Print what a run on the devices of another process missed beside busy processes, without and with
    --realtime."""
    with TemporaryDirectory() as folder, ExitStack() as stack:
        devices = stack.enter_context(Process(Path(folder), "twin", "diffbot", "--realtime=50"))
        line = re.search(r"(?m)^  gateway (run .*)$", devices.until("gateway run "))
        assert line is not None
        stack.enter_context(busy(count))
        for how in ([], ["--realtime"]):
            arguments = [*line[1].split(), "--goal", "3,0.5", "--seconds", f"{seconds}", *how]
            with Process(Path(folder), *arguments) as host:
                text = host.end()[1]
            print(f"{count} busy processes, {' '.join(how) or 'without'}:")
            print("\n".join(one for one in text.splitlines() if re.search("ticks|fault|lost|stopped", one)))
        print(devices.end(signal.SIGTERM)[1].splitlines()[-1])


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(prog="benchmarks.busy")
    parser.add_argument("what", choices=["stop", "realtime"])
    parser.add_argument("--busy", type=int)
    parser.add_argument("--seconds", type=float)
    options = parser.parse_args()
    measure, count, seconds = (stop, 20, 30.0) if options.what == "stop" else (realtime, 8, 3.0)
    measure(options.busy or count, options.seconds or seconds)


if __name__ == "__main__":
    main()
