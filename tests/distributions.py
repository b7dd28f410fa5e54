"""Distributions that are installed by hand in a folder of their own, for this process and for others.

A `Site` is a folder on the path, as `pip install --target` makes it: it holds .dist-info folders with entry
points, and what they name. Modules that come from it are forgotten when the test is over."""

from __future__ import annotations

import os
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

from brain.skills import found
from gateway.recording import environment
from protocols.plugin import GROUP, Device, Plugin, Spec

ROOT = Path(__file__).resolve().parents[1]


CACHED = ((found, "_offered"), (found, "_loaded"), (environment, "_plugins"))
"""What is read once in a process: what is installed."""


class Site:
    """A folder on sys.path."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path, self._monkeypatch = path, monkeypatch
        path.mkdir(exist_ok=True)
        monkeypatch.syspath_prepend(str(path))

    def install(
        self,
        distribution: str,
        entry: str,
        source: str | None = None,
        module: str = "",
        more: str = "",
        group: str = GROUP,
    ) -> None:
        """A distribution with one entry point, by default a protocol, and a module if it has a source; `more`
        is metadata."""
        info = self.path / f"{distribution.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n{more}")
        (info / "entry_points.txt").write_text(f"[{group}]\n{entry}\n")
        module = module or entry.partition("=")[2].strip().partition(":")[0]
        self._forget(module)
        if source is not None:
            (self.path / f"{module}.py").write_text(source)

    def link(self, distribution: str, entry: str, folder: Path) -> None:
        """A distribution whose package lies in `folder`, which stays where it is."""
        self.install(distribution, entry)
        package = entry.partition("=")[2].strip().partition(":")[0]
        (self.path / package).symlink_to(folder / package)

    def project(self, folder: Path, version: str = "") -> None:
        """The distribution of a project, by its pyproject.toml; its packages stay where they are."""
        table = tomllib.loads((folder / "pyproject.toml").read_text())
        project = table["project"]
        info = self.path / f"{project['name'].replace('-', '_')}-x.dist-info"
        info.mkdir(exist_ok=True)
        metadata = (
            f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {version or project['version']}\n"
        )
        (info / "METADATA").write_text(metadata)
        entries = [
            f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
            for group, points in project["entry-points"].items()
        ]
        (info / "entry_points.txt").write_text("".join(entries))
        for package in table["tool"]["setuptools"]["packages"]:
            self._forget(package)
            if not (link := self.path / package).exists():
                link.symlink_to(folder / package)

    def environment(self, **more: str) -> dict[str, str]:
        """For another process that is to find the same."""
        kept = {key: os.environ[key] for key in ("PATH", "HOME") if key in os.environ}
        return {**kept, "PYTHONPATH": f"{self.path}{os.pathsep}{ROOT}", "OPENBLAS_NUM_THREADS": "1", **more}

    def spec(self, plugin: Plugin) -> Spec:
        """Of a device as it comes out of the box."""
        return plugin.spec(Device("motor", 1, plugin.options(), plugin.settings()))

    def _forget(self, module: str) -> None:
        for place, name in CACHED:
            self._monkeypatch.setattr(place, name, cache(getattr(place, name).__wrapped__))
        for name in list(sys.modules):
            if name == module or name.startswith(module + "."):
                self._monkeypatch.delitem(sys.modules, name)
