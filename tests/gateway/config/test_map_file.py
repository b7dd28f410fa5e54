"""Maps of map_server: what each pixel says, every mistake in words, and a robot that begins in one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from brain.perception.map import MapSettings
from brain.perception.saved_map import Start
from gateway.cli.main import main
from gateway.config import load_robot, parse_robot
from gateway.config.errors import Mistakes
from gateway.config.files import MOST_PACKED, unpacked, with_files
from gateway.config.map_file import read_pixels, saved_map
from gateway.config.text import read_toml
from gateway.errors import ConfigError
from gateway.replay import replay_recording
from protocols.bounds import Invalid
from protocols.plugin import load

YAML = """image: map.pgm
resolution: 0.05
origin: [-1.0, -2.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
SHADES = bytes((0, 50, 89, 90, 100, 128, 205, 206, 254, 255))
"""Of which 89 is just occupied, 90 not (0.651 and 0.647), 205 just not free, 206 free (0.19608 and 0.192)"""


def pgm(pixels: bytes, width: int) -> bytes:
    return b"P5\n%d %d\n255\n" % (width, len(pixels) // width) + pixels


def percent(log_odds: float) -> int:
    return -1 if log_odds == 0.0 else round(100.0 / (1.0 + math.exp(-log_odds)))


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("", [97, 97, 97, -1, -1, -1, -1, 12, 12, 12]),
        ("mode: Trinary", [97, 97, 97, -1, -1, -1, -1, 12, 12, 12]),
        ("negate: 1", [12, -1, -1, -1, -1, -1, 97, 97, 97, 97]),
        ("negate: true", [12, -1, -1, -1, -1, -1, 97, 97, 97, 97]),
        ("free_thresh: 0.25", [97, 97, 97, -1, -1, -1, 12, 12, 12, 12]),
        ("mode: scale", [97, 97, 97, 97, 90, 67, 12, 12, 12, 12]),
        ("mode: raw", [12, -1, 89, 90, 97, -1, -1, -1, -1, -1]),
    ],
)
def test_what_a_pixel_says(keys: str, expected: list[int]) -> None:
    """As nav2's map_server: occupied is 100 %, which is 97 in a map whose cells reach 3.5; free is 12 (-2).
    What is 50 % is not known."""
    key = keys.partition(":")[0]
    text = "".join(line for line in YAML.splitlines(True) if not key or not line.startswith(key)) + keys
    made = saved_map(text, {"map.pgm": pgm(SHADES, 10)}, MapSettings(), None)
    ((row, column), values) = next(iter(made.tiles()))
    assert (row, column) == (-1, -1)
    found = values[64 - 40, 64 - 20 : 64 - 10] / 32.0
    assert [percent(one) for one in found.tolist()] == pytest.approx(expected, abs=1)


def test_the_first_row_is_the_uppermost() -> None:
    made = saved_map(YAML, {"map.pgm": pgm(bytes((255, 255, 255, 0)), 2)}, MapSettings(), None)
    ((_, values),) = made.tiles()
    assert np.sign(values[24:26, 44:46]).tolist() == [[-1, 1], [-1, -1]]


PLAIN = b"P2 # as a person writes it\n# two lines\n2 2\n# the most\n10\n0 5\n10 2\n"


