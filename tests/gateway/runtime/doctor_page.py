"""The tables of docs/doctor.md, which the tests of the doctor hold to what it says."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from gateway.runtime.doctor import Finding

PAGE = Path(__file__).parents[3] / "docs" / "doctor.md"


def rows() -> dict[str, tuple[str, ...]]:
    """Return the rows of all tables of the page by their first cell."""
    lines = [line for line in PAGE.read_text().splitlines() if line.startswith("| ") and "---" not in line]
    cells = [tuple(cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]) for line in lines]
    return {one[0]: one[1:] for one in cells}


def holds(
    cause: str, said: Sequence[tuple[str, str, str]], found: Sequence[Finding], when: float | None
) -> None:
    """Hold the rows of a cause against what was said of it: of what, part of what was seen, part of what to
    type; and after how many seconds [simulated], None where opening says it. Print the row that is due."""
    time = "at once" if when is None else f"{when:.0f} s"
    page = rows()
    for number, (about, seen, todo) in enumerate(said):
        name = cause if number == 0 else f"{cause} ({number + 1})"
        due = f"| {name} | {about} | `{seen}` | `{todo}` | {time} |"
        assert any(one.about == about and seen in one.seen and todo in one.todo for one in found), found
        assert name in page, f"docs/doctor.md lacks the row:\n{due}"
        *cells, stated = page[name]
        assert cells == [about, f"`{seen}`", f"`{todo}`"], f"docs/doctor.md has another row than:\n{due}"
        if when is None:
            assert stated == time, due
        else:
            assert abs(float(stated.split()[0]) - when) <= max(1.0, 0.2 * when), (
                f"the page says {stated}:\n{due}"
            )
