"""Bits beside cantools, checksums beside crccheck and opendbc, mistakes in words, conversations."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.conformance.bench import Bench, make_bench
from protocols.dbc import example, plugin
from protocols.dbc.checksums import CHECKSUMS
from protocols.dbc.database import Message, Signal, messages_of, read_database
from protocols.dbc.options import Commanded, Fed, Feedback, Options
from protocols.dbc.table import Number, declared
from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Mode
from protocols.messages import Feedback as Measured
from protocols.plugin import Device

NAME, TEXT = example().file.split("\n", 1)

# Every way in which a signal can lie: both orders, signs, binary32 and 64, 1 to 64 bits, a multiplexer.
ODD = """VERSION ""
BU_: A B
BO_ 2566849023 Odd: 8 A
 SG_ KIND M : 0|2@1+ (1,0) [0|3] "" B
 SG_ LITTLE m0 : 3|13@1- (0.5,-7) [0|0] "" B
 SG_ BIG m0 : 22|11@0- (1,0) [0|0] "" B
 SG_ LONG m1 : 8|56@1+ (1,0) [0|0] "" B
 SG_ CROSSED m0 : 37|19@0+ (2,1) [0|0] "" B
BO_ 5 Floats: 8 A
 SG_ SINGLE : 0|32@1- (1,0) [0|0] "" B
 SG_ BACK : 39|32@0- (1,0) [0|0] "" B
BO_ 6 Double: 8 A
 SG_ DOUBLE : 7|64@0- (1,0) [0|0] "" B
BO_ 7 Whole: 8 A
 SG_ ALL : 7|64@0- (1,0) [0|0] "" B
