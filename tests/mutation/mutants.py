"""The mutants of a source file, as package mutmut 3.8 makes them: one change in one function each.

Rules. mutmut writes all mutants of a file into one text, each a copy of its function under a name of its own;
here each is put back in the place of its function, under the function's name. What mutmut leaves alone stays
alone: what stands outside of functions, decorated functions, annotations, docstrings. Left out besides, and
counted: another wording of a sentence, or of an exception, which is for people and changes nothing that a
program does.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mutmut.mutation.file_mutation import mutate_file_contents

ORIGINAL = "__mutmut_orig"


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change in one function."""

    module: str
    file: str
    """The file's name in the language's folder."""
    function: str
    """`name` or `Class.name`."""
    diff: str
    """The lines that differ, old ones after "- ", new ones after "+ "."""
    identity: str
    """Digest of the function and of what became of it."""
    text: str
    """The mutated function."""


@dataclass(frozen=True, slots=True)
class Source:
    """A file and its mutants."""

    module: str
    path: Path
    text: str
    places: Mapping[str, tuple[int, int]]
    """Of each function: its first line, decorators included, and the one behind its last, from 0."""
    mutants: tuple[Mutant, ...]
    wordings: int
    """Mutants left out: other wordings of sentences."""

    def with_mutant(self, mutant: Mutant) -> str:
        """The file's text with the mutant in the place of its function."""
        lines = self.text.split("\n")
        first, end = self.places[mutant.function]
        return "\n".join([*lines[:first], *mutant.text.split("\n"), *lines[end:]])

    @property
    def digest(self) -> str:
        """Of the file as it was read."""
        return digest(self.text)


def digest(*texts: str) -> str:
    """Some texts as one short word."""
    whole = hashlib.sha256()
    for text in texts:
        whole.update(hashlib.sha256(text.encode()).digest())
    return whole.hexdigest()[:16]


def source_of(module: str, path: Path) -> Source:
    """A file with all its mutants, in the order of the file."""
    text = path.read_text("utf-8")
    made = mutate_file_contents(str(path), text)
    lines, spans = made.code.split("\n"), made.line_span_by_function_name
    mutants: dict[str, Mutant] = {}
    wordings = 0
    for name in made.mutant_names:
        mangled = name.rpartition("__mutmut_")[0]
        function = _function(mangled)
        old, new = (
            _renamed(lines[spans[each].start - 1 : spans[each].end], each, function)
            for each in (mangled + ORIGINAL, name)
        )
        if _only_worded(old, new):
            wordings += 1
            continue
        mutant = Mutant(
            module, path.name, function, _difference(old, new), digest(path.name, function, old, new), new
        )
        mutants.setdefault(mutant.identity, mutant)
    return Source(module, path, text, _places(text), tuple(mutants.values()), wordings)


def _function(mangled: str) -> str:
    """`x_name` is mutmut's word for `name`, `xǁClassǁname` for `Class.name`."""
    return ".".join(mangled.split("ǁ")[1:]) if "ǁ" in mangled else mangled.removeprefix("x_")


def _renamed(lines: Sequence[str], name: str, function: str) -> str:
    """A function as mutmut wrote it, under its own name, without the comments and blank lines above it."""
    start = next(at for at, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#"))
    return "\n".join(lines[start:]).replace(f"def {name}(", f"def {function.rpartition('.')[2]}(", 1)


def _places(text: str) -> dict[str, tuple[int, int]]:
    places: dict[str, tuple[int, int]] = {}

    def note(body: Sequence[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef):
                first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
                places[prefix + node.name] = (first - 1, node.end_lineno or node.lineno)
            elif isinstance(node, ast.ClassDef) and not prefix:
                note(node.body, f"{node.name}.")

    note(ast.parse(text).body, "")
    return places


def _difference(old: str, new: str) -> str:
    lines = list(difflib.unified_diff(old.split("\n"), new.split("\n"), n=0, lineterm=""))[2:]
    return "\n".join(f"{line[0]} {line[1:].strip()}" for line in lines if not line.startswith("@@"))


def _only_worded(old: str, new: str) -> bool:
    """Whether all that differs is in sentences: string literals with a space in them, texts of exceptions."""
    return _unworded(old) == _unworded(new)


def _unworded(text: str) -> str:
    """What a function does, without its sentences."""
    tree = ast.parse("if True:\n" + text if text[:1].isspace() else text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            node.exc.args = [arg for arg in node.exc.args if not _is_text(arg)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            node.value = " "
    return ast.dump(tree)


def _is_text(node: ast.expr) -> bool:
    """A text, or the None that a mutant puts in its place."""
    plain = isinstance(node, ast.Constant) and (node.value is None or isinstance(node.value, str))
    return plain or isinstance(node, ast.JoinedStr)