@pytest.mark.parametrize(
    ("data", "shades"),
    [
        (PLAIN, [[0.0, 0.5], [1.0, 0.2]]),
        (b"P5 2 1 65535\n\x00\x00\xff\xff", [[0.0, 1.0]]),
        (b"P6\n1 1\n255\n\x00\xff\x7e", [[127 / 255]]),
        (b"P3 1 1 255 10 20 30", [[20 / 255]]),
    ],
    ids=["P2", "16 bits", "P6", "P3"],
)
def test_kinds_of_netpbm(data: bytes, shades: list[list[float]]) -> None:
    assert read_pixels(data) == pytest.approx(np.array(shades))


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (None, "not among the files"),
        (b"\x89PNG\r\n\x1a\n", "it is a PNG, expected a PGM"),
        (b"\xff\xd8\xff\xe0", "it is a JPEG"),
        (b"", "it is no PGM"),
        (b"P5\n-1 2\n255\n", "it is no PGM"),
        (b"P5\n2 2\n0\n", "2 x 2 pixels of at most 0"),
        (b"P5\n99999 99999\n255\n", "99999 x 99999 pixels"),
        (b"P5\n2 2\n255\n\x00\x00\x00", "it ends after 3 of 4 values"),
        (b"P2 2 1 255 1 x", "pixels that are no numbers"),
        (b"P2 2 1 255 1 256", "a pixel of 256, and 255 as the largest value"),
        (b"P2 2 1 255 1", "it ends after 1 of 2"),
    ],
)
def test_what_is_no_image_is_said(data: bytes | None, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        read_pixels(data)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [", ["it is not YAML in line 1"]),
        ("- 1", ["expected the keys image, resolution, origin"]),
        ("", ["expected the keys image, resolution, origin"]),
        ("image: map.pgm", ["resolution: missing; expected m per pixel", "free_thresh: missing"]),
        (YAML.replace("0.05", "-1"), ["resolution: found -1, expected m per pixel, 0.001 to 10"]),
        (YAML.replace("0.05", ".nan"), ["resolution: found nan"]),
        (YAML.replace(", 0.0]", "]"), [r"origin: found \[-1.0, -2.0\], expected \[x, y, yaw\]"]),
        (YAML.replace("-1.0", "1e9"), ["expected it within 10 km"]),
        (YAML.replace("negate: 0", "negate: 2"), ["negate: found 2, expected 0, or 1 if white"]),
        (YAML.replace("0.65", "0.1"), ["free_thresh: found 0.196, expected less than occupied_thresh, 0.1"]),
        (
            YAML + "mode: trinery",
            ["mode: found 'trinery', expected one of trinary, scale, raw"],
        ),
        (YAML.replace("free_thresh", "free_tresh"), ["free_tresh: not known; did you mean 'free_thresh'"]),
        (YAML.replace("map.pgm", "other.pgm"), ["other.pgm: it is not among the files"]),
        (YAML.replace("map.pgm", "[1]"), [r"image: found \[1\], expected the name of a PGM"]),
    ],
)
def test_every_mistake_in_a_map_is_said(text: str, expected: list[str]) -> None:
    with pytest.raises(Invalid) as found:
        saved_map(text, {"map.pgm": pgm(SHADES, 10)}, MapSettings(), None)
    for each in expected:
        found.match(each)


def test_more_keys_of_others_are_no_mistake() -> None:
    images = {"map.pgm": pgm(SHADES, 10)}
    made = saved_map(f"{YAML}elevation_image: one.pgm\n", images, MapSettings(), None)
    assert made.text == saved_map(YAML, images, MapSettings(), None).text


def test_a_grey_that_savers_write_for_unknown_is_told_where_it_is_free() -> None:
    made = saved_map(YAML.replace("0.196", "0.25"), {"map.pgm": pgm(SHADES, 10)}, MapSettings(), None)
    assert made.remark.startswith("10 % of it are the grey 205")
    assert not saved_map(YAML, {"map.pgm": pgm(SHADES, 10)}, MapSettings(), None).remark


def test_more_tiles_than_the_robot_keeps() -> None:
    image = {"map.pgm": pgm(bytes((255,)) * 1100 * 1100, 1100)}
    few = MapSettings(tiles=256, farthest=5.0)
    with pytest.raises(Invalid, match=r"it has 324 tiles .*tiles is 256: expected at least as many"):
        saved_map(YAML, image, few, None)


# -- in a robot file ------------------------------------------------------------------------------


def room(folder: Path) -> Path:
    """Write a map of a room of 4 m x 4 m about (0, 0)."""
    pixels = np.full((100, 100), 205, dtype=np.uint8)
    pixels[10:90, 10:90], pixels[11:89, 11:89] = 0, 254
    (folder / "map.pgm").write_bytes(pgm(pixels.tobytes(), 100))
    (folder / "map.yaml").write_text(YAML.replace("[-1.0, -2.0", "[-2.5, -2.5"))
    return folder / "map.yaml"


def test_a_recording_carries_the_map(tmp_path: Path) -> None:
    robot = load_robot("diffbot", saved_map=str(room(tmp_path)), start=(0.5, 0.25, 1.0))
    again = parse_robot(robot.text)
    saved = again.brain.saved
    assert saved is not None
    assert saved.start == Start(0.5, 0.25, 1.0)
    assert saved.text == "5.0 m x 5.0 m, 3.2 % occupied, 60.8 % free"
    (tmp_path / "map.pgm").unlink()
    assert parse_robot(again.text).brain.saved is not None


