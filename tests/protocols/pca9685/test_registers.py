"""Values ↔ bytes: those of Adafruit's library, which also drive the twin; the registers by NXP's data
sheet."""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Mode
from protocols.pca9685 import plugin
from protocols.pca9685 import table as pt
from protocols.pca9685.memory import output_of
from protocols.pca9685.options import Options, Settings
from protocols.pca9685.twin import Pca9685Twin
from protocols.plugin import Device, join
from protocols.reference_vectors import vectors_of
from protocols.toolkit import i2c

VECTORS = {one.name: one.frame for one in vectors_of(plugin) if isinstance(one.frame, bytes)}
SERVO = Options(low_us=1000.0, high_us=2000.0, travel=1.6)


def written(name: str) -> bytes:
    found = i2c.parse(VECTORS[name])
    assert found is not None
    return found.written


def test_no_vector_is_left_out() -> None:
    assert set(VECTORS) == {
        *("sleep", "prescale_50_hz", "wake", "auto_increment", "read_output_0", "read_mode1"),
        *("duty_of_0x1333", "off_3", "full_3", "half_15"),
    }


def test_what_a_host_writes() -> None:
    assert written("duty_of_0x1333") == pt.led(0, 0, 0x133)
    assert written("off_3") == pt.led(3, 0, pt.FULL)
    assert written("full_3") == pt.led(3, pt.FULL, 0)
    assert written("half_15") == pt.led(15, 0, 0x800)
    assert written("prescale_50_hz") == bytes((pt.PRE_SCALE, pt.prescale(25e6, 50.0)))
    assert VECTORS["read_output_0"] == i2c.transfer(0x40, bytes((pt.LED0,)), 4)
    assert VECTORS["read_mode1"] == i2c.transfer(0x40, bytes((pt.MODE1,)), 1)
    assert [pt.read_only(VECTORS[name]) for name in ("read_output_0", "off_3", "wake")] == [
        True,
        False,
        False,
    ]


@pytest.mark.parametrize(("frequency", "scale"), [(50.0, 121), (200.0, 30), (24.0, 253), (1500.0, 3)])
def test_the_prescaler(frequency: float, scale: int) -> None:
    """200 Hz is the data sheet's example (7.3.5), 1526 and 24 Hz are its ends."""
    assert pt.prescale(25e6, frequency) == scale


def chip(*addresses: int, options: Options = SERVO) -> list[Pca9685Twin]:
    twins = [
        Pca9685Twin(Device(f"at {each}", each, options, Settings()), at) for at, each in enumerate(addresses)
    ]
    join(twins)
    for twin in twins:
        twin.step(0, ())
    return twins


def told(twins: list[Pca9685Twin], *frames: Frame) -> list[Frame]:
    answers: list[Frame] = []
    for at, frame in enumerate(frames):
        for twin in twins:
            twin.receive((at + 1) * MILLISECOND, frame)
            answers += twin.step((at + 1) * MILLISECOND, ())[1]
    return answers


def test_adafruits_library_drives_the_twin() -> None:
    """Its calls for 50 Hz, and for outputs of 0, 3 and 15: each is acknowledged once."""
    first, third, last = twins = chip(0, 3, 15)
    names = ["sleep", "prescale_50_hz", "wake", "auto_increment", "duty_of_0x1333", "off_3", "half_15"]
    frames = [VECTORS[name] for name in names]
    assert told(twins, *frames) == [i2c.outcome(each, i2c.DONE) for each in frames]
    assert [twin.mode for twin in twins] == [Mode.ARMED, Mode.READY, Mode.ARMED]
    assert first.output.high() * SERVO.count_us == pytest.approx(1498.2, abs=0.1)  # 0x133 of 50.03 Hz
    assert isinstance(first.goal, msg.Position)
    assert abs(first.goal.position) < 0.005
    assert third.output.high() == 0
    assert last.output.high() == 0x800
    read = told(twins, VECTORS["read_output_0"])
    assert read == [i2c.outcome(VECTORS["read_output_0"], i2c.DONE, bytes((0, 0, 0x33, 0x01)))]


def test_the_data_sheet() -> None:
    """Registers after power-on (7.3.1 to 7.3.5), no auto-increment then, the prescaler while awake, both
    "full" bits (7.3.3), ALL_LED (7.3.4), and the software reset (7.6)."""
    (twin,) = twins = chip(2)
    out = twin.output
    assert (out.get(pt.MODE1), out.get(pt.MODE2), out.get(pt.PRE_SCALE)) == (0x11, 0x04, 0x1E)
    assert out.pair() == (0, pt.FULL)
    told(twins, i2c.transfer(0x40, pt.led(2, 0, 300)))
    assert out.pair() == (0x01, pt.FULL)  # all bytes to one register
    told(twins, i2c.transfer(0x40, bytes((pt.MODE1, 0x20))), i2c.transfer(0x40, bytes((pt.PRE_SCALE, 121))))
    assert out.get(pt.PRE_SCALE) == 0x1E
    told(twins, i2c.transfer(0x40, bytes((pt.MODE1, 0x30))), i2c.transfer(0x40, bytes((pt.PRE_SCALE, 1))))
    assert out.get(pt.PRE_SCALE) == 3
    told(twins, i2c.transfer(0x40, bytes((pt.MODE1, 0x20))), i2c.transfer(0x40, pt.led(2, pt.FULL, pt.FULL)))
    assert out.high() == 0
    told(twins, i2c.transfer(0x40, bytes((pt.ALL_LED,)) + pt.led(0, 0, 307)[1:]))
    assert (out.high(), twin.mode) == (307, Mode.ARMED)
    told(twins, i2c.transfer(i2c.GENERAL_CALL, bytes((0x06,))))
    assert (out.get(pt.MODE1), out.high(), twin.mode) == (0x11, 0, Mode.READY)


def test_two_chips_on_a_bus_and_one_that_is_not_there() -> None:
    twins = chip(0, 6500)
    there, absent = (i2c.transfer(address, bytes((0x00, 0x20))) for address in (0x41, 0x42))
    assert told(twins, there, absent) == [i2c.outcome(there, i2c.DONE)]
    assert [twin.output.awake for twin in twins] == [False, True]


def test_what_is_no_transfer_does_nothing() -> None:
    output = output_of(Device("servo", 0, SERVO, Settings()))
    before = dict(output.registers)
    for frame in (b"", b"\x40", b"\x40\x00", b"\xff\x00\x00", i2c.transfer(0x00, b"\x07")):
        assert not output.obey(frame)
    assert output.registers == before
