"""Keyframes saved beside a map: the same again, gone on from in a second drive, and refused where wrong."""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brain.belief import Pose
from brain.perception.consistency import Trust
from brain.perception.loops import GROUP
from brain.perception.map import MapSettings
from brain.perception.perception import Perception
from brain.perception.saved_keyframes import SavedKeyframes
from gateway.config.keyframes_file import keyframes_file, keyframes_of
from gateway.config.map_file import load_map, saved_map
from gateway.errors import ConfigError
from gateway.rosbag.drawn import Drawn
from tests.brain.perception.office import BODY, MOUNTS, SETTINGS, Rover, _towards

IMAGE = b"the image"


def driven(perception: Perception, rover: Rover, goals: Iterable[tuple[float, float]]) -> list[float]:
    """Drive from goal to goal by the truth; return how far off the estimate was, m, from when on the place
    was known."""
    left, speeds, off = list(goals), (0.0, 0.0), []
    while left:
        perception.observe(rover.now, rover.step(*speeds))
        here = perception.estimate
        if here is None or not perception.is_placed:
            continue  # it stands
        off.append(math.dist((here.pose.x, here.pose.y), (rover.truth.x, rover.truth.y)))
        if math.dist((rover.truth.x, rover.truth.y), left[0]) < 0.1:
            left.pop(0)
        speeds = _towards(rover.truth, left[0], speeds) if left else speeds
    return off


@pytest.fixture(scope="module")
def first() -> Perception:
    """A drive through both rooms: 9 m."""
    perception = Perception(BODY, MOUNTS, SETTINGS)
    driven(perception, Rover(1), [(2.6, 0.3), (3.2, 1.8), (5.2, 1.8), (8.3, 2.2)])
    return perception


def files_of(perception: Perception) -> dict[str, bytes]:
    """What `gateway map` writes of it."""
    drawn = Drawn(perception.map.view(), [(0, Pose(0.0, 0.0, 0.0))])
    kept = keyframes_file(perception.saved_keyframes(), drawn.pgm())
    return {"map.pgm": drawn.pgm(), "map.keyframes": kept, "map.yaml": drawn.yaml("map.keyframes").encode()}


def assert_equal(one: Any, other: Any) -> None:
    """All values and arrays in both."""
    if isinstance(one, np.ndarray | float | int):
        np.testing.assert_array_equal(one, other)
        return
    if hasattr(one, "__slots__") and hasattr(one, "bearings"):
        one, other = ((each.origin, each.bearings, each.ranges, each.hit) for each in (one, other))
    assert len(one) == len(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        one, other = one.values(), other.values()
    for a, b in zip(one, other, strict=True):
        assert_equal(a, b)


def test_they_are_the_same_again(first: Perception) -> None:
    saved = first.saved_keyframes()
    assert len(saved.kept) > 20
    assert len(saved.poses) % GROUP == 0
    again = keyframes_of(keyframes_file(saved, IMAGE), IMAGE)
    assert_equal(saved, again)


def test_a_second_drive_goes_on_in_the_map_of_the_first(first: Perception) -> None:
    """It begins elsewhere, and is not told where: it is found by its first scans, its keyframes are tied to
    those from before by loops, and the map is the map of both."""
    files = files_of(first)
    before = first.saved_keyframes()
    saved = saved_map(files["map.yaml"].decode(), files, MapSettings(), None)
    rover = Rover(2)
    rover.truth = Pose(5.2, 0.9, 2.15)
    perception = Perception(BODY, MOUNTS, SETTINGS, saved=saved)
    off = driven(perception, rover, [(5.2, 2.2), (8.2, 2.3), (5.2, 1.8)])
    assert rover.now < 60 * 10**9
    assert max(off) < 0.06
    assert perception.verdict.trust < Trust.DOUBTFUL
    both = perception.saved_keyframes()
    new = len(before.poses)
    assert [*both.kept][: len(before.kept)] == [*before.kept]
    assert len(both.kept) > len(before.kept) + 12
    assert any(tie.first * GROUP < new <= tie.second * GROUP for tie in both.ties)
    again = saved_map(files_of(perception)["map.yaml"].decode(), files_of(perception), MapSettings(), None)
    assert again.keyframes is not None
    assert_equal(both, again.keyframes)


def changed(**arrays: Callable[[Any], Any]) -> Callable[[bytes], bytes]:
    """Return what changes arrays of a file."""

    def change(data: bytes) -> bytes:
        found = dict(np.load(BytesIO(data)))
        for name, make in arrays.items():
            found[name] = make(found[name])
        made = BytesIO()
        np.savez_compressed(made, **{name: one for name, one in found.items() if one is not None})
        return made.getvalue()

    return change


def set_at(at: Any, value: float) -> Callable[[Any], Any]:
    def change(array: Any) -> Any:
        array = array.copy()
        array[at] = value
        return array

    return change


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0x10]) + data[middle + 1 :]


