"""The architecture's rules: who imports whom, what lies where, and what no text may name.

Each rule is also shown something that breaks it, so that none of them can pass by accident.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

from tests.house import ONLY, OUTSIDE, imports, protocol_of, violations

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("protocols", "brain", "gateway")
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
SOURCES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
PROTOCOLS = sorted(
    path.parent
    for path in (ROOT / "protocols").glob("*/__init__.py")
    if protocol_of(f"protocols.{path.parent.name}")
)


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


# -- who imports whom ---------------------------------------------------------------------------


def test_every_source_keeps_the_rules() -> None:
    assert len(SOURCES) > 30
    broken = [
        line
        for path in SOURCES
        for line in violations(module_of(path), path.read_text(), package=path.name == "__init__.py")
    ]
    assert not broken, "\n".join(broken)


BREAKS = [
    ("brain.brain", "import time", "only in gateway.core.clock"),
    ("gateway.runtime.loop", "from time import monotonic_ns", "only in gateway.core.clock"),
    ("gateway.runtime.loop", "def f():\n    import time", "only in gateway.core.clock"),
    ("gateway.clock2", "import time", "only in gateway.core.clock"),
    ("gateway.runtime.loop", "importlib.import_module('time')", "only in gateway.core.clock"),
    ("gateway.runtime.loop", "__import__('time')", "only in gateway.core.clock"),
    ("protocols.plain.driver", "import can", "only in gateway.buses"),
    ("gateway.runtime.loop", "from serial.tools import list_ports", "only in gateway.buses"),
    ("gateway.runtime.loop", "import random", "no place at all"),
    ("protocols.plain.twin", "import numpy", "protocols imports no numpy"),
    (
        "brain.planning.astar",
        "import scipy.ndimage",
        "only in brain.perception.graph, brain.perception.keyframes, brain.planning.blocks, gateway.bench",
    ),
    ("brain.perception.map", "import filterpy.kalman", "only in brain.perception.engine"),
    ("brain.brain", "from gateway.core.joint import Joint", "brain lies below gateway"),
    ("protocols.messages", "import brain", "protocols lies below brain"),
    ("protocols.plain", "from brain import belief", "protocols lies below brain"),
    ("protocols.plain", 'vectors = ("gateway.fixtures", "vectors.json")', "protocols lies below gateway"),
    ("protocols.plain.driver", "import socket", "below the loop"),
    ("brain.belief", "from pathlib import Path", "below the loop"),
    ("gateway.core.joint", "import logging", "below the loop"),
    ("gateway.core.step", "import os.path", "below the loop"),
    ("brain.brain", "from protocols.plugin import Spec", "the messages alone"),
    ("brain.brain", "from protocols import frames", "the messages alone"),
    ("protocols.foo.driver", "from protocols.plain import codec", "and its own folder"),
    ("protocols.foo.driver", "from ..plain.codec import pack", "and its own folder"),
    ("protocols.vesc.driver", "from protocols.vesc_uart import table", "and its own folder"),
    ("protocols.foo", "from protocols.conformance import check", "and its own folder"),
    ("protocols.plugin", "from protocols.plain import plugin", "knows none of them"),
    ("protocols.conformance.state", "import protocols.foo.codec", "knows none of them"),
    ("protocols.foo.driver", "from protocols.foo.twin import Twin", "only in their table"),
    ("protocols.foo.driver", "from .twin import Twin", "only in their table"),
    ("protocols.foo.twin", "from protocols.foo import driver", "only in their table"),
    ("protocols.foo.codec", "import protocols.foo.twin", "only in their table"),
]
KEEPS = [
    ("gateway.core.clock", "import time"),
    ("gateway.buses.can", "import can\nfrom gateway.core.clock import Clock"),
    ("brain.perception.engine", "from filterpy.kalman import ExtendedKalmanFilter\nimport numpy as np"),
    ("brain.brain", "from protocols.messages import Nanos\nfrom brain import belief\nimport math"),
    ("protocols.foo.driver", "from .codec import pack\nfrom protocols.messages import Nanos\nimport struct"),
    ("protocols.foo.driver", "from protocols.foo import codec\nfrom protocols import plugin"),
    ("protocols.foo.twin", "from protocols.foo.servo import Servo"),
    ("protocols.vesc_uart.driver", "from protocols.vesc.controller import Controller"),
    ("protocols.conformance.state", "from protocols.plugin import load\nfrom .case import Case"),
    (
        "gateway.recording.tick_codec",
        "from protocols.message_codec import pack\nfrom brain.belief import Belief\nimport os",
    ),
    ("gateway.timing", "import timeit"),
]


@pytest.mark.parametrize(("module", "source", "rule"), BREAKS)
def test_a_broken_rule_is_found(module: str, source: str, rule: str) -> None:
    found = violations(module, source, package=module in ("protocols.plain", "protocols.foo"))
    assert any(rule in line for line in found), found


@pytest.mark.parametrize(("module", "source"), KEEPS)
def test_what_keeps_the_rules_is_left_alone(module: str, source: str) -> None:
    assert violations(module, source) == []


def test_relative_imports_are_resolved() -> None:
    source = "from . import a\nfrom ..b import c\nfrom .d.e import f"
    assert list(imports("x.y.z", source)) == [(1, "x.y.a"), (2, "x.b.c"), (3, "x.y.d.e.f")]
    assert list(imports("x.y", source, package=True)) == [(1, "x.y.a"), (2, "x.b.c"), (3, "x.y.d.e.f")]


def test_ruff_bans_the_same_and_says_why() -> None:
    banned = PROJECT["tool"]["ruff"]["lint"]["flake8-tidy-imports"]["banned-api"]
    assert sorted(banned) == sorted(ONLY)
    source = "".join(f"import {name}\n" for name in banned)
    command = [
        sys.executable,
        "-m",
        "ruff",
        "check",
        "--select",
        "TID251",
        "--stdin-filename",
        "brain/brain.py",
        "-",
    ]
    done = subprocess.run(command, cwd=ROOT, input=source, capture_output=True, text=True, check=False)
    missed = [name for name, ban in banned.items() if ban["msg"] not in done.stdout]
    assert done.returncode == 1
    assert not missed


LAYERS = [
    ("brain/belief.py", "import gateway.core.joint", "gateway over brain over protocols"),
    ("protocols/frames.py", "import brain.belief", "gateway over brain over protocols"),
    ("brain/belief.py", "import protocols.plugin", "the brain knows the messages"),
    ("protocols/plain/driver.py", "import protocols.plain.twin", "driver and twin meet only in their table"),
    ("protocols/messages.py", "import protocols.plugin", "no import cycles"),
    ("gateway/core/joint.py", "import gateway.core.clock", "the step knows no clock, bus, world or file"),
    (
        "gateway/core/tick.py",
        "import gateway.buses.virtual.bus",
        "the step knows no clock, bus, world or file",
    ),
]


@pytest.mark.sample(3)
@pytest.mark.parametrize(("file", "line", "contract"), LAYERS)
def test_the_contracts_of_the_layers_hold_and_can_break(
    tmp_path: Path, file: str, line: str, contract: str
) -> None:
    for room in ROOMS:
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    with (tmp_path / file).open("a") as source:
        source.write(f"\n{line}\n")
    command = [
        sys.executable,
        "-c",
        "from importlinter.cli import lint_imports_command as run; run()",
        "--no-cache",
    ]
    environment = {**os.environ, "COLUMNS": "200"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout
    assert re.search(rf"^{re.escape(contract)}.* BROKEN", done.stdout, re.MULTILINE), done.stdout


# -- what lies where ----------------------------------------------------------------------------


def test_every_folder_with_code_is_a_package() -> None:
    folders = {path.parent for path in [*SOURCES, *(ROOT / "tests").rglob("*.py")]}
    assert not [str(folder) for folder in sorted(folders) if not (folder / "__init__.py").exists()]


def test_the_gateway_shows_its_architecture_at_the_top_level() -> None:
    """Packages, and beside them only what Python and pytest ask for, and the errors."""
    entries = {path for path in (ROOT / "gateway").iterdir() if path.name not in ("__pycache__", "py.typed")}
    files = {"__init__.py", "__main__.py", "errors.py", "testing.py"}
    assert {path.name for path in entries if path.is_file()} == files
    layers = next(c for c in PROJECT["tool"]["importlinter"]["contracts"] if "rooms of the" in c["name"])
    named = {name for layer in layers["layers"] for name in layer.split(" | ")} - {"errors"}
    assert {path.name for path in entries if path.is_dir()} == named | {"fixtures"}


@pytest.mark.parametrize("room", sorted(path.name for path in (ROOT / "gateway").iterdir() if path.is_dir()))
def test_each_room_says_what_it_is_for_and_what_it_must_not_import(room: str) -> None:
    if room in ("__pycache__", "fixtures"):
        return
    text = ast.get_docstring(ast.parse((ROOT / "gateway" / room / "__init__.py").read_text())) or ""
    assert len(text.split()) >= 15, text
    assert re.search(r"must\s+not\s+import|imports? no", text, re.IGNORECASE), text


def test_every_package_has_tests() -> None:
    """tests/a/b/test_*.py for the package a/b; a package inside a room of the gateway is tested with it."""
    packages = {path.relative_to(ROOT).parent.parts[:2] for path in SOURCES if path.name != "__init__.py"}
    rooms = sorted(Path(*parts) for parts in packages if parts != ("gateway",))
    assert len(rooms) > 12

    def tested(room: Path) -> bool:
        own = (ROOT / "tests" / room).glob("test_*.py")
        beside = (ROOT / "tests" / room.parent).glob(f"test_{room.name}*.py")
        return any([*own, *beside])

    assert not [str(room) for room in rooms if not tested(room)]


def test_a_protocol_is_a_whole_folder() -> None:
    assert PROTOCOLS
    declared = PROJECT["project"]["entry-points"]["motor_gateway.protocols"]
    assert declared == {folder.name: f"protocols.{folder.name}:plugin" for folder in PROTOCOLS}
    for folder in PROTOCOLS:
        missing = [n for n in ("driver.py", "twin.py", "README.md") if not (folder / n).is_file()]
        assert not missing, f"{folder.name} lacks {', '.join(missing)}"


def assigned_elsewhere(source: str) -> list[int]:
    """Return the lines that assign an attribute of another object than `self` and `cls`."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in [each for one in targets for each in getattr(one, "elts", [one])]:
            owner = target
            while isinstance(owner, ast.Subscript):
                owner = owner.value
            if isinstance(owner, ast.Attribute) and ast.unparse(owner.value) not in ("self", "cls"):
                lines.append(owner.lineno)
    return lines


