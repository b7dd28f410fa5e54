"""The real-CAN tier seen from the host: what the machine's end means, and what is said where it cannot run.

Nothing is booted here: a script stands in for QEMU."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from protocols.frames import CanFrame
from tests.real_can import __main__ as command
from tests.real_can import machine
from tests.real_can.candump import in_order, parse
from tests.real_can.machine import Missing, Parts


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Parts:
    """Parts of a machine that is never booted."""
    monkeypatch.setattr(machine, "_initramfs", lambda folder, parts: folder / "initramfs.gz")
    monkeypatch.setattr(machine, "LEFT_OUT", ("*",))
    image = tmp_path / "image"
    image.touch()
    return Parts("6.1", tmp_path, image)


def stand_in(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """A shell script in the place of QEMU; $SHARE is the shared folder."""

    def qemu(parts: Parts, initramfs: Path, share: Path) -> list[str]:
        return ["sh", "-c", f"SHARE='{share}'; {script}"]

    monkeypatch.setattr(machine, "_qemu", qemu)


ENDS = [
    # what QEMU does                                                        status, what is said of it
    ("echo hello; echo 0 > $SHARE/status", 0, "hello"),
    ("echo 5 > $SHARE/status", 5, ""),
    ("echo booting", 1, "FAILED: it ended without a result"),
    ("exit 7", 1, "FAILED: qemu ended with status 7"),
    ("echo 0 > $SHARE/status; exit 7", 1, "FAILED: qemu ended with status 7"),
    ("echo > $SHARE/status", 1, "FAILED: it ended without a result"),
    ("exec sleep 60", 1, "FAILED: it was not done after 1 s"),
    ("echo 0 > $SHARE/status; exec sleep 60", 1, "FAILED: it was not done after 1 s"),
]


@pytest.mark.parametrize(("script", "status", "said"), ENDS)
def test_only_a_result_from_inside_is_a_result(
    parts: Parts,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    script: str,
    status: int,
    said: str,
) -> None:
    stand_in(monkeypatch, script)
    limit = 1.0 if "sleep" in script else machine.TIME_LIMIT
    assert machine.run(parts, ["true"], limit) == status
    assert said in capsys.readouterr().out


def test_job_is_run_in_the_projects_folder(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, "grep -q \"^echo 'a b' c$\" $SHARE/job.sh; echo $? > $SHARE/status")
    assert machine.run(parts, ["echo", "a b", "c"]) == 0
    stand_in(monkeypatch, f"grep -q '^cd {machine.ROOT}$' $SHARE/job.sh; echo $? > $SHARE/status")
    assert machine.run(parts, ["true"]) == 0


def test_missing_programs_are_named_with_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_which", lambda program: None if program == "cpio" else "/bin/true")
    monkeypatch.setattr(os, "uname", lambda: type("Uname", (), {"machine": "x86_64"}))
    with pytest.raises(Missing, match=r"^cpio missing: apt-get install .*qemu-system-x86 .*cpio"):
        machine.prepare()


def test_another_processor_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "uname", lambda: type("Uname", (), {"machine": "aarch64"}))
    with pytest.raises(Missing, match="aarch64"):
        machine.prepare()


class Tier:
    """The tier with stand-ins for the places where it runs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, host: int | None, inside: int | str) -> None:
        """Exit status of the tests there; `host`: None if it has no CAN; `inside`: or what is missing."""
        self.ran: list[str] = []
        enter = None if host is None else ["sh", "-c", f"exit {host}"]
        monkeypatch.setattr(command, "own_network", lambda: enter)
        monkeypatch.setattr(command, "prepare", lambda: self._prepare(inside))
        monkeypatch.setattr(command, "run", lambda parts, job: self._run(job, inside))

    def _prepare(self, inside: int | str) -> None:
        if isinstance(inside, str):
            raise Missing(inside)

    def _run(self, job: list[str], inside: int | str) -> int:
        self.ran.append(job[len(job) - job[::-1].index("-m")])
        assert isinstance(inside, int)
        return inside


TIERS = [
    # host, inside        status  with FILE  what ran inside, what is told
    (None, 0, 0, 0, ["real_can and not prove"], ""),
    (None, 1, 1, 1, ["real_can and not prove"], ""),
    (None, 5, 1, 1, ["real_can and not prove"], ""),
    (None, "no qemu", 2, 0, [], "none of its tests: no qemu\n"),
    (0, 0, 0, 0, ["real_can and not prove and controllers"], ""),
    (0, 1, 1, 1, ["real_can and not prove and controllers"], ""),
    (1, 0, 1, 1, ["real_can and not prove and controllers"], ""),
    (0, "no qemu", 2, 0, [], "the tests on two controllers: no qemu\n"),
    (1, "no qemu", 1, 1, [], "the tests on two controllers: no qemu\n"),
]


@pytest.mark.parametrize(("host", "inside", "status", "with_file", "ran", "reported"), TIERS)
def test_tier_fails_if_any_part_fails_and_tells_what_did_not_run(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    host: int | None,
    inside: int | str,
    status: int,
    with_file: int,
    ran: list[str],
    reported: str,
) -> None:
    tier = Tier(monkeypatch, host, inside)
    assert command.main([]) == status
    absent = tmp_path / "absent"
    assert command.main([str(absent)]) == with_file
    assert (absent.read_text() if absent.exists() else "") == reported
    assert tier.ran == ran * 2


def test_left_out_of_a_plain_run_and_never_passed_over() -> None:
    """Without CAN the tests fail with a sentence; they are not skipped."""
    collect = [
        sys.executable,
        "-m",
        "pytest",
        "tests/real_can",
        "--collect-only",
        "-q",
        "-p",
        "no:cacheprovider",
    ]
    plain = subprocess.run(collect, cwd=machine.ROOT, capture_output=True, text=True, check=False)
    assert plain.returncode == 5, plain.stdout
    assert "deselected" in plain.stdout
    asked = subprocess.run(
        [*collect, "-m", "real_can"], cwd=machine.ROOT, capture_output=True, text=True, check=False
    )
    assert asked.returncode == 0, asked.stdout
    for name in ("test_goal_is_reached[diffbot-vcan0]", "test_goal_is_reached[rover-1000k]", "test_a_flood"):
        assert name in asked.stdout


def test_candumps_lines() -> None:
    text = "(1.250000) vcan0 123#0102\n(2.5) can1 00000123#\n(3.000001) can0 021#R\n(3.000002) can0 021#R8\n"
    seen = parse(text)
    assert [one.seconds for one in seen] == [1.25, 2.5, 3.000001, 3.000002]
    request = CanFrame(0x21, b"", remote=True)
    of_eight = replace(request, requested=8)
    frames = [CanFrame(0x123, b"\x01\x02"), CanFrame(0x123, b"", extended=True), request, of_eight]
    assert [one.frame for one in seen] == frames
    with pytest.raises(ValueError, match="not a line"):
        parse("vcan0  123   [2]  01 02\n")


def test_order() -> None:
    frames = [CanFrame(number, b"") for number in (1, 2, 1, 3)]
    one, two, _, three = frames
    assert in_order([], frames)
    assert in_order([one, one, three], frames)
    assert in_order([two, one, three], frames)
    assert not in_order([one, one, two], frames)
    assert not in_order([three, three], frames)
