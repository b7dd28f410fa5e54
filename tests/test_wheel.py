"""The wheel: built from a clean copy, installed in an empty environment outside the checkout, and used there.

The environment holds the wheel alone; what the project depends on is lent to it by a path file, which does
not make it find the checkout (the test says so first).
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from dataclasses import dataclass
from email.message import Message
from email.parser import Parser
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("protocols", "brain", "gateway")
CARRIED = {
    ".py",
    ".toml",
    ".json",
    ".md",
    ".dbc",
    ".eds",
    ".typed",
    ".js",
    ".css",
    ".html",
    ".svg",
    ".LICENSE",
}
KINDS = (
    "__init__.py",
    "catalogue.toml",
    "robots/*.*",
    "worlds/*.toml",
    "plants/*.toml",
    "missions/*.toml",
    "scenarios/*.toml",
    "vectors/*.json",
)
LEFT_OUT = shutil.ignore_patterns("__pycache__", "*.egg-info")
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def build(source: Path, out: Path) -> Path:
    """The wheel of a clean copy of the project: the checkout gets no build folder, and lends no old one."""
    for package in (*PACKAGES, "fixtures"):
        shutil.copytree(ROOT / package, source / package, ignore=LEFT_OUT, symlinks=True)
    for path in ROOT.iterdir():
        if path.suffix in (".toml", ".md") or path.name == "LICENSE":
            shutil.copy(path, source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = out.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist"))


@dataclass(frozen=True)
class Installed:
    """An environment with the wheel in it."""

    root: Path
    home: Path

    def run(self, program: str, *arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
        """Run one of its programs in an empty folder, with an empty home and nothing else inherited."""
        environment = {"PATH": f"{self.root / 'bin'}:/usr/bin:/bin", "HOME": str(self.home), **more}
        command = [str(self.root / "bin" / program), *arguments]
        return subprocess.run(
            command, cwd=self.home, env=environment, capture_output=True, text=True, check=False
        )


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    root = tmp_path_factory.mktemp("empty") / "environment"
    venv.create(root, with_pip=False, symlinks=True)
    into = [sys.executable, "-m", "pip", "--python", str(root / "bin" / "python")]
    options = ["install", "--no-deps", "--no-index", "--disable-pip-version-check", "--no-user", str(wheel)]
    done = subprocess.run([*into, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (packages,) = root.glob("lib/python*/site-packages")
    lent = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (packages / "lent.pth").write_text("\n".join(sorted(lent)) + "\n")
    return Installed(root, tmp_path_factory.mktemp("home"))


# -- what is in it ------------------------------------------------------------------------------


def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        return Parser().parsestr(archive.read(name).decode())


def test_it_carries_what_a_user_needs_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    code = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file()
        and path.suffix in CARRIED
        and not {"__pycache__", "fixtures"} & {*path.relative_to(ROOT).parts}
    }
    data = {
        f"gateway/fixtures/{path.relative_to(ROOT / 'fixtures').as_posix()}"
        for pattern in KINDS
        for path in (ROOT / "fixtures").glob(pattern)
    }
    assert names == code | data
    assert {
        "gateway/py.typed",
        "protocols/odrive_can/README.md",
        "gateway/fixtures/robots/diffbot.toml",
    } <= names
    assert {name.split("/")[0] for name in names} == set(PACKAGES)  # no other distribution's name is taken


def test_its_data_is_the_checkouts(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        data = [name for name in archive.namelist() if name.startswith("gateway/fixtures/")]
        assert data
        assert not [
            name for name in data if archive.read(name) != (ROOT / name.removeprefix("gateway/")).read_bytes()
        ]


def test_its_metadata(wheel: Path) -> None:
    said = metadata(wheel)
    assert said["Name"] == "motor-gateway"
    assert said["Version"] == PROJECT["version"]
    assert said["License-Expression"] == "Apache-2.0"
    assert said["Requires-Python"] == PROJECT["requires-python"]
    assert set(said.get_all("Provides-Extra", [])) == set(PROJECT["optional-dependencies"])
    needed = [line for line in said.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert len(needed) == len(PROJECT["dependencies"])
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if name.endswith("/licenses/LICENSE")]
        assert len(names) == 1
        assert b"Apache License" in archive.read(names[0])


# -- and used outside the checkout --------------------------------------------------------------

WHERE = """
import importlib, importlib.metadata, json, sys
places = {name: importlib.import_module(name).__file__ for name in sys.argv[1:]}
here = importlib.metadata.distribution("motor-gateway")
print(json.dumps([places, str(here.locate_file("gateway"))]))
"""


def test_nothing_of_the_checkout_is_seen_there(installed: Installed) -> None:
    done = installed.run(
        "python", "-c", WHERE, *PACKAGES, "protocols.odrive_can", "gateway.sim", "gateway.fixtures"
    )
    assert done.returncode == 0, done.stderr
    places, distribution = json.loads(done.stdout)
    inside = installed.root / "lib"
    strays = {name: place for name, place in places.items() if not Path(place).is_relative_to(inside)}
    assert not strays
    assert Path(distribution).is_relative_to(inside)
    assert str(ROOT) not in done.stdout


def test_pip_finds_no_conflict(installed: Installed) -> None:
    command = [sys.executable, "-m", "pip", "--python", str(installed.root / "bin" / "python"), "check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "No broken requirements found" in done.stdout


def test_help(installed: Installed) -> None:
    done = installed.run("gateway", "--help")
    assert done.returncode == 0, done.stderr
    for word in ("demo", "run", "replay", "check", "protocols"):
        assert re.search(rf"^\s+{word}\b", done.stdout, re.MULTILINE), word


def test_protocols_are_found_by_their_entry_points(installed: Installed) -> None:
    done = installed.run("gateway", "protocols")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    for name in PROJECT["entry-points"]["motor_gateway.protocols"]:
        assert re.search(rf"^{name}\b", done.stdout, re.MULTILINE), done.stdout


def test_a_shipped_robot_is_found_by_name(installed: Installed) -> None:
    known = installed.run("gateway", "check", "diffbot")
    assert known.returncode == 0, known.stdout + known.stderr
    assert "diffbot" in known.stdout
    unknown = installed.run("gateway", "check", "difbot")
    assert unknown.returncode == 2
    assert "diffbot" in unknown.stdout + unknown.stderr
    assert "Traceback" not in unknown.stderr


def test_the_demo_runs_and_its_recording_replays(installed: Installed, tmp_path: Path) -> None:
    out = tmp_path / "out"
    demo = installed.run(
        "gateway", "demo", "--fast", "--goal", "1.2,0.5", "--out", str(out), PYTHONHASHSEED="1"
    )
    assert demo.returncode == 0, demo.stdout + demo.stderr
    (recording,) = out.glob("*.mcap")
    (picture,) = out.glob("*.png")
    assert picture.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    left = [path.name for path in installed.home.iterdir() if not path.name.startswith(".")]
    assert left == []  # everything is in --out, but for the caches of other packages
    replay = installed.run("gateway", "replay", str(recording), PYTHONHASHSEED="2")
    assert replay.returncode == 0, replay.stdout + replay.stderr
