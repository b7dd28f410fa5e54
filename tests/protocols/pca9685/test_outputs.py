"""Servos and motors on a PCA9685: which pulses they get, and what becomes of them without chip or bus."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from gateway.buses.virtual.medium import Transmission
from gateway.config import load_robot
from gateway.errors import ConfigError
from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.conformance.bench import ALPHA, NAMES, Bench, make_bench
from protocols.frames import BusState, Frame
from protocols.messages import Mode
from protocols.pca9685 import plugin
from protocols.pca9685 import table as pt
from protocols.pca9685.options import Options, Settings
from protocols.plugin import Device
from protocols.toolkit import i2c
from tests.distributions import ROOT
from tests.gateway.rig import Rig, notes_in

HEAD = (ROOT / "fixtures" / "robots" / "pan_tilt.toml").read_text("utf-8")
URDF = ROOT / "fixtures" / "robots" / "pan_tilt.urdf"


def bench(options: Options, addresses: tuple[int, ...] = (3, 7)) -> Bench:
    made = make_bench(plugin, options, addresses, NAMES[: len(addresses)])
    made.steps(80)
    return made


def pulses(frames: Iterable[Frame], options: Options) -> list[float]:
    """The pulses [µs] in these transfers; 0: none."""
    found: list[float] = []
    for each in map(i2c.parse, frames):
        if each is not None and len(each.written) == 5:
            on, off = (int.from_bytes(each.written[at : at + 2], "little") for at in (1, 3))
            found.append(0.0 if off & pt.FULL else (off - on) % pt.COUNTS * options.count_us)
    return found


ODD = (0.0, 0.3, -0.8, 0.8, 0.8000001, 3.0, -417.0, 1e30, math.inf, -math.inf, math.nan, 5e-324)


@pytest.mark.parametrize(
    ("low", "centre", "high", "frequency"),
    [(1100.0, 1500.0, 1900.0, 50.0), (900.25, 1000.0, 2100.5, 330.0), (1001.0, 1030.0, 1052.0, 50.0)],
)
def test_a_pulse_outside_the_servos_range_is_never_sent(
    low: float, centre: float, high: float, frequency: float
) -> None:
    options = Options(low_us=low, centre_us=centre, high_us=high, travel=1.6, frequency=frequency)
    made = bench(options)
    sent: list[Frame] = []
    for first, then in product(ODD, ODD):
        for command in (msg.Position(ALPHA, first), msg.Hold(ALPHA), msg.Position(ALPHA, then)):
            sent += [frame for step in made.steps(2, [command]) for frame in step.down]
    sent += [frame for step in made.steps(60, [msg.Idle(ALPHA)]) for frame in step.down]
    found = pulses(sent, options)
    assert len(found) > 150
    assert all(pulse == 0.0 or low <= pulse <= high for pulse in found), sorted(set(found))
    assert min(each for each in found if each) < centre + options.count_us
    assert 0.0 in found


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ({"frequency": 500.0}, "high_us must be less than a period, 2000 µs"),
        ({"oscillator": 1e6}, "oscillator must be from 20000000 to 50000000 Hz"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], wrong: str) -> None:
    with pytest.raises(Invalid, match=wrong):
        Options(**options)


@pytest.mark.parametrize(
    ("address", "options"), [(16, {}), (3900, {}), (12_800, {}), (15, {"kind": "pwm", "reversible": True})]
)
def test_an_address_that_is_no_output(address: int, options: dict[str, Any]) -> None:
    with pytest.raises(Invalid, match="an output, 0 to 15, of the chip at 0x40"):
        plugin.spec(Device("servo", address, Options(**options), Settings()))


def test_one_chip_has_one_frequency_and_an_output_one_device(tmp_path: Path) -> None:
    (tmp_path / "pan_tilt.urdf").write_text(URDF.read_text("utf-8"), "utf-8")
    file = tmp_path / "pan_tilt.toml"
    file.write_text(HEAD.replace("sign = 1\n", "sign = 1\noptions = { frequency = 60.0 }\n", 1), "utf-8")
    with pytest.raises(
        ConfigError, match="pan and tilt are on one chip, which has one frequency: found 60 and"
    ):
        load_robot(str(file))
    two = Options(kind="pwm", reversible=True)
    devices = [Device("left", 0, two, Settings()), Device("right", 1, two, Settings())]
    with pytest.raises(ValueError, match="left and right have output 1 both"):
        plugin.driver(devices)


def test_another_frequency_is_written_while_the_chip_sleeps_and_then_no_more() -> None:
    made = bench(Options(frequency=100.0))
    steps = made.steps(100, [msg.Position(ALPHA, 0.0)])
    written = [
        each.written for step in steps for frame in step.down if (each := i2c.parse(frame)) is not None
    ]
    set_up = [each for each in written if len(each) == 2]
    assert set_up == [bytes((pt.PRE_SCALE, pt.prescale(25e6, 100.0))), b"\x00\x20"]  # it was asleep
    assert made.modes[ALPHA] is Mode.ARMED
    more = [frame for step in made.steps(100, [msg.Position(NAMES[1], 0.0)]) for frame in step.down]
    assert not any(
        each and each.written[:1] == b"\xfe" and len(each.written) > 1 for each in map(i2c.parse, more)
    )


@pytest.mark.parametrize("velocity", [10.0, -5.0, 0.0, 20.0, -20.0])
def test_a_motor_by_two_outputs(velocity: float) -> None:
    options = Options(kind="pwm", reversible=True, frequency=1000.0)
    made = bench(options, (2,))
    made.steps(400, [msg.Velocity(ALPHA, velocity)])
    assert made.modes[ALPHA] is Mode.ARMED
    assert made.shafts[ALPHA].velocity == pytest.approx(velocity, rel=0.05, abs=0.05)
    assert min(made.twins[0].output.high(0), made.twins[0].output.high(1)) == 0  # type: ignore[attr-defined]
    made.steps(100, [msg.Idle(ALPHA)])
    assert made.modes[ALPHA] is Mode.READY


# -- the robot --------------------------------------------------------------------------------


def armed() -> Rig:
    rig = Rig(load_robot("pan_tilt"))
    rig.run(0.4)
    rig.run(0.6, msg.Position("pan", 0.4), msg.Position("tilt", 0.2))
    rig.run(1.0)
    assert {name: joint.mode for name, joint in rig.gateway.joints.items()} == {
        "pan": Mode.ARMED,
        "tilt": Mode.ARMED,
    }
    return rig


def test_a_pan_tilt_goes_where_it_is_sent() -> None:
    """From wherever it stood; the truth is as far off as its servos are."""
    rig = armed()
    assert rig.world.world.shaft("pan")[0] == pytest.approx(0.4 * 0.99 + 0.01, abs=0.01)
    assert rig.world.world.shaft("tilt")[0] == pytest.approx(0.2 * 1.02, abs=0.01)


def test_a_chip_that_is_switched_off_and_on_is_a_fault_and_nothing_starts_by_itself() -> None:
    rig = armed()
    rig.world.reset("pan")
    rig.world.reset("tilt")
    rig.run(0.6)
    faults = [fault.name for joint in rig.gateway.joints.values() for fault in joint.faults.values()]
    assert len(faults) == 2
    assert all(each.startswith("disarmed itself: ready (open loop: ") for each in faults), faults
    assert not any(joint.armed for joint in rig.gateway.joints.values())


def answered(result: int) -> Any:
    """What falsifies a bus: each transfer ends so."""

    def change(_: str, one: Transmission) -> Iterable[Transmission]:
        is_answer = bool(one.sender) and isinstance(one.frame, bytes)
        return (replace(one, frame=bytes((one.frame[0], result, one.frame[2]))),) if is_answer else (one,)  # type: ignore[index]

    return change


@pytest.mark.parametrize(
    ("result", "why"),
    [
        (i2c.NO_CHIP, "no message for 250 ms: no chip acknowledges 0x40: wiring, supply, its address pins"),
        (i2c.FAILED, "no message for 250 ms: the bus hangs: a chip or a short holds SDA or SCL down"),
        (None, "no message for 250 ms"),
    ],
)
def test_an_absent_chip_and_a_bus_that_hangs_are_named_within_the_declared_time(
    result: int | None, why: str
) -> None:
    rig = armed()
    if result is None:
        rig.world.disconnect("pan")
        rig.world.disconnect("tilt")
    else:
        rig.world.tamper.transmission = answered(result)
    ticks = rig.run(0.35)
    states = [one for tick in ticks for one in tick.outputs.events if isinstance(one, msg.State)]
    told = {one.motor: one for one in states if one.mode is Mode.OFFLINE}
    assert set(told) == {"pan", "tilt"}
    assert all(one.detail.startswith(why) for one in told.values()), told
    faults = [fault.name for joint in rig.gateway.joints.values() for fault in joint.faults.values()]
    assert faults == ["silent: no feedback for more than 250 ms"] * 2
    rig.world.tamper.transmission = None
    rig.world.reconnect("pan")
    rig.world.reconnect("tilt")
    place = [rig.world.world.shaft(name)[0] for name in ("pan", "tilt")]
    rig.run(0.5, msg.Position("pan", -0.4))
    assert all(isinstance(joint.sent, msg.Hold) for joint in rig.gateway.joints.values())
    assert [rig.world.world.shaft(name)[0] for name in ("pan", "tilt")] == pytest.approx(place, abs=0.01)


def test_the_interface_vanishes_and_is_back() -> None:
    rig = armed()
    rig.world.buses["i2c1"].lose(BusState.OFF)
    rig.run(0.4)
    assert all(joint.faults for joint in rig.gateway.joints.values())
    assert notes_in(rig.ticks, "i2c1")
