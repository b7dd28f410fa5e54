"""A motor with a brake, over outages; the limits of its loops; what else it keeps."""

from __future__ import annotations

import math
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Mode
from protocols.myactuator import plugin
from protocols.myactuator.options import Options, Settings
from protocols.myactuator.table import ANY
from protocols.plugin import Device
from tests.protocols.helpers import CanBench, bench_of

PUSH, REST = msg.Torque("left", 1.0), msg.Idle("left")


def bench(settings: Settings | None = None, **options: Any) -> CanBench[Any, Any]:
    return bench_of(plugin, Device("left", 1, Options(**options), settings or Settings()))


def tell(rig: CanBench[Any, Any], name: str, **values: Any) -> None:
    """Send the motor a message, as another host would."""
    rig.twins[0].receive(rig.now, ANY.encode(name, 1, **values))
    rig.run(1)


# -- its brake -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("outage", [0, 60, 150, 250, 400])
@pytest.mark.parametrize("rest", [5, 20, 60])
def test_after_an_outage_and_a_short_idle_its_brake_is_opened(outage: int, rest: int) -> None:
    """A current alone does not open it."""
    rig = bench(brake=True)
    rig.shaft.locked = True
    rig.run(400, PUSH)
    assert rig.twins[0].torque == pytest.approx(1.0)
    rig.to_device = rig.from_device = lambda frame: False
    rig.run(outage)
    rig.to_device = rig.from_device = lambda frame: True
    rig.run(rest, REST)
    rig.run(1000, PUSH)
    assert (rig.twins[0].memory.released, rig.twins[0].mode) == (True, Mode.ARMED)
    assert rig.twins[0].torque == pytest.approx(1.0)


def test_a_brake_that_a_late_frame_locked_is_opened_again() -> None:
    rig = bench(brake=True)
    rig.shaft.locked = True
    rig.run(400, PUSH)
    tell(rig, "lock brake")
    assert rig.twins[0].mode is Mode.READY
    rig.run(200)
    assert rig.twins[0].torque == pytest.approx(1.0)


# -- its limits ------------------------------------------------------------------------------------------


def test_its_acceleration_holds_also_where_another_is_written() -> None:
    rig = bench(Settings(acceleration=100))
    rig.run(200)
    rig.run(1050, msg.Velocity("left", 20.0))
    assert rig.shaft.velocity == pytest.approx(math.radians(100.0), abs=0.3)
    tell(rig, "set acceleration", index=2, value=60_000)
    rig.run(1000)
    assert rig.shaft.velocity == pytest.approx(20.0, abs=0.2)


def test_a_position_is_reached_no_faster_than_it_may_be() -> None:
    """Also though the angle is read after each set-point."""
    rig = bench(max_velocity=2.0)
    rig.run(200)
    fastest = 0.0
    for _ in range(3000):
        rig.run(1, msg.Position("left", 4.0))
        fastest = max(fastest, rig.shaft.velocity)
    assert rig.shaft.position == pytest.approx(4.0, abs=0.02)
    assert fastest < 2.5


def test_its_gains_count() -> None:
    rig = bench()
    rig.shaft.locked = True
    rig.run(200)
    tell(rig, "set gains", **dict.fromkeys(("current_kp", "current_ki", "position_kp", "position_ki"), 9),
         speed_kp=17, speed_ki=0)  # fmt: skip
    rig.run(500, msg.Velocity("left", 10.0))
    assert rig.twins[0].torque == pytest.approx(0.3 * 17 / 85 * 10.0, abs=0.01)


# -- what it keeps ---------------------------------------------------------------------------------------


def test_a_zero_counts_from_its_next_start_on() -> None:
    rig = bench()
    rig.shaft.position = 2.0
    rig.run(100)
    tell(rig, "zero here", value=0)
    rig.run(100)
    assert rig.twins[0].encoder.position == pytest.approx(2.0)
    tell(rig, "reset")
    rig.run(500)
    assert rig.twins[0].encoder.position == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("to", [0x141, 0x300])
def test_its_id_is_told_and_changed(to: int) -> None:
    rig = bench()
    twin = rig.twins[0]
    twin.step(rig.now, [])

    def answer(text: str) -> list[str]:
        twin.receive(rig.now, CanFrame(to, bytes.fromhex(text)))
        return [f"{each.id:03X}#{each.data.hex()}" for each in twin.step(rig.now, [])[1]]

    assert answer("7900010000000000") == ["241#7900010000004102"]
    assert answer("7900000000000500") == ["245#7900000000000500"]
    twin.receive(rig.now, ANY.encode("read angle", 5))
    assert [each.id for each in twin.step(rig.now, [])[1]] == [0x245]


@pytest.mark.parametrize("name", ["set acceleration", "set gains", "store gains", "set zero", "zero here"])
def test_what_is_kept_is_never_asked_for_here(name: str) -> None:
    device = Device("left", 1, Options(), Settings())
    frame = ANY.encode(name, 1, **{field.name: 0 for field in ANY.row(name).fields if field.name})
    (kept,) = plugin.decoder([device]).decode(0, frame)
    assert isinstance(kept, msg.Kept)
    assert kept.name not in plugin.spec(device).set_up
