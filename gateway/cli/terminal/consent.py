"""Asking a person before something moves."""

from __future__ import annotations

import sys

from gateway.errors import UserError


def ask_consent(what: str, given: bool) -> None:
    """Say what will happen, and return if it may. `given`: by --yes. Raises UserError if it may not."""
    print(what)
    if given:
        return
    if not sys.stdin.isatty():
        raise UserError("nothing was done: give --yes, or answer on a terminal")
    print("Go on? [y/N] ", end="", flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UserError("nothing was done")