SIG_VALTYPE_ 5 SINGLE : 1;
SIG_VALTYPE_ 5 BACK : 1;
SIG_VALTYPE_ 6 DOUBLE : 2;
"""
THEIRS: dict[str, Any] = {
    name: one for text in (ODD, TEXT) for one in read_database("a.dbc", text).messages for name in [one.name]
}
OURS: dict[str, Message] = {**messages_of("odd.dbc", ODD), **messages_of(NAME, TEXT)}


@pytest.mark.parametrize("name", sorted(OURS))
@given(data=st.binary(min_size=8, max_size=8))
@settings(max_examples=30, deadline=None)
def test_bits_are_decoded_and_encoded_as_cantools_does(name: str, data: bytes) -> None:
    ours, theirs = OURS[name], THEIRS[name]
    data = data[: ours.length]
    try:
        wanted = theirs.decode(data, scaling=False, decode_choices=False)
    except cantools.database.DecodeError:  # a multiplexer without such a case: it says nothing of the others
        return
    raws = ours.decode(CanFrame(ours.id, data, ours.extended))
    assert raws is not None
    assert (ours.id, ours.extended) == (theirs.frame_id, theirs.is_extended_frame)
    assert raws.keys() == wanted.keys()
    for key, raw in raws.items():
        if wanted[key] == wanted[key] and abs(wanted[key]) >= 2.0**-126:
            assert raw == wanted[key], key
    finite = {key: raw for key, raw in raws.items() if math.isfinite(raw)}
    if finite.keys() == raws.keys():
        assert ours.encode(raws).data == theirs.encode(raws, scaling=False, strict=False)


SUMS = [  # kind, id, extended, data without it, the byte it is in, its bits, its value: by whom
    ("crc8_j1850", 0, "123456789abcde", 7, 8, 0xB1),  # crccheck 1.3.1
    ("crc8_j1850", 0, "5a0000000000", 6, 8, 0x34),
    ("crc8_autosar", 0, "123456789abcde", 7, 8, 0x30),
    ("crc8_autosar", 0, "5a0000000000", 6, 8, 0x27),
    ("comma", 592, "0064ff9c01", 5, 8, 0x18),  # opendbc 0.3.1 for all that follow
    ("comma", 592, "fc1803e702", 5, 8, 0xE0),
    ("toyota", 0x343, "fb500000000000", 7, 8, 0x99),
    ("toyota", 0x2E4, "03febf00", 4, 8, 0xAB),
    ("honda", 0xE4, "fb2e800010", 4, 4, 0x3),
    ("honda", 0x1FA, "4b00000000000010", 7, 4, 0xE),
    ("xor", 0, "12345678", 4, 8, 0x12 ^ 0x34 ^ 0x56 ^ 0x78),
    ("sum", 0, "ffff02", 3, 8, 0x00),
]


@pytest.mark.parametrize(("kind", "number", "data", "at", "bits", "value"), SUMS)
def test_checksums_are_those_of_others(
    kind: str, number: int, data: str, at: int, bits: int, value: int
) -> None:
    whole = bytes.fromhex(data)
    whole = whole if bits < 8 else whole[:at] + b"\0" + whole[at:]
    assert CHECKSUMS[kind](number, False, whole, at) & (1 << bits) - 1 == value


# -- mistakes -------------------------------------------------------------------------------------------

SPEED_ALONE = Feedback(velocity=Fed("Motor{}_Motion.SPEED"), voltage=Fed("Motor{}_Status.VOLTAGE"))
WRONG: list[tuple[dict[str, Any], tuple[str, str]]] = [
    ({"file": ""}, ("options.file", "missing; expected the file with its messages")),
    ({"file": "motor.dbc"}, ("options.file", "there is no text of 'motor.dbc'")),
    ({"file": "motor.dbc\nBO_ nonsense"}, ("options.file", "not read as a DBC, KCD, SYM or ARXML file")),
    ({"file": 'motor.dbc\nVERSION ""\n'}, ("options.file", "there is no CAN message in it")),
    ({"idle": ()}, ("options.idle", "missing; expected the safe command")),
    ({"idle": ("Motor{}_Command.ENABLE = 1",)}, ("options.idle", "it leaves enabled")),
    ({"idle": ("Motor{}_Comand.ENABLE = 0",)}, ("options.idle", "did you mean 'Motor1_Command'?")),
    ({"enable": ("Motor{}_Command.ENABEL = 1",)}, ("options.enable", "did you mean 'ENABLE'?")),
    (
        {"enable": ("Motor{}_Command.ENABLE = 2",)},
        ("options.enable", "does not fit into ENABLE: it has 0 to 1"),
    ),
    (
        {"enable": ("Motor{}_Command.ENABLE = 0.6",)},
        ("options.enable", "0.6 is no value of ENABLE, which has whole steps"),
    ),
    ({"enable": ("Motor{}_Command.MODE = velocty",)}, ("options.enable", "did you mean 'velocity'?")),
    ({"enable": ("ENABLE",)}, ("options.enable", "there is no message 'ENABLE'")),
    ({"enable": ("Motor{}_Command",)}, ("options.enable", 'expected "MESSAGE.SIGNAL = VALUE"')),
    *(
        ({"enable": (f"Motor{{}}_Command.ENABLE = {value}",)}, ("options.enable", "expected a number"))
        for value in ("nan", "inf", "0x" + "f" * 400)
    ),
    ({"enable": ("Motor{}_Command.SPEED = 5",)}, ("options.enable", "is what commands the velocity")),
    (
        {"torque": Commanded("Motor{}_Command.TORQUE", beside=("Motor{}_Command.TORQUE = 5",))},
        ("options.torque.beside", "is what commands the torque"),
    ),
    ({"counters": ("Motor{}_Command.SPEED",)}, ("options.counters", "is named by velocity, too")),
    ({"counters": ("Motor{}_Motion.ANGLE",)}, ("options.counters", "is no integer")),
    ({"counters": ("Motor{}_Status.STATE",)}, ("options.counters", "is named by feedback.state, too")),
    (
        {"counters": ("Motor{}_Status.COUNTER", "Motor{}_Status.TEMPERATURE"), "feedback": SPEED_ALONE},
        ("options.counters", "Motor1_Status has two: COUNTER, TEMPERATURE"),
    ),
    ({"checksums": ("Motor{}_Command.MODE = sum",)}, ("options.checksums", "is named by idle, too")),
    ({"checksums": ("Motor{}_Command.COUNTER = sum",)}, ("options.checksums", "is named by counters, too")),
    ({"counters": ("Motor{}_Command",)}, ("options.counters", 'expected "MESSAGE.SIGNAL"')),
    ({"counters": ("Motor3_Command.COUNTER",)}, ("options.counters", "neither sent nor fed back")),
    ({"checksums": ("Motor{}_Command.CHECKSUM = crc9",)}, ("options.checksums", "expected one of sum, xor")),
    ({"periods": ("Motor{}_Command = 0",)}, ("options.periods", 'expected "MESSAGE = 1 to 60000" ms')),
    (
        {"velocity": Commanded("Motor{}_Command.SPEED", "deg")},
        ("options.velocity.unit", "no unit of a velocity"),
    ),
    ({"velocity": None, "position": None, "torque": None}, ("options.velocity", "which signal commands it")),
    (
        {"velocity": Commanded("Motor{}_Command.SPEED", "rpm")},
        ("options.position", "must differ in a signal"),
    ),
    ({"feedback": Feedback()}, ("options.feedback", "expected a signal of the velocity, or of the position")),
    (
        {"feedback": Feedback(velocity=Fed("Motor{}_Motion.SPEED"))},
        ("options.position", "only where it is fed back"),
    ),
    (
        {"feedback": Feedback(velocity=Fed("Motor{}_Command.SPEED"))},
        ("options.feedback", "what is sent is no feedback"),
    ),
]


@pytest.mark.parametrize(("change", "wrong"), WRONG)
def test_a_mistake_is_told_in_words_at_its_key(change: dict[str, Any], wrong: tuple[str, str]) -> None:
    with pytest.raises(Invalid) as found:
        declared(replace(example(), **change), 1)
    assert any(key == wrong[0] and wrong[1] in text for key, text in found.value.wrong), found.value.wrong


def test_all_mistakes_are_told_at_once() -> None:
    several = {key: value for change, _ in WRONG[5:11] for key, value in change.items()}
    with pytest.raises(Invalid) as found:
        declared(replace(example(), **several, periods=("X = 1",), velocity=Commanded("A.B", "A")), 1)
    assert {key for key, _ in found.value.wrong} >= {
        "options.enable", "options.periods", "options.velocity.signal", "options.velocity.unit",
    }  # fmt: skip


def test_a_magnitude_of_nothing_is_measured_and_what_lies_at_another_end_is_not() -> None:
    signal = Signal("SPEED", 0, 8, False, False, False, 0.5, 0.0, "rad/s", None, None, (), 0, None)
    magnitude, both = (Number("M", one, 0.5, 0.0) for one in (signal, replace(signal, signed=True)))
    assert [magnitude.measured(raw) for raw in (0, 1, 254, 255)] == [0.0, 0.5, 127.0, None]
    assert [both.measured(raw) for raw in (-128, -127, 0, 127)] == [None, -63.5, 0.0, None]
    assert (magnitude.range(inside=1).low, both.range(inside=1).low) == (0.0, -63.5)


def test_without_cantools_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cantools", None)
    with pytest.raises(ValueError, match=r"pip install 'motor-gateway\[dbc\]'"):
        read_database("a.dbc", ODD)


# -- conversations --------------------------------------------------------------------------------------


def two_wheels(**changes: Any) -> tuple[Device, Device]:
    """Both wheels of a base in one message, without an enable and a state: as of a hoverboard."""
    text = (
        'VERSION ""\nBU_: A\nBO_ 592 CMD: 6 A\n'
        ' SG_ L : 7|16@0- (1,0) [-1000|1000] "" A\n SG_ R : 23|16@0- (1,0) [-1000|1000] "" A\n'
        ' SG_ COUNTER : 35|4@0+ (1,0) [0|15] "" A\n SG_ CHECKSUM : 47|8@0+ (1,0) [0|255] "" A\n'
        'BO_ 513 DATA: 5 A\n SG_ L : 7|16@0- (1,0) [0|0] "" A\n SG_ R : 23|16@0- (1,0) [0|0] "" A\n'
        ' SG_ COUNTER : 35|4@0+ (1,0) [0|15] "" A\n'
    )
    return tuple(
        Device(
            name,
            address,
            Options(
                f"wheels.dbc\n{text}",
                torque=Commanded(f"CMD.{name[0]}", scale=0.01),
                idle=(f"CMD.{name[0]} = 0",),
                counters=("CMD.COUNTER", "DATA.COUNTER"),
                checksums=("CMD.CHECKSUM = comma",),
                feedback=Feedback(velocity=Fed(f"DATA.{name[0]}", "rpm")),
                **{"timeout_ms": 200.0, **changes},
            ),
            plugin.settings(),
        )
        for address, name in ((1, "Left"), (2, "Right"))
    )  # type: ignore[return-value]


def test_two_motors_in_one_message_are_the_bytes_that_opendbc_makes() -> None:
    driver = plugin.driver(two_wheels())
    driver.receive(0, CanFrame(513, bytes.fromhex("0000000000")))
    sent: list[Frame] = []
    for at, (left, right) in enumerate([(0.0, 0.0), (1.0, -1.0), (-10.0, 9.99), (0.37, -5.12)]):
        now = at * SECOND // 100
        driver.receive(now, CanFrame(513, bytes([0, 0, 0, 0, at + 1])))
        sent += driver.send(now, [msg.Torque("Left", left), msg.Torque("Right", right)])[1]
    # opendbc 0.3.1, CANPacker("comma_body"), the first of them without a torque
    wanted = ("0000000000a9", "0064ff9c0118", "fc1803e702e0", "0025fe0003f5")
    assert [frame.data.hex() for frame in sent if isinstance(frame, CanFrame)] == list(wanted)


def test_a_motor_that_is_given_nothing_is_idle_in_the_message_of_the_other() -> None:
    devices = two_wheels()
    driver, decoder = plugin.driver(devices), plugin.decoder(devices)
    for at in range(8):
        driver.receive(at * SECOND // 100, CanFrame(513, bytes([0, 0, 0, 0, at + 1])))
        _, frames = driver.send(at * SECOND // 100, [msg.Torque("Left", 2.0), msg.Idle("Right")])
    obeyed = decoder.decode(0, frames[0])
    assert msg.Torque("Left", 2.0) in obeyed
    assert [one for one in obeyed if getattr(one, "motor", "") == "Right"] == [msg.Idle("Right")]


def test_a_signal_commands_one_motor() -> None:
    left, right = two_wheels()
    with pytest.raises(ValueError, match=r"CMD\.L commands both Left and Right"):
        plugin.driver([left, replace(right, options=left.options)])


def test_the_stop_of_one_motor_commands_no_other_by_initial_values() -> None:
    """What a motor's own stop says of the others in its message are the file's initial values."""
    devices = two_wheels()
    starts = (
        'BA_DEF_ SG_ "GenSigStartValue" INT 0 100000;\nBA_DEF_DEF_ "GenSigStartValue" 0;\n'
        'BA_ "GenSigStartValue" SG_ 592 R 500;\n'
    )
    moving = [
        replace(each, options=replace(each.options, file=each.options.file + starts)) for each in devices
    ]
    assert plugin.driver(devices)
    with pytest.raises(ValueError, match="the stop of Left would command Right"):
        plugin.driver(moving)


def bench(**changes: Any) -> Bench:
    return make_bench(plugin, replace(example(), **changes), (1, 2), ("one", "two"))


def turning(made: Bench, command: msg.Command, steps: int = 400) -> float:
    """The velocity of the first shaft after a while."""
    made.steps(steps, [command, msg.Idle("two")])
    return made.shafts["one"].velocity


def test_command_shaft_feedback() -> None:
    made = bench()
    assert turning(made, msg.Velocity("one", 12.0)) == pytest.approx(12.0, abs=0.2)
    reported = [e for s in made.steps(20, [msg.Velocity("one", 12.0)]) for e in s.events]
    speeds = [e.velocity for e in reported if isinstance(e, Measured) and e.motor == "one" and e.velocity]
    assert speeds[-1] == pytest.approx(12.0, abs=0.2)
    assert made.modes == {"one": Mode.ARMED, "two": Mode.READY}
    made.steps(300, [msg.Position("one", made.shafts["one"].position)])
    made.steps(1500, [msg.Position("one", 3.0)])
    assert made.shafts["one"].position == pytest.approx(3.0, abs=0.05)


def test_another_command_changes_what_goes_beside_it() -> None:
    made = bench()
    turning(made, msg.Velocity("one", 1.0))
    step = made.steps(25, [msg.Torque("one", 0.5)])
    received = [one for each in step for one in each.received]
    assert msg.Torque("one", pytest.approx(0.5, abs=0.01)) in received  # type: ignore[arg-type]
    assert not [one for one in received if isinstance(one, msg.Idle)]


APART = """VERSION ""
BU_: A
BO_ 16 MODE: 1 A
 SG_ KIND : 0|8@1+ (1,0) [0|0] "" A
