"""A plugin in a distribution of its own: built, installed, found by its entry point, like a built-in one.

One wheel is built from what `gateway protocols new` writes, and installed with pip into a folder of its own.
Beside it, by hand, lie distributions that are broken in different ways: they are named, and affect no other.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from gateway import config
from gateway.cli import scaffold
from gateway.errors import ConfigError
from protocols.messages import Idle, Velocity
from protocols.plugin import load
from tests.distributions import ROOT, Site
from tests.gateway.rig import BENCH, Rig, sent_commands

NAME = "g7_motor"
MIXED = BENCH.replace("[motors.left]\n", f'[motors.left]\nprotocol = "{NAME}"\noptions = {{}}\n').replace(
    'options = { watchdog = "acknowledged" }\n', ""
)
"""The left motor has the installed protocol and the right one a built-in one, on one bus."""
ROBOT = MIXED.replace("address = 2\n", 'address = 2\noptions = { watchdog = "acknowledged" }\n')
COLOURED = """
from dataclasses import replace
from protocols.plain import plugin
plugin = replace(plugin, name="g7_unspecified", spec=lambda device: device.color)
"""
BROKEN = {
    "raises": ("1 / 0", "ZeroDivisionError: division by zero"),
    "poor": ("import g7_dependency", "ModuleNotFoundError: No module named 'g7_dependency'"),
    "leaves": ("raise SystemExit(3)", "SystemExit: 3"),
    "panics": ("raise BaseException('a panic')", "BaseException: a panic"),
    "other": ("plugin = 5", "g7_other:plugin is not a protocols.plugin.Plugin"),
    "older": (
        "from protocols.plugin import Plugin\nplugin = Plugin('g7_older', wires=3)",
        "got an unexpected keyword argument 'wires' (it requires motor-gateway>=9)",
    ),
    "unspecified": (COLOURED, "AttributeError: 'Device' object has no attribute 'color'"),
}


@dataclass(frozen=True)
class Installed:
    """Folders with installed distributions, in the order of the search."""

    folders: tuple[Path, ...]

    def gateway(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the gateway outside the checkout, with the folders on its path."""
        path = os.pathsep.join(str(folder) for folder in (*self.folders, ROOT))
        home = str(self.folders[0])
        environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
        return subprocess.run(
            [sys.executable, "-P", "-m", "gateway", *arguments],
            cwd=home,
            env={**environment, "HOME": home, "XDG_RUNTIME_DIR": ""},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )


def python(*arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = scaffold.new(NAME, "can", tmp_path_factory.mktemp("source")).folder
    out = tmp_path_factory.mktemp("dist")
    python("build", "--wheel", "--no-isolation", "--outdir", str(out), str(folder))
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def sound(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    target = tmp_path_factory.mktemp("site")
    python("pip", "install", "-q", "--no-index", "--no-deps", "--target", str(target), str(wheel))
    return Installed((target,))


@pytest.fixture(scope="module")
def beside(sound: Installed, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The same, with the broken ones beside it."""
    with pytest.MonkeyPatch.context() as patch:
        site = Site(tmp_path_factory.mktemp("broken"), patch)
    for name, (source, _) in BROKEN.items():
        entry, more = f"g7_{name} = g7_{name}:plugin", "Requires-Dist: motor-gateway>=9\n"
        site.install(f"acme-{name}", entry, source, more=more if name == "older" else "")
    return Installed((site.path, *sound.folders))


@pytest.fixture
def here(sound: Installed, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process find it, too."""
    monkeypatch.syspath_prepend(str(sound.folders[0]))


# -- one that is sound ---------------------------------------------------------------------------------


def test_its_wheel_carries_the_package_and_its_data(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names == {f"{NAME}/{file}" for file in (*scaffold.PACKAGE, "py.typed")}


def test_it_is_listed_like_a_built_in_one(sound: Installed) -> None:
    done = sound.gateway("protocols")
    assert (done.returncode, done.stderr) == (0, "")
    listed = re.findall(r"^(\w+)", done.stdout, re.MULTILINE)
    assert {NAME, "odrive_can", "plain"} <= set(listed)
    assert listed == sorted(listed)


def test_a_robot_file_may_name_it(sound: Installed) -> None:
    robot = sound.folders[0] / "robot.toml"
    robot.write_text(ROBOT)
    done = sound.gateway("check", str(robot))
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(
        rf"^left +{NAME} +can0 +1 +0x101 +0x201 +cyclic, 10 ms +100 ms$", done.stdout, re.MULTILINE
    )
    wrong = ROBOT.replace(NAME, NAME[:-1]).replace("address = 1\n", "address = 99\n")
    robot.write_text(wrong)
    done = sound.gateway("check", str(robot))
    assert done.returncode == 2
    assert f"did you mean '{NAME}'?" in done.stderr


@pytest.mark.usefixtures("here")
def test_it_drives_a_motor_beside_a_built_in_one() -> None:
    rig = Rig(ROBOT)
    rig.run(0.5)
    ticks = rig.run(2.0, Velocity("left", 3.0), Velocity("right", 2.0))
    assert rig.velocity("left") == pytest.approx(3.0, abs=0.2)
    assert rig.velocity("right") == pytest.approx(2.0, abs=0.2)
    assert any(c.motor == "left" for _, c in sent_commands(rig.robot, ticks) if isinstance(c, Velocity))
    last = sent_commands(rig.robot, rig.leave())
    assert Idle("left") in [command for _, command in last]


# -- broken ones ---------------------------------------------------------------------------------------


def test_broken_ones_are_named_with_the_reason_and_left_out(beside: Installed, sound: Installed) -> None:
    done = beside.gateway("protocols")
    assert done.returncode == 1
    for name, (_, reason) in BROKEN.items():
        (line,) = [line for line in done.stderr.splitlines() if line.startswith(f"g7_{name}:")]
        assert line.startswith(f"g7_{name}: left out: acme-{name} is broken: ")
        assert line.endswith(reason)
    assert len(done.stderr.splitlines()) == len(BROKEN)
    assert done.stdout == sound.gateway("protocols").stdout


def test_a_robot_runs_beside_them(beside: Installed) -> None:
    robot = beside.folders[0] / "robot.toml"
    robot.write_text(ROBOT)
    done = beside.gateway("run", str(robot), "--fast", "--seconds", "0.5")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ticks" in done.stdout
    assert "acme" not in done.stdout + done.stderr


def test_the_contract_is_run_on_the_sound_one_beside_them(beside: Installed) -> None:
    done = beside.gateway("protocols", "check", NAME, "-q")
    failed = re.findall(r"^(\w+) +failed", done.stdout, re.MULTILINE)
    assert set(failed) <= {"vectors"}, done.stdout
    assert done.returncode == (1 if failed else 0)
    assert re.search(rf"^{NAME}: \d\d passed, {len(failed)} failed", done.stdout, re.MULTILINE)
    assert not done.stderr


@pytest.mark.usefixtures("here")
def test_a_robot_file_with_a_broken_one_is_refused_with_the_reason(
    beside: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(beside.folders[0]))
    for name, (_, reason) in BROKEN.items():
        with pytest.raises(ConfigError) as raised:
            config.parse_robot(ROBOT.replace(NAME, f"g7_{name}"))
        assert f"protocol 'g7_{name}' of acme-{name} is broken: " in str(raised.value)
        assert reason in str(raised.value)


@pytest.mark.usefixtures("here")
def test_a_spec_that_raises_later_is_a_mistake_in_the_robot_file(monkeypatch: pytest.MonkeyPatch) -> None:
    plugin = load(NAME)
    monkeypatch.setattr(f"{NAME}.ids", None)
    with pytest.raises(ConfigError, match=f"protocol '{NAME}' is broken: its spec raises TypeError"):
        config.parse_robot(ROBOT, find=lambda name: plugin if name == NAME else load(name))
