"""What a new robot file must know: questions made of dataclasses, and who answers them.

Rules. A question is a field without a default, or one that a number's meaning hangs on; its text is what the
source says of the field. An answer is stated, or asked for; what nobody tells is noted, and all of it is
told at once. Only a question with a proposal is answered by that.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING
from functools import cache
from itertools import pairwise
from typing import Any, Literal, NamedTuple, get_args, get_origin

from gateway.errors import UserError
from protocols.bounds import Settings, bounds_of, hints, keys

YES_NO = {"y": "true", "yes": "true", "n": "false", "no": "false"}


class Question(NamedTuple):
    """One thing that must be known."""

    key: str
    """By which it is stated: --set KEY=VALUE"""
    text: str
    proposal: str = ""
    """What is taken unless something else is stated; "": nothing is."""


class Answers:
    """What is stated, and who is asked for the rest. What nobody tells is noted, and stood in for."""

    def __init__(self, stated: Mapping[str, str], ask: Callable[[Question], str] | None = None) -> None:
        self._stated, self._ask = dict(stated), ask
        self._used: set[str] = set()
        self.missing: list[Question] = []
        self.proposed: dict[str, str] = {}
        """What was taken since nothing else was stated."""

    def has(self, key: str) -> bool:
        """True if it is stated."""
        return key in self._stated

    def state(self, key: str, value: str) -> None:
        """Note what was found out elsewhere."""
        self._stated[key] = value

    def forget(self, keys: Iterable[str]) -> None:
        """Leave out what was noted, and was not needed."""
        self._used |= {*keys}

    def get(self, question: Question, hint: object, stand_in: object = 1.0) -> Any:  # noqa: ANN401 -- as hinted
        """Return an answer, of the type of a field. Raises UserError if what is stated cannot be one."""
        key, asked = question.key, question
        self._used.add(key)
        while key not in self._stated:
            if question.proposal and self._ask is None:
                self.proposed[key] = question.proposal
                return converted(question.proposal, hint)
            if self._ask is None:
                self.missing.append(question)
                return stand_in
            given = self._ask(asked) or question.proposal
            try:
                converted(given, hint)
            except ValueError as error:
                asked = question._replace(text=f"{error}; {question.text}")
                continue
            self.proposed |= {key: given} if given == question.proposal else {}
            self._stated[key] = given
        try:
            return converted(self._stated[key], hint)
        except ValueError as error:
            raise UserError(f"--set {key}={self._stated[key]}: {error}; it is: {question.text}") from error

    def check_missing(self) -> None:
        """Raise UserError with all that is missing."""
        lines = [
            f"{_option(one.key)}=…    {one.text}" for one in {one.key: one for one in self.missing}.values()
        ]
        if lines:
            raise UserError("\n".join(["to be stated, too (or asked on a terminal):", *lines]))

    def check(self) -> None:
        """Raise UserError with all that is missing, or with what was stated and is none of it."""
        self.check_missing()
        if strange := self._stated.keys() - self._used:
            raise UserError(f"stated, and nothing of this robot: {', '.join(sorted(strange))}")


def _option(key: str) -> str:
    """Return the option by which something is stated."""
    name, _, of = key.rpartition(".")
    return f"--motor {name}" if of == "address" else f"--set {key}"


def converted(text: str, hint: object) -> Any:  # noqa: ANN401 -- as hinted
    """Return a text as a value of a field. Raises ValueError with what was expected."""
    if get_origin(hint) is Literal or isinstance(hint, tuple):
        choices = [*map(str, get_args(hint) or hint)]  # type: ignore[call-overload]  # a tuple of texts
        if text not in choices:
            raise ValueError(f"found {text!r}, expected {', '.join(choices)}")
        return text
    several = get_origin(hint) is tuple
    if several and get_args(hint)[0] is str:
        return [one.strip() for one in text.split(",") if one.strip()]
    if hint is str:
        return text
    if hint is bool:
        return converted(YES_NO.get(text.lower(), text), ("true", "false")) == "true"
    try:
        value = tomllib.loads(f"x = [{text}]" if several and "[" not in text else f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        raise ValueError(
            f"found {text!r}, expected {bounds_of(hint) or 'a number, or a list of them'}"
        ) from None
    bounds = bounds_of(hint)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if bounds is not None and number and not bounds.admit(value):
        raise ValueError(f"found {text}, expected a number {bounds}")
    if float in (hint, *get_args(hint)) and number:
        return float(value)
    if (hint is float or int in (hint, *get_args(hint))) and type(value) is not int:
        raise ValueError(f"found {text}, expected {'a number' if hint is float else 'an integer'}")
    return value


@cache
def docs(kind: type) -> Mapping[str, str]:
    """Return what the source says of each field of a dataclass, its first sentence."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__[:-1]):
        try:
            (made,) = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        except (OSError, TypeError, ValueError, SyntaxError):
            continue
        body = made.body if isinstance(made, ast.ClassDef) else []
        for field_, text in pairwise(body):
            if isinstance(field_, ast.AnnAssign) and isinstance(text, ast.Expr):
                said = ast.literal_eval(text.value) if isinstance(text.value, ast.Constant) else ""
                sentence = " ".join(str(said).split()).partition(". ")[0]
                found[getattr(field_.target, "id", "")] = sentence.rstrip(".,")
    return found


def required(kind: type[Settings]) -> list[str]:
    """Return the keys of a dataclass that have no default."""
    return [
        key for key, one in keys(kind).items() if one.default is MISSING and one.default_factory is MISSING
    ]


def question_of(kind: type[Settings], name: str, key: str, proposal: str = "") -> Question:
    """Return the question for a field of a dataclass."""
    bounds = bounds_of(hints(kind)[name])
    said = docs(kind).get(name, "")
    return Question(key, said or f"{name.replace('_', ' ')}{f', {bounds.unit}' if bounds else ''}", proposal)