def claims(*shape: int) -> Callable[[bytes], bytes]:
    """Return what has the first array with three dimensions claim another shape than it has bytes for."""

    def change(data: bytes) -> bytes:
        found, made = dict(np.load(BytesIO(data))), BytesIO()
        with zipfile.ZipFile(made, "w") as archive:
            for name, one in found.items():
                head = np.lib.format.header_data_from_array_1_0(one)
                with archive.open(f"{name}.npy", "w") as file:
                    claimed = head | {"shape": shape} if name == "covariances" else head
                    np.lib.format.write_array_header_1_0(file, claimed)
                    file.write(one.tobytes())
        return made.getvalue()

    return change


def encrypted(data: bytes) -> bytes:
    """Mark every file of the archive as encrypted, where it lies and in the list at the end."""
    made = bytearray(data)
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        for found in re.finditer(re.escape(signature), data):
            made[found.start() + flags] |= 1
    return bytes(made)


def headed(header: bytes) -> Callable[[bytes], bytes]:
    """Return what gives the first array this header."""

    def change(data: bytes) -> bytes:
        made = BytesIO()
        with zipfile.ZipFile(BytesIO(data)) as before, zipfile.ZipFile(made, "w") as after:
            for name in before.namelist():
                whole = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
                after.writestr(name, whole if name == "format.npy" else before.read(name))
        return made.getvalue()

    return change


