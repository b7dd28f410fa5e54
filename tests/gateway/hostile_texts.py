"""Texts that were made to do harm: files that a person may give, lines of an operator, messages in JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path
from random import Random

from gateway.operator.commands import COMMANDS

NUMBERS = (
    *("0", "1", "-1", "1e308", "-1e308", "1e-320", "1e20", "1e400", "nan", "inf", "-inf", "0x7f", "1_0", "٣"),
    *("90deg", "1e300rad", "5s", "1e9s", "2m", "1e300m", "3m/s", "9" * 18, "9" * 400, "9" * 900),
)
JSON = (
    *("NaN", "Infinity", "-Infinity", "1e400", "-1e400", "1e308", "-0.0", "9" * 400, "1" + "0" * 4000),
    *("true", "null", "[]", "{}", "[" * 2000 + "]" * 2000, '{"a":' * 2000 + "1" + "}" * 2000),
    *('"\\ud800"', '"\\u0000"', '"\x7f\x1b[2J"'),
)

FILES: dict[str, bytes] = {
    "an integer of 5,000 digits": b"[[steps]]\nwait = " + b"9" * 5000,
    "an integer of 400 digits": b"[[steps]]\nwait = " + b"9" * 400,
    "a number that is not finite": b"[[steps]]\nwait = nan",
    "a huge number": b"[[steps]]\ngoto = [1e308, -1e308]",
    "deep arrays": b"x = " + b"[" * 100_000,
    "deep tables": b"x" + b".x" * 50_000 + b" = 1",
    "deep steps": b"steps = " + b"[{repeat=2,steps=" * 30 + b"[]" + b"}]" * 30,
    "a NUL": b"[[steps]]\nwait = 1\n\0",
    "bytes that are no UTF-8": b"name = '\xff\xfe'\n",
    "UTF-16": "[[steps]]\nwait = 1\n".encode("utf-16"),
    "a key twice": b"[[steps]]\nwait = 1\nwait = 2\n",
    "too large": b"# " + b"x" * 10**6,
    "nothing": b"",
    "a recording": bytes(range(256)) * 20,
}
"""By what is wrong with each; of a mission file, as TOML."""


def write_files(folder: Path) -> list[Path]:
    """Write all of them, and what is no file at all."""
    folder.mkdir()
    paths = [folder / f"{number}.toml" for number in range(len(FILES))]
    for path, content in zip(paths, FILES.values(), strict=True):
        path.write_bytes(content)
    inside, pipe, dangling, round_ = (folder / f"{name}.toml" for name in ("folder", "pipe", "none", "round"))
    inside.mkdir()
    os.mkfifo(pipe)
    dangling.symlink_to(folder / "no.toml")
    round_.symlink_to(round_)
    strange = [folder / ("x" * 255) / "a.toml", folder / ("y" * 300 + ".toml"), folder / "a\0b.toml"]
    return [*paths, inside, pipe, dangling, round_, *strange]


def line(random: Random, names: list[str]) -> str:
    """Return a line of the operator's language, with wrong words at most places."""
    words = [random.choice(list(COMMANDS))]
    words += [random.choice(NUMBERS if random.random() < 0.6 else names) for _ in range(random.randrange(7))]
    return " ".join(words)


def message(random: Random, keys: list[str], texts: list[str]) -> str | bytes:
    """Return a message in JSON, or nearly, with these keys."""

    def value() -> str:
        return random.choice(JSON) if random.random() < 0.6 else json.dumps(random.choice(texts))

    pairs = [f"{json.dumps(random.choice(keys))}:{value()}" for _ in range(random.randrange(1, 5))]
    text = "{" + ",".join(pairs) + "}"
    match random.randrange(8):
        case 0:
            return text[: random.randrange(len(text))]
        case 1:
            return random.choice(JSON)
        case 2:
            return random.randbytes(random.randrange(1, 200))
    return text
