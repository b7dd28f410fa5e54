"""Transcripts fail where they should: each line here is wrong, and the failure says which and why."""

from __future__ import annotations

from pathlib import Path

import pytest

from protocols.frames import Frame
from protocols.plain import plugin
from protocols.plugin import Device
from tests.protocols.plain.published import notation
from tests.protocols.transcripts import read, run

HEAD = """
protocol plain
device left 1 options kind=motor settings watchdog_ms=50
"""
DRIVER = "tests driver\n== Title\n"
CYCLE = DRIVER + "cycle 10\n"
TWIN = "tests twin\n== Title\nbackground rx A557???????? 019946 *\n"
BOTH = "tests both\ncycle 10\nbackground tx *\nbackground rx *\nbackground event Feedback ...\n== Title\n"
DECODER = "tests decoder\n== Title\n"
HOLD = '1 Hold "" 0.0'
READY = '1 State "" 0 "ready" ""'
MOVED = '1 Feedback "" 0 0.25 none none none none none'


class Peer:
    """A peer that is ready once it has received a frame."""

    def __init__(self, _: Device) -> None:
        self.received = 0

    def receive(self, _: Frame) -> None:
        self.received += 1

    def step(self) -> list[Frame]:
        return [notation(READY)] if self.received == 1 else []

    def change(self, text: str) -> str:
        return "" if text == f"received {self.received}" else f"it received {self.received}"


def check(folder: Path, text: str) -> None:
    """Run the blocks of a file with this text."""
    file = folder / "file.txt"
    file.write_text(HEAD + text, "utf-8")
    for block in read(file):
        run(block, plugin, notation, Peer)


@pytest.mark.parametrize(
    "text",
    [
        DRIVER + f"0 host Hold left\n0 tx {HOLD}",
        DRIVER + f"0 host Hold left => {HOLD}",
        DRIVER + f"0..5 tx {HOLD} -- some time\n3 host Hold left",
        DRIVER + f'0 host Hold left ; Zero left\n0 tx 1 Zero "" | {HOLD}',
        DRIVER + '0 host Hold left\n+2 host Zero left => 1 Zero ""\n' + f"0..1 tx {HOLD}",
        CYCLE + f"0 host Hold left\n0..50 every 10 tx {HOLD}",
        CYCLE + f"0 host Hold left\n0..50 every 5..12 tx {HOLD}",
        CYCLE + f"background tx 1 ; {HOLD}\n0 host Hold left\n50 end",
        CYCLE + f"0 host Hold left\n5 host nothing\n0 tx {HOLD}\n50 end",
        DRIVER + f"cyclic 100 {MOVED}\n0..300 every 100 event Feedback left 0.25\n300 end",
        DRIVER + f"0..300 every 100 rx {MOVED}\n0..300 every 100 event Feedback left 0.25",
        DRIVER + f"reply {HOLD} => {READY}\n0 host Hold left => {HOLD}\n1 event State left ready",
        DRIVER + f"name ready {READY}\n0 rx ready => State left ready ; accepted",
        CYCLE + f"0 peer left received 0\n0..20 every 10 tx {HOLD}\n0 host Hold left\n"
        "1 event State left ready\n11 peer left received 2",
        DRIVER + f"1 end\n== Second\nafter Title\n0 rx {READY} => State left ready",
        DRIVER + "before all others\n9 end\n== Second\n241 event State left offline *"
        "\n== Third\nafter nothing\n250 event State left offline *",
        DRIVER + f"each line by itself\nrx {READY} => State left ready\nhost Idle left => nothing",
        DECODER + '0 tx 1 Velocity "" 2.0 0.0 => Arm left ; Velocity left 2 ; named Velocity',
        TWIN + '0..1 every 1 rx 1 State "" 0 "ready" "ready"\n0 shaft left position=1 locked=yes\n'
        '5 tx 1 Torque "" 0.5\n5 rx 1 State "" 0 "armed" "armed"\n9 measure left torque=0.5 position=1±0.1',
        BOTH + "1 event State left ready *\n10 host Hold left\n11 event State left armed *\n"
        "50 host nothing\n90..95 event Fault left 1 *  ...\n90..95 event State left fault *\n"
        '120 host ClearFault left\n121 event Done ClearFault left\n121 event State left ready "ready"',
    ],
)
def test_what_is_written_and_comes_passes(tmp_path: Path, text: str) -> None:
    check(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (DRIVER + "0 host Hold left", "not written, and not in the background: 0 +tx +A557"),
        (DRIVER + f"0 rx {READY}", "not written.*event +State left ready"),
        (DRIVER + f"0 host Hold left => {HOLD}\n1..5 tx {HOLD}", "txt:7: 1..5 tx.*\n.*did not come"),
        (DRIVER + f'0 host Hold left ; Zero left\n0 tx {HOLD} | 1 Zero ""', "did not come"),
        (DRIVER + f"0 host Hold left ; Hold left => {HOLD}", "not written"),
        (DRIVER + "0 host Velocity left 1 => 1 Velocity \"\" 1.5 0.0", "did not come"),
        (CYCLE + f"0 host Hold left\n0..60 every 10 tx {HOLD}\n50 host nothing", "did not come"),
        (CYCLE + f"0 host Hold left\n0..50 every 20 tx {HOLD}", "not written.*10 "),
        (CYCLE + f"0 host Hold left\n0..50 every 2..8 tx {HOLD}", "not written.*10 "),
        (CYCLE + f"background tx {HOLD}\nwithout background\n0 host Hold left", "not written"),
        (DRIVER + f"0 rx {READY} => State left armed", "did not come"),
        (DRIVER + f"0 rx {READY} => State left ready ; malformed", r"counted .*\[1, 0, 0\], not \[1, 1, 0\]"),
        (DRIVER + "0 rx 1 body => nothing", "counted as .*: \\[0, 1, 0\\], not \\[0, 0, 0\\]"),
        (DRIVER + "0 rx 001#01 => nothing", "counted as"),
        (DRIVER + '0 rx 1 Done 5 "Zero" "" "" => Done Zero left', "did not come"),
        (DRIVER + f"0 host Hold left => {HOLD}\n1 peer left received 2", "txt:7: 1 peer.*\n.*it received 1"),
        (DRIVER + "250 end", "not written.*State left offline detail=\"no message for 250 ms\""),
        (DRIVER + f"each line by itself\nrx {READY} => nothing\nhost Idle left => {HOLD}", ":8: host Idle"),
        (DECODER + '0 tx 1 Velocity "" 2.0 0.0 => nothing', "not written.*obeys +Velocity left 2"),
        (DECODER + '0 tx 1 Velocity "" 2.0 0.0 => Arm left ; Velocity left 3', "did not come"),
        (DECODER + f"0 tx {HOLD} => Arm left ; Hold left ; named Idle", "messages are named \\['Hold'\\]"),
        (TWIN + "5 end", "not written.*0 +rx"),
        (BOTH + "1 event State left ready *\n5 measure left position=0.1", "the position is 0"),
    ],
)  # fmt: skip
def test_what_is_not_written_or_does_not_come_fails(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(AssertionError, match=reason):
        check(tmp_path, text)


@pytest.mark.parametrize(
    "text",
    [
        DRIVER + "0 sends Hold left",
        DRIVER + "== Title",
        "== One\nafter Other",
        DRIVER + "0 host Hld left",
        TWIN + "0 bus off",
    ],
)
def test_what_cannot_be_read_fails(tmp_path: Path, text: str) -> None:
    with pytest.raises((ValueError, KeyError)):
        check(tmp_path, text)
