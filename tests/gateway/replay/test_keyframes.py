"""Keyframes: bytes and back, in a folder of one's own, within bounds."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from itertools import chain, repeat
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np
import pytest

from brain.skills import found as skills
from gateway.recording import read_recording
from gateway.replay import keyframes
from gateway.replay.keyframes import Frame, Keyframes, StateCodec
from tests.distributions import Site
from tests.gateway import little


class Constant:
    def __deepcopy__(self, memo: object) -> Constant:
        return self


@dataclass
class State:
    constant: Constant = field(default_factory=Constant)
    function: Callable[[int], int] = field(default_factory=lambda: lambda x: x + 1)
    values: list[Any] = field(default_factory=list)
    again: list[Any] = field(default_factory=list)


def test_constants_are_referred_to_and_the_rest_is_copied() -> None:
    state = State()
    codec = StateCodec(state)
    state.values = state.again = [1, {"a": 2.5}]
    made = codec.load(codec.dump(state))
    assert (made.constant is state.constant, made.function is state.function) == (True, True)
    assert made.values == state.values
    assert made.values is made.again
    assert made.values is not state.values


def test_another_codec_of_the_same_kind_puts_its_own_constants_in() -> None:
    one, two = State(), State()
    made = StateCodec(two).load(StateCodec(one).dump(one))
    assert (made.constant is two.constant, made.function is two.function) == (True, True)


def test_what_cannot_be_pickled_raises() -> None:
    state = State()
    codec = StateCodec(state)
    state.function = lambda x: x + 2
    with pytest.raises(AttributeError, match="lambda"):
        codec.dump(state)


ARRAYS: dict[str, np.ndarray[Any, np.dtype[Any]]] = {
    "floats": np.linspace(0, 1, 12).reshape(3, 4),
    "by columns": np.asfortranarray(np.linspace(0, 1, 12).reshape(3, 4)),
    "turned": np.arange(24, dtype=np.int16).reshape(2, 3, 4).transpose(1, 0, 2),
    "a part": np.arange(20.0)[3:17:2],
    "empty": np.zeros((0, 3)),
    "one value": np.array(3.5),
    "records": np.array([(1, 2.5), (3, 4.5)], dtype=[("a", "<i2"), ("b", "<f8")]),
    "not finite": np.array([np.nan, np.inf, -0.0]),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_comes_back_as_a_deep_copy(name: str) -> None:
    codec = StateCodec(State())
    array = ARRAYS[name]
    made, copied = codec.load(codec.dump(array)), copy.deepcopy(array)
    assert (made.dtype, made.shape, made.tobytes()) == (copied.dtype, copied.shape, copied.tobytes())
    assert made.flags.f_contiguous >= array.flags.f_contiguous
    assert (made.flags.owndata, made.flags.writeable) == (True, True)


def test_a_layout_comes_back() -> None:
    codec = StateCodec(State())
    assert codec.load(codec.dump(Struct("<Qd"))).format == "<Qd"


# -- on disk -----------------------------------------------------------------------------------


def filled(frames: Keyframes, count: int, size: int = 100) -> Keyframes:
    for number in range(1, count + 1):
        frames.put(Frame(number * frames.spacing, number * 10), os.urandom(size))
    return frames


def test_the_last_one_is_found_by_time_and_by_number(tmp_path: Path) -> None:
    frames = filled(Keyframes("a", tmp_path / "c"), 3)
    one, two, three = Frame(500, 10), Frame(1000, 20), Frame(1500, 30)
    assert frames.last() == three
    cases = {-1: None, 9: None, 10: one, 29: two, 99: three}
    assert {now: frames.last(now=now) for now in cases} == cases
    numbers = {0: None, 499: None, 500: one, 1499: two, 9999: three}
    assert {played: frames.last(played=played) for played in numbers} == numbers
    assert frames.last(now=29, played=999) == frames.last(now=19, played=9999) == one


def test_they_are_there_the_next_time_for_this_user_alone(tmp_path: Path) -> None:
    frames = Keyframes("a", tmp_path / "c")
    frames.put(Frame(1000, -5), b"state")
    frames.close()
    assert Keyframes("a", tmp_path / "c").get(Frame(1000, -5)) == b"state"
    assert len(Keyframes("b", tmp_path / "c")) == 0
    assert [oct(path.stat().st_mode & 0o777) for path in (tmp_path / "c", tmp_path / "c/a")] == ["0o700"] * 2


def others(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    folder.chmod(0o750)


def linked(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(folder.parent / "elsewhere")


@pytest.mark.parametrize("make", [others, linked, Path.touch])
def test_a_folder_that_others_may_write_to_is_not_used(
    make: Callable[[Path], None], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make(tmp_path / "c")
    frames = filled(Keyframes("a", tmp_path / "c"), 1)
    assert not list(tmp_path.rglob("*.key"))
    assert "keyframes are not kept for the next time" in caplog.text
    assert frames._temporary is not None
    temporary = Path(frames._temporary.name)
    assert (temporary.stat().st_mode & 0o777, frames.get(Frame(500, 10)) is None) == (0o700, False)
    frames.close()
    assert not temporary.exists()


@pytest.mark.parametrize("make", [others, linked, Path.touch])
def test_nor_is_such_a_folder_in_it(make: Callable[[Path], None], tmp_path: Path) -> None:
    (tmp_path / "c").mkdir(mode=0o700)
    make(tmp_path / "c/a")
    frames = filled(Keyframes("a", tmp_path / "c"), 1)
    assert not list(tmp_path.rglob("*.key"))
    frames.close()


def another_users(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)


def writable(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.chmod(0o620)


def a_link(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.symlink_to(path.rename(path.with_name("elsewhere")))


def a_pipe(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


@pytest.mark.parametrize("make", [another_users, writable, a_link, a_pipe])
def test_a_file_that_others_may_have_written_is_not_read(
    make: Callable[[Path, pytest.MonkeyPatch], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = filled(Keyframes("a", tmp_path / "c"), 2)
    make(tmp_path / "c/a/500_10.key", monkeypatch)
    assert (frames.get(Frame(500, 10)), len(frames)) == (None, 1)


def test_another_folder_in_its_place_is_not_read(tmp_path: Path) -> None:
    frames, forged = filled(Keyframes("a", tmp_path / "c"), 1), Keyframes("a", tmp_path / "forged")
    data = frames.get(Frame(500, 10))
    forged.put(Frame(500, 10), b"code")
    (tmp_path / "c").rename(tmp_path / "moved")
    (tmp_path / "forged").rename(tmp_path / "c")
    assert data == frames.get(Frame(500, 10)) != b"code"


def test_a_folder_of_another_user_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    users = chain([os.getuid() + 1], repeat(os.getuid()))
    monkeypatch.setattr(os, "geteuid", lambda: next(users))
    frames = filled(Keyframes("a", tmp_path / "c"), 1)
    assert not list(tmp_path.rglob("*.key"))
    frames.close()


HOMES = [
    ({"XDG_CACHE_HOME": "{tmp}/x"}, "x/motor-gateway/keyframes"),
    ({"XDG_CACHE_HOME": "x", "HOME": "{tmp}"}, ".cache/motor-gateway/keyframes"),
    ({"XDG_CACHE_HOME": "", "HOME": "{tmp}"}, ".cache/motor-gateway/keyframes"),
]


@pytest.mark.parametrize(("environment", "folder"), HOMES)
def test_the_cache_is_where_the_user_wants_it(
    environment: dict[str, str], folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value.format(tmp=tmp_path))
    filled(Keyframes("a"), 1)
    assert (tmp_path / folder / "a/500_10.key").is_file()


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "a flipped bit": lambda data: data[:40] + bytes([data[40] ^ 1]) + data[41:],
    "cut": lambda data: data[:-1],
    "empty": lambda _: b"",
    "longer": lambda data: data + b"\0",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_one_is_none(damage: str, tmp_path: Path) -> None:
    frames = filled(Keyframes("a", tmp_path / "c"), 2)
    path = tmp_path / "c/a/500_10.key"
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert frames.get(Frame(500, 10)) is None
    assert (len(frames), path.exists(), frames.last(now=15)) == (1, False, None)
    (tmp_path / "c/a/1000_20.key").unlink()
    assert (frames.get(Frame(1000, 20)), len(frames)) == (None, 0)


def test_their_size_is_bounded_and_they_stay_spread(tmp_path: Path) -> None:
    frames = Keyframes("a", tmp_path / "c", limit=2000)
    for number in range(1, 1001):
        if number * 500 % frames.spacing == 0:
            frames.put(Frame(number * 500, number), os.urandom(100))
        assert frames.size == sum(path.stat().st_size for path in tmp_path.rglob("*.key")) <= 2000
    numbers = [frame.played for frame in frames._frames]
    assert frames.spacing == 32_000
    assert numbers == list(range(32_000, 500_000, 32_000))


def test_the_recording_that_was_not_played_for_longest_is_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keyframes, "TOTAL_LIMIT", 3000)
    names = {letter: letter * 32 for letter in "abcde"}
    for number, letter in enumerate("abcd"):
        filled(Keyframes(names[letter], tmp_path / "c", limit=1000), 5)
        os.utime(tmp_path / "c" / names[letter], (number, number))
    not_ours = tmp_path / "c/letters"
    not_ours.mkdir()
    (not_ours / "a").write_bytes(bytes(5000))
    Keyframes(names["a"], tmp_path / "c", limit=1000)
    Keyframes(names["e"], tmp_path / "c", limit=1000)
    left = sorted(path.name for path in (tmp_path / "c").iterdir())
    assert left == [*(names[letter] for letter in "acde"), "letters"]


def test_a_full_disk_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    frames = filled(Keyframes("a", tmp_path / "c"), 1)
    monkeypatch.setattr(os, "replace", full)
    filled(frames, 3)
    assert frames._frames == [Frame(500, 10)]
    assert [path.name for path in (tmp_path / "c/a").iterdir()] == ["500_10.key"]


# -- what they are good for ----------------------------------------------------------------------


def test_the_folder_is_another_for_another_recording_robot_program_or_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    little.record(tmp_path / "a.mcap", 20)
    little.record(tmp_path / "b.mcap", 21)
    plugin = tmp_path / "somebodys_plugin"
    plugin.mkdir()
    (plugin / "__init__.py").write_text("class Driver: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    driver = import_module("somebodys_plugin").Driver()

    def name(
        file: str = "a.mcap", text: str = little.ROBOT, state: object = driver, **facts: str
    ) -> str | None:
        return keyframes.folder_name(read_recording(tmp_path / file), text, facts, StateCodec(state))

    first = name()
    assert name() == first
    others = [
        name("b.mcap"),
        name(text=f"{little.ROBOT} "),
        name(sources="x"),
        name(state=[driver, lambda: None]),
    ]
    (plugin / "wire.py").write_text("x = 1\n")
    others.append(name())
    (plugin / "wire.py").write_text("x = 2\n")
    others.append(name())
    assert len({first, *others}) == 7


def test_the_folder_is_another_for_another_source_of_a_skill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    little.record(tmp_path / "a.mcap", 20)
    site = Site(tmp_path / "site", monkeypatch)
    site.install("acme", "nod = acme_nod:skill", "skill = 1\n", group=skills.GROUP)

    def name() -> str | None:
        recording = read_recording(tmp_path / "a.mcap")
        return keyframes.folder_name(recording, little.ROBOT, {}, StateCodec([]))

    first = name()
    assert name() == first
    (site.path / "acme_nod.py").write_text("skill = 2\n")
    assert name() != first
    assert "acme_nod" not in sys.modules


def test_a_large_recording_is_recognised_by_its_ends_size_and_last_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    little.record(path, 20)
    monkeypatch.setattr(keyframes, "WHOLE", path.stat().st_size // 2)

    def name() -> str | None:
        return keyframes.folder_name(read_recording(path), little.ROBOT, {}, StateCodec([]))

    first, data = name(), path.read_bytes()
    assert name() == first
    written = path.stat().st_mtime_ns
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])
    os.utime(path, ns=(written, written))
    assert name() == first  # nothing but its middle differs: it is not read
    os.utime(path, ns=(written, written + 1))
    assert name() != first