OTHERS: list[tuple[Callable[[bytes], bytes], str]] = [
    (lambda data: data[: len(data) // 2], "it is cut off, damaged or another file"),
    (lambda data: data[:-1], "it is cut off, damaged or another file"),
    (flipped, "it is cut off, damaged or another file"),
    (lambda _: b"", "expected the file that `gateway map` has written"),
    (lambda _: b"P5\n1 1\n255\n\0", "it is cut off, damaged or another file"),
    (changed(ways=lambda _: None), "it has no array 'ways'"),
    (encrypted, "it is cut off, damaged or another file (File 'format.npy' is encrypted"),
    (headed(b"(" * 900), "it is cut off, damaged or another file ("),
    (headed(b"{'shape': '''"), "it is cut off, damaged or another file ("),
    (claims(10**13, 3, 3), "its array 'covariances' of (10000000000000, 3, 3) has "),
    (claims(2**70, 3, 3), "its array 'covariances' of (1180591620717411303424, 3, 3) has "),
    (claims(-1, 3, 3), "its array 'covariances' of (-1, 3, 3) has "),
    (changed(format=lambda _: np.int64(2)), "it is of format 2: this program reads 1"),
    (
        changed(ranges=lambda r: r.astype(np.float64)),
        "its array 'ranges' is 1 x float64, expected 1 x uint16",
    ),
    (changed(ways=lambda w: w[:, None]), "its array 'ways' is 2 x float64, expected 1 x float64"),
    (changed(poses=set_at((3, 2), math.nan)), "its array 'poses' has numbers that are not finite"),
    (changed(poses=set_at((3, 0), 1e9)), "its keyframes cannot be so"),
    (changed(poses=lambda p: p[:-1]), "its keyframes cannot be so"),
    (changed(numbers=lambda n: n[::-1]), "its keyframes cannot be so"),
    (changed(numbers=lambda n: n + 10**6), "its keyframes cannot be so"),
    (changed(beams=lambda b: b + 1), "its keyframes cannot be so"),
    (changed(beams=set_at(0, -1)), "its keyframes cannot be so"),
    (changed(hits=lambda h: h[:-1]), "its keyframes cannot be so"),
    (changed(ways=lambda w: -w), "its keyframes cannot be so"),
    (changed(covariances=lambda c: -c), "its keyframes cannot be so"),
    (changed(bearings=lambda b: b * 1e6), "its keyframes cannot be so"),
    (changed(groups=lambda g: g[1:]), "its pose graph cannot be so"),
    (changed(ends=lambda e: e + 1), "its pose graph cannot be so"),
    (changed(ends=set_at((-1, 1), 10**6)), "its pose graph cannot be so"),
    (changed(information=lambda i: 0.0 * i), "its pose graph cannot be so"),
    (changed(information=set_at((0, 0, 1), 1e7)), "its pose graph cannot be so"),
]


@pytest.mark.parametrize(("change", "said"), OTHERS, ids=range(len(OTHERS)))
def test_what_is_wrong_is_refused_in_words(
    first: Perception, change: Callable[[bytes], bytes], said: str
) -> None:
    with pytest.raises(ValueError, match=r"gateway map|this program reads") as found:
        keyframes_of(change(keyframes_file(first.saved_keyframes(), IMAGE)), IMAGE)
    assert said in str(found.value)


def test_no_damaged_file_raises_anything_else(first: Perception) -> None:
    """Whatever byte is another one; whatever is cut off."""
    whole = keyframes_file(first.saved_keyframes(), IMAGE)
    random = np.random.default_rng(5)
    for _ in range(60):
        at = int(random.integers(len(whole)))
        other = whole[:at] + bytes([int(random.integers(256))]) + whole[at + 1 :]
        for data in (other, whole[:at]):
            try:
                keyframes_of(data, IMAGE)
            except ValueError:
                continue
            assert data == whole or data[:at] == whole[:at]


def test_an_image_that_was_edited_is_not_what_they_saw(first: Perception, tmp_path: Path) -> None:
    files = files_of(first)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    made = load_map(tmp_path / "map.yaml", MapSettings(), None)
    assert made.keyframes is not None
    assert made.text.endswith(f"{len(made.keyframes.kept)} keyframes")
    (tmp_path / "map.pgm").write_bytes(files["map.pgm"][:-1] + b"\0")
    with pytest.raises(ConfigError, match="who has edited that takes `keyframes` out of the map's YAML"):
        load_map(tmp_path / "map.yaml", MapSettings(), None)
    (tmp_path / "map.keyframes").unlink()
    with pytest.raises(ConfigError, match=r"map\.keyframes: it is not among the files"):
        load_map(tmp_path / "map.yaml", MapSettings(), None)
    text = "".join(line for line in files["map.yaml"].decode().splitlines(True) if "keyframes" not in line)
    (tmp_path / "map.yaml").write_text(text)
    assert load_map(tmp_path / "map.yaml", MapSettings(), None).keyframes is None
    (tmp_path / "map.yaml").write_text(f"{text}keyframes: 3\n")
    with pytest.raises(ConfigError, match="keyframes: found 3, expected the name of a file"):
        load_map(tmp_path / "map.yaml", MapSettings(), None)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_map(tmp_path / "absent.yaml", MapSettings(), None)


def test_nothing_kept_is_no_file(first: Perception) -> None:
    none = SavedKeyframes(np.zeros((0, 3)), {}, (0,), (), ())
    with pytest.raises(ValueError, match="cannot be so"):
        keyframes_of(keyframes_file(none, IMAGE), IMAGE)
    assert first.saved_keyframes().kept
