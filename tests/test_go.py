"""`./go`: which Python it takes, when it sets up, what it prints, and that it passes arguments on unchanged.

The whole way is walked on a small project made here: the real script, a real virtual environment, an
empty lock and a build backend of a few lines, so that no network is needed.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import packages_distributions, requires
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

from tests.sampled import sampled

GO = Path(__file__).resolve().parent.parent / "go"


def load_go() -> ModuleType:
    """The script as a module, without leaving compiled bytes beside it."""
    module = ModuleType("go")
    module.__file__ = str(GO)
    exec(compile(GO.read_bytes(), str(GO), "exec"), module.__dict__)
    return module


go = load_go()


# -- the script itself --------------------------------------------------------------------------


def test_an_old_python_can_read_it() -> None:
    source = GO.read_bytes()
    ast.parse(source, feature_version=(3, 6))
    assert source.isascii()
    assert "from __future__ import annotations" not in source.decode()  # unknown to 3.6
    assert os.access(GO, os.X_OK)
    assert source.startswith(b"#!/usr/bin/env python3\n")


def test_it_needs_the_standard_library_alone() -> None:
    tree = ast.parse(GO.read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "." for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert names
    assert names <= sys.stdlib_module_names


# -- which Python -------------------------------------------------------------------------------

CHOICES = [
    # running   on the path, and what each says it is                    chosen
    ((3, 11), {}, "running"),
    ((3, 13), {"python3.11": (3, 11)}, "running"),
    ((3, 8), {"python3.11": (3, 11)}, "/bin/python3.11"),
    ((3, 8), {"python3.11": (3, 11), "python3.13": (3, 13)}, "/bin/python3.13"),
    ((3, 10), {"python3.12": None, "python3.11": (3, 11)}, "/bin/python3.11"),
    ((3, 10), {"python3.12": (3, 8)}, None),
    ((3, 8), {"python3.10": (3, 10)}, None),
    ((2, 7), {}, None),
    ((3, 14), {}, "running"),
    ((3, 14), {"python3.12": (3, 12)}, "/bin/python3.12"),
]


@pytest.mark.parametrize(("version", "path", "chosen"), CHOICES)
def test_choice_of_python(
    version: tuple[int, int], path: dict[str, tuple[int, int] | None], chosen: str | None
) -> None:
    def which(name: str) -> str | None:
        return f"/bin/{name}" if name in path else None

    def ask(python: str) -> tuple[int, int] | None:
        return path[Path(python).name]

    assert go.choose("running", version, which, ask) == chosen


def script(path: Path, text: str) -> Path:
    """An executable shell script."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_version_of(tmp_path: Path) -> None:
    assert go.version_of(sys.executable) == sys.version_info[:2]
    assert go.version_of(str(tmp_path / "absent")) is None
    assert go.version_of(str(script(tmp_path / "shim", "echo 'not installed' >&2; exit 127"))) is None


def test_lock_range_is_what_the_project_declares() -> None:
    declared = (GO.parent / "pyproject.toml").read_text()
    assert f'requires-python = ">={go.dotted(go.OLDEST)}"' in declared


# -- small parts --------------------------------------------------------------------------------


def test_clean_drops_what_breaks_and_keeps_the_rest() -> None:
    given = {
        "PATH": "/bin",
        "HOME": "/nowhere",
        "PYTHONPATH": "/opt/ros",
        "PYTHONHOME": "/usr",
        "PIP_USER": "1",
        "PIP_TARGET": "/x",
        "PIP_CERT": "/etc/cert",
        "UV_SYSTEM_PYTHON": "1",
        "PYTHONHASHSEED": "7",
    }
    kept = {name: given[name] for name in ("PATH", "HOME", "PIP_CERT", "PYTHONHASHSEED")}
    assert go.clean(given) == {**kept, "OPENBLAS_NUM_THREADS": "1"}
    assert go.clean({"OPENBLAS_NUM_THREADS": "4"}) == {"OPENBLAS_NUM_THREADS": "4"}


