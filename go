#!/usr/bin/env python3
"""Set-up and every command of motor-gateway.

    ./go demo [...]      drive the demo robot through its office
    ./go test            every check: lint, format, types, layers, docs, tests, and those on a real CAN
    ./go test ...        the same without the real CAN; the arguments go to pytest
    ./go prove [...]     the long campaigns; the arguments go to pytest
    ./go bench [...]     measure speed and memory beside what else there is (--quick, --json FILE)
    ./go docs            build the site of docs/ and the API in out/site
    ./go lock [...]      make requirements.lock anew (needs uv and a network); the arguments go to uv
    ./go COMMAND [...]   run, replay, check, protocols ...: the `gateway` command

Each of them first makes the environment `.venv` in this folder, or renews it if the lock has changed:
test, prove, bench and docs with all that judges the program, the others with what it needs to run.

Rules of this file: the standard library alone, and syntax that Python 3.6 can read, so that an old
Python prints what is missing instead of a traceback. ASCII only, for terminals without a locale.
"""

import fcntl
import hashlib
import os
import re
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Callable, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple

ROOT = Path(__file__).resolve().parent
LOCK = ROOT / "requirements.lock"
PROJECT = ROOT / "pyproject.toml"
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMP = VENV / "set-up-from"
ABSENT = VENV / "not-run"

OLDEST = (3, 11)
NEWEST = (3, 13)
"""The lock is tested from OLDEST to NEWEST; a newer Python is used only if it is all there is."""

LOCK_HEADER = """\
# Every dependency with its hashes, for Python 3.11 to 3.13 on x86-64 and aarch64.
# Made from pyproject.toml by `./go lock`; not edited by hand.
"""

# fmt: off
BREAKING = frozenset([
    "PYTHONPATH", "PYTHONHOME",
    "PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_USER", "PIP_PYTHON", "PIP_DRY_RUN", "PIP_REPORT",
    "PIP_IGNORE_INSTALLED", "PIP_REQUIREMENT", "PIP_CONSTRAINT", "PIP_EDITABLE", "PIP_NO_DEPS",
    "PIP_NO_BINARY",
    "UV_SYSTEM_PYTHON", "UV_PYTHON", "UV_CONSTRAINT", "UV_OVERRIDE", "UV_NO_BINARY", "UV_ENV_FILE",
])
# fmt: on
"""Variables that change what is imported or what is installed where. Where packages come from stays."""

TOOLS = (
    ("ruff check", ["-m", "ruff", "check", "."]),
    ("ruff format", ["-m", "ruff", "format", "--check", "."]),
    ("mypy --strict", ["-m", "mypy"]),
    ("import-linter", ["-c", "from importlinter.cli import lint_imports_command as run; run()"]),
)
DOCS = ["-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", "out/site"]
PYTEST = ["-m", "pytest", "-n", "3", "--dist", "loadfile", "--no-loadscope-reorder"]
"""One worker more than cores: some tests wait for processes and pages. The order is tests/conftest.py's."""

REAL_CAN = ["-m", "tests.real_can"]
"""The tests of a real CAN; the file named next gets what of them could not run, and why."""
REQUIRE = "MOTOR_GATEWAY_REQUIRE"
"""Names of what must not be left out: "real-can"; and for the tests "data", "foxglove", "browser",
"ros"."""
PROGRESS_PERIOD = 10.0
"""Seconds between two lines of progress where the output is no terminal."""


class Missing(Exception):
    """What is missing for the set-up, in one line, and the last lines of the tool that found out."""

    def __init__(self, line: str, output: str = "") -> None:
        super().__init__(line)
        self.tail = output.strip().splitlines()[-8:]


def report(line: str) -> None:
    """Print a line for the user, apart from what the command itself prints."""
    print("./go: " + line, file=sys.stderr, flush=True)


class Progress:
    """A line that shows what the set-up does and for how long: redrawn on a terminal, else printed anew."""

    def __init__(self, step: str, stream: Optional[IO[str]] = None) -> None:
        self.step = step
        self._stream = stream or sys.stderr
        self._began = self._shown = time.monotonic()
        self._terminal = self._stream.isatty()
        self._write(step)

    def update(self) -> None:
        """Show the step and its time, if it is time to."""
        now = time.monotonic()
        if now - self._shown >= (0.5 if self._terminal else PROGRESS_PERIOD):
            self._shown = now
            self._write("%s, %.0f s" % (self.step, now - self._began))

    def end(self) -> None:
        """Leave the terminal's line."""
        if self._terminal:
            print("\r\033[K", end="", file=self._stream, flush=True)

    def _write(self, text: str) -> None:
        head, tail = ("\r\033[K", "") if self._terminal else ("", "\n")
        print("%s./go: %s ..." % (head, text), end=tail, file=self._stream, flush=True)


