"""`import gateway`: quick, about sixty names, all documented, and one tree of errors."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest

import gateway
from gateway.errors import GatewayError

NAMES = sorted(set(gateway.__all__) - {"__version__"})
HEAVY = {"numpy", "can", "serial", "mcap", "mujoco", "matplotlib", "filterpy", "rosbags"}


def test_the_names_are_few() -> None:
    assert 45 <= len(NAMES) <= 70
    assert sorted(dir(gateway)) == sorted(gateway.__all__)
    assert gateway.__version__.count(".") == 2


@pytest.mark.parametrize("name", NAMES)
def test_each_name_is_there_and_documented(name: str) -> None:
    value = getattr(gateway, name)
    text = inspect.getdoc(value) or ""
    assert len(text.split()) >= 3, text
    if inspect.isfunction(value):
        for section in ("Args:", "Returns:"):
            assert section in text, f"{name} has no {section}"


def test_the_page_of_the_api_has_each_name() -> None:
    page = (Path(__file__).parents[1] / "docs" / "api.md").read_text()
    whole = [module for module in gateway._MODULES if f"automodule:: {module}\n" in page]
    one_by_one = {name for module, names in gateway._MODULES.items() if module not in whole for name in names}
    assert {"protocols.messages", "gateway.errors"} <= set(whole)
    assert {name for name in one_by_one if f":: {name}\n" not in page} == set()


def test_the_typing_names_are_the_lazy_ones() -> None:
    source = Path(gateway.__file__).read_text()
    typed = {line.split(" as ")[1].strip() for line in source.splitlines() if line.startswith("    from ")}
    assert typed == set(NAMES)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Goals'"):
        gateway.Goals  # noqa: B018 -- to look it up is the test


def test_every_error_of_ours_is_in_the_tree() -> None:
    errors = [getattr(gateway, name) for name in NAMES if name.endswith(("Error", "NotFound"))]
    assert len(errors) == 8
    assert all(issubclass(error, GatewayError) for error in errors)


def test_the_import_is_light() -> None:
    code = "import json, sys; old = {*sys.modules}; import gateway; new = {*sys.modules} - old"
    code += "; print(json.dumps(sorted(new)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert "gateway" in loaded
    assert not {name.split(".")[0] for name in loaded} & (HEAVY | {"protocols", "brain"})
    assert len(loaded) < 40, loaded


def test_no_name_is_hidden_by_a_package_of_the_same_name() -> None:
    """A package that is imported becomes an attribute of `gateway`, and the lazy name is never asked for."""
    packages = {path.name for path in Path(gateway.__file__).parent.iterdir() if path.is_dir()}
    assert not packages & set(NAMES)


@pytest.mark.parametrize("hiding", ["brain.py", "protocols/__init__.py", "protocols/mine.py"])
def test_a_file_that_hides_a_package_of_ours_is_named(tmp_path: Path, hiding: str) -> None:
    path = tmp_path / hiding
    path.parent.mkdir(exist_ok=True)
    path.write_text("")
    (tmp_path / "script.py").write_text("import gateway")
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=False
    )
    if hiding == "protocols/mine.py":  # a folder without __init__ hides nothing
        assert not done.returncode, done.stderr
        return
    last = done.stderr.splitlines()[-1]
    assert last.startswith("ImportError: motor-gateway needs its own package")
    assert str(path) in last
