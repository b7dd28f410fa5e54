#!/usr/bin/env python3
"""Set-up and every command of motor-gateway.

    ./go demo [...]    drive the demo robot through its office
    ./go test          every check: lint, format, types, layers, tests, and those on a real CAN
    ./go test ...      the same without the real CAN; what follows is handed to pytest
    ./go prove [...]   the long campaigns; what follows is handed to pytest
    ./go lock [...]    make requirements.lock anew (needs uv and a network); what follows is handed to uv
    ./go WORD [...]    run, replay, check, protocols ...: handed to the `gateway` command

Each of them first makes the environment `.venv` in this folder, or renews it if the lock has changed.

Rules of this file: the standard library alone, and syntax that Python 3.6 can read, so that an old
Python says what is missing instead of a traceback. ASCII only, for terminals without a locale.
"""

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Callable, Dict, Iterator, Mapping, Optional, Sequence, Tuple

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
PYTEST = ["-m", "pytest", "-n", "2", "--dist", "loadfile"]

REAL_CAN = ["-m", "tests.real_can"]
"""The tests of a real CAN; what of them could not run, and why, they write to the file that is named next."""
REQUIRE = "MOTOR_GATEWAY_REQUIRE"
"""Names of what must not be left out, in words: "real-can" (and "data", see tests/data)."""


class Missing(Exception):
    """What is missing for the set-up, in one line, and the last words of the tool that found out."""

    def __init__(self, line: str, output: str = "") -> None:
        super().__init__(line)
        self.tail = output.strip().splitlines()[-8:]


def say(line: str) -> None:
    """Tell the person at the terminal, beside what the command itself prints."""
    print("./go: " + line, file=sys.stderr, flush=True)


def dotted(version: Sequence[int]) -> str:
    """A version as people write it."""
    return ".".join(str(part) for part in version)


# -- which Python -------------------------------------------------------------------------------


