"""Which language, and which of its files its driver and its ear lean on.

Rules. Nothing is listed by hand: a driver and an ear are built as the conformance kit builds them, and the
imports of the modules that their classes stand in are followed within the language's folder. Never followed
are the twin's own module, the one of the options and settings (a robot file's business, not the wire's), and
the package itself (its `Spec` is what the contract measures by).
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from protocols.conformance.bench import ADDRESSES, NAMES, rehearse
from protocols.plugin import Plugin, installed


@dataclass(frozen=True, slots=True)
class Language:
    """A device language that can be imported anew."""

    name: str
    package: str
    """Where its modules lie: `protocols.odrive_can`."""
    module: str
    attribute: str
    """Where its `Plugin` stands: `module` and name in it."""
    tests: str | None = None
    """The package of its tests, if there is one; its tests of vectors judge, too."""
    clauses: tuple[str, ...] | None = None
    """The clauses that judge; None: all."""

    def plugin(self) -> Plugin:
        """As it stands in the modules that are imported now, or are imported by this."""
        plugin: Plugin = getattr(importlib.import_module(self.module), self.attribute)
        return plugin

    def forget(self) -> None:
        """Take the language and its tests out of the imported modules: the next import reads them anew."""
        for name in list(sys.modules):
            if any(_within(name, package) for package in (self.package, self.tests)):
                del sys.modules[name]


def installed_language(name: str) -> Language:
    """An installed language with its tests in tests/protocols. LookupError if there is none of this name."""
    for point in installed():
        if point.name == name:
            tests = f"tests.protocols.{name}"
            found = importlib.util.find_spec(tests) is not None
            return Language(name, point.module, point.module, point.attr, tests if found else None)
    raise LookupError(f"no protocol {name!r} is installed")


def ours() -> list[str]:
    """The names of the installed languages that lie in this project."""
    return [point.name for point in installed() if point.module.startswith("protocols.")]


def mutated_modules(language: Language) -> dict[str, Path]:
    """The modules that driver and ear lean on, by name, in alphabetical order, with their files."""
    plugin = language.plugin()
    stage = rehearse(plugin, plugin.options(), ADDRESSES[:2], NAMES)
    left_out = {type(twin).__module__ for twin in stage.twins} | {language.package}
    left_out |= {plugin.options.__module__, plugin.settings.__module__}
    found: dict[str, Path] = {}
    ahead = sorted({type(stage.driver).__module__, type(stage.ear).__module__})
    while ahead:
        module = ahead.pop()
        if module in found or not _within(module, language.package):
            continue
        path = _file_of(module)
        found[module] = path
        ahead += [name for name in _imports(module, path.read_text("utf-8")) if name not in left_out]
    return dict(sorted(found.items()))


def _imports(module: str, source: str) -> Iterator[str]:
    """The modules that a module's source imports, at its top or anywhere else in it."""
    package = module if _file_of(module).name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            origin = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            for alias in node.names:
                inner = f"{origin}.{alias.name}"
                yield inner if _within(inner, package) and _is_module(inner) else origin


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def _file_of(module: str) -> Path:
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise LookupError(f"{module} has no source file")
    return Path(spec.origin)


def _within(name: str, package: str | None) -> bool:
    return package is not None and (name == package or name.startswith(package + "."))
