"""Recordings that were made to do harm: refused in a sentence, with little memory, and nothing obeyed by a
terminal. `./go prove -k hostile_recordings` takes 100,000 (tests/prove/test_recordings.py)."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import lz4.frame
import pytest

from gateway.recording.layout import METADATA, Opcode
from tests.gateway import little
from tests.gateway.recording.hostile import KINDS, Forge, read_all

MB = 1024 * 1024
READ = """
import resource, sys
from pathlib import Path
from gateway.config import load_robot
from gateway.errors import BagError
from gateway.rosbag import is_bag
from gateway.rosbag.evaluate import evaluate_file
from tests.gateway.recording.hostile import read_all
def used(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
robot = load_robot("jackal")
before = used()
for path in map(Path, sys.argv[1:]):
    texts = read_all(path)
    if is_bag(path):
        try:
            evaluate_file(path, robot)
        except BagError as error:
            texts.append(str(error))
    print(path.stem, used() - before, len(texts))
"""


def packed(megabytes: int) -> bytes:
    """An lz4 frame of so many megabytes of zeros: one block of 4 MB, again and again."""
    options = {"block_size": lz4.frame.BLOCKSIZE_MAX4MB, "block_linked": False, "store_size": False}
    one: bytes = lz4.frame.compress(bytes(4 * MB), **options)
    head, block = one[:7], one[7:-4]
    return head + block * (megabytes // 4) + one[-4:]


def chunk(data: bytes, size: int, compression: bytes = b"lz4") -> bytes:
    name = struct.pack("<I", len(compression)) + compression
    content = struct.pack("<QQQI", 0, 0, size, 0) + name + struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", Opcode.CHUNK, len(content)) + content


def views(count: int) -> bytes:
    """So many messages of a topic, without a tick between them."""
    topic = b"".join(struct.pack("<I", len(text)) + text for text in (b"/x", b"cdr")) + bytes(4)
    channel = struct.pack("<BQHH", Opcode.CHANNEL, 4 + len(topic), 77, 0) + topic
    return channel + (struct.pack("<BQHIQQ", Opcode.MESSAGE, 1022, 77, 0, 0, 0) + bytes(1000)) * count


def test_what_unpacks_to_gigabytes_takes_little_memory(path: Path) -> None:
    """One chunk, one that lies, many, views without a tick; then another program's file with such chunks."""
    gigabytes = packed(2048)
    bombs = {
        "one": (chunk(gigabytes, 2048 * MB), 300),
        "lying": (chunk(gigabytes, 1000), 300),
        "many": (chunk(packed(60), 60 * MB) * 20, 300),
        "views": (chunk(lz4.frame.compress(views(60_000)), len(views(60_000))), 300),
        "bag": (chunk(gigabytes, 2048 * MB), 1000),
        "lying_bag": (chunk(gigabytes, 1000), 1000),
    }
    little.record_in_chunks(path, 40)
    whole = path.read_bytes()
    start = whole.index(struct.pack("<BQ", Opcode.DATA_END, 4))
    files = [path.with_name(f"{name}.mcap") for name in bombs]
    for file, (bomb, _most) in zip(files, bombs.values(), strict=True):
        data = whole.replace(METADATA.encode(), b"another_prog.") if "bag" in file.stem else whole
        file.write_bytes(data[:start] + bomb + data[start:])
    done = subprocess.run([sys.executable, "-c", READ, *files], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    assert [name for name, _, _ in rows] == list(bombs)
    assert all(int(memory) < bombs[name][1] for name, memory, _ in rows), f"MB: {rows}"
    assert all(int(sentences) for _, _, sentences in rows), f"nothing was refused: {rows}"


@pytest.mark.sample(3)
@pytest.mark.parametrize("kind", range(len(KINDS)), ids=KINDS)
def test_a_hostile_recording_is_read_or_refused_in_a_sentence(kind: int, tmp_path: Path) -> None:
    forge = Forge(tmp_path, seed=5)
    refused = 0
    for number in range(kind, 8 * len(KINDS), len(KINDS)):
        refused += bool(read_all(forge.make(number), printed=number < len(KINDS)))
    assert refused or KINDS[kind] in ("flipped", "ticks")