def test_no_object_assigns_the_attributes_of_another_one() -> None:
    """In the protocols, and in the brain."""
    assert assigned_elsewhere("a.b = 1\nself.b.c += 1\nd, e.f[0] = 1, 2\nself.g: int = 3") == [1, 2, 3]
    folders = [*PROTOCOLS, ROOT / "protocols/toolkit", ROOT / "brain"]
    sources = [path for folder in folders for path in folder.rglob("*.py")]
    wrong = {str(path.relative_to(ROOT)): assigned_elsewhere(path.read_text()) for path in sources}
    assert not {path: lines for path, lines in wrong.items() if lines}


def test_no_vendor_is_named_outside_its_folder() -> None:
    names = {folder.name.split("_")[0] for folder in PROTOCOLS if "_" in folder.name}
    assert "odrive" in names
    pattern = re.compile("|".join(sorted(names)), re.IGNORECASE)
    named = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in SOURCES
        if not any(path.is_relative_to(folder) for folder in PROTOCOLS)
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(line)
    ]
    assert not named, "\n".join(named)


def test_no_body_is_named_outside_its_file() -> None:
    bodies = PROJECT["project"]["entry-points"]["motor_gateway.bodies"]
    kinds = [name for name in bodies if name != "joints"]  # which are also any motors
    assert "differential" in kinds
    classes = [value.partition(":")[2] for value in bodies.values()]
    pattern = re.compile(
        "|".join([*(rf"[\"']{name}\b" for name in kinds), *(rf"\b{name}\b" for name in classes)])
    )
    named = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in SOURCES
        if not path.is_relative_to(ROOT / "brain/bodies")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(line) and not line.lstrip().startswith(("#", '"""'))
    ]
    assert not named, "\n".join(named)


