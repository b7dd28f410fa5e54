"""A motor below a gateway, in both modes: what moves, and what a person reads. Wheels. Ids that collide."""

from __future__ import annotations

import pytest

from gateway import config
from gateway.errors import ConfigError
from protocols.cubemars import plugin
from protocols.cubemars.options import Options
from protocols.cubemars.table import MIT, MODELS, SERVO, V3
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback, Mode, Position, Stop, Torque, Velocity
from protocols.plugin import Device
from protocols.toolkit.mit import NUMBERS
from tests.gateway.rig import BENCH, Rig
from tests.protocols.helpers import bench_of

CUBEMARS = BENCH.replace('"odrive_can"', '"cubemars"').replace("gear = 8.0", "gear = 1.0")
OPTIONS = '{ watchdog = "acknowledged" }'


def rig(options: str) -> Rig:
    return Rig(CUBEMARS.replace(OPTIONS, f'{{ watchdog = "acknowledged", {options} }}'))


def mode_of(bench: Rig) -> Mode:
    return bench.gateway.joints["left"].mode


@pytest.mark.parametrize("mode", ["servo", "mit", "mit_v3"])
def test_it_turns_and_goes_where_it_is_sent(mode: str) -> None:
    bench = rig(f'mode = "{mode}", damping = 5.0, sole_host = true')
    bench.run(0.3)
    bench.run(1.0, Velocity("left", 3.0))
    joint = bench.gateway.joints["left"]
    assert mode_of(bench) is Mode.ARMED
    assert bench.velocity("left") == pytest.approx(3.0, abs=0.2)
    assert joint.feedback.velocity == pytest.approx(3.0, abs=0.2)
    goal = (joint.feedback.position or 0.0) + 0.5
    bench.run(2.0, Position("left", goal))
    assert joint.feedback.position == pytest.approx(goal, abs=0.05)
    bench.run(0.5, Stop("a test"))
    assert mode_of(bench) is Mode.READY


def test_what_has_no_watchdog_is_said_until_it_is_acknowledged() -> None:
    spec = plugin.spec(Device("m", 1, Options(), plugin.settings()))
    assert "goes on with the last set-point" in spec.watchdog.note
    assert not plugin.spec(Device("m", 1, Options(watchdog="acknowledged"), plugin.settings())).watchdog.note


def test_a_wheel_turns_on_beyond_what_is_reported() -> None:
    """Servo mode, at 10 rad/s: reports end at 3200° (55.9 rad)."""
    device = Device("m", 1, Options(turns=True), plugin.settings())
    driver, twin = plugin.driver([device]), plugin.twin(device, 0)
    position = 0.0
    reported = list[float]()
    for ms in range(10_000):
        now, speed = ms * MILLISECOND, max(-10.0, 10.0 - 0.02 * max(ms - 8000, 0))
        position += speed * 1e-3
        for frame in twin.step(now, [Feedback("m", now, position, speed)])[1]:
            events = [e for e in driver.receive(now, frame) if isinstance(e, Feedback)]
            reported += [each.position for each in events if each.position is not None]
            assert events[0].position == pytest.approx(position, abs=0.05)
    assert max(reported) == pytest.approx(82.5, abs=0.2)


def test_messages_of_the_other_mode_do_nothing() -> None:
    five = V3.encode("SET_MIT", 1, **dict.fromkeys(NUMBERS, 1.0))
    others = (
        ("servo", MIT.encode("enter", 1)),
        ("mit", SERVO.encode("SET_RPM", 1, value=900)),
        ("servo", five),
    )
    for mode, frame in others:
        device = Device("m", 1, plugin.options(mode=mode), plugin.settings())
        twin = plugin.twin(device, 0)
        twin.step(0, [])
        twin.receive(1, frame)
        assert twin.step(MILLISECOND, [])[0] == [Torque("m", 0.0)]
        assert not plugin.decoder([device]).decode(0, frame)


@pytest.mark.parametrize(
    ("options", "starts"),
    [('mode = "servo"', True), ('mode = "mit", sole_host = true', True), ('mode = "mit"', False)],
)
def test_a_motor_that_can_never_start_is_a_caution_with_the_option_to_set(options: str, starts: bool) -> None:
    bench = rig(f"{options}, turns = true")
    found = [one for one in config.cautions(bench.robot) if "it cannot start" in one]
    assert [one.partition(":")[0] for one in found] == ([] if starts else ["left", "right"])
    assert all("sole_host = true" in one for one in found)
    bench.run(0.3)
    bench.run(0.3, Velocity("left", 1.0))
    assert (mode_of(bench) is Mode.ARMED) == starts


@pytest.mark.parametrize(
    ("mode", "temperature"), [("mit", -20), ("mit", 120), ("servo", -20), ("mit_v3", 120)]
)
def test_a_temperature_is_what_the_motor_measures(mode: str, temperature: int) -> None:
    """In MIT mode the byte is 40 more."""
    options = plugin.options(mode=mode, sole_host=True)
    device = Device("m", 1, options, plugin.settings(temperature=temperature))
    driver, twin = plugin.driver([device]), plugin.twin(device, 0)
    seen = []
    for ms in range(30):
        for frame in driver.send(ms * MILLISECOND, [])[1]:
            twin.receive(ms * MILLISECOND, frame)
        replies = twin.step(ms * MILLISECOND, [Feedback("m", 0, 0.1, 0.0)])[1]
        seen += [e for frame in replies for e in driver.receive(ms * MILLISECOND, frame)]
    assert {each.temperature for each in seen if isinstance(each, Feedback)} == {temperature}


