"""JUnit's XML, as servers of continuous integration read it."""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import escape, quoteattr


def junit_xml(suite: str, kind: str, cases: Sequence[tuple[str, str, Sequence[str]]]) -> str:
    """Return a suite of cases as XML.

    Args:
        suite: its name.
        kind: what a case is, as the name of its class.
        cases: name, the line that says how it failed ("": it passed), and lines of details, of each.
    """
    bad = sum(bool(wrong) for _, wrong, _ in cases)
    lines = ['<?xml version="1.0" encoding="utf-8"?>']
    lines.append(f'<testsuite name={quoteattr(suite)} tests="{len(cases)}" failures="{bad}">')
    for name, wrong, details in cases:
        head = f"  <testcase classname={quoteattr(kind)} name={quoteattr(name)}"
        failure = f"<failure message={quoteattr(wrong)}>{escape(chr(10).join(details))}</failure>"
        lines.append(f"{head}>{failure}</testcase>" if wrong else f"{head}/>")
    return "\n".join([*lines, "</testsuite>"]) + "\n"
