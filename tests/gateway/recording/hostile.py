"""Recordings made to do harm: cut, damaged, forged, and sealed with valid digests.

`Forge(folder, seed).make(number)` writes one; `read_all` gives it to everything that reads recordings.
"""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from random import Random

import zstandard

from brain.belief import Belief
from gateway.cli.main import main
from gateway.config import parse_robot
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.errors import ConfigError, GatewayError
from gateway.recording import read_recording, tick_codec
from gateway.recording.layout import FACTS, FORMAT, METADATA, ROBOT_FILE, Opcode, digest
from gateway.recording.mcap_file import McapFile
from gateway.recording.mcap_records import records
from gateway.recording.recover import is_whole, recover
from gateway.recording.ros_views import Views
from gateway.recording.tick_writer import TickWriter
from gateway.replay.compare import compare
from gateway.rosbag import is_bag
from gateway.runtime.session import open_session
from protocols import messages as msg
from protocols.conformance.noise import STRANGE
from protocols.frames import BusState, CanFrame, Frame, Packet

NASTY = "\x1b]0;owned\x07\r\n\x9b2J\u202e\u2028\0"
"""Sequences of a terminal, a line of its own, right to left, and the end of a string."""
INTEGERS = (0, 1, -1, 255, 2**16, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**62, 2**63 - 1, -(2**63))
FLOATS = (0.0, -0.0, 5e-324, 1e-19, -1e9, 1e18, 1e300, 1.7e308, -1.7e308)
KINDS = ("cut", "flipped", "forged", "patched", "ticks", "structure", "robot")


@cache
def base(name: str) -> tuple[str, tuple[tuple[Tick, Belief], ...]]:
    """Return a robot file, and the ticks of the first 0.08 s of that robot with beliefs."""
    task = msg.Velocity("left", 2.0) if name == "bench" else msg.Goal(1.0, 0.5)
    with open_session(name, simulated=True) as session:
        ticks = []
        for tick in session.run(0.08):
            ticks.append((tick, session.belief))
            session.submit(*[task] * (tick.number == 5))
        return session.robot.text, tuple(ticks)