def test_the_ramp_on_the_way_to_a_position_holds() -> None:
    device = Device("m", 1, Options(max_acceleration=4.0), plugin.settings())
    bench = bench_of(plugin, device)
    bench.run(100)
    bench.run(525, Position("m", 3.0))
    assert 1.5 < bench.shaft.velocity < 2.3
    bench.run(2500)
    assert bench.shaft.position == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize("size", [4, 8])
def test_set_points_may_be_padded(size: int) -> None:
    twin = plugin.twin(Device("m", 1, Options(), plugin.settings()), 0)
    twin.step(0, [])
    twin.receive(1, CanFrame(0x301, bytes.fromhex("00001388").ljust(size, b"\0"), extended=True))
    assert twin.step(MILLISECOND, [])[0][0].torque > 0.0


def test_a_model_that_is_not_known_in_a_mode_is_refused() -> None:
    for mode, model in (("mit_v3", "AK80-64"), ("mit", "AKE60-8")):
        with pytest.raises(ValueError, match=f"no {model} is known in mode {mode}: one of AK10-9"):
            plugin.options(mode=mode, model=model)
    assert Options(mode="mit_v3", model="AKE60-8").gains.ranges()["Torque.torque"].high == 15.0


def test_a_reply_with_the_motors_own_id_is_told_from_a_returned_command() -> None:
    """Address 1 at −12.4 rad: the first byte of the command is that of a reply of this motor."""
    device = Device("m", 1, Options(mode="mit"), plugin.settings())
    driver, twin = plugin.driver([device]), plugin.twin(device, 0)
    place = -12.5 + 25.0 * 0x0101 / 0xFFFF
    truth = [Feedback("m", 0, place, 0.0)]
    twin.step(0, truth)
    seen = []
    for ms in range(1, 10):
        frames = driver.send(ms * MILLISECOND, [Position("m", place)])[1]
        for frame in frames:
            twin.receive(ms * MILLISECOND, frame)
            assert not driver.receive(ms * MILLISECOND, frame)
        replies = twin.step(ms * MILLISECOND, truth)[1]
        seen += [e for frame in replies for e in driver.receive(ms * MILLISECOND, frame)]
    measured = [each.position for each in seen if isinstance(each, Feedback)]
    assert measured
    assert measured == pytest.approx([place] * len(measured), abs=1e-3)


@pytest.mark.parametrize(("stated", "answers"), [(-1, {0, 1}), (0, {0}), (1, {1}), (0x21, {0x21})])
def test_replies_count_on_0_and_on_the_motors_own_id_unless_one_is_stated(
    stated: int, answers: set[int]
) -> None:
    """The vendor's manual V1.0.17 (5.3) has "0x00 + Drive ID"; early firmware, like the mini-cheetah's, 0."""
    device = Device("m", 1, Options(mode="mit", sole_host=True, reply_id=stated), plugin.settings())
    reply = bytes.fromhex("01851e8008004600")
    heard = {
        number
        for number in (0, 1, 2, 0x21)
        if any(isinstance(e, Feedback) for e in plugin.driver([device]).receive(1, CanFrame(number, reply)))
    }
    assert heard == answers
    assert {mask[0] for mask in plugin.spec(device).expects} == answers
    twin = plugin.twin(device, 0)
    twin.step(0, [])
    twin.receive(1, MIT.encode("exit", 1))
    (answered,) = twin.step(MILLISECOND, [])[1]
    assert isinstance(answered, CanFrame)
    assert answered.id == (1 if stated < 0 else stated)


def test_ends_are_those_of_the_vendors_latest_manual() -> None:
    """AK Series Module Driver User Manual V1.0.17, 5.3; that of AK60-6 was changed in V1.0.6."""
    manual = {
        "AK10-9": (50.0, 65.0),
        "AK60-6": (45.0, 15.0),
        "AK70-10": (50.0, 25.0),
        "AK80-6": (76.0, 12.0),
        "AK80-9": (50.0, 18.0),
        "AK80-64": (8.0, 144.0),
        "AK80-8": (37.5, 32.0),
        "AK45-36": (6.0, 34.0),
        "AK45-10": (20.0, 8.0),
        "AK40-10": (45.5, 5.0),
    }
    assert {name: MODELS[name] for name in manual} == {name: (12.5, *ends) for name, ends in manual.items()}


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("address = 1\n", "'left' has address 1 on bus 'can0' too"),
        ('address = 1\nprotocol = "vesc"\n', "each would obey what the other is sent"),
        ("address = 0\n", "it must be 1 to 255"),
    ],
)
def test_ids_that_collide_are_refused_at_start(right: str, wrong: str) -> None:
    text = CUBEMARS.replace(f"options = {OPTIONS}\n", "").replace("address = 2\n", right)
    with pytest.raises(ConfigError, match=wrong):
        config.parse_robot(text)
