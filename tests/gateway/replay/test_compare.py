"""Comparison: equal is equal, and every difference is found, named and described."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from brain.belief import Belief, Pose
from gateway.config import parse_robot
from gateway.core.message_text import message_text
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.recording import Recorder, environment, read_recording, tick_codec
from gateway.recording.recover import recover
from gateway.recording.tick_codec import CHAIN_START, DigestChain
from gateway.recording.tick_codec import encode as encode_tick
from gateway.replay import Comparison, compare, diff, replay_recording
from protocols import messages as msg
from protocols.frames import CanFrame, Packet
from protocols.messages import Event, Message, Nanos
from protocols.plugin import CommandDecoder
from tests.gateway import little
from tests.gateway.little import Little


def decoder(bus: str) -> CommandDecoder:
    assert bus == "can0"
    return little.LittleDecoder()


def always(outputs: Outputs) -> Callable[[Nanos, Inputs], Outputs]:
    return lambda _now, _inputs: outputs


def compared(path: Path, robot: Little | None = None, **more: Any) -> Comparison:
    robot = robot or Little()
    options = {"mounts": little.MOUNTS, "robot_text": little.ROBOT, **more}
    return compare(read_recording(path), robot.step, robot.belief, decoder, **options)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("compare") / "a.mcap"
    little.record(path, 300)
    return path


def altered(path: Path, alter: Callable[[int, bytes], bytes]) -> Path:
    """Record the same as `recorded`, but with each tick's message altered by `alter(number, bytes)`."""

    def encode(tick: Tick, before: DigestChain) -> tuple[bytes, DigestChain]:
        data, chain = encode_tick(tick, before)
        return alter(tick.number, data), chain

    with patch.object(tick_codec, "encode", encode):
        little.record(path, 300)
    return path


@dataclass
class Altered(Little):
    """Has other outputs in one step."""

    at: int = 0
    changes: dict[str, Any] = field(default_factory=dict)

    def step(self, now: Nanos, inputs: Inputs) -> Outputs:
        outputs = super().step(now, inputs)
        return replace(outputs, **self.changes) if now == self.at * little.PERIOD else outputs


# -- the same ----------------------------------------------------------------------------------


def test_the_same_is_the_same(recorded: Path) -> None:
    result = compared(recorded)
    assert result.ok, result.text()
    assert (result.ticks, result.packets, result.bytes) == (300, 300, 2400)
    assert result.views == sum(len(step.views) for step in read_recording(recorded).steps) > 900
    assert (result.given, result.left_over, result.unread) == (900, 0, 0)
    assert result.first is None
    assert result.causes == ()
    assert result.text() == (
        f"the same, byte for byte\ncompared 300 ticks, 300 packets with 2400 bytes, and {result.views} view "
        "messages; 900 received packets given again, 0 left over"
    )


def test_the_result_is_deterministic(recorded: Path) -> None:
    assert compared(recorded, Little(gain=3.0)) == compared(recorded, Little(gain=3.0))


# -- nothing proven ----------------------------------------------------------------------------


def test_no_tick_proves_nothing(tmp_path: Path) -> None:
    little.record(tmp_path / "a.mcap", 0)
    result = compared(tmp_path / "a.mcap")
    assert not result.ok
    assert "there is no tick in the recording: nothing was compared" in result.text()


def test_no_packet_proves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, little.ROBOT, {}) as recorder:
        for number in range(5):
            recorder.record(Tick(number, number, Inputs(), Outputs()), little.bare_belief(), patient=True)
    result = compare(read_recording(path), always(Outputs()), little.bare_belief, decoder)
    assert (result.ticks, result.ok) == (5, False)
    assert "no packet was sent in the recording" in result.text()


def test_packets_of_an_unknown_bus_are_left_over(recorded: Path) -> None:
    assert compared(recorded, buses=["can0", "tty"]).ok
    result = compared(recorded, buses=["can0"])
    assert not result.ok
    assert (result.given, result.left_over) == (600, 300)
    assert result.differences == ()
    assert "300 received packets are left over: the robot has no such bus" in result.text()
    assert compared(recorded, buses=[]).left_over == 900


