"""`gateway motor`: what it prints, its exit status, and what it refuses in words."""

from __future__ import annotations

from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from gateway.cli.main import main

ROBOT = "diffbot_damiao"


def motor(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Return exit status, standard output and standard error."""
    status = main(["motor", *arguments])
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return status, printed.out, printed.err


@pytest.fixture(scope="module")
def dumped(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What a dump of the robot's motors is."""
    path = tmp_path_factory.mktemp("motor") / "dump.toml"
    with redirect_stdout(StringIO()) as printed, redirect_stderr(StringIO()) as trouble:
        status = main(["motor", "dump", ROBOT, "--out", str(path)])
    assert (status, trouble.getvalue()) == (0, "")
    out = printed.getvalue()
    assert "left: damiao at address 1 on can0, serial number DA310001\n  UV_Value   15\n" in out
    assert "  SN         3660644353  (left: it names the motor)\n" in out
    return path.read_text(encoding="utf-8")


@pytest.fixture
def dump(tmp_path: Path, dumped: str) -> Path:
    path = tmp_path / "dump.toml"
    path.write_text(dumped, encoding="utf-8")
    return path


def test_without_a_difference_the_status_is_0(dump: Path, capsys: pytest.CaptureFixture[str]) -> None:
    last = "diffbot_damiao: 74 parameters read, 0 differ from"
    assert motor(capsys, "diff", ROBOT, str(dump)) == (0, f"{last} the dump\n", "")
    status, out, err = motor(capsys, "diff", ROBOT)
    assert (status, out.splitlines()[-1], err) == (0, f"{last} the robot file", "")
    assert "remark: left.VMAX = 30: the device allows 30 rad/s at the joint, whose limit is 20\n" in out
    assert motor(capsys, "restore", ROBOT, str(dump), "--yes") == (0, "0 to be written, 0 left; done\n", "")


def test_restore_writes_with_yes_alone_and_leaves_what_is_protected(
    dump: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = dump.read_text(encoding="utf-8")
    dump.write_text(
        text.replace('"OT_Value" = 100.0', '"OT_Value" = 90.0').replace('"Rs" = 0.0', '"Rs" = 1.0')
    )
    hotter = "{}.OT_Value = 100: the dump has 90"
    left = "{}.Rs = 0: the dump has 1; left: it was measured of the motor"
    found = [each.format(name) for name in ("left", "right") for each in (hotter, left)]
    status, out, _ = motor(capsys, "diff", ROBOT, str(dump))
    assert (status, out.splitlines()[:-1]) == (1, found)
    status, out, _ = motor(capsys, "restore", ROBOT, str(dump))
    assert (status, out.splitlines()) == (1, [*found, "2 to be written; nothing was: give --yes for that"])
    status, out, _ = motor(capsys, "restore", ROBOT, str(dump), "--yes")
    written = [line for n in ("left", "right") for line in (f"{n}.OT_Value: written: 90", f"{n}: saved")]
    left_lines = [left.format(name) for name in ("left", "right")]
    assert (status, out.splitlines()) == (0, [*left_lines, *written, "2 to be written, 2 left; done"])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("", "\n[x", "not TOML"),
        ('robot = "diffbot_damiao"', "", "is no dump"),
        (
            'robot = "diffbot_damiao"',
            'robot = "bench"',
            "is a dump of the robot 'bench', not of 'diffbot_damiao'",
        ),
        ('protocol = "damiao"', 'protocol = "plain"', "of the protocol 'plain', the robot file has 'damiao'"),
        ("[motors.left", "[motors.lift", "no motor 'lift': there is left, right"),
        ('serial = "DA310001"', 'serial = "5"', "serial number DA310001, the dump is of 5"),
        ('serial = "DA310001"', 'serial = "x"', "serial hexadecimal digits"),
        ('"UV_Value" = 15.0', '"UV_Value" = nan', "left.UV_Value: nan is no finite number"),
        ('"UV_Value" = 15.0', '"UV_Value" = 1e999', "left.UV_Value: inf is no finite number"),
        ('"UV_Value" = 15.0', '"UV_Value" = true', "left.UV_Value: True is no finite number"),
        ('"UV_Value" = 15.0', '"UV_Value" = 9.0', "left.UV_Value: 9.0 is outside 10 … 3.40282e+38"),
        ('"UV_Value" = 15.0', f'"UV_Value" = {"9" * 5000}', "not TOML"),
    ],
)
def test_a_dump_that_is_not_of_these_motors_is_refused_before_anything_is_written(
    dump: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected: str
) -> None:
    text = dump.read_text(encoding="utf-8")
    assert old in text
    dump.write_text(text.replace(old, new) if old else text + new, encoding="utf-8")
    status, out, err = motor(capsys, "restore", ROBOT, str(dump), "--yes")
    assert (status, out) == (2, "")
    assert expected in err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("diff difbot", "did you mean 'diffbot'?"),
        ("diff bench no.toml", "no.toml: cannot be read: No such file or directory"),
        ("diff bench .", ".: is no file, but a folder"),
        ("dump bench --out /proc/x.toml", "/proc/x.toml: cannot be written"),
        ("dump bench --out README.md", "README.md: exists already; it is never overwritten"),
    ],
)
def test_wrong_use_is_answered_in_words(
    arguments: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = motor(capsys, *arguments.split())
    assert (status, out) == (2, "")
    assert expected in err


def test_a_protocol_without_configuration_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = motor(capsys, "dump", "bench05")
    assert status == 0
    assert "right: odrive_can at address 2 on can0, firmware 0.5.x\n  nothing: its protocol" in out


def test_what_is_done_to_one_motor_is_told_and_asked_for_first(capsys: pytest.CaptureFixture[str]) -> None:
    told = "left: the damiao at address 1 on can0 gets the address 5, and saves it (save_parameters)\n"
    status, out, err = motor(capsys, "set-id", ROBOT, "left", "5")
    assert (status, out) == (2, told)
    assert "give --yes" in err
    status, out, err = motor(capsys, "set-id", ROBOT, "left", "5", "--yes")
    assert (status, err) == (0, "")
    assert out.splitlines()[-1] == "left: the robot file has address = 1: write 5 there"
    status, out, err = motor(capsys, "calibrate", ROBOT, "left", "--yes")
    assert (status, out) == (2, "")
    assert "damiao cannot do this over its bus" in err


def test_the_page_shows_what_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    page = Path("docs/motor-settings.md").read_text("utf-8")
    for line in ("set-id diffbot_damiao left --from 7 --yes", "zero diffbot_damiao left --yes"):
        shown = page.partition(f"$ gateway motor {line}\n")[2]
        status, out, err = motor(capsys, *line.split())
        assert (status, err) == (0, "")
        assert shown.startswith(out)