def test_stamp_tells_place_lock_and_project_apart() -> None:
    one = go.wanted(Path("/a"), b"lock", b"project")
    assert one == go.wanted(Path("/a"), b"lock", b"project")
    others = [
        go.wanted(Path("/b"), b"lock", b"project"),
        go.wanted(Path("/a"), b"lock2", b"project"),
        go.wanted(Path("/a"), b"lock", b"project2"),
        go.wanted(Path("/a"), b"lockp", b"roject"),
    ]
    assert len({one, *others}) == 5


def test_what_runs_the_program_is_a_closed_part_of_the_lock() -> None:
    """By what the installed packages say they need, which is not what the part is made from."""

    def names(lock: str) -> set[str]:
        return set(re.findall(r"(?m)^([a-z0-9-]+)==", lock))

    def canonical(requirement: str) -> str:
        return re.sub("[-_.]+", "-", re.split(r"[^\w.-]", requirement)[0]).lower()

    lock = (GO.parent / "requirements.lock").read_text()
    part = names(go.to_run((GO.parent / "pyproject.toml").read_text(), lock))
    installed = {canonical(name) for found in packages_distributions().values() for name in found}
    needs = {
        name: {canonical(need) for need in requires(name) or () if "extra" not in need}
        for name in part & installed
    }
    assert {"numpy", "mujoco", "pytest", "setuptools", "distributed"} <= needs.keys()
    assert not part & {"mypy", "ruff", "sphinx", "dynamixel-sdk", "hypothesis"}
    assert not {name: missing for name, need in needs.items() if (missing := need & names(lock) - part)}


def test_last_words_are_few() -> None:
    missing = go.Missing("one line", "\n".join(str(i) for i in range(100)))
    assert str(missing) == "one line"
    assert missing.tail == [str(i) for i in range(92, 100)]


def test_no_venv_module_is_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse = 'case "$*" in *ensurepip*) echo No module named ensurepip; exit 1;; esac'
    python = script(tmp_path / "python3", f'{refuse}\nexec "{sys.executable}" "$@"')
    monkeypatch.setattr(go, "PYTHON", tmp_path / ".venv/bin/python")
    with pytest.raises(go.Missing, match=r"has no venv module: apt-get install python3\.\d+-venv") as caught:
        go.install_with_pip(str(python), go.LOCK)
    assert caught.value.tail == ["No module named ensurepip"]


# -- the whole way ------------------------------------------------------------------------------

PROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]
[project]
name = "motor-gateway"
version = "0"
"""
BACKEND = """
import pathlib, zipfile
def build_editable(folder, config_settings=None, metadata_directory=None):
    name, info = "motor_gateway-0-py3-none-any.whl", "motor_gateway-0.dist-info"
    with zipfile.ZipFile(pathlib.Path(folder, name), "w") as wheel:
        wheel.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\\nName: motor-gateway\\nVersion: 0\\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        wheel.writestr("here.pth", str(pathlib.Path.cwd()))
        record = ["here.pth,,", f"{info}/METADATA,,", f"{info}/WHEEL,,", f"{info}/RECORD,,", ""]
        wheel.writestr(f"{info}/RECORD", "\\n".join(record))
    return name
"""
GATEWAY = """
import os, sys, time
if sys.argv[1:] == ["sleep"]:
    print("asleep", flush=True)
    time.sleep(60)
