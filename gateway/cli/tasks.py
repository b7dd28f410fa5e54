"""Many independent commands, each in a process of its own, here or on the workers of a dask cluster.

Rules. A task is a `gateway` command that writes its result as JSON. Results come in the order of the tasks,
whoever made them and however often: so every engine gives the same table. A worker must have the very sources
that ask it. One whose worker dies is given to another; one that dies of itself is that task's error.
"""

from __future__ import annotations

import platform
import re
import subprocess
import sys
import tempfile
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from gateway.errors import UserError
from gateway.recording.environment import sources

Result: TypeAlias = tuple[str, str]
"""JSON, or "" and why there is none"""
RETRIES = 5
"""How often a task is given to another worker"""
WAIT = 30
"""s that a scheduler may take to answer"""


@dataclass(frozen=True, slots=True)
class Engine:
    """Who does the tasks."""

    jobs: int = 1
    """Processes of this machine,"""
    dask: str = ""
    """or the scheduler of a cluster: "tcp://10.0.0.1:8786\""""


def add_engine(parser: ArgumentParser) -> None:
    """Add --jobs and --engine."""
    text = "how many side by side, each in a process of its own (default: 1)"
    parser.add_argument("--jobs", type=_jobs, dest="engine", default=Engine(), metavar="N", help=text)
    text = "on the workers of a cluster of dask.distributed (extra dask), with the same sources and files"
    parser.add_argument("--engine", type=_engine, default=Engine(), metavar="dask:ADDRESS", help=text)


def _jobs(text: str) -> Engine:
    if not re.fullmatch("[1-9][0-9]?", text):
        raise ArgumentTypeError(f"{text!r} is not a number from 1 to 99")
    return Engine(int(text))


def _engine(text: str) -> Engine:
    kind, _, address = text.partition(":")
    if kind != "dask" or not re.fullmatch(r"(?:\w+://)?[\w.\[\]:-]+:\d+", address):
        raise ArgumentTypeError(f"{text!r} is not dask:ADDRESS, such as dask:tcp://10.0.0.1:8786")
    return Engine(dask=address)


def run_tasks(tasks: Sequence[Sequence[str]], engine: Engine) -> Iterator[Result]:
    """Yield the result of each task, in their order. Raises UserError if nobody can do them."""
    return _on_cluster(tasks, engine.dask) if engine.dask else _side_by_side(tasks, engine.jobs)


def _side_by_side(tasks: Sequence[Sequence[str]], jobs: int) -> Iterator[Result]:
    with tempfile.TemporaryDirectory() as folder:
        waiting = [(task, Path(folder, f"{number}.json")) for number, task in enumerate(tasks)]
        running: list[tuple[Path, subprocess.Popen[str]]] = []
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    task, file = waiting.pop(0)
                    running.append((file, _started(task, file)))
                file, process = running.pop(0)
                yield _result(file, process)
                file.unlink(missing_ok=True)
        finally:
            for _, process in running:
                process.kill()


def _started(task: Sequence[str], file: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-P", "-m", "gateway", *task, "--json", str(file)]
    nothing = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=subprocess.PIPE, text=True)


def _result(file: Path, process: subprocess.Popen[str]) -> Result:
    wrong = process.communicate()[1].strip().rpartition("\n")[2]
    if file.exists():
        return file.read_text(), ""
    return "", f"its process ended with status {process.returncode}: {wrong}"


def done_here(task: Sequence[str], version: str) -> Result:
    """Do one task on this machine, as a worker does; none for a program of other sources than these."""
    if sources() != version:
        return "", f"{platform.node()}: another version of this program's sources than here"
    (result,) = _side_by_side([task], 1)
    return result


def _on_cluster(tasks: Sequence[Sequence[str]], address: str) -> Iterator[Result]:
    try:
        from distributed import Client
    except ImportError as error:
        raise UserError('--engine dask needs the extra "dask": pip install "motor-gateway[dask]"') from error
    try:
        client: Any = Client(address, timeout=WAIT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UserError(f"no scheduler of dask answers at {address} within {WAIT} s: {error}") from error
    with client:
        if not client.scheduler_info()["workers"]:
            raise UserError(f"{address}: its cluster has no worker")
        futures = client.map(done_here, tasks, version=sources(), pure=False, retries=RETRIES)
        for future in futures:
            yield future.result()