def dotted(version: Sequence[int]) -> str:
    """A version as people write it."""
    return ".".join(str(part) for part in version)


# -- which Python -------------------------------------------------------------------------------


def version_of(python: str) -> Optional[Tuple[int, int]]:
    """Return the (major, minor) of an interpreter; None if it does not run."""
    ask = [python, "-c", "import sys; print(sys.version_info[0], sys.version_info[1])"]
    try:
        done = subprocess.run(ask, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    major, minor = done.stdout.split()
    return int(major), int(minor)


def choose(
    running: str,
    version: Tuple[int, int],
    which: Callable[[str], Optional[str]],
    ask: Callable[[str], Optional[Tuple[int, int]]],
) -> Optional[str]:
    """The interpreter to build with: the running one if the lock is tested on it, else one on the path."""
    if OLDEST <= version <= NEWEST:
        return running
    for minor in range(NEWEST[1], OLDEST[1] - 1, -1):
        path = which("python3.%d" % minor)
        if path and ask(path) == (3, minor):
            return path
    return running if version > NEWEST else None


def base_python() -> str:
    """The running interpreter, outside any virtual environment it may belong to."""
    inside = sys.prefix != sys.base_prefix
    return str(Path(sys.executable).resolve()) if inside else sys.executable


# -- the environment ----------------------------------------------------------------------------


def clean(environ: Mapping[str, str]) -> Dict[str, str]:
    """The environment for everything we start: nothing that breaks it, and one BLAS thread.

    One thread, because sums split over threads differ in their last bits from machine to machine."""
    kept = {name: value for name, value in environ.items() if name not in BREAKING}
    kept.setdefault("OPENBLAS_NUM_THREADS", "1")
    return kept


def wanted(root: Path, *sources: bytes) -> str:
    """What an environment was made from, as one word: the place and the content of its sources."""
    digest = hashlib.sha256(str(root).encode())
    for source in sources:
        digest.update(hashlib.sha256(source).digest())
    return digest.hexdigest()


def stamp(lock: str) -> str:
    """The stamp of an environment that is up to date with these packages."""
    return wanted(ROOT, lock.encode(), PROJECT.read_bytes())


def ready(*locks: str) -> bool:
    """Whether the environment stands, finished, and is made from the present project and one of these."""
    return PYTHON.exists() and STAMP.is_file() and STAMP.read_text() in [stamp(lock) for lock in locks]


def to_run(project: str, lock: str) -> str:
    """The part of the lock that the program with all its extras but "dev" needs, by the lock's comments."""
    head, *entries = re.split(r"(?m)^(?=[A-Za-z0-9])", lock)
    used = {entry: set(re.findall(r"(?m)^ +#(?: via)? +([A-Za-z0-9._-]+)", entry)) for entry in entries}
    declared = re.sub(r"(?ms)^dev = \[$.*?^\]$", "", project)
    needed = {re.sub("[-_.]+", "-", name).lower() for name in re.findall(r'"([\w.-]+)[<>=~]=?', declared)}
    kept: List[str] = []
    while True:
        more = [e for e in entries if e not in kept and (e.split("==")[0] in needed or used[e] & needed)]
        if not more:
            return head + "".join(entry for entry in entries if entry in kept)
        kept += more
        needed.update(entry.split("==")[0] for entry in more)


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """One set-up at a time in this folder; a second one waits and then finds it done."""
    folder = os.open(str(ROOT), os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def run(command: Sequence[str], failure: str, step: str = "") -> None:
    """Run a tool of the set-up and show its progress under the name `step`. Raises Missing if it fails."""
    output = []
    try:
        with subprocess.Popen(
            command,
            cwd=str(ROOT),
            env=clean(os.environ),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        ) as process:
            progress = Progress(step) if step else None
            collected = 0
            for line in lines_of(process.stdout) if process.stdout else ():
                if line:
                    output.append(line)
                    collected += line.startswith("Collecting ")
                if progress and line and collected:
                    installing = line.startswith("Installing")
                    progress.step = "%s: %s" % (
                        step,
                        "writing them" if installing else "%d fetched" % collected,
                    )
                if progress:
                    progress.update()
            if progress:
                progress.end()
    except OSError as error:
        raise Missing(failure, str(error)) from None
    if process.returncode != 0:
        raise Missing(failure, "\n".join(output))


def lines_of(stream: IO[bytes]) -> Iterator[str]:
    """Yield the lines of a pipe as they come, and "" whenever none came for a while."""
    rest = b""
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while True:
            if not selector.select(0.5):
                yield ""
                continue
            data = os.read(stream.fileno(), 65536)
            if not data:
                break
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                yield line.decode("utf-8", "replace") or " "
    if rest:
        yield rest.decode("utf-8", "replace")


def works(*arguments: str) -> bool:
    """Whether the environment's Python is new enough and runs these arguments."""
    version = version_of(str(PYTHON)) if PYTHON.exists() else None
    if version is None or version < OLDEST:
        return False
    try:
        run([str(PYTHON), *arguments], "")
    except Missing:
        return False
    return True


def install_with_uv(uv: str, python: Optional[str], lock: Path) -> None:
    """Make or repair the environment with uv, which can also bring a Python of its own."""
    if not works("-c", ""):
        name = python or ">=%s,<%s" % (dotted(OLDEST), dotted((NEWEST[0], NEWEST[1] + 1)))
        run([uv, "venv", "--clear", "--python", name, str(VENV)], "uv could not make .venv")
    install = [uv, "pip", "install", "--python", str(PYTHON)]
    failure = "uv could not install the packages (is there a network?)"
    run([*install, "--require-hashes", "-r", str(lock)], failure, installing(lock))
    alone = ["--no-index", "--no-deps", "--no-build-isolation", "--reinstall-package", "motor-gateway"]
    run([*install, *alone, "-e", "."], "uv could not install the project itself", "installing the project")


def install_with_pip(python: Optional[str], lock: Path) -> None:
    """Make or repair the environment with the standard library's venv, and pip."""
    if not works("-m", "pip", "--version"):
        if python is None:
            raise Missing(too_old())
        version = dotted(version_of(python) or OLDEST)
        hint = "apt-get install python%s-venv, or install uv" % version
        run([python, "-c", "import venv, ensurepip"], "Python %s has no venv module: %s" % (version, hint))
        if VENV.exists():
            shutil.rmtree(str(VENV))
        run([python, "-m", "venv", str(VENV)], "venv could not make .venv", "making .venv")
    install = [str(PYTHON), "-m", "pip", "install", "--disable-pip-version-check", "--no-input", "--no-user"]
    install += ["--no-compile"]  # what is imported is compiled then: a tenth of what is there
    failure = "pip could not install the packages (is there a network?)"
    run([*install, "--require-hashes", "-r", str(lock)], failure, installing(lock))
    alone = ["--no-index", "--no-deps", "--no-build-isolation"]
    run([*install, *alone, "-e", "."], "pip could not install the project itself", "installing the project")


def too_old() -> str:
    """Return the sentence for an old Python where there is no newer one, and no uv to bring it."""
    here = dotted(sys.version_info[:3])
    return "Python %s or newer is needed; this is %s (%s)" % (dotted(OLDEST), here, sys.executable)


def installing(lock: Path) -> str:
    """Return what is said while the packages of a lock are installed."""
    return "installing %d packages" % len(re.findall(r"(?m)^[A-Za-z0-9._-]+==", lock.read_text()))


def install(uv: Optional[str], python: Optional[str], lock: Path) -> None:
    """Install with uv where it is on the path, else, or if that fails, with venv and pip."""
    if uv:
        try:
            install_with_uv(uv, python, lock)
        except Missing as missing:
            report("\n    ".join(["%s; trying pip" % missing, *missing.tail]))
        else:
            return
    install_with_pip(python, lock)


def set_up(all_of_it: bool) -> None:
    """Make the environment, unless it is ready, with the whole lock or what the program needs to run. The
    stamp goes first and comes last: a set-up that was interrupted is done again."""
    whole = LOCK.read_text()
    part = whole if all_of_it else to_run(PROJECT.read_text(), whole)
    if ready(whole, part):
        return
    uv = shutil.which("uv")
    python = choose(base_python(), sys.version_info[:2], shutil.which, version_of)
    if python is None and uv is None:
        raise Missing(too_old())
    with one_at_a_time(), tempfile.NamedTemporaryFile("w", suffix=".txt") as lock:
        if ready(whole, part):
            return
        lock.write(part)
        lock.flush()
        began = time.monotonic()
        report("setting up .venv (once, and whenever the lock changes; half a minute to four minutes)")
        if STAMP.exists():
            STAMP.unlink()
        install(uv, python, Path(lock.name))
        STAMP.write_text(stamp(part))
        report("set up in %.0f s" % (time.monotonic() - began))


# -- the commands -------------------------------------------------------------------------------


def python_here(arguments: Sequence[str], output: Optional[IO[Any]] = None) -> "subprocess.Popen[bytes]":
    """Start the environment's Python on this folder."""
    command = [str(PYTHON), *arguments]
    error = subprocess.STDOUT if output else None
    return subprocess.Popen(command, cwd=str(ROOT), env=clean(os.environ), stdout=output, stderr=error)


def test(arguments: Sequence[str]) -> int:
    """Run every check, also after one has failed. Returns 0 only if all passed, and what is required ran.

    The tests of a real CAN keep one core busy and wait much: they run beside the other checks."""
    required = "real-can" in re.split(r"[,\s]+", os.environ.get(REQUIRE, ""))
    if ABSENT.exists():
        ABSENT.unlink()
    failed = False
    summary = []

    def ended(name: str, status: int, began: float) -> bool:
        result = "ok" if status == 0 else "FAILED (exit status %d)" % status
        summary.append("   %-14s %6.1f s  %s" % (name, time.monotonic() - began, result))
        print("== %s: %.1f s, %s" % (name, time.monotonic() - began, result), flush=True)
        return status != 0

    with tempfile.TemporaryFile() as log:
        began = time.monotonic()
        real_can = python_here([*REAL_CAN, str(ABSENT)], log) if not arguments or required else None
        try:
            for name, command in (*TOOLS, ("docs", DOCS), ("pytest", [*PYTEST, *arguments])):
                print("== " + name, flush=True)
                since = time.monotonic()
                failed = ended(name, python_here(command).wait(), since) or failed
            if real_can:
                print("== real CAN (beside the others, since the beginning)", flush=True)
                status = real_can.wait()
                log.seek(0)
                sys.stdout.write(log.read().decode("utf-8", "replace"))
                failed = ended("real CAN", status, began) or failed
        finally:
            if real_can and real_can.poll() is None:
                real_can.terminate()
                real_can.wait()
    for line in ABSENT.read_text().splitlines() if ABSENT.exists() else ():
        failed = failed or required
        summary.append("!! NOT RUN: real CAN: " + line + (" (it is required)" if required else ""))
    print("\n".join(["== ./go test: %.0f s in all" % (time.monotonic() - began), *summary]), flush=True)
    return 1 if failed else 0


def docs(arguments: Sequence[str]) -> int:
    """Build the site. Returns 0 if there was nothing to warn of."""
    status = python_here([*DOCS, *arguments]).wait()
    if status == 0:
        report("the site: %s" % (ROOT / "out" / "site" / "index.html"))
    return status


def prove(arguments: Sequence[str]) -> int:
    """Run the long campaigns. Returns pytest's exit status: to have run none is no success."""
    status = python_here(["-m", "pytest", "-m", "prove", "--timeout", "0", "-v", *arguments]).wait()
    if status == 5:
        report("no campaign matches: nothing was proven")
    return status


def lock(arguments: Sequence[str]) -> int:
    """Make requirements.lock anew, without an index address or a path of this machine in it."""
    uv = shutil.which("uv") or shutil.which("uv", path=str(VENV / "bin"))
    if uv is None:
        raise Missing("uv is needed to make the lock: install it, or `.venv/bin/python -m pip install uv`")
    options = ["--universal", "--python-version", dotted(OLDEST), "--all-extras", "--generate-hashes"]
    silent = ["--no-header", "--no-emit-index-url", "--no-emit-find-links", "--quiet"]
    command = [uv, "pip", "compile", "pyproject.toml", "-o", LOCK.name, *options, *silent, *arguments]
    run(command, "uv could not make the lock")
    text = LOCK.read_text()
    if "://" in text or str(ROOT) in text:
        raise Missing("%s names an address or a path of this machine: not fit to be committed" % LOCK.name)
    LOCK.write_text(LOCK_HEADER + text)
    report("%s made; `./go test` installs it" % LOCK.name)
    return 0


def become(module: str, arguments: Sequence[str]) -> None:
    """Replace this process by a module of the environment: its signals and its exit status are ours."""
    sys.stdout.flush()
    environment = clean(os.environ)
    if module == "benchmarks":  # not installed: it belongs to the checkout
        environment["PYTHONPATH"] = str(ROOT)
    os.execve(str(PYTHON), [str(PYTHON), "-P", "-m", module, *arguments], environment)


def main(arguments: Sequence[str]) -> int:
    """Set up, and run the command that the first word names."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print((__doc__ or "").split("\n\nRules of this file")[0], flush=True)
        return 0
    word, rest = arguments[0], arguments[1:]
    if word == "lock":
        return lock(rest)
    own = {"test": test, "prove": prove, "docs": docs}
    set_up(all_of_it=word in own or word == "bench")
    if word in own:
        return own[word](rest)
    if word == "bench":
        become("benchmarks", rest)
    become("gateway", arguments)
    return 1


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except Missing as missing:
        report("\n    ".join([str(missing), *missing.tail]))
        sys.exit(1)
    except OSError as error:
        report("the set-up failed: %s" % error)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
