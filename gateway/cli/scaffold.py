"""`gateway protocols new`: a small distribution with a plugin, in which the places to fill in are marked.

Rules. What is written is `gateway/cli/templates`, a plugin that is linted, typed and tested in its place,
under another name. Nothing is overwritten: an existing folder is refused, like a name that Python, an
installed package or another protocol has, before anything is written.
"""

from __future__ import annotations

import keyword
import re
import sys
from dataclasses import dataclass
from importlib.metadata import packages_distributions
from importlib.resources import files
from pathlib import Path
from typing import Literal, TypeAlias

from gateway.errors import UserError
from protocols import plugin

Bus: TypeAlias = Literal["can", "canfd", "serial"]
BUSES: tuple[Bus, ...] = ("can", "canfd", "serial")
Kind: TypeAlias = Bus | Literal["sensor"]
"""A motor's on a bus, or that of a sensor that streams on a serial line"""
TEMPLATE = "gateway.cli.templates"
PACKAGE = (
    "__init__.py",
    "table.py",
    "line.py",
    "driver.py",
    "twin.py",
    "README.md",
    "vectors.json",
)
"""The files of the plugin's own package; besides there are py.typed, pyproject.toml and the test."""
SENSOR = tuple(file for file in PACKAGE if file != "line.py")
"""The same of a sensor's"""
OTHERS = ("protocols", "brain", "gateway", "fixtures", "tests", "test", "plugin", "blank")
"""Names of packages of the gateway, and of common packages."""


@dataclass(frozen=True, slots=True)
class Scaffold:
    """A distribution that was written."""

    name: str
    kind: Kind
    folder: Path
    files: tuple[Path, ...]


def new(name: str, kind: Kind, into: Path) -> Scaffold:
    """Write the folder `into/name`. Raises UserError if it must not be, or cannot be, written."""
    check_name(name)
    folder = into / name
    if not into.is_dir():
        raise UserError(f"{into} is not a folder; make it first, or choose another one with --into")
    if folder.exists() or folder.is_symlink():
        raise UserError(f"{folder} is there already: nothing was written; remove it, or choose another name")
    texts = contents(name, kind)
    try:
        for path, text in texts.items():
            place = folder / path
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error}") from error
    return Scaffold(name, kind, folder, tuple(folder / path for path in texts))


def check_name(name: str) -> None:
    """Check that a name can be a package, an entry point and a protocol in a robot file. Raises UserError."""
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) or len(name) > 40:
        hint = (
            re.sub(r"_+", "_", re.sub(r"[^a-z0-9]+", "_", name.lower())).strip("_0123456789")[:40].strip("_")
        )
        near = f", such as {hint!r}" if hint and hint != name and not _taken(hint) else ""
        raise UserError(
            f"{name!r} is no name for a plugin: lower-case letters, digits and single underscores, beginning "
            f"with a letter, 40 at most{near}"
        )
    if taken := _taken(name):
        raise UserError(f"{name!r} {taken}; choose another name, such as {name + '_motor'!r}")


def _taken(name: str) -> str:
    """Return what has this name already, as the end of a sentence; "" if it is free."""
    if keyword.iskeyword(name) or keyword.issoftkeyword(name):
        return "is a keyword of Python"
    if name in sys.stdlib_module_names or name in OTHERS:
        return "is the name of a common module"
    if name in {point.name for point in plugin.installed()}:
        return "is the name of an installed protocol"
    if owners := packages_distributions().get(name):
        return f"is the name of an installed package ({', '.join(sorted(set(owners)))})"
    return ""


def contents(name: str, kind: Kind) -> dict[str, str]:
    """Return the texts to write, by path in the folder."""
    files, place = (SENSOR, "sensor/") if kind == "sensor" else (PACKAGE, "")
    texts = {f"{name}/{file}": _read(place + file) for file in files}
    table, line = f"{name}/table.py", f"{name}/line.py"
    texts[table] = _put(texts[table], 'NAME = "blank"', f'NAME = "{name}"')
    if kind == "serial":
        texts |= _asked(name, texts)
    if kind == "canfd":
        texts[line] = _put(texts[line], '"serial"] = "can"', '"serial"] = "canfd"')
        texts[line] = _put(texts[line], "FD = False", "FD = True")
    texts[f"{name}/README.md"] = _renamed(texts[f"{name}/README.md"], name)
    texts[f"{name}/py.typed"] = ""
    project = _put(_read("project.toml"), "motor-gateway-blank", f"motor-gateway-{name.replace('_', '-')}")
    texts["pyproject.toml"] = _renamed(project, name)
    texts["tests/test_contract.py"] = _renamed(_read("test_contract.py"), name)
    return texts


def _asked(name: str, texts: dict[str, str]) -> dict[str, str]:
    """Return the texts that differ on a serial line: its devices speak only when asked."""
    package, asked = texts[f"{name}/__init__.py"], _put(_read("asked.py"), ".line_serial", ".line")
    for old, new in _ON_A_LINE:
        package = _put(package, old, new)
    return {
        f"{name}/__init__.py": package,
        f"{name}/asked.py": asked,
        f"{name}/line.py": _read("line_serial.py"),
    }


_ON_A_LINE = (
    (
        '''def read_only(_frame: Frame) -> bool:
    """True if a frame neither moves, arms, clears nor configures anything.

    FILL IN (clause "passive"): what the driver may send before the first command, such as queries. This
    device sends its status unasked, so there is nothing."""
    return False


''',
        "",
    ),
    (
        """        read_only=read_only,
        # FILL IN (clause "measurements"): polled, cyclic or only in replies to commands, and the period.
        feedback=FeedbackKind.CYCLIC,
        feedback_period=PERIOD,
""",
        """        # FILL IN (clause "measurements"): how often it is asked.
        feedback_period=PERIOD,
        **ASKED,
""",
    ),
    ("FeedbackKind, ", ""),
    (
        "from .driver import OFFLINE, MotorAdapter, Options",
        "from .asked import ASKED, AskedAdapter, AskedTwin\nfrom .driver import OFFLINE, Options",
    ),
    ("import MotorDecoder, MotorTwin, Settings", "import MotorDecoder, Settings"),
    ("driver_of(MotorAdapter", "driver_of(AskedAdapter"),
    ("twin=MotorTwin", "twin=AskedTwin"),
)
"""What `__init__` of the template has, and what it has on a serial line."""


def _read(file: str) -> str:
    return (files(TEMPLATE) / file).read_text(encoding="utf-8")


def _put(text: str, old: str, new: str) -> str:
    """Replace the one `old` in a text. Raises AssertionError if the template has none or several."""
    if text.count(old) != 1:
        raise AssertionError(f"the template has {old!r} {text.count(old)} times")
    return text.replace(old, new)


def _renamed(text: str, name: str) -> str:
    return re.sub(r"\bblank\b", name, text)


def next_steps(made: Scaffold) -> str:
    """Return what to do with it now, as text."""
    sensor = made.kind == "sensor"
    unseen = "" if sensor else "; one clause fails until vectors.json holds real bytes"
    page = "a sensor" if sensor else "a protocol"
    what = "what a sensor must do" if sensor else "a real motor, from its manual to a robot that drives"
    return f"""\
written: {made.folder}, a distribution of its own with a plugin for an invented device

next steps:
  cd {made.folder}
  python -m pip install --no-build-isolation --no-deps -e .
                                  installs its entry point; your changes take effect at once
  gateway protocols check {made.name}
                                  checks the contract{unseen}
  grep -rn "FILL IN" .            lists the places to fill in, each with the clause that checks it
docs/adding-{page.replace(" ", "-")}.md: {what}"""