def test_a_cut_recording_is_compared_and_not_good(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    result = compared(tmp_path / "cut.mcap")
    assert 0 < result.ticks < 300
    assert [d.kind for d in result.differences] == ["recording"]
    assert "it was cut; all before was compared" in result.text()
    assert result.text().startswith("the same up to its end, which is missing\n")
    repair = f"the recording was cut off: `gateway recover {tmp_path / 'cut.mcap'}` repairs it"
    assert result.causes == (repair,)
    assert not result.ok
    altered = compared(tmp_path / "cut.mcap", Little(gain=2.1))
    assert altered.text().startswith("NOT the same\n")


def test_a_recovered_recording_is_good_and_says_so(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    recover(tmp_path / "cut.mcap", tmp_path / "whole.mcap")
    result = compared(tmp_path / "whole.mcap")
    assert result.ok
    assert "it was recovered: what had been cut off or damaged is not in it" in result.text()
    assert "recovered" not in compared(recorded).text()


def test_a_damaged_recording_leaves_ticks_over(recorded: Path, tmp_path: Path) -> None:
    path, data = tmp_path / "damaged.mcap", bytearray(recorded.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    result = compared(path)
    assert result.ticks + result.unread == 300
    assert 0 < result.ticks < 300
    assert "the recording cannot be read further" in result.text()
    assert f"{result.unread} ticks are left over" in result.text()


def test_lost_ticks_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "b.mcap"
    with Recorder(path, little.ROBOT, {}, little.MOUNTS) as recorder:
        for tick, belief in little.life(300):
            if tick.number != 100:
                recorder.record(tick, belief, patient=True)
    result = compared(path)
    assert not result.ok
    assert result.differences[0].tick == 101
    assert "the tick before it in the recording is 99: some were lost" in result.text()


# -- a change of the robot ---------------------------------------------------------------------


def test_a_changed_gain_is_reported_with_its_key(recorded: Path) -> None:
    changed = little.ROBOT.replace("gain = 2.0", "gain = 2.1")
    result = compared(recorded, Little(gain=2.1), robot_text=changed)
    assert not result.ok
    first = result.first
    assert first is not None
    assert (first.kind, first.tick, first.since) == ("packets", 1, little.PERIOD)
    position = struct.unpack("<f", struct.pack("<f", math.sin(0.01)))[0]
    frames = [little.command(-gain * position) for gain in (2.0, 2.1)]
    assert result.text().splitlines()[:5] == [
        "NOT the same",
        "tick 1, 0.005 s after the start: bus can0",
        f"  recorded: frame {frames[0]}   left: Velocity -0.02 rad/s",
        f"  now:      frame {frames[1]}   left: Velocity -0.021 rad/s",
        "the packets of 299 ticks differ in all",
    ]
    assert result.causes == ("the robot file is not the recorded one: brain.gain: 2.0 recorded, 2.1 now",)


def test_a_tiny_change_gets_the_digits_it_needs(recorded: Path) -> None:
    result = compared(recorded, Little(gain=2.000001))
    assert result.first is not None
    one, two = result.first.text.splitlines()[1:]
    assert one.split("Velocity")[1] != two.split("Velocity")[1]


def test_the_decoder_has_decoded_all_frames_before(recorded: Path) -> None:
    class Counting:
        received = 0

        def decode(self, t: Nanos, frame: Any) -> list[Any]:
            self.received += 1
            return [msg.Velocity("left", float(self.received))]

    robot = Altered(at=100, changes={"packets": ()})
    recording = read_recording(recorded)
    result = compare(recording, robot.step, robot.belief, lambda _: Counting(), mounts=little.MOUNTS)
    assert result.first is not None
    assert result.first.tick == 100
    assert "left: Velocity 101 rad/s\n  now:      nothing more" in result.first.text
    assert result.differing == 1


def test_a_difference_in_belief_alone_is_found(recorded: Path) -> None:
    class OtherBelief(Little):
        def belief(self) -> Belief:
            belief = super().belief()
            assert belief.estimate is not None
            moved = replace(belief.estimate.pose, y=0.5 + 1e-12)
            return (
                replace(belief, estimate=replace(belief.estimate, pose=moved)) if self.seen > 150 else belief
            )

    result = compared(recorded, OtherBelief())
    assert [d.kind for d in result.differences] == ["views"]
    assert result.differing == 0
    assert "/tf: transforms[1].transform.translation.y: 0.5 recorded, 0.500000000001 now" in result.text()
    assert result.causes == ("the program: robot file and inputs are the recorded ones",)


def test_a_difference_in_events_is_found(recorded: Path) -> None:
    result = compared(recorded, Altered(at=50, changes={"events": ()}))
    assert result.differences[0].kind == "events"
    assert result.differences[0].text == (
        "event of a device\n  recorded: left: Feedback position 0.4794 rad\n  now:      nothing more"
    )


def test_a_difference_in_notes_is_found(recorded: Path) -> None:
    result = compared(recorded, Altered(changes={"notes": (Note("info", "left", "hello"),)}))
    assert "notes" in [d.kind for d in result.differences]
    assert "recorded: nothing more\n  now:      left: hello (info)" in result.text()


def test_order_and_bus_of_packets_matter(tmp_path: Path) -> None:
    a, b = Packet(0, "can0", CanFrame(1, b"a")), Packet(0, "can0", CanFrame(2, b"b"))
    path = tmp_path / "a.mcap"
    with Recorder(path, little.ROBOT, {}) as recorder:
        recorder.record(Tick(0, 0, Inputs(), Outputs((a, b))), little.bare_belief(), patient=True)
    for sent in ((b, a), (a, replace(b, bus="can1")), (a,), (a, b, b), (a, Packet(0, "can0", b"b"))):
        result = compare(
            read_recording(path), always(Outputs(sent)), little.bare_belief, lambda _: little.LittleDecoder()
        )
        assert not result.ok
        assert result.differing == 1
        assert "packets" in [d.kind for d in result.differences]


def test_another_machine_is_named_as_a_cause(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    little.record(path, 20, facts={"package numpy": "1.0", "date": "today"})
    facts = {**read_recording(recorded).facts, "package numpy": "2.0"}
    assert compared(path, facts=facts).causes == ()
    causes = compared(path, Little(gain=1.0), facts=facts).causes
    assert causes == ("it was recorded elsewhere: package numpy: '1.0' recorded, '2.0' now",)
    facts = {**read_recording(path).facts, environment.PROGRAM: "another"}
    causes = compared(path, Little(gain=1.0), facts=facts).causes
    assert causes == ("the program: its sources have changed since",)


# -- a change of the recording -----------------------------------------------------------------


def flip(number: int, written: bytes, bit: int, at: int = 0) -> Callable[[int, bytes], bytes]:
    """Flip one bit of the byte `at` of these in the tick of this number."""

    def alter(tick: int, data: bytes) -> bytes:
        if tick != number:
            return data
        assert data.count(written) == 1
        place = data.index(written) + at
        return data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :]

    return alter


MOVING = little.feedback(math.sin(0.01 * 120))
"""The wheel's frame in tick 120."""


def test_a_flipped_bit_that_moves_the_wheel(tmp_path: Path) -> None:
    result = compared(altered(tmp_path / "b.mcap", flip(120, MOVING.data, 4)))
    assert not result.ok
    assert [d.kind for d in result.differences] == ["recording", "events", "packets", "views"]
    assert {d.tick for d in result.differences} == {120}
    flipped = CanFrame(MOVING.id, bytes([MOVING.data[0] ^ 16]) + MOVING.data[1:])
    assert str(result.first) == (
        "tick 120, 0.600 s after the start: the recorded input on bus can0, "
        f"frame {flipped}, does not match the digest written with it"
    )
    assert "left: Velocity" in result.text()
    assert result.causes == ("the recording is not as it was written: see above",)
    assert result.differing == 1


def test_a_flipped_bit_is_no_cause_of_what_came_before(tmp_path: Path) -> None:
    result = compared(altered(tmp_path / "b.mcap", flip(120, MOVING.data, 4)), Little(gain=1.0))
    assert result.first is not None
    assert result.first.tick == 1
    assert "recording" in [d.kind for d in result.differences]
    assert result.causes == ("the program: robot file and inputs are the recorded ones",)


def test_a_flipped_bit_that_changes_nothing_is_found_too(tmp_path: Path) -> None:
    foreign = struct.pack("<I", 1) + bytes([33])  # its length and its data
    result = compared(altered(tmp_path / "b.mcap", flip(33, foreign, 0, at=4)))
    assert not result.ok
    assert result.differing == 0
    assert (result.differences[0].kind, result.differences[0].tick) == ("recording", 33)
    assert "frame 7FF#20, does not match the digest" in result.text()


def test_a_flipped_bit_in_what_was_sent_is_found(recorded: Path, tmp_path: Path) -> None:
    sent = next(t for t in read_recording(recorded).ticks if t.number == 77).outputs.packets[0].frame
    assert isinstance(sent, CanFrame)
    result = compared(altered(tmp_path / "b.mcap", flip(77, sent.data, 0)))
    assert [d.kind for d in result.differences] == ["recording", "packets"]
    assert "the recorded output on bus can0" in result.text()
    assert result.differing == 1


def test_a_tick_written_with_false_digests_is_found(tmp_path: Path) -> None:
    """A tick rewritten with another input and digests of its own: the chain is broken."""

    def alter(number: int, data: bytes) -> bytes:
        if number != 200:
            return data
        tick = tick_codec.decode(data, CHAIN_START).tick
        return encode_tick(replace(tick, inputs=replace(tick.inputs, packets=())), CHAIN_START)[0]

    result = compared(altered(tmp_path / "b.mcap", alter))
    assert result.differences[0].kind == "recording"
    assert result.differences[0].tick == 200


# -- format 1 ----------------------------------------------------------------------------------

FORMAT_1 = Path(__file__).parents[3] / "fixtures" / "recordings" / "format1.mcap"


def test_a_recording_of_format_1_replays_but_for_its_texts_and_a_frame_that_is_new() -> None:
    recording = read_recording(FORMAT_1)
    assert recording.format == "1"
    assert 'on_command_timeout = "hold"' in recording.robot_text
    result = replay_recording(recording)
    assert (result.ticks, result.packets, result.bytes) == (199, 67, 184)
    assert [difference.kind for difference in result.differences] == ["packets"]
    assert result.differing == 1
    assert "now:      frame 02B#0200000001000000 " in result.text()  # it did not repeat the control mode
    assert "texts for people were left out: they were worded differently in format 1" in result.text()
    changed = parse_robot(recording.robot_text.replace("gear = 8.0", "gear = 4.0"), "changed")
    assert "packets" in [d.kind for d in replay_recording(recording, changed).differences]


@pytest.mark.parametrize(
    ("recorded", "now", "same"),
    [
        (Note("info", "left", "was"), Note("info", "left", "is"), True),
        (Note("info", "left", "was"), Note("error", "left", "is"), False),
        (msg.State("left", 0, msg.Mode.READY, "was"), msg.State("left", 0, msg.Mode.READY, "is"), True),
        (msg.State("left", 0, msg.Mode.READY, "was"), msg.State("left", 0, msg.Mode.ARMED, "was"), False),
        (msg.Refused(0, "Zero", "left", "was"), msg.Refused(0, "Zero", "left", "is"), True),
        (msg.Refused(0, "Zero", "left", "was"), msg.Refused(0, "Home", "left", "was"), False),
        (msg.Fault("left", 0, 1, "NAME", "was", "was"), msg.Fault("left", 0, 1, "NAME", "is", "is"), True),
        (msg.Fault("left", 0, 1, "NAME", "was"), msg.Fault("left", 0, 1, "OTHER", "was"), False),
        (msg.Done(0, "Zero", "left", "was"), msg.Done(0, "Zero", "left", "is"), True),
    ],
)
def test_in_format_1_only_texts_are_left_out(
    tmp_path: Path, recorded: Note | Event, now: Note | Event, same: bool
) -> None:
    old_outputs, new_outputs = (
        Outputs(
            packets=(Packet(0, "can0", CanFrame(1, b"a")),),
            events=() if isinstance(one, Note) else (one,),
            notes=(one,) if isinstance(one, Note) else (),
        )
        for one in (recorded, now)
    )
    with Recorder(tmp_path / "a.mcap", little.ROBOT, {}) as recorder:
        recorder.record(Tick(0, 0, Inputs(), old_outputs), little.bare_belief(), patient=True)
    new = read_recording(tmp_path / "a.mcap")
    step = always(new_outputs)
    results = [compare(one, step, little.bare_belief, decoder) for one in (replace(new, format="1"), new)]
    assert [result.ok for result in results] == [same, False]


def test_in_formats_before_3_views_of_poses_are_left_out(recorded: Path) -> None:
    class Leapt(Little):
        def belief(self) -> Belief:
            belief = super().belief()
            assert belief.estimate is not None
            return replace(belief, estimate=replace(belief.estimate, pose=Pose(5.0, 6.0, 1.0)))

    new = read_recording(recorded)
    for format_ in ("1", "2", "3"):
        gateway = Leapt()
        result = compare(
            replace(new, format=format_), gateway.step, gateway.belief, decoder, mounts=little.MOUNTS
        )
        assert result.ok == (format_ != "3")
        assert ("views of poses were left out" in result.text()) == (format_ != "3")
        assert result.views > 300  # the others


# -- texts -------------------------------------------------------------------------------------

IMPEDANCE = (
    "a: Impedance position 1 rad, velocity 0 rad/s, torque 2 N·m, stiffness 3 N·m/rad, damping 4 N·m·s/rad"
)
SCAN = (
    "l: LaserScan angle_min 0 rad, angle_increment 0.1 rad, range_min 0.1 m, range_max 9 m, "
    "ranges (1, 1, 1, 1, 1, 1, 1, 1, … 9 in all) m"
)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (msg.Velocity("left", 3.14159), "left: Velocity 3.142 rad/s"),
        (msg.Velocity("left", 3.0, 0.5), "left: Velocity 3 rad/s, torque 0.5 N·m"),
        (msg.Torque("left", -0.25), "left: Torque -0.25 N·m"),
        (msg.Position("a", 1.0, velocity=2.0), "a: Position 1 rad, velocity 2 rad/s"),
        (msg.Impedance("a", 1.0, 0.0, 2.0, 3.0, 4.0), IMPEDANCE),
        (msg.Idle("left"), "left: Idle"),
        (msg.Stop("enough"), "Stop reason enough"),
        (msg.Stop(), "Stop"),
        (msg.SetId("can0", 7, 3), "can0: SetId serial 7, address 3"),
        (msg.Goal(1.0, 2.0), "Goal x 1 m, y 2 m"),
        (msg.LaserScan("l", 0, 0.0, 0.1, 0.1, 9.0, (1.0,) * 9), SCAN),
    ],
)
def test_messages_as_text(message: Message, text: str) -> None:
    assert message_text(message) == text


def test_settings_as_text() -> None:
    old = 'a = 1\n[b]\nc = [1, 2]\nd = "x"\n[[m]]\nname = "left"\ng = 1.0\n[[n]]\ng = 1\n'
    assert diff.settings(old, old) == []
    assert diff.settings(old, "# comment\n" + old) == []
    new = 'a = 1.0\n[b]\nc = [1, 3]\ne = true\n[[m]]\nname = "left"\ng = 2.0\n[[n]]\ng = 2\n'
    assert diff.settings(old, new) == [
        "a: 1 recorded, 1.0 now",
        "b.c: [1, 2] recorded, [1, 3] now",
        "b.d: 'x' recorded, nothing now",
        "b.e: nothing recorded, True now",
        "m[left].g: 1.0 recorded, 2.0 now",
        "n[0].g: 1 recorded, 2 now",
    ]
    for wrong in ("a = ", f"a = {'9' * 5000}", "a = " + "[" * 10_000):
        assert "cannot be read" in diff.settings(old, wrong)[0]
