"""Keyframes: the state of a replay after some of its ticks, as bytes, so that it can go on from there.

Rules. A keyframe is a pickle, hence code to whoever loads it: it is only ever read from a folder that belongs
to this user and is closed to all others, and never from a recording or from beside one. What can never change
(the robot, tables, compiled functions: all that a deep copy shares) is not in it, but referred to by its
number in the state before the first step. So a keyframe is good only for the recording, the robot and the
sources it was made with: the name of its folder is a digest of all three.
"""

from __future__ import annotations

import copy
import hashlib
import logging
import os
import pickle
import re
import sys
import zlib
from bisect import bisect_right, insort
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from struct import Struct
from tempfile import TemporaryDirectory
from types import FunctionType
from typing import Any, Literal, NamedTuple

import numpy as np

from brain.skills import found as skills
from gateway.recording import Recording, environment
from gateway.replay.own_folder import OwnFolder
from protocols.entry_points import is_ours, offered

log = logging.getLogger("gateway")

SPACING = 500
"""Ticks between two keyframes, at first: what a seek has to step at most."""
LIMIT = 512_000_000
"""Bytes of the keyframes of one recording: beyond, every other one is dropped,"""
TOTAL_LIMIT = 2_000_000_000
"""and of those of all: beyond, the recordings that were not played for the longest time are dropped."""
WHOLE = 128 * 1024 * 1024
"""Bytes of a recording that are read to recognise it: a larger one would take seconds to open."""
_DIGEST = 16
_NAME = re.compile("[0-9a-f]{32}")
"""The name of a recording's folder: nothing else is ever dropped."""
_PROTOCOL = 5
_LEVEL = 4
"""A tenth smaller than with 1, in 10 ms more."""


class StateCodec:
    """State to bytes and back.

    Args:
        state: a state of this kind before its first step.
        constants: what never changes, beside what is found in `state`.
    """

    def __init__(self, state: object, constants: Sequence[object] = ()) -> None:
        found = _Collector(constants)
        found.dump(state)
        self.constants = found.constants
        self._numbers = {id(each): number for number, each in enumerate(found.constants)}
        self.modules = found.modules
        """Where the state's classes and functions are defined."""
        self.kinds = [getattr(each, "__qualname__", type(each).__qualname__) for each in self.constants]
        """What the numbers of the constants mean."""

    def dump(self, state: object) -> bytes:
        """Return a state as bytes. Raises what pickle raises if there is in it what cannot be pickled."""
        file = BytesIO()
        _Dumper(file, self._numbers).dump(state)
        return zlib.compress(file.getbuffer(), _LEVEL)

    def load(self, data: bytes) -> Any:  # noqa: ANN401 -- whatever was dumped
        """Return the state in bytes that `dump` made, by this or another codec of the same kind of state."""
        return _Loader(BytesIO(zlib.decompress(data)), self.constants).load()


class _Collector(pickle.Pickler):
    """Finds the constants of a state, always in the same order."""

    def __init__(self, constants: Sequence[object]) -> None:
        super().__init__(BytesIO(), _PROTOCOL)
        self.constants = list(constants)
        self.modules: set[str] = set()
        self._known = {id(each) for each in constants}

    def persistent_id(self, each: Any) -> bool | None:  # noqa: ANN401 -- any object
        if id(each) in self._known:
            return True
        self.modules.add((each if isinstance(each, FunctionType | type) else type(each)).__module__)
        if not _is_constant(each):
            return None
        self.constants.append(each)
        self._known.add(id(each))
        return True


def _is_constant(each: object) -> bool:
    """True for functions, and for what is its own deep copy by its own account."""
    if isinstance(each, type):
        return False
    return isinstance(each, FunctionType) or (
        hasattr(type(each), "__deepcopy__") and copy.deepcopy(each) is each
    )


