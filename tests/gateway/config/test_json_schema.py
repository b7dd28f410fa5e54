"""The schemas of the files that a user writes, judged by an independent validator beside our own readers."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft7Validator

from gateway.cli.main import main
from gateway.cli.schema import FILES, Examples
from gateway.config import load_robot
from gateway.config.json_schema import Schema, rows_of
from gateway.errors import ConfigError

ROOT = Path(__file__).parents[3]
SHIPPED = [
    (kind, path)
    for kind in FILES
    for path in sorted((ROOT / "fixtures" / f"{kind}s").glob("*.toml"))
]  # fmt: skip
DEVICE_SETTINGS = "settings]"
"""What is configured on a device is explained by its maker's manual."""


@pytest.fixture(scope="module")
def schemas() -> dict[str, Schema]:
    return {kind: make() for kind, make in FILES.items()}


def objections(schema: Schema, text: str) -> set[str]:
    return {
        ".".join(map(str, error.absolute_path)) + ": " + error.message
        for error in Draft7Validator(schema).iter_errors(tomllib.loads(text))
    }


def test_every_schema_is_one_of_draft_7(schemas: dict[str, Schema]) -> None:
    for schema in schemas.values():
        Draft7Validator.check_schema(schema)


def test_every_file_that_ships_is_accepted(schemas: dict[str, Schema]) -> None:
    wrong = {
        str(path): found for kind, path in SHIPPED if (found := objections(schemas[kind], path.read_text()))
    }
    assert not wrong
    assert {kind for kind, _ in SHIPPED} == set(FILES)


DIFFBOT = (ROOT / "fixtures/robots/diffbot.toml").read_text()
# fmt: off
WRONG = [
    # what is written instead of what, and the key that is named
    ('rate_hz = 200', 'rate_hz = "200"', "rate_hz"),
    ('rate_hz = 200', 'rate_hz = 5000', "rate_hz"),
    ('kind = "can" ', 'kind = "can-fd" ', "buses.can0.kind"),
    ('bitrate = 1_000_000', 'bitrate = 1_000_000.5', "buses.can0.bitrate"),
    ('interface = "twin"', 'interfce = "twin"', "buses.can0"),
    ('protocol = "odrive_can"', 'protocol = "odrive"', "motors.left.protocol"),
    ('address = 1\n', 'adress = 1\n', "motors.left"),
    ('sign = 1 ', 'sign = 0 ', "motors.left.sign"),
    ('gear = 8.0', 'gear = 0.0', "motors.left.gear"),
    ('velocity = 20.0', 'velocity = true', "motors.left.limits.velocity"),
    ('body = "differential"', 'body = "diff"', "brain.body"),
    ('[motors.left.limits]', '[motors.left.limit]', "motors.left"),
    ('[brain]', '[brain.planner]\nmargin_m = 0.1\n[brain]', "brain.planner"),
]
# fmt: on


@pytest.mark.parametrize(("before", "after", "key"), WRONG)
def test_what_our_reader_refuses_the_schema_refuses_at_the_same_key(
    schemas: dict[str, Schema], before: str, after: str, key: str, tmp_path: Path
) -> None:
    assert before in DIFFBOT
    file = tmp_path / "robot.toml"
    file.write_text(DIFFBOT.replace(before, after, 1))
    assert any(one.startswith(f"{key}:") for one in objections(schemas["robot"], file.read_text()))
    with pytest.raises(ConfigError, match=key.replace(".", r"\.")):
        load_robot(file)


def test_options_are_those_of_the_protocol_that_is_chosen(schemas: dict[str, Schema]) -> None:
    text = DIFFBOT.replace('watchdog = "acknowledged"', 'model = "4310"', 1)
    assert [one.partition(":")[0] for one in objections(schemas["robot"], text)] == ["motors.left.options"]
    assert not objections(schemas["robot"], text.replace('"odrive_can"', '"damiao"', 1))


def test_what_defaults_have_may_be_left_out_elsewhere(schemas: dict[str, Schema]) -> None:
    text = "\n".join(line for line in DIFFBOT.splitlines() if not line.startswith("protocol ="))
    assert objections(schemas["robot"], text)
    assert not objections(schemas["robot"], text + '\n[defaults.motors]\nprotocol = "odrive_can"\n')


def test_every_key_says_what_it_means(schemas: dict[str, Schema]) -> None:
    """A key is explained below its field; that of a table by the table's own keys."""
    silent = [
        f"{heading} {row.key}"
        for kind in FILES
        for heading, rows in rows_of(schemas[kind]).items()
        if DEVICE_SETTINGS not in heading
        for row in rows
        if not row.text and not row.what.startswith("table")
    ]
    assert not silent


def test_the_command_prints_a_schema_writes_it_once_and_prints_the_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["schema", "mission"]) == 0
    printed: Any = json.loads(capsys.readouterr().out)
    file = tmp_path / "mission.schema.json"
    assert main(["schema", "mission", "--out", str(file)]) == 0
    assert json.loads(file.read_text()) == printed
    assert main(["schema", "mission", "--out", str(file)]) == 2
    assert "cannot be written: File exists" in capsys.readouterr().err
    assert main(["schema", "robot", "--keys"]) == 0
    row = "| `gear` | number, 0.001 to 10000 | `1` | `1.5` | Turns of the device's shaft per turn of the "
    row += "joint. |"
    printed = capsys.readouterr().out.splitlines()
    assert row in printed
    assert any(line.startswith("Settings of `brain/planning/") for line in printed)


@pytest.mark.parametrize("kind", FILES)
def test_keys_have_examples_from_the_files_that_ship_and_the_file_in_which_they_count(
    schemas: dict[str, Schema], kind: str
) -> None:
    example = Examples(kind)
    rows = [(heading, row) for heading, rows in rows_of(schemas[kind]).items() for row in rows]
    shown = [example.of(heading, row.key) for heading, row in rows if not row.what.startswith("table")]
    assert sum(map(bool, shown)) > {"robot": 200}.get(kind, 0.5 * len(shown))
    for one in filter(None, shown):
        tomllib.loads(f"key = {one}")
    assert all((ROOT / row.where).is_file() for _, row in rows if row.where)