def class_questions(source: str) -> list[int]:
    """Return the lines that ask for the class of a body."""
    classes = {"Base", "Linkage", "Body", "Limbs"}
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    asked = [node for node in calls if ast.unparse(node.func) == "isinstance"]
    return [
        node.lineno
        for node in asked
        if classes & {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
    ]


def test_the_gateway_asks_what_a_body_can_do_and_never_its_class() -> None:
    assert class_questions("isinstance(a, Base)\nisinstance(b, (int, Linkage))\nisinstance(c, int)") == [1, 2]
    asked = {str(path): class_questions(path.read_text()) for path in (ROOT / "gateway").rglob("*.py")}
    assert not {path: lines for path, lines in asked.items() if lines}


# -- dependencies -------------------------------------------------------------------------------


def normal(name: str) -> str:
    """Return the name of a distribution as the lock has it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def requirement_names(requirements: list[str]) -> set[str]:
    return {normal(re.split(r"[<>=!~\[; ]", requirement)[0]) for requirement in requirements}


IF_THERE = {"pandas", "pytest"}
"""What is used if a user has it, and asked for in words if not."""


def test_what_is_imported_is_declared_and_the_other_way_round() -> None:
    distributions = packages_distributions()
    tops = {
        name.split(".")[0]
        for path in SOURCES
        for _, name in imports(module_of(path), path.read_text(), package=path.name == "__init__.py")
    }
    outside = tops - set(sys.stdlib_module_names) - {*ROOMS, "benchmarks"} - IF_THERE
    # A distribution may bring its module through another one (mujoco through mujoco-core).
    providers = {top: {top, *(normal(name) for name in distributions[top])} for top in outside}
    optional = PROJECT["project"]["optional-dependencies"]
    extras = [one for name, extra in optional.items() if name not in ("dev", "testing") for one in extra]
    declared = requirement_names([*PROJECT["project"]["dependencies"], *extras])
    assert not {top for top, names in providers.items() if not names & declared}, "imported, not declared"
    assert not declared - set().union(*providers.values()), "declared, not imported"
    assert set().union(*OUTSIDE.values()) <= outside


def test_the_lock_holds_every_dependency_and_no_address() -> None:
    lock = (ROOT / "requirements.lock").read_text()
    entries = re.split(
        r"\n(?=\S)", "\n".join(line for line in lock.splitlines() if not line.lstrip().startswith("#"))
    )
    assert "://" not in lock
    assert not re.search(r"index-url|find-links|file:|-e ", lock)
    bare = [
        entry
        for entry in entries
        if not re.match(r"[a-z0-9.-]+==\S+.*--hash=sha256:[0-9a-f]{64}", entry, re.DOTALL)
    ]
    assert not bare
    locked = {entry.split("==")[0] for entry in entries}
    optional = PROJECT["project"]["optional-dependencies"]
    wanted = [*PROJECT["project"]["dependencies"], *optional["sim"], *optional["dev"]]
    assert requirement_names(wanted) <= locked
    assert len(locked) > 50


# -- what no text may name ----------------------------------------------------------------------

PRIVATE = [
    r"(?<![\w.~])/(?:work|root|home|tmp|Users)/[\w.]",
    r"shared/(?:facts|wire|data|HOUSE|STYLE)",
    r"(?:pypi|pythonhosted|crates|npmjs)\.(?:org|io|com)",
]
"""Paths of somebody's machine, and addresses of package indexes."""
TEXT = {".py", ".toml", ".json", ".md", ".lock", ".typed", ".txt", ".yml", ""}


def texts() -> list[Path]:
    """Every text file of the project: the rooms, fixtures, tests, docs, and what lies at the top."""
    folders = [*ROOMS, "fixtures", "tests", "docs", "examples", "benchmarks", ".ci", ".github"]
    below = [path for folder in folders for path in (ROOT / folder).rglob("*")]
    at_top = [path for path in ROOT.iterdir() if path.name not in (".git", ".coverage")]
    files = {path for path in [*below, *at_top] if path.is_file() and path.suffix in TEXT}
    return sorted(path for path in files if not {"__pycache__", ".ruff_cache"} & {*path.parts})


def private(text: str) -> list[str]:
    return [match.group() for pattern in PRIVATE for match in re.finditer(pattern, text)]


def test_no_text_names_a_private_place() -> None:
    files = [path for path in texts() if path != Path(__file__).resolve()]
    assert {ROOT / "go", ROOT / "pyproject.toml", ROOT / ".ci" / "run"} <= set(files)
    found = {str(path.relative_to(ROOT)): private(path.read_text()) for path in files}
    assert not {name: places for name, places in found.items() if places}


@pytest.mark.parametrize(
    "text",
    ["x = '/home/me/x'", "see ../shared/facts/y.md", "https://pypi.org/simple", "(/tmp/x)", "/root/.venv"],
)
def test_a_private_place_is_found(text: str) -> None:
    assert private(text)


@pytest.mark.parametrize("text", ["gateway/sim/files.py", "~/root/x", "http://www.apache.org/", "a/tmp/"])
def test_a_public_place_is_no_private_one(text: str) -> None:
    assert not private(text)
