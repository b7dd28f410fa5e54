"""Robot and world files that no person means: a mistake in words, soon, and with bounded memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.config import load_robot, parse_robot, resources
from gateway.config.text import MAX_SIZE
from gateway.errors import ConfigError
from gateway.sim.load import load_world, parse_world

DIFFBOT = resources.find("robots", "diffbot").read_text(encoding="utf-8")
OFFICE = resources.find("worlds", "office").read_text(encoding="utf-8")


def mistakes_in(read: Callable[[str], object], text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        read(text)
    assert len(caught.value.mistakes) <= 100
    assert max(len(str(one)) for one in caught.value.mistakes) < 2200
    return str(caught.value)


ANY_TOML = {
    "nested arrays": ("x = " + "[" * 500 + "]" * 500, "nested too deeply"),
    "many nested arrays": ("x = " + "[" * 10**5 + "]" * 10**5, "nested too deeply"),
    "nested tables": ("x = " + "{a = " * 500 + "1" + "}" * 500, "nested too deeply"),
    "a dotted key": ("x" + ".x" * 10**5 + " = 1", "nested too deeply"),
    "a dotted key in quotes": ("x" + '."\\""' * 20 + ".'y'" * 20 + " = 1", "nested too deeply"),
    "a dotted header": ("[x" + ".x" * 10**5 + "]", "nested too deeply"),
    "a dotted key in a table": ("x = {a" + ".b" * 10**5 + " = 1}", "nested too deeply"),
    "digits": (f"seed = {'9' * 5000}", "not TOML: an integer of thousands of digits"),
    "hexadecimal digits": (f"seed = 0x{'f' * 5000}", "seed"),
    "keys": ("".join(f"k{i} = 1\n" for i in range(10**6)), "the file is too large"),
    "keys in a small file": (
        "".join(f"k{i}=1\n" for i in range(11_000)),
        "keys and values: expected at most 10000",
    ),
    "items": (f"x = [{'1,' * 11_000}]", "keys and values: expected at most 10000"),
    "unknown keys": ("".join(f"k{i}=1\n" for i in range(9_000)), "no key 'k0'"),
    "a long key": ("k" * 10**5 + " = 1", "no key 'kkk"),
    "NUL": ("name = 'x\0'", "character '\\x00'"),
}


@pytest.mark.parametrize("read", [parse_robot, parse_world])
@pytest.mark.parametrize("case", ANY_TOML)
def test_any_toml_is_read_or_refused_in_words(read: Callable[[str], object], case: str) -> None:
    text, mistake = ANY_TOML[case]
    assert mistake in mistakes_in(read, f"kind = 'bench'\n{text}")


OFTEN = "".join(f"[motors.m{i}]\nprotocol = 'odrive_can'\nbus = 'can0'\naddress = {i}\n" for i in range(900))


@pytest.mark.parametrize(
    ("old", "new", "mistake"),
    [
        ("rate_hz = 200", "rate_hz = 1e308", "found 1e+308, expected a finite number from 10 to 1000 steps"),
        ("rate_hz = 200", f"seed = {10**18}", "found 1000000000000000000, expected an integer from 0"),
        ("feedback_timeout_ms = 100", "feedback_timeout_ms = 3600000", "found 3600000, expected"),
        ("feedback_timeout_ms = 100", "feedback_timeout_ms = 1e308", "found 1e+308, expected"),
        ("timeout_ms = 500", "timeout_ms = 3600000", "of milliseconds from 1 to 5000"),
        ("bitrate = 1_000_000", "bitrate = 1", "expected an integer from 5000 to 1000000"),
        (
            "max_linear = 0.6",
            "max_linear = 1e308",
            "found 1e+308, expected a finite number from 0.001 to 20 m/s",
        ),
        (
            "wheel_radius = 0.05",
            "wheel_radius = 1e-300",
            "found 1e-300, expected a finite number from 0.005 to 2 m",
        ),
        (
            "[brain.differential]",
            "[brain.planner]\nmargin = 10\n[brain.differential]",
            "found 10, expected a finite number from 0 to 1 m",
        ),
        ('name = "diffbot"', f'name = "{"x" * 1000}"', "expected letters, digits, _ and -"),
        ('world = "office"', 'world = "a\\u0000b.toml"', "there is no file"),
        ("[motors.left]", f"{OFTEN}[motors.left]", "motors: found 902 tables, expected at most 256"),
    ],
)
def test_a_careless_value_of_a_robot_is_a_mistake_in_words(old: str, new: str, mistake: str) -> None:
    assert old in DIFFBOT
    text = DIFFBOT.replace(old, new, 1)
    assert mistake in mistakes_in(lambda text: parse_robot(text, file=Path("r.toml")), text)


@pytest.mark.parametrize(
    ("old", "new", "mistake"),
    [
        ("friction = 1.0", "friction = 1e308", "found 1e+308, expected a finite number from 0.01 to 10"),
        ("size = [1.2, 0.6, 0.4]", "size = [1.2, 1e-300, 0.4]", "expected an array of 3 finite numbers"),
        ("x = 0.0,", "x = 1e300,", "found 1e+300, expected a finite number from -1000 to 1000"),
        ("[walls.south]", "".join(f"[walls.w{i}]\n" for i in range(600)) + "[walls.south]", "found 6"),
    ],
)
def test_a_careless_value_of_a_world_is_a_mistake_in_words(old: str, new: str, mistake: str) -> None:
    assert old in OFFICE
    assert mistake in mistakes_in(parse_world, OFFICE.replace(old, new, 1))


@pytest.mark.parametrize("load", [load_robot, load_world])
def test_of_a_very_large_file_only_the_beginning_is_read(
    load: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "large.toml"
    with path.open("wb") as file:
        file.truncate(100 * 2**20)
    tracemalloc.start()
    with pytest.raises(ConfigError, match=f"the file is too large: expected at most {MAX_SIZE} characters"):
        load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6