print(repr([sys.argv[1:], os.getcwd(), os.environ.get("PYTHONPATH"), os.environ["OPENBLAS_NUM_THREADS"]]))
sys.exit(7)
"""


class Clone:
    """A small project with the real `go` in it, under a path with a space."""

    def __init__(self, root: Path) -> None:
        self.root = root
        (root / "gateway").mkdir(parents=True)
        files = {"pyproject.toml": PROJECT, "backend.py": BACKEND, "requirements.lock": "# nothing\n"}
        for name, text in {**files, "gateway/__main__.py": GATEWAY, "go": GO.read_text()}.items():
            (root / name).write_text(text)
        (root / "go").chmod(0o755)

    def environment(self, **more: str) -> dict[str, str]:
        """What a new machine has: a home, a path; and no package index to reach.

        uv is on the path only where Python cannot make an environment by itself."""
        uv = None if find_spec("ensurepip") else shutil.which("uv")
        places = [Path(python).resolve().parent for python in (sys.executable, uv) if python]
        path = os.pathsep.join([*map(str, places), "/usr/bin", "/bin"])
        return {"HOME": str(self.root), "PATH": path, "PIP_NO_INDEX": "1", "UV_OFFLINE": "1", **more}

    def go(self, *words: str, cwd: Path | None = None, **more: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(self.root / "go"), *words]
        return subprocess.run(
            command,
            cwd=cwd or self.root,
            env=self.environment(**more),
            capture_output=True,
            text=True,
            check=False,
        )

    @property
    def stamp(self) -> Path:
        return self.root / ".venv" / "set-up-from"


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Clone:
    return Clone(tmp_path_factory.mktemp("go") / "my clone")


def test_help_sets_nothing_up(tmp_path: Path) -> None:
    clone = Clone(tmp_path / "new clone")
    for words in ((), ("--help",), ("-h",)):
        done = clone.go(*words)
        assert done.returncode == 0
        assert "./go demo" in done.stdout
        assert "./go test" in done.stdout
        assert "Rules of this file" not in done.stdout
    assert not (clone.root / ".venv").exists()


def test_first_word_sets_up_and_hands_on(clone: Clone, tmp_path: Path) -> None:
    shutil.rmtree(clone.root / ".venv", ignore_errors=True)
    (tmp_path / "gateway.py").write_text("raise SystemExit('shadowed')")
    first = clone.go("run", "a robot.toml", "--fast", cwd=tmp_path, PYTHONPATH=str(tmp_path), PIP_USER="1")
    assert "setting up .venv" in first.stderr, first.stderr
    expected = repr([["run", "a robot.toml", "--fast"], str(tmp_path), None, "1"])
    assert first.stdout == f"{expected}\n", first.stderr
    assert first.returncode == 7
    again = clone.go("run", OPENBLAS_NUM_THREADS="2")
    assert again.stderr == ""
    assert again.stdout == repr([["run"], str(clone.root), None, "2"]) + "\n"


def test_the_set_up_shows_what_it_does(clone: Clone) -> None:
    clone.stamp.unlink(missing_ok=True)
    shown = clone.go("run").stderr
    assert shown.index("setting up .venv (once") < shown.index("./go: installing 0 packages ...")
    assert shown.index("installing the project ...") < shown.index("set up in ")


def test_the_lines_of_a_slow_tool_come_as_they_are_written() -> None:
    code = "print('one', flush=True); input(); print('two', end='')"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        lines: list[str] = []
        for line in go.lines_of(process.stdout):
            if not line and lines[-1:] == ["one"]:  # none came for a while: time to show progress
                process.stdin.write(b"\n")
                process.stdin.flush()
            lines.append(line)
    assert [line for line in lines if line] == ["one", "two"]
    assert "" in lines[lines.index("one") :]


def test_signals_reach_the_command(clone: Clone) -> None:
    assert clone.go("run").returncode == 7
    command = [sys.executable, str(clone.root / "go"), "sleep"]
    with subprocess.Popen(command, env=clone.environment(), stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"asleep\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == -signal.SIGTERM


def change_lock(clone: Clone) -> None:
    lock = clone.root / "requirements.lock"
    lock.write_text(lock.read_text() + "# changed\n")


def change_project(clone: Clone) -> None:
    project = clone.root / "pyproject.toml"
    project.write_text(project.read_text() + "# changed\n")


def interrupt(clone: Clone) -> None:
    clone.stamp.unlink()


def lose_pip(clone: Clone) -> None:
    for pip in (clone.root / ".venv").glob("lib/python*/site-packages/pip"):
        pip.rename(pip.with_name("lost"))
    clone.stamp.unlink()


def lose_base(clone: Clone) -> None:
    """As after an upgrade of the system that took the old Python away."""
    for python in (clone.root / ".venv/bin").glob("python*"):
        python.unlink()
        python.symlink_to("/nowhere/python")


@pytest.mark.sample(1)
@pytest.mark.parametrize("harm", sampled([interrupt, lose_pip, change_lock, lose_base, change_project], 2))
def test_set_up_is_repaired(clone: Clone, harm: Callable[[Clone], None]) -> None:
    assert clone.go("run").returncode == 7
    harm(clone)
    repaired = clone.go("run")
    assert "setting up .venv" in repaired.stderr
    assert repaired.returncode == 7, repaired.stderr
    assert clone.go("run").stderr == ""


def test_failed_install_says_so_and_is_tried_again(clone: Clone) -> None:
    lock = clone.root / "requirements.lock"
    good = lock.read_text()
    assert clone.go("run").returncode == 7
    project = clone.root / "pyproject.toml"
    project.write_text(PROJECT + 'dependencies = ["not-a-package>=1"]\n')
    lock.write_text(good + f"not-a-package==1.0 --hash=sha256:{'0' * 64}\n")
    for _ in range(2):
        failed = clone.go("run")
        assert failed.returncode == 1
        assert "could not install the packages (is there a network?)" in failed.stderr
        assert "not-a-package" in failed.stderr
        assert "Traceback" not in failed.stderr
        assert failed.stdout == ""
        assert not clone.stamp.exists()  # the old one would call a half-changed environment ready
    lock.write_text(good)
    assert clone.go("run").returncode == 7


def test_every_check_runs_also_after_one_has_failed(clone: Clone) -> None:
    done = clone.go("test", "-k", "x")
    assert done.returncode == 1
    for name in ("ruff check", "ruff format", "mypy --strict", "import-linter", "docs", "pytest"):
        assert f"== {name}\n" in done.stdout
        line = next(line for line in done.stdout.splitlines() if line.startswith(f"   {name} "))
        assert line.endswith("FAILED (exit status 1)")  # none of them is installed in this small project


TIER = """
import sys
print("the tier ran")
if {absent!r}:
    open(sys.argv[1], "w").write({absent!r})
