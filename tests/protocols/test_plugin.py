from __future__ import annotations

import sys
from pathlib import Path

import pytest

from protocols import plugin as interface
from protocols.conformance import CLAUSES, check
from protocols.plugin import GROUP, Broken, Plugin, UnknownProtocol, installed, load, load_all

GOOD = """
from dataclasses import replace
from protocols.plain import plugin as plain

plugin = replace(plain, name="acme", title="Acme's motors")
"""


class Shelf:
    """A directory on sys.path in which distributions are installed by hand."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def put(self, distribution: str, entry: str, module: str = "", source: str = "") -> None:
        info = self.path / f"{distribution.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{entry}\n")
        if module:
            (self.path / f"{module}.py").write_text(source)


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Shelf:
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in list(sys.modules):
        if name.startswith("acme_"):
            monkeypatch.delitem(sys.modules, name)
    return Shelf(tmp_path)


def test_ours_are_declared_as_anybodys() -> None:
    assert {"odrive_can", "plain"} <= {point.name for point in installed()}
    assert [point.name for point in installed()] == sorted(point.name for point in installed())


@pytest.mark.parametrize("name", ["odrive_can", "plain"])
def test_load(name: str) -> None:
    plugin = load(name)
    assert isinstance(plugin, Plugin)
    assert plugin.name == name


@pytest.mark.parametrize(
    ("name", "hint"),
    [("odrive", "; did you mean 'odrive_can'?"), ("plane", "; did you mean 'plain'?"), ("zzz", "")],
)
def test_an_unknown_name_is_answered_with_what_there_is_and_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(UnknownProtocol) as raised:
        load(name)
    names = ", ".join(point.name for point in installed())
    assert str(raised.value) == f"no protocol '{name}'; installed: {names}{hint}"
    assert raised.value.name == name
    assert raised.value.broken is None


def test_a_third_partys_distribution_is_found_and_treated_like_ours(shelf: Shelf) -> None:
    shelf.put("acme-motors", "acme = acme_good:plugin", "acme_good", GOOD)
    plugin = load("acme")
    assert plugin.title == "Acme's motors"
    loaded, broken = load_all()
    assert {"acme", "odrive_can", "plain"} <= {p.name for p in loaded}
    assert broken == ()
    (result,) = check(plugin, clauses=[clause for clause in CLAUSES if clause.name == "declared"])
    assert result.outcome == "passed"


# What the entry point names, what stands in that module (None: there is no such module), what is said.
BROKEN: list[tuple[str, str, str | None, str]] = [
    ("no module", "acme_nowhere", None, "ModuleNotFoundError: No module named 'acme_nowhere'"),
    ("no attribute", "acme_empty", "", "AttributeError: "),
    ("an error at import", "acme_bad", "1 / 0", "ZeroDivisionError: division by zero"),
    ("a syntax error", "acme_syntax", "def", "SyntaxError: "),
    ("the end of the program", "acme_exit", "raise SystemExit(3)", "SystemExit: 3"),
    ("no plugin", "acme_else", "plugin = 5", "acme_else:plugin is not a protocols.plugin.Plugin"),
    ("only its class", "acme_type", "from protocols.plugin import Plugin as plugin", "is not a protocols."),
]


@pytest.mark.parametrize(("module", "source", "reason"), [b[1:] for b in BROKEN], ids=[b[0] for b in BROKEN])
def test_a_broken_plugin_is_named_and_left_out(
    shelf: Shelf, module: str, source: str | None, reason: str
) -> None:
    shelf.put("acme-motors", f"acme = {module}:plugin", "" if source is None else module, source or "")
    loaded, broken = load_all()
    assert {"odrive_can", "plain"} <= {plugin.name for plugin in loaded}
    assert "acme" not in {plugin.name for plugin in loaded}
    (only,) = broken
    assert (only.name, only.distribution) == ("acme", "acme-motors")
    assert reason in only.reason
    with pytest.raises(UnknownProtocol) as raised:
        load("acme")
    assert str(raised.value) == f"protocol 'acme' of acme-motors is broken: {only.reason}"
    assert raised.value.broken == only
    assert load("plain").name == "plain"  # it hinders nobody


def test_a_broken_plugin_does_not_hinder_one_that_is_sound(shelf: Shelf) -> None:
    shelf.put("acme-motors", "acme = acme_good:plugin", "acme_good", GOOD)
    shelf.put("acme-brakes", "acme_brakes = acme_worse:plugin", "acme_worse", "raise SystemError('no')")
    loaded, broken = load_all()
    assert "acme" in {plugin.name for plugin in loaded}
    assert broken == (Broken("acme_brakes", "acme-brakes", "SystemError: no"),)


def test_entry_points_of_other_groups_are_not_ours(shelf: Shelf) -> None:
    shelf.put("acme-motors", "acme = acme_good:plugin", "acme_good", GOOD)
    info = next(shelf.path.glob("*.dist-info"))
    (info / "entry_points.txt").write_text("[console_scripts]\nacme = acme_good:plugin\n")
    assert "acme" not in {point.name for point in installed()}


def test_the_interface_imports_no_language() -> None:
    assert not [name for name in vars(interface) if name.startswith("odrive") or name == "plain"]