def test_a_table_in_the_robot_file_is_read_from_beside_it(tmp_path: Path) -> None:
    room(tmp_path)
    text = load_robot("diffbot").text
    path = tmp_path / "robot.toml"
    path.write_text(f'{text}\n[map]\nfile = "map.yaml"\nstart = {{ x = 1.0 }}\n')
    saved = load_robot(path).brain.saved
    assert saved is not None
    assert saved.start == Start(1.0)
    with pytest.raises(ConfigError, match=r"the file has a table \[map\]; expected one of both"):
        load_robot(path, saved_map="map.yaml")


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ('file = "none.yaml"', "there is no 'none.yaml' beside the robot file"),
        ('file = "map.pgm"', "expected the map's YAML file, not its image"),
        ("file = 3", "found 3, expected a string"),
        ('file = "map.yaml"\nstart = { x = 1e9 }', "x"),
        ('file = "map.yaml"\nstart = { X = 1.0 }', "no key 'X'"),
        ("", "missing; expected"),
    ],
)
def test_mistakes_in_the_table(tmp_path: Path, table: str, expected: str) -> None:
    room(tmp_path)
    path = tmp_path / "robot.toml"
    path.write_text(f"{load_robot('diffbot').text}\n[map]\n{table}\n")
    with pytest.raises(ConfigError) as found:
        load_robot(path)
    assert expected in str(found.value)


def test_an_image_that_is_missing_is_told_with_all_else(tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text(YAML.replace("0.05", "0"))
    with pytest.raises(ConfigError) as found:
        load_robot("diffbot", saved_map=str(path))
    assert "there is no 'map.pgm' beside the map's file" in str(found.value)
    assert "map.yaml: resolution: found 0" in str(found.value)


def test_who_has_no_base_has_no_map(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a base, of this project's own brain"):
        load_robot("bench", saved_map=str(room(tmp_path)))


def test_an_image_that_no_recording_can_carry(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (1200, 1200), dtype=np.uint8)
    path = room(tmp_path)
    (tmp_path / "map.pgm").write_bytes(pgm(noise.tobytes(), 1200))
    mistakes = Mistakes("", "")
    with_files(f'[map]\nfile = "{path.name}"', tmp_path / "robot.toml", mistakes, load)
    assert f"expected at most {MOST_PACKED}" in str(mistakes.error())


@pytest.mark.parametrize("header", ["[files]", "[files]  # texts", " [ files ]"])
def test_files_are_put_into_the_table_that_is_there(tmp_path: Path, header: str) -> None:
    path, mistakes = room(tmp_path), Mistakes("", "")
    text = with_files(f'map.file = "{path.name}"\n{header}\n', tmp_path / "robot.toml", mistakes, load)
    assert read_toml(text, mistakes)["files"].keys() == {"map.yaml", "map.pgm"}


@pytest.mark.parametrize("value", ["{}", "3"])
def test_what_is_no_table_of_files_that_can_be_filled_is_told(tmp_path: Path, value: str) -> None:
    path, mistakes = room(tmp_path), Mistakes("", "")
    with_files(f'map.file = "{path.name}"\nfiles = {value}\n', tmp_path / "robot.toml", mistakes, load)
    assert "files: expected a table with the line [files], or none" in str(mistakes.error())


@pytest.mark.parametrize("text", ["!!", "AAAA", ""])
def test_what_is_packed_wrongly_is_none(text: str) -> None:
    assert unpacked(text) is None


def test_a_drive_becomes_a_map_in_which_the_next_one_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """By the command line, recorded, replayed to the same bytes."""
    first, second, folder = (str(tmp_path / name) for name in ("first.mcap", "second.mcap", "map"))
    assert main(["run", "diffbot", "--fast", "--goal", "0.6,0", "--record", first]) == 0
    assert main(["map", first, "--out", folder]) == 0
    begin = ["--map", f"{folder}/map.yaml", "--at", "0,0"]
    assert main(["run", "diffbot", "--fast", "--goal", "0.3,0.1", *begin, "--record", second]) == 0
    assert any("began in a saved map of " in one for one in caplog.messages)
    assert not any("lost" in one for one in caplog.messages)
    comparison = replay_recording(second)
    assert comparison.ok, comparison.text()
    assert main(["run", "diffbot", "--fast", "--at", "0,0"]) == 2
    assert "name its file by --map" in capsys.readouterr().err
    both = tmp_path / "both"
    assert main(["map", first, second, "--out", str(both)]) == 0
    assert "path.tum, path.csv, path-2.tum, path-2.csv" in capsys.readouterr().out
    paths = [(both / name).read_text().splitlines() for name in ("path.csv", "path-2.csv")]
    ends = [tuple(map(float, lines[-1].split(",")[1:3])) for lines in paths]
    assert ends == [pytest.approx((0.6, 0.0), abs=0.05), pytest.approx((0.3, 0.1), abs=0.05)]
    torn = Path(second)
    torn.write_bytes(torn.read_bytes()[: -torn.stat().st_size // 3])
    assert main(["map", first, second, "--out", str(tmp_path / "torn")]) == 1
    assert "it was cut; all before is used" in capsys.readouterr().out
    assert main(["map", second, "--at", "0,0", "--out", str(tmp_path / "two")]) == 2
    assert "name its file by --map" in capsys.readouterr().err