class _Dumper(pickle.Pickler):
    def __init__(self, file: BytesIO, numbers: Mapping[int, int]) -> None:
        super().__init__(file, _PROTOCOL)
        self._numbers = numbers

    def persistent_id(self, each: object) -> int | None:
        return self._numbers.get(id(each))

    def reducer_override(self, each: object) -> Any:  # noqa: ANN401 -- as pickle declares it
        """Let an array come back as a deep copy would: with memory of its own, which it may resize."""
        if type(each) is Struct:
            return Struct, (each.format,)
        if type(each) is not np.ndarray or each.dtype.hasobject:
            return NotImplemented
        order: Literal["C", "F"] = "F" if each.flags.f_contiguous and not each.flags.c_contiguous else "C"
        return _array, (each.tobytes(order), each.dtype, each.shape, order)


def _array(
    data: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], order: Literal["C", "F"]
) -> np.ndarray[Any, np.dtype[Any]]:
    made = np.empty(shape, dtype, order)
    made.reshape(-1, order=order).view(np.uint8)[:] = np.frombuffer(data, np.uint8)
    return made


class _Loader(pickle.Unpickler):
    def __init__(self, file: BytesIO, constants: Sequence[object]) -> None:
        super().__init__(file)
        self.constants = constants

    def persistent_load(self, number: Any) -> object:  # noqa: ANN401 -- as pickle declares it
        return self.constants[number]


class Frame(NamedTuple):
    """Which keyframe."""

    played: int
    """Number of ticks played,"""
    now: int
    """and the time of the last of them [ns]."""

    @property
    def file(self) -> str:
        """The name of its file."""
        return f"{self.played}_{self.now}.key"


class Keyframes:
    """The keyframes of one recording, in files of their own.

    Args:
        name: of their folder; None: they are not kept for the next time.
        cache: the folder of all recordings; None: the user's own. If one of the two is not this user's alone,
            they are not kept for the next time.
    """

    def __init__(self, name: str | None, cache: Path | None = None, limit: int = LIMIT) -> None:
        self.spacing = SPACING
        """Ticks between two keyframes."""
        self._limit = limit
        self._temporary: TemporaryDirectory[str] | None = None
        folder = _kept_folder(name, cache, TOTAL_LIMIT - limit) if name else None
        if folder is None:
            self._temporary = TemporaryDirectory(prefix="motor-gateway-")
            folder = OwnFolder(self._temporary.name)
        self._folder = folder
        self._sizes = {
            frame: found.st_size
            for name, found in folder.found().items()
            if (frame := _frame_of(name)) is not None
        }
        self._frames = sorted(self._sizes)

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return sum(self._sizes.values())

    def last(self, *, now: int = sys.maxsize, played: int = sys.maxsize) -> Frame | None:
        """Return the last one at this time or before it, after so many ticks at most."""
        at = bisect_right(self._frames, played, key=lambda frame: frame.played)
        return next((self._frames[i] for i in range(at - 1, -1, -1) if self._frames[i].now <= now), None)

    def put(self, frame: Frame, data: bytes) -> None:
        """Keep one. If the disk does not take it, there is none at this place."""
        try:
            self._folder.write(frame.file, _digest(data) + data)
        except OSError as error:
            log.info("keyframe not kept: %s", error)
            return
        if frame not in self._sizes:
            insort(self._frames, frame)
        self._sizes[frame] = _DIGEST + len(data)
        while self.size > self._limit and len(self._frames) > 1:
            self.spacing *= 2
            for each in [each for each in self._frames[:-1] if each.played % self.spacing]:
                self.drop(each)

    def get(self, frame: Frame) -> bytes | None:
        """Return one as it was put; None if it is damaged, gone, or another user's: then it is dropped."""
        try:
            content = self._folder.read(frame.file)
        except OSError as error:
            log.info("keyframe not used: %s", error)
            content = b""
        data = content[_DIGEST:]
        if content[:_DIGEST] == _digest(data):
            return data
        self.drop(frame)
        return None

    def drop(self, frame: Frame) -> None:
        """Remove one."""
        self._frames.remove(frame)
        del self._sizes[frame]
        self._folder.remove(frame.file)

    def close(self) -> None:
        """Remove them, unless they are kept for the next time."""
        self._folder.close()
        if self._temporary is not None:
            self._temporary.cleanup()


