"""The judge: the same is the same, and whatever is not is found, named, and said in words."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from brain.belief import Belief
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.recording import Recorder, environment, read, tick_codec
from gateway.replay import diff
from gateway.replay.compare import Verdict, compare
from protocols import messages as msg
from protocols.frames import CanFrame, Packet
from protocols.messages import (
    Message as AnyMessage,
)
from protocols.messages import Nanos
from protocols.plugin import CommandDecoder
from tests.gateway import little
from tests.gateway.little import Little


def decoder(bus: str) -> CommandDecoder:
    assert bus == "can0"
    return little.LittleDecoder()


def always(outputs: Outputs) -> Callable[[Nanos, Inputs], Outputs]:
    return lambda _now, _inputs: outputs


def judged(path: Path, robot: Little | None = None, **more: Any) -> Verdict:
    robot = robot or Little()
    options = {"mounts": little.MOUNTS, "robot_text": little.ROBOT, **more}
    return compare(read(path), robot.step, robot.belief, decoder, **options)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("judge") / "a.mcap"
    little.record(path, 300)
    return path


def rewritten(old: Path, new: Path, change: Callable[[int, bytes], bytes | None]) -> Path:
    """The same recording properly written again, each tick's message changed by `change(place, bytes)`; it is
    left out, with its views, if that gives None."""
    stream = BytesIO()
    writer = Writer(stream, compression=CompressionType.LZ4)
    writer.start(profile="ros2", library="a test")
    channels: dict[int, int] = {}
    schemas: dict[int, int] = {}
    place, tick_channel, left_out = -1, 0, False
    for record in StreamReader(BytesIO(old.read_bytes())).records:
        if isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            writer.add_attachment(0, 0, record.name, record.media_type, record.data)
        elif isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            schema = schemas[record.schema_id]
            channels[record.id] = writer.register_channel(record.topic, "cdr", schema, record.metadata)
            tick_channel = record.id if record.topic == tick_codec.TOPIC else tick_channel
        elif isinstance(record, Message):
            data: bytes | None = record.data
            if record.channel_id == tick_channel:
                place += 1
                data = change(place, record.data)
                left_out = data is None
            if data is not None and not left_out:
                number = channels[record.channel_id]
                writer.add_message(number, record.log_time, data, record.publish_time, record.sequence)
    writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates arguments only
    new.write_bytes(stream.getvalue())
    return new


# -- the same ----------------------------------------------------------------------------------


def test_the_same_is_the_same(recorded: Path) -> None:
    verdict = judged(recorded)
    assert verdict.ok, verdict.text()
    assert (verdict.ticks, verdict.packets, verdict.bytes) == (300, 300, 2400)
    assert verdict.views == sum(len(step.views) for step in read(recorded).steps) > 900
    assert (verdict.given, verdict.left_over, verdict.unread) == (900, 0, 0)
    assert verdict.first is None
    assert verdict.causes == ()
    assert verdict.text() == (
        f"the same, byte for byte\ncompared 300 ticks, 300 packets with 2400 bytes, and {verdict.views} view "
        "messages; 900 received packets given again, 0 left over"
    )


def test_twice_the_same_verdict(recorded: Path) -> None:
    assert judged(recorded, Little(gain=3.0)) == judged(recorded, Little(gain=3.0))


# -- nothing proven ----------------------------------------------------------------------------


def test_no_tick_proves_nothing(tmp_path: Path) -> None:
    little.record(tmp_path / "a.mcap", 0)
    verdict = judged(tmp_path / "a.mcap")
    assert not verdict.ok
    assert "there is no tick in the recording: nothing was compared" in verdict.text()


def test_no_packet_proves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, little.ROBOT, {}) as recorder:
        for number in range(5):
            recorder.record(Tick(number, number, Inputs(), Outputs()), little.bare_belief(), patient=True)
    verdict = compare(read(path), always(Outputs()), little.bare_belief, decoder)
    assert (verdict.ticks, verdict.ok) == (5, False)
    assert "not one packet was sent in the recording" in verdict.text()


def test_packets_of_an_unknown_bus_are_left_over(recorded: Path) -> None:
    assert judged(recorded, buses=["can0", "tty"]).ok
    verdict = judged(recorded, buses=["can0"])
    assert not verdict.ok
    assert (verdict.given, verdict.left_over) == (600, 300)
    assert verdict.differences == ()
    assert "300 received packets are left over: the robot has no such bus" in verdict.text()
    assert judged(recorded, buses=[]).left_over == 900


def test_a_cut_recording_is_compared_and_not_good(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    verdict = judged(tmp_path / "cut.mcap")
    assert 0 < verdict.ticks < 300
    assert [d.kind for d in verdict.differences] == ["recording"]
    assert "it was cut; all before was compared" in verdict.text()


def test_a_damaged_recording_leaves_ticks_over(recorded: Path, tmp_path: Path) -> None:
    path, data = tmp_path / "damaged.mcap", bytearray(recorded.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    verdict = judged(path)
    assert verdict.ticks + verdict.unread == 300
    assert 0 < verdict.ticks < 300
    assert "the recording cannot be read on" in verdict.text()
    assert f"{verdict.unread} ticks are left over" in verdict.text()


def test_lost_ticks_are_told(recorded: Path, tmp_path: Path) -> None:
    path = rewritten(recorded, tmp_path / "b.mcap", lambda n, data: None if n == 100 else data)
    verdict = judged(path)
    assert not verdict.ok
    assert verdict.differences[0].tick == 101
    assert "the tick before it in the recording is 99: some were lost" in verdict.text()


# -- a change of the robot ---------------------------------------------------------------------


def test_a_changed_gain_is_told_in_words_with_its_key(recorded: Path) -> None:
    changed = little.ROBOT.replace("gain = 2.0", "gain = 2.1")
    verdict = judged(recorded, Little(gain=2.1), robot_text=changed)
    assert not verdict.ok
    first = verdict.first
    assert first is not None
    assert (first.kind, first.tick, first.since) == ("packets", 1, little.PERIOD)
    position = struct.unpack("<f", struct.pack("<f", math.sin(0.01)))[0]
    frames = [little.command(-gain * position) for gain in (2.0, 2.1)]
    assert verdict.text().splitlines()[:5] == [
        "NOT the same",
        "tick 1, 0.005 s after the start: bus can0",
        f"  recorded: frame {frames[0]}   left: Velocity -0.02 rad/s",
        f"  now:      frame {frames[1]}   left: Velocity -0.021 rad/s",
        "the packets of 299 ticks differ in all",
    ]
    assert verdict.causes == ("the robot file is not the recorded one: brain.gain: 2.0 recorded, 2.1 now",)


def test_a_tiny_change_gets_the_digits_it_needs(recorded: Path) -> None:
    verdict = judged(recorded, Little(gain=2.000001))
    assert verdict.first is not None
    one, two = verdict.first.text.splitlines()[1:]
    assert one.split("Velocity")[1] != two.split("Velocity")[1]


def test_the_ear_has_heard_all_before(recorded: Path) -> None:
    class Counting:
        received = 0

        def decode(self, t: Nanos, frame: Any) -> list[Any]:
            self.received += 1
            return [msg.Velocity("left", float(self.received))]

    class Late(Little):
        def step(self, now: Nanos, inputs: Inputs) -> Outputs:
            outputs = super().step(now, inputs)
            return replace(outputs, packets=()) if now == 100 * little.PERIOD else outputs

    robot = Late()
    verdict = compare(read(recorded), robot.step, robot.belief, lambda _: Counting(), mounts=little.MOUNTS)
    assert verdict.first is not None
    assert verdict.first.tick == 100
    assert "left: Velocity 101 rad/s\n  now:      nothing more" in verdict.first.text
    assert verdict.differing == 1


def test_a_difference_in_belief_alone_is_found(recorded: Path) -> None:
    class Dreamer(Little):
        def belief(self) -> Belief:
            reported = super().belief()
            assert reported.estimate is not None
            moved = replace(reported.estimate.pose, y=0.5 + 1e-12)
            return (
                replace(reported, estimate=replace(reported.estimate, pose=moved))
                if self.seen > 150
                else reported
            )

    verdict = judged(recorded, Dreamer())
    assert [d.kind for d in verdict.differences] == ["views"]
    assert verdict.differing == 0
    assert "/odom: pose.pose.position.y: 0.5 recorded, 0.500000000001 now" in verdict.text()
    assert verdict.causes == ("the program: robot file and inputs are the recorded ones",)


def test_a_difference_in_what_a_driver_hears_is_found(recorded: Path) -> None:
    class Deaf(Little):
        def step(self, now: Nanos, inputs: Inputs) -> Outputs:
            outputs = super().step(now, inputs)
            return replace(outputs, events=()) if now == 50 * little.PERIOD else outputs

    verdict = judged(recorded, Deaf())
    assert verdict.differences[0].kind == "events"
    assert verdict.differences[0].text == (
        "heard from a device\n  recorded: left: Feedback position 0.4794 rad\n  now:      nothing more"
    )


def test_a_difference_in_notes_is_found(recorded: Path) -> None:
    class Chatty(Little):
        def step(self, now: Nanos, inputs: Inputs) -> Outputs:
            outputs = super().step(now, inputs)
            return (
                replace(outputs, notes=(*outputs.notes, Note("info", "left", "hello")))
                if now == 0
                else outputs
            )

    verdict = judged(recorded, Chatty())
    assert "notes" in [d.kind for d in verdict.differences]
    assert "recorded: nothing more\n  now:      left: hello (info)" in verdict.text()


def test_order_and_bus_of_packets_matter(tmp_path: Path) -> None:
    a, b = Packet(0, "can0", CanFrame(1, b"a")), Packet(0, "can0", CanFrame(2, b"b"))
    path = tmp_path / "a.mcap"
    with Recorder(path, little.ROBOT, {}) as recorder:
        recorder.record(Tick(0, 0, Inputs(), Outputs((a, b))), little.bare_belief(), patient=True)
    for sent in ((b, a), (a, replace(b, bus="can1")), (a,), (a, b, b), (a, Packet(0, "can0", b"b"))):
        verdict = compare(
            read(path),
            always(Outputs(sent)),
            little.bare_belief,
            lambda _: little.LittleDecoder(),
        )
        assert not verdict.ok
        assert verdict.differing == 1
        assert "packets" in [d.kind for d in verdict.differences]


def test_another_machine_is_named_as_a_cause(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    little.record(path, 20, facts={"package numpy": "1.0", "date": "today"})
    facts = {**read(recorded).facts, "package numpy": "2.0"}
    assert judged(path, facts=facts).causes == ()
    causes = judged(path, Little(gain=1.0), facts=facts).causes
    assert causes == ("it was recorded elsewhere: package numpy: '1.0' recorded, '2.0' now",)
    facts = {**read(path).facts, environment.PROGRAM: "another"}
    causes = judged(path, Little(gain=1.0), facts=facts).causes
    assert causes == ("the program: its sources have changed since",)


# -- a change of the recording -----------------------------------------------------------------


def flip(number: int, written: bytes, bit: int) -> Callable[[int, bytes], bytes]:
    """Flip one bit of these bytes in the tick at this place."""

    def change(place: int, data: bytes) -> bytes:
        if place != number:
            return data
        assert data.count(written) == 1
        at = data.index(written)
        return data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]

    return change


def test_a_flipped_bit_that_moves_the_wheel(recorded: Path, tmp_path: Path) -> None:
    frame = little.feedback(math.sin(0.01 * 120))
    path = rewritten(recorded, tmp_path / "b.mcap", flip(120, frame.data, 4))
    verdict = judged(path)
    assert not verdict.ok
    assert [d.kind for d in verdict.differences] == ["recording", "events", "packets", "views"]
    assert {d.tick for d in verdict.differences} == {120}
    flipped = CanFrame(frame.id, bytes([frame.data[0] ^ 16]) + frame.data[1:])
    assert str(verdict.first) == (
        "tick 120, 0.600 s after the start: the recorded input on bus can0, "
        f"frame {flipped}, does not match the digest written with it"
    )
    assert "left: Velocity" in verdict.text()
    assert verdict.causes == ("the recording is not as it was written: see above",)
    assert verdict.differing == 1


def test_a_flipped_bit_is_no_cause_of_what_came_before(recorded: Path, tmp_path: Path) -> None:
    frame = little.feedback(math.sin(0.01 * 120))
    path = rewritten(recorded, tmp_path / "b.mcap", flip(120, frame.data, 4))
    verdict = judged(path, Little(gain=1.0))
    assert verdict.first is not None
    assert verdict.first.tick == 1
    assert "recording" in [d.kind for d in verdict.differences]
    assert verdict.causes == ("the program: robot file and inputs are the recorded ones",)


def test_a_flipped_bit_that_changes_nothing_is_found_too(recorded: Path, tmp_path: Path) -> None:
    foreign = CanFrame(0x7FF, bytes([33]))
    needle = struct.pack("<I", 1) + foreign.data

    def change(place: int, data: bytes) -> bytes:
        return data.replace(needle, needle[:-1] + bytes([33 ^ 1])) if place == 33 else data

    path = rewritten(recorded, tmp_path / "b.mcap", change)
    verdict = judged(path)
    assert not verdict.ok
    assert verdict.differing == 0
    assert (verdict.differences[0].kind, verdict.differences[0].tick) == ("recording", 33)
    assert "frame 7FF#20, does not match the digest" in verdict.text()


def test_a_flipped_bit_in_what_was_sent_is_found(recorded: Path, tmp_path: Path) -> None:
    sent = next(t for t in read(recorded).ticks if t.number == 77).outputs.packets[0].frame
    assert isinstance(sent, CanFrame)
    verdict = judged(rewritten(recorded, tmp_path / "b.mcap", flip(77, sent.data, 0)))
    assert [d.kind for d in verdict.differences] == ["recording", "packets"]
    assert "the recorded output on bus can0" in verdict.text()
    assert verdict.differing == 1


def test_a_tick_written_with_false_digests_is_found(recorded: Path, tmp_path: Path) -> None:
    """Somebody wrote the tick anew with another input, properly sealed by itself: the chain is broken."""

    def change(place: int, data: bytes) -> bytes:
        if place != 200:
            return data
        tick = tick_codec.decode(data, tick_codec.UNPROTECTED).tick
        other = replace(tick, inputs=replace(tick.inputs, packets=()))
        return tick_codec.encode(other, tick_codec.UNPROTECTED)[0]

    verdict = judged(rewritten(recorded, tmp_path / "b.mcap", change))
    assert verdict.differences[0].kind == "recording"
    assert verdict.differences[0].tick == 200


def test_rewriting_alone_changes_nothing(recorded: Path, tmp_path: Path) -> None:
    assert judged(rewritten(recorded, tmp_path / "b.mcap", lambda _, data: data)).ok


# -- in words ----------------------------------------------------------------------------------

IMPEDANCE = (
    "a: Impedance position 1 rad, velocity 0 rad/s, torque 2 N·m, stiffness 3 N·m/rad, damping 4 N·m·s/rad"
)
SCAN = (
    "l: LaserScan angle_min 0, angle_increment 0.1, range_min 0.1, range_max 9, "
    "ranges (1, 1, 1, 1, 1, 1, 1, 1, … 9 in all)"
)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        (msg.Velocity("left", 3.14159), "left: Velocity 3.142 rad/s"),
        (msg.Velocity("left", 3.0, 0.5), "left: Velocity 3 rad/s, torque 0.5 N·m"),
        (msg.Torque("left", -0.25), "left: Torque -0.25 N·m"),
        (msg.Position("a", 1.0, velocity=2.0), "a: Position 1 rad, velocity 2 rad/s"),
        (
            msg.Impedance("a", 1.0, 0.0, 2.0, 3.0, 4.0),
            IMPEDANCE,
        ),
        (msg.Idle("left"), "left: Idle"),
        (msg.Stop("enough"), "Stop reason enough"),
        (msg.Stop(), "Stop"),
        (msg.SetId("can0", 7, 3), "can0: SetId serial 7, address 3"),
        (msg.Goal(1.0, 2.0), "Goal x 1 m, y 2 m"),
        (
            msg.LaserScan("l", 0, 0.0, 0.1, 0.1, 9.0, (1.0,) * 9),
            SCAN,
        ),
    ],
)
def test_words_in_words(word: AnyMessage, said: str) -> None:
    assert diff.say(word) == said


def test_settings_in_words() -> None:
    old = 'a = 1\n[b]\nc = [1, 2]\nd = "x"\n[[m]]\nname = "left"\ng = 1.0\n[[n]]\ng = 1\n'
    assert diff.settings(old, old) == []
    assert diff.settings(old, "# said\n" + old) == []
    new = 'a = 1.0\n[b]\nc = [1, 3]\ne = true\n[[m]]\nname = "left"\ng = 2.0\n[[n]]\ng = 2\n'
    assert diff.settings(old, new) == [
        "a: 1 recorded, 1.0 now",
        "b.c: [1, 2] recorded, [1, 3] now",
        "b.d: 'x' recorded, nothing now",
        "b.e: nothing recorded, True now",
        "m[left].g: 1.0 recorded, 2.0 now",
        "n[0].g: 1 recorded, 2 now",
    ]
    assert "cannot be read" in diff.settings(old, "a = ")[0]