class Forge:
    """Makes recordings, each from the seed and its number alone."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.path, self._seed = folder / "hostile.mcap", seed
        self._whole: dict[str, bytes] = {}

    def make(self, number: int) -> Path:
        """Write a recording, over the one before."""
        random = Random(self._seed * 10**9 + number)
        self.path.unlink(missing_ok=True)
        kind = KINDS[number % len(KINDS)]
        name = "diffbot" if random.random() < 0.2 else "bench"
        if kind in ("ticks", "structure", "robot"):
            getattr(self, f"_{kind}")(name, random)
            return self.path
        if name not in self._whole:
            self._written(name, base(name)[1])
            self._whole[name] = self.path.read_bytes()
        data = bytearray(self._whole[name])
        for _ in range(random.choice((1, 1, 2, 8))):
            at = random.randrange(len(data) or 1)
            if kind == "cut":
                del data[at : random.choice((len(data), at + 1 + random.randrange(99)))]
            elif kind == "flipped":
                data[at : at + 1] = bytes((data[at] ^ 1 << random.randrange(8),))
            elif kind == "forged":
                data[at : at + 8] = struct.pack("<Q", random.choice(INTEGERS) % 2**64)
            else:
                data = patched(data, random)
        self.path.write_bytes(data)
        return self.path

    def _written(self, name: str, ticks: tuple[tuple[Tick, Belief], ...], text: str | None = None) -> None:
        views = Views({})
        writer = TickWriter(self.path, base(name)[0] if text is None else text, {}, views)
        for tick, belief in ticks:
            writer.add(tick, belief)
        writer.finish()

    def _ticks(self, name: str, random: Random) -> None:
        """Valid digests over absurd values; the views are those of the valid ticks."""
        text, ticks = base(name)
        chosen = [hostile_tick(t, random) if random.random() < 0.4 else t for t, _ in ticks]
        file = self._head(text.encode())
        channel = file.open_channel(tick_codec.TOPIC, tick_codec.TYPE, tick_codec.DEFINITION)
        chain = tick_codec.CHAIN_START
        for tick in chosen:
            with contextlib.suppress(ValueError, struct.error):
                data, chain = tick_codec.encode(tick, chain)
                file.message(channel, tick.number % 2**32, abs(tick.now) % 2**63, 0, data)
        file.finish()

    def _structure(self, name: str, random: Random) -> None:
        """Records of any kind and content, in chunks with a valid checksum and outside."""
        text, ticks = base(name)
        file = self._head(text.encode(), str(random.choice((1, 2, 2, 2, 3, NASTY))))
        chain, topics = tick_codec.CHAIN_START, [tick_codec.TOPIC, NASTY, "", "/map", "/a" * 200]
        for tick, _ in ticks[: random.randrange(len(ticks))]:
            number = file.channel(tick_codec.TOPIC, tick_codec.TYPE) or file.open_channel(
                tick_codec.TOPIC, tick_codec.TYPE, tick_codec.DEFINITION
            )
            data, chain = tick_codec.encode(tick, chain)
            match random.randrange(8):
                case 0:
                    data = bytes(damaged(data, random))
                case 1:
                    topic = random.choice(topics)
                    number = file.channel(topic, NASTY) or file.open_channel(topic, NASTY, NASTY, NASTY)
                case 2:
                    number = random.randrange(2**16)
            file.message(number, random.randrange(2**32), tick.now, random.randrange(2**64), data)
            if random.random() < 0.3:
                _put(file, random)
            if random.random() < 0.3:
                file.flush()
        random.choice((file.finish, file.flush, file.finish))()
        file.abandon()

    def _robot(self, name: str, random: Random) -> None:
        """Another robot file with a valid digest."""
        text, ticks = base(name)
        lines = text.splitlines(keepends=True)
        for _ in range(random.randrange(1, 6)):
            at = random.randrange(len(lines))
            key, equals, _value = lines[at].partition("=")
            values = ("nan", "1e308", "-1", "9" * 400, '"x\\u001b[2J"', "[" * 90, "{}", "true", "1e-300", "")
            lines[at] = f"{key}{equals} {random.choice(values)}\n" if equals else random.choice(("", "[x]\n"))
        self._written(name, ticks[:8], "".join(lines))

    def _head(self, robot: bytes, format_: str = FORMAT) -> McapFile:
        file = McapFile(self.path, f"motor-gateway {NASTY}")
        file.metadata(METADATA, {"format": format_, "robot digest": digest(robot)})
        file.metadata(FACTS, {f"package {NASTY}": NASTY})
        file.attachment(ROBOT_FILE, "application/toml", robot)
        return file


def _put(file: McapFile, random: Random) -> None:
    """Put a record of any kind into the chunk, with a length that may be wrong."""
    data = random.choice((b"", random.randbytes(30), bytes(200), NASTY.encode(), *STRANGE))
    length = random.choice((len(data), len(data), random.choice(INTEGERS) % 2**64))
    file._chunk += struct.pack("<BQ", random.randrange(18), length) + data


def patched(data: bytearray, random: Random) -> bytearray:
    """Return a recording of which one chunk has other contents, and a valid checksum."""
    mark = b"\x04\x00\x00\x00zstd"
    places = [i for i in range(len(data)) if data.startswith(mark, i)]
    at = random.choice(places[: max(1, len(places) // 2)]) - 28 - 9
    (length,) = struct.unpack_from("<Q", data, at + 1)
    contents = damaged(zstandard.decompress(bytes(data[at + 9 + 28 + 16 : at + 9 + length])), random)
    packed = zstandard.compress(bytes(contents))
    head = struct.pack("<QQQII", 0, 0, len(contents), zlib.crc32(contents), 4) + b"zstd"
    chunk = head + struct.pack("<Q", len(packed)) + packed
    record = struct.pack("<BQ", Opcode.CHUNK, len(chunk)) + chunk
    return bytearray(data[:at] + record + data[at + 9 + length :])


def damaged(data: bytes, random: Random) -> bytearray:
    """Return data with some bytes or numbers replaced, or cut."""
    out = bytearray(data)
    for _ in range(random.choice((1, 2, 9))):
        at = random.randrange(len(out) + 1)
        match random.randrange(4):
            case 0:
                del out[at:]
            case 1:
                out[at : at + 4] = random.choice(STRANGE)
            case 2:
                out[at : at + 8] = struct.pack("<q", random.choice(INTEGERS))
            case 3:
                out[at : at + 1] = random.randbytes(1)
    return out


def hostile_tick(tick: Tick, random: Random) -> Tick:
    """Return a tick with one part absurd."""
    made, sent, number = tick.inputs, tick.outputs, random.choice(INTEGERS)
    match random.randrange(9):
        case 0:
            return replace(tick, now=number)
        case 1:
            return replace(tick, number=number % 2**64)
        case 2:
            made = replace(made, states=((random.choice(("can0", NASTY)), random.choice(list(BusState))),))
        case 3:
            made = replace(made, packets=(*made.packets, hostile_packet(random)))
        case 4:
            made = replace(made, packets=tuple(replace(p, t=number) for p in made.packets))
        case 5:
            made = replace(made, instructions=tuple(hostile_instruction(random) for _ in range(3)))
        case 6:
            sent = replace(sent, packets=(hostile_packet(random), *sent.packets))
        case 7:
            sent = replace(sent, notes=(Note("error", NASTY, NASTY),) * random.choice((1, 99)))
        case 8:
            sent = replace(sent, events=(msg.Fault("left", number, 3, NASTY, NASTY, NASTY),))
    return Tick(tick.number, tick.now, Inputs(*_parts(made)), Outputs(*_parts(sent)))  # type: ignore[arg-type]  # as before


def _parts(value: Inputs | Outputs) -> tuple[object, ...]:
    return tuple(getattr(value, name) for name in type(value).__slots__)


def hostile_packet(random: Random) -> Packet:
    """Return a packet on any bus, of any size and id."""
    data = random.randbytes(random.choice((0, 1, 7, 8, 9, 64, 65, 5000)))
    number = random.choice((0x029, 0x7FF, 0x800, 2**29, 2**31, 2**32 - 1, random.randrange(2**11)))
    flags = [random.random() < 0.5 for _ in range(4)]
    frame: Frame = data if random.random() < 0.3 else CanFrame(number, data, *flags)
    return Packet(random.choice(INTEGERS), random.choice(("can0", "sensors", NASTY, "")), frame)


def hostile_instruction(random: Random) -> msg.Instruction:
    """Return an instruction with extreme numbers and names."""
    value, name = random.choice(FLOATS), random.choice(("left", "all", "", NASTY))
    makers: tuple[Callable[[], msg.Instruction], ...] = (
        lambda: msg.Goal(value, random.choice(FLOATS), random.choice((None, value))),
        lambda: msg.Drive(value, random.choice(FLOATS)),
        lambda: msg.Velocity(name, value),
        lambda: msg.Torque(name, value),
        lambda: msg.Position(name, value),
        lambda: msg.Set(random.choice(("left.velocity", "brain.pursuit.lookahead", NASTY)), value),
        lambda: msg.Stop(NASTY),
        lambda: msg.SetId("can0", 2**63, 2**62),
        lambda: msg.WriteParameter(name, NASTY, value),
        lambda: msg.Release(),
    )
    return random.choice(makers)()


# -- readers --------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _robot_of(text: str) -> Robot | ConfigError:
    try:
        return parse_robot(text, "robot.toml")
    except ConfigError as error:
        return error


def read_all(path: Path, *, printed: bool = False) -> list[str]:
    """Read, recover, replay and print a recording; return the sentences with which that was refused.

    Raises what is no GatewayError, AssertionError for a sentence that is none."""
    target = path.with_name("recovered.mcap")
    target.unlink(missing_ok=True)

    def replay() -> None:
        recording = read_recording(path)
        robot = _robot_of(recording.robot_text)
        if isinstance(robot, ConfigError):
            raise robot
        gateway = Gateway(robot)
        bus = robot.buses
        compare(recording, gateway.step, gateway.belief, lambda b: decoder_of(robot, b), buses=bus).text()

    def scan() -> None:
        with path.open("rb") as file:
            for _ in records(file):
                pass

    readers: list[Callable[[], object]] = [scan, lambda: is_bag(path), lambda: is_whole(path)]
    readers += [lambda: list(read_recording(path).steps), lambda: recover(path, target), replay]
    refused = []
    for reader in readers:
        try:
            reader()
        except GatewayError as error:
            refused.append(str(error))
    assert all(10 < len(text) < 20_000 for text in refused), refused
    if printed:
        for command in (["replay"], ["watch"], ["watch", "--lines"], ["recover"]):
            with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
                main([*command, str(path)])
            assert_printable(out.getvalue())
        path.with_name(f"{path.stem}.recovered.mcap").unlink(missing_ok=True)
    return refused


def assert_printable(text: str) -> None:
    """Raise AssertionError if a terminal would obey a part of this text."""
    wrong = {c for c in text if c != "\n" and not c.isprintable()}
    assert not wrong, f"{wrong} in {text[:2000]!r}"
