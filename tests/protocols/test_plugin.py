from __future__ import annotations

import sys
from pathlib import Path

import pytest

from protocols.conformance import CLAUSES, check
from protocols.plugin import Broken, Plugin, UnknownProtocol, installed, load, load_all
from tests.distributions import Site

GOOD = """
from dataclasses import replace
from protocols.plain import plugin as plain

plugin = replace(plain, name="acme", title="Acme's motors")
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    return Site(tmp_path / "site", monkeypatch)


def test_ours_are_declared_by_entry_points() -> None:
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
def test_an_unknown_name_raises_with_what_is_installed_and_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(UnknownProtocol) as raised:
        load(name)
    names = ", ".join(point.name for point in installed())
    assert str(raised.value) == f"no protocol '{name}'; installed: {names}{hint}"
    assert raised.value.name == name
    assert raised.value.broken is None


def test_a_third_partys_distribution_is_found_and_treated_like_ours(site: Site) -> None:
    site.install("acme-motors", "acme = acme_good:plugin", GOOD)
    plugin = load("acme")
    assert plugin.title == "Acme's motors"
    loaded, broken = load_all()
    assert {"acme", "odrive_can", "plain"} <= {p.name for p in loaded}
    assert broken == ()
    (result,) = check(plugin, clauses=[clause for clause in CLAUSES if clause.name == "declared"])
    assert result.outcome == "passed"


# What the entry point names, what stands in that module (None: there is no such module), the reason.
BROKEN: list[tuple[str, str, str | None, str]] = [
    ("no module", "acme_nowhere", None, "ModuleNotFoundError: No module named 'acme_nowhere'"),
    ("no attribute", "acme_empty", "", "AttributeError: "),
    ("an error at import", "acme_bad", "1 / 0", "ZeroDivisionError: division by zero"),
    ("a syntax error", "acme_syntax", "def", "SyntaxError: "),
    ("the end of the program", "acme_exit", "raise SystemExit(3)", "SystemExit: 3"),
    ("no plugin", "acme_else", "plugin = 5", "acme_else:plugin is not a protocols.plugin.Plugin"),
    ("a missing dependency", "acme_poor", "import acme_dependency", "No module named 'acme_dependency'"),
    ("another's panic", "acme_panic", "raise BaseException('panic')", "BaseException: panic"),
    ("another name", "acme_name", f"{GOOD}\nplugin = replace(plugin, name='other')", "calls itself 'other'"),
    ("a spec that raises", "acme_spec", f"{GOOD}\nplugin = replace(plugin, spec=len)", "TypeError: "),
    (
        "a spec that is none",
        "acme_none",
        f"{GOOD}\nplugin = replace(plugin, spec=repr)",
        "its spec gives str",
    ),
    ("options without defaults", "acme_options", f"{GOOD}\nplugin = replace(plugin, options=bytes.find)", ""),
    (
        "another interface",
        "acme_old",
        "from protocols.plugin import Plugin\nplugin = Plugin(ear=1)",
        "'ear'",
    ),
    ("a name that is gone", "acme_gone", "from protocols.plugin import Translator", "cannot import name"),
    ("only its class", "acme_type", "from protocols.plugin import Plugin as plugin", "is not a protocols."),
]


@pytest.mark.parametrize(("module", "source", "reason"), [b[1:] for b in BROKEN], ids=[b[0] for b in BROKEN])
def test_a_broken_plugin_is_named_and_left_out(
    site: Site, module: str, source: str | None, reason: str
) -> None:
    site.install("acme-motors", f"acme = {module}:plugin", source)
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
    assert load("plain").name == "plain"  # others are unaffected


def test_a_plugin_for_another_version_is_reported_with_the_version_it_requires(site: Site) -> None:
    source = "from protocols.plugin import Translator"
    site.install("acme-motors", "acme = acme_new:plugin", source, more="Requires-Dist: motor-gateway>=9\n")
    (broken,) = load_all()[1]
    assert broken.reason.startswith("ImportError: cannot import name 'Translator'")
    assert broken.reason.endswith("(it requires motor-gateway>=9)")


def test_a_keyboard_interrupt_is_not_a_broken_plugin(site: Site) -> None:
    site.install("acme-motors", "acme = acme_slow:plugin", "raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        load_all()
    assert load("plain").name == "plain"


def test_to_load_one_imports_no_other(site: Site) -> None:
    site.install("acme-motors", "acme = acme_good:plugin", GOOD)
    site.install("acme-brakes", "acme_brakes = acme_worse:plugin", "raise KeyboardInterrupt")
    assert load("acme").name == "acme"
    assert "acme_worse" not in sys.modules


def test_two_distributions_with_one_name_are_reported_and_neither_is_taken(site: Site) -> None:
    site.install("acme-motors", "acme = acme_good:plugin", GOOD)
    site.install("acme-clones", "acme = acme_clone:plugin", GOOD)
    plugins, broken = load_all()
    assert "acme" not in {plugin.name for plugin in plugins}
    assert broken == (
        Broken("acme", "acme-clones", "acme-motors has a protocol of that name too"),
        Broken("acme", "acme-motors", "acme-clones has a protocol of that name too"),
    )
    with pytest.raises(UnknownProtocol, match="acme-motors has a protocol of that name too"):
        load("acme")
    assert load("plain").name == "plain"


def test_our_names_cannot_be_taken(site: Site) -> None:
    site.install("a-clone", "plain = acme_good:plugin", GOOD.replace('"acme"', '"plain"'))
    plugins, broken = load_all()
    assert load("plain").title == next(p.title for p in plugins if p.name == "plain") != "Acme's motors"
    assert broken == (Broken("plain", "a-clone", "motor-gateway has a protocol of that name too"),)
    assert "acme_good" not in sys.modules


def test_a_spec_that_rejects_an_address_is_not_broken(site: Site) -> None:
    source = (
        GOOD + "\ndef spec(_): raise ValueError('an address from 7')\nplugin = replace(plugin, spec=spec)"
    )
    site.install("acme-motors", "acme = acme_seven:plugin", source)
    assert load("acme").name == "acme"


def test_an_entry_point_that_names_no_object_is_broken(site: Site) -> None:
    site.install("acme-motors", "acme = 5 6 7")
    assert load_all()[1] == (Broken("acme", "acme-motors", "'5 6 7' is not MODULE:NAME"),)


@pytest.mark.parametrize("content", [b"[motor_gateway.protocols]\nacme\n", b"\xff\xfe"], ids=["ini", "utf-8"])
def test_a_distribution_that_cannot_be_read_affects_no_other(site: Site, content: bytes) -> None:
    site.install("acme-motors", "acme = acme_good:plugin", GOOD)
    site.install("acme-brakes", "acme_brakes = acme_worse:plugin")
    next(site.path.glob("acme_brakes*/entry_points.txt")).write_bytes(content)
    plugins, (broken,) = load_all()
    assert {"acme", "odrive_can", "plain"} <= {plugin.name for plugin in plugins}
    assert load("acme").name == "acme"
    assert (broken.name, broken.distribution) == ("?", "acme-brakes")
    assert broken.reason.startswith("its entry points cannot be read: ")


def test_entry_points_of_other_groups_are_not_ours(site: Site) -> None:
    site.install("acme-motors", "acme = acme_good:plugin", GOOD)
    info = next(site.path.glob("*.dist-info"))
    (info / "entry_points.txt").write_text("[console_scripts]\nacme = acme_good:plugin\n")
    assert "acme" not in {point.name for point in installed()}