def folder_name(
    recording: Recording, robot_text: str, facts: Mapping[str, str], codec: StateCodec
) -> str | None:
    """Return a digest of all that a keyframe depends on; None if the recording cannot be read.

    `facts` are those of this program (`environment.facts`); the sources of others' plugins are not among
    them, and are read here."""
    digest = hashlib.blake2b(digest_size=_DIGEST)
    try:
        digest.update(_content(recording.path))
    except OSError:
        return None
    kinds = " ".join(codec.kinds)
    for name, value in sorted({**facts, "robot": robot_text, "constants": kinds}.items()):
        digest.update(f"{name}\0{value}\0".encode(errors="surrogateescape"))
    modules = {*codec.modules, *(p.module for p in offered(skills.GROUP).points if not is_ours(p))}
    for package in sorted({module.partition(".")[0] for module in modules} - _WITH_FACTS):
        for path in _files(package):
            digest.update(f"{package}\0{path.name}\0".encode(errors="surrogateescape"))
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _content(path: Path) -> bytes:
    """Return a digest of a file: of all of it; of a large one of its ends, its size and its last change."""
    status = path.stat()
    with path.open("rb") as file:
        if status.st_size <= WHOLE:
            return hashlib.file_digest(file, "sha256").digest()
        digest = hashlib.sha256(repr((status.st_size, status.st_mtime_ns, status.st_ino)).encode())
        digest.update(file.read(WHOLE // 8))
        file.seek(-WHOLE // 8, os.SEEK_END)
        digest.update(file.read())
    return digest.digest()


_WITH_FACTS = {*environment.ROOMS, *sys.stdlib_module_names, "filterpy", "numpy", "rosbags"}
"""Packages whose version or sources are among the facts, or come with Python."""


def _files(package: str) -> list[Path]:
    """Return the sources of a package that is not ours."""
    module = sys.modules.get(package)
    spec = find_spec(package) if module is None else None  # a skill that no step needed yet
    within = getattr(module, "__path__", None) or (spec and spec.submodule_search_locations)
    folders = [Path(folder) for folder in within or ()]
    if not folders:
        file = getattr(module, "__file__", None) or (spec and spec.origin)
        return [Path(file)] if file else []
    return sorted(path for folder in folders for path in folder.rglob("*.py"))


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_DIGEST).digest()


def _frame_of(file: str) -> Frame | None:
    stem, _, ending = file.rpartition(".")
    played, _, now = stem.partition("_")
    try:
        return Frame(int(played), int(now)) if ending == "key" else None
    except ValueError:
        return None


def _user_cache() -> Path:
    """Return the folder for keyframes in the user's cache, as freedesktop's XDG Base Directory has it."""
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (given if given.is_absolute() else Path("~/.cache").expanduser()) / "motor-gateway/keyframes"


def _kept_folder(name: str, cache: Path | None, rest: int) -> OwnFolder | None:
    """Return the folder of a recording in the cache; None if there can be none for this user alone. Those of
    recordings that were not played for longest are removed, as far as all of them take more than `rest`."""
    try:
        root = OwnFolder(cache or _user_cache())
        with closing(root):
            folder = root.folder(name)
            folder.touch()
            _make_room(root, name, rest)
            return folder
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        log.warning("keyframes are not kept for the next time: %s", error)
        return None


def _make_room(root: OwnFolder, name: str, rest: int) -> None:
    found = {each: at for each, at in root.found().items() if _NAME.fullmatch(each) and each != name}
    for each in sorted(found, key=lambda each: found[each].st_mtime_ns, reverse=True):
        with suppress(OSError), closing(root.folder(each)) as folder:  # another player may have removed it
            rest -= sum(file.st_size for file in folder.found().values())
        if rest < 0:
            root.remove_folder(each)