"""


def test_what_could_not_run_is_told_at_the_end_and_may_be_required(clone: Clone) -> None:
    tier = clone.root / "tests/real_can/__main__.py"
    tier.parent.mkdir(parents=True)
    tier.write_text(TIER.format(absent="none of its tests: no kernel\n"))
    done = clone.go("test")
    assert "the tier ran" in done.stdout
    assert done.stdout.endswith("!! NOT RUN: real CAN: none of its tests: no kernel\n")
    required = clone.go("test", MOTOR_GATEWAY_REQUIRE="data, real-can")
    assert required.stdout.endswith("!! NOT RUN: real CAN: none of its tests: no kernel (it is required)\n")
    tier.write_text(TIER.format(absent=""))
    done = clone.go("test")
    assert "real CAN" in done.stdout
    assert "NOT RUN" not in done.stdout
    assert "the tier ran" not in clone.go("test", "-k", "x").stdout
    assert "the tier ran" in clone.go("test", "-k", "x", MOTOR_GATEWAY_REQUIRE="real-can").stdout


@pytest.mark.parametrize(
    ("required", "status"), [("", 0), ("data", 0), ("real-can", 1), ("data real-can", 1)]
)
def test_what_is_required_and_did_not_run_is_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, required: str, status: int
) -> None:
    absent = tmp_path / "not-run"
    monkeypatch.setattr(go, "ABSENT", absent)

    def succeed(command: list[str], output: object = None) -> subprocess.Popen[bytes]:
        absent.write_text("no kernel\n")
        return subprocess.Popen(["true"])

    monkeypatch.setattr(go, "python_here", succeed)
    monkeypatch.setenv("MOTOR_GATEWAY_REQUIRE", required)
    assert go.test([]) == status


def test_old_python_alone_is_told_in_one_line(tmp_path: Path) -> None:
    clone = Clone(tmp_path / "old")
    newer = (
        GO.read_text()
        .replace("OLDEST = (3, 11)", "OLDEST = (3, 98)")
        .replace("NEWEST = (3, 13)", "NEWEST = (3, 99)")
    )
    (clone.root / "go").write_text(newer)
    done = clone.go("demo", PATH="/nowhere")
    here = ".".join(str(part) for part in sys.version_info[:3])
    assert done.stderr == f"./go: Python 3.98 or newer is needed; this is {here} ({sys.executable})\n"
    assert done.returncode == 1
    assert not (clone.root / ".venv").exists()


def test_lock_without_uv_says_what_is_missing(tmp_path: Path) -> None:
    done = Clone(tmp_path / "lock").go("lock", PATH="/nowhere")
    assert done.returncode == 1
    assert done.stderr.startswith("./go: uv is needed to make the lock")