def version_of(python: str) -> Optional[Tuple[int, int]]:
    """The (major, minor) that an interpreter says of itself; None if it does not run."""
    ask = [python, "-c", "import sys; print(sys.version_info[0], sys.version_info[1])"]
    try:
        said = subprocess.run(ask, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    major, minor = said.stdout.split()
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


def stamp() -> str:
    """The stamp of an environment that is up to date."""
    return wanted(ROOT, LOCK.read_bytes(), PROJECT.read_bytes())


def ready() -> bool:
    """Whether the environment stands, finished, and is made from the present lock and project."""
    return PYTHON.exists() and STAMP.is_file() and STAMP.read_text() == stamp()


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """One set-up at a time in this folder; a second one waits and then finds it done."""
    folder = os.open(str(ROOT), os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def run(command: Sequence[str], failure: str) -> None:
    """Run a tool of the set-up quietly. Raises Missing with the tool's last words."""
    try:
        done = subprocess.run(
            command,
            cwd=str(ROOT),
            env=clean(os.environ),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            check=False,
        )
    except OSError as error:
        raise Missing(failure, str(error)) from None
    if done.returncode != 0:
        raise Missing(failure, done.stdout.decode("utf-8", "replace"))


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


def install_with_uv(uv: str, python: Optional[str]) -> None:
    """Make or repair the environment with uv, which can also bring a Python of its own."""
    if not works("-c", ""):
        name = python or ">=%s,<%s" % (dotted(OLDEST), dotted((NEWEST[0], NEWEST[1] + 1)))
        run([uv, "venv", "--clear", "--python", name, str(VENV)], "uv could not make .venv")
    install = [uv, "pip", "install", "--python", str(PYTHON), "--compile-bytecode"]
    failure = "uv could not install the packages (is there a network?)"
    run([*install, "--require-hashes", "-r", str(LOCK)], failure)
    alone = ["--no-index", "--no-deps", "--no-build-isolation", "--reinstall-package", "motor-gateway"]
    run([*install, *alone, "-e", "."], "uv could not install the project itself")


def install_with_pip(python: Optional[str]) -> None:
    """Make or repair the environment with the standard library's venv, and pip."""
    if not works("-m", "pip", "--version"):
        if python is None:
            raise Missing(too_old())
        version = dotted(version_of(python) or OLDEST)
        hint = "apt-get install python%s-venv, or install uv" % version
        run([python, "-c", "import venv, ensurepip"], "Python %s has no venv module: %s" % (version, hint))
        if VENV.exists():
            shutil.rmtree(str(VENV))
        run([python, "-m", "venv", str(VENV)], "venv could not make .venv")
    install = [str(PYTHON), "-m", "pip", "install", "--disable-pip-version-check", "--no-input", "--no-user"]
    failure = "pip could not install the packages (is there a network?)"
    run([*install, "--require-hashes", "-r", str(LOCK)], failure)
    alone = ["--no-index", "--no-deps", "--no-build-isolation"]
    run([*install, *alone, "-e", "."], "pip could not install the project itself")


def too_old() -> str:
    """What to say to an old Python when there is no newer one, and no uv to bring it."""
    here = dotted(sys.version_info[:3])
    return "Python %s or newer is needed; this is %s (%s)" % (dotted(OLDEST), here, sys.executable)


def install(uv: Optional[str], python: Optional[str]) -> None:
    """With uv where it is on the path, else, or if it fails, with venv and pip."""
    if uv:
        try:
            install_with_uv(uv, python)
        except Missing as missing:
            say("\n    ".join(["%s; trying pip" % missing, *missing.tail]))
        else:
            return
    install_with_pip(python)


def set_up() -> None:
    """Make the environment, unless it is ready. The stamp goes first and comes last: a set-up that was
    interrupted is done again."""
    if ready():
        return
    uv = shutil.which("uv")
    python = choose(base_python(), sys.version_info[:2], shutil.which, version_of)
    if python is None and uv is None:
        raise Missing(too_old())
    with one_at_a_time():
        if ready():
            return
        began = time.monotonic()
        say("setting up .venv (once, and when the lock changes; about a minute) ...")
        if STAMP.exists():
            STAMP.unlink()
        install(uv, python)
        STAMP.write_text(stamp())
        say("set up in %.0f s" % (time.monotonic() - began))


# -- the words ----------------------------------------------------------------------------------


def python_here(arguments: Sequence[str]) -> int:
    """Run the environment's Python on this folder, and wait. Returns its exit status."""
    command = [str(PYTHON), *arguments]
    return subprocess.run(command, cwd=str(ROOT), env=clean(os.environ), check=False).returncode


def test(arguments: Sequence[str]) -> int:
    """Every check, also after one has failed. Returns 0 only if all passed, and what is required ran."""
    checks = [*TOOLS, ("pytest", [*PYTEST, *arguments])]
    required = "real-can" in re.split(r"[,\s]+", os.environ.get(REQUIRE, ""))
    if not arguments or required:
        checks.append(("real CAN", [*REAL_CAN, str(ABSENT)]))
    if ABSENT.exists():
        ABSENT.unlink()
    summary = []
    failed = False
    for name, command in checks:
        print("== " + name, flush=True)
        began = time.monotonic()
        status = python_here(command)
        failed = failed or status != 0
        said = "ok" if status == 0 else "FAILED (exit status %d)" % status
        summary.append("   %-14s %6.1f s  %s" % (name, time.monotonic() - began, said))
    for line in ABSENT.read_text().splitlines() if ABSENT.exists() else ():
        failed = failed or required
        summary.append("!! NOT RUN: real CAN: " + line + (" (it is required)" if required else ""))
    print("\n".join(["== ./go test", *summary]), flush=True)
    return 1 if failed else 0


def prove(arguments: Sequence[str]) -> int:
    """The long campaigns. Returns pytest's exit status: to have run none is no success."""
    status = python_here(["-m", "pytest", "-m", "prove", "--timeout", "0", *arguments])
    if status == 5:
        say("no campaigns yet: nothing was proven")
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
    say("%s made; `./go test` installs it" % LOCK.name)
    return 0


def gateway(arguments: Sequence[str]) -> int:
    """Become the `gateway` command: its signals and its exit status are ours."""
    sys.stdout.flush()
    os.execve(str(PYTHON), [str(PYTHON), "-P", "-m", "gateway", *arguments], clean(os.environ))


def main(arguments: Sequence[str]) -> int:
    """Set up, and do what the first word says."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print((__doc__ or "").split("\n\nRules of this file")[0], flush=True)
        return 0
    word, rest = arguments[0], arguments[1:]
    if word == "lock":
        return lock(rest)
    set_up()
    if word == "test":
        return test(rest)
    if word == "prove":
        return prove(rest)
    return gateway(arguments)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except Missing as missing:
        say("\n    ".join([str(missing), *missing.tail]))
        sys.exit(1)
    except OSError as error:
        say("the set-up failed: %s" % error)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