BO_ 17 SPEED: 2 A
 SG_ SPEED : 0|16@1- (0.01,0) [0|0] "" A
BO_ 18 TORQUE: 2 A
 SG_ TORQUE : 0|16@1- (0.01,0) [0|0] "" A
BO_ 19 STATUS: 2 A
 SG_ SPEED : 0|16@1- (0.01,0) [0|0] "" A
"""
MODES_APART = Options(
    f"apart.dbc\n{APART}",
    velocity=Commanded("SPEED.SPEED", beside=("MODE.KIND = 1",)),
    torque=Commanded("TORQUE.TORQUE", beside=("MODE.KIND = 2",)),
    idle=("MODE.KIND = 0", "SPEED.SPEED = 0", "TORQUE.TORQUE = 0"),
    feedback=Feedback(velocity=Fed("STATUS.SPEED")),
    timeout_ms=200.0,
)


@pytest.mark.parametrize("gap", [11, 20, 50])
def test_a_mode_in_a_message_of_its_own_changes_at_once_whatever_its_period(gap: int) -> None:
    made = make_bench(plugin, replace(MODES_APART, periods=("MODE = 1000",)), (1,), ("one",))
    made.steps(20)
    for command in (
        msg.Velocity("one", 1.0), msg.Idle("one"), msg.Velocity("one", 1.0), msg.Torque("one", 0.5),
        msg.Velocity("one", 2.0), msg.Idle("one"), msg.Torque("one", -0.5),
    ):  # fmt: skip
        obeyed = [one for step in made.steps(gap, [command]) for one in step.received]
        moved = [one for one in obeyed if isinstance(one, msg.COMMANDS)]
        still = (msg.Idle("one"), msg.Velocity("one", 0.0), msg.Torque("one", 0.0))
        assert all(one in still or type(one) is type(command) for one in moved), (command, moved)
        assert moved, command
        assert type(moved[-1]) is type(command), (command, moved)


def test_a_message_goes_out_once_per_period_and_what_lets_go_at_once() -> None:
    made = bench(period_ms=20.0)
    made.steps(200, [msg.Velocity("one", 1.0)])
    sent = [frame for step in made.steps(200, [msg.Velocity("one", 1.0)]) for frame in step.down]
    assert 9 <= len(sent) <= 14
    assert made.step([msg.Idle("one")]).down
    assert made.step([msg.Idle("one")]).down == ()


def test_a_counter_that_stands_still_is_no_feedback_any_more() -> None:
    (left, _), rest = two_wheels(), CanFrame(513, bytes([0, 0, 0, 0, 3]))
    driver = plugin.driver([left])
    assert driver.receive(0, rest)
    assert not driver.receive(SECOND // 100, rest)
    assert (driver.counters.accepted, driver.counters.malformed) == (1, 1)
    driver.send(SECOND // 100, [])
    assert any(getattr(one, "mode", None) is Mode.OFFLINE for one in driver.send(SECOND, [])[0])


def test_a_device_obeys_no_message_with_a_wrong_checksum_a_counter_twice_or_strange_bits() -> None:
    left, _ = two_wheels()
    decoder = plugin.decoder([left])
    frame = CanFrame(592, bytes.fromhex("0064ff9c0118"))
    assert decoder.decode(0, replace(frame, data=b"\0\x65" + frame.data[2:])) == []
    assert msg.Torque("Left", 1.0) in decoder.decode(0, frame)
    assert decoder.decode(0, frame) == []
    strange = CHECKSUMS["comma"](592, False, bytes.fromhex("0064ff9c8200"), 5)
    bits = decoder.decode(0, CanFrame(592, bytes.fromhex("0064ff9c82") + bytes([strange])))
    assert [type(one) for one in bits] == [msg.Kept]


def test_a_turn_is_counted_where_the_angle_begins_anew() -> None:
    usual = example().feedback
    made = bench(
        feedback=replace(usual, within_turn=True), position=None, timeout_ms=0.0, watchdog="acknowledged"
    )
    turning(made, msg.Velocity("one", 20.0), 1000)
    last = [
        e for s in made.steps(20, [msg.Velocity("one", 20.0)]) for e in s.events if isinstance(e, Measured)
    ]
    places = [e.position for e in last if e.motor == "one" and e.position is not None]
    assert places[-1] > 12.0
    assert math.remainder(places[-1] - made.shafts["one"].position, math.tau) == pytest.approx(0.0, abs=0.4)


def test_without_a_timeout_a_person_is_told() -> None:
    device = Device("one", 1, replace(example(), timeout_ms=0.0), plugin.settings())
    assert "its last command goes on" in plugin.spec(device).watchdog.note
    known = replace(device, options=replace(device.options, watchdog="acknowledged"))
    assert not plugin.spec(known).watchdog.note
