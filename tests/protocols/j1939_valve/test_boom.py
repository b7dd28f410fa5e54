"""A boom on two valves: where it is sent, what holds it, and a spool that sticks."""

from __future__ import annotations

import pytest

from gateway.config import load_robot, parse_robot, resources
from gateway.config.validate import cautions
from protocols import messages as msg
from protocols.j1939_valve import table as jt
from protocols.j1939_valve.twin import ValveTwin
from protocols.messages import SECOND, Mode
from tests.gateway.rig import Rig

ROBOT = load_robot("boom")
TEXT = resources.find("robots", "boom").read_text("utf-8")


def moving() -> Rig:
    """The lift is extending."""
    rig = Rig(ROBOT)
    rig.run(0.5)
    rig.run(1.0, msg.Position("lift", 0.85))
    assert rig.gateway.joints["lift"].mode is Mode.ARMED
    assert rig.world.world.shaft("lift")[1] == pytest.approx(0.08, abs=0.02)
    return rig


def twin(rig: Rig, name: str) -> ValveTwin:
    found = rig.world.twin(name)
    assert isinstance(found, ValveTwin)
    return found


def found(rig: Rig, name: str) -> list[str]:
    return [fault.name for fault in rig.gateway.joints[name].faults.values()]


def test_it_goes_where_it_is_sent_and_closed_ports_hold_it() -> None:
    rig = moving()
    rig.run(4.0)
    assert rig.world.world.shaft("lift")[0] == pytest.approx(0.85, abs=0.003)
    rig.leave()
    assert twin(rig, "lift").mode is Mode.READY
    before = rig.world.world.shaft("lift")[0]
    for bus in rig.world.buses.values():
        bus.read(rig.clock.now() + 2 * SECOND)
    assert rig.world.world.shaft("lift")[0] == pytest.approx(before, abs=1e-3)
    assert not cautions(ROBOT)


def test_a_spool_that_sticks_closed_is_noticed_in_time_and_the_boom_stands() -> None:
    rig = Rig(ROBOT)
    rig.run(0.5)
    twin(rig, "lift").stick()
    ticks = rig.run(1.5, msg.Position("lift", 0.85))
    assert found(rig, "lift")[0].startswith("does not follow its set-points")
    told = [t.now for t in ticks for note in t.outputs.notes if note.level == "error"]
    sent = next(t.now for t in ticks for p in t.outputs.packets)
    assert (told[0] - sent) / SECOND < 1.0
    place = rig.world.world.shaft("lift")[0]
    rig.run(0.5, msg.Position("fold", 0.6))  # the whole robot stands
    assert rig.world.world.shaft("lift")[0] == pytest.approx(place, abs=1e-4)
    assert not any(joint.armed for joint in rig.gateway.joints.values())


def test_a_spool_that_sticks_open_is_told_and_everything_is_sent_to_close() -> None:
    """Nothing on this bus stops it: that is said, for who has a hand at the dump valve."""
    rig = moving()
    twin(rig, "lift").stick()
    rig.run(1.6, msg.Stop("a test"))
    assert rig.world.world.shaft("lift")[1] == pytest.approx(0.08, abs=0.02)
    first, second = found(rig, "lift")
    assert first.startswith("runs away")
    assert second == "still turns as fast as before it was let go: cut its supply"
    assert all(isinstance(joint.sent, msg.Idle) for joint in rig.gateway.joints.values())


def test_an_address_that_is_lost_stops_the_boom_by_the_valves_time_out() -> None:
    rig = moving()
    claim = jt.TABLE.encode("address claimed by another", ecu=39, name=1)
    rig.world.buses["can0"].from_devices.send(rig.clock.now(), "another", claim)
    rig.run(0.6)
    assert "our address is another's" in found(rig, "lift")
    assert abs(rig.world.world.shaft("lift")[1]) < 1e-3
    rig.run(0.1)
    late = [p.frame for t in rig.ticks[-10:] for p in t.outputs.packets]
    assert not late


def test_a_valve_that_is_silent_is_a_fault() -> None:
    rig = moving()
    rig.world.disconnect("lift")
    rig.run(0.7)
    assert found(rig, "lift")
    assert abs(rig.world.world.shaft("lift")[1]) < 1e-3  # its own time-out


def test_without_tight_ports_it_says_that_the_load_falls() -> None:
    files = "\n[files]\n\"boom.urdf\" = '''\n" + ROBOT.brain.body.urdf + "'''\n"  # type: ignore[attr-defined]
    text = (TEXT + files).replace("tight = true                  #", "tight = false                 #")
    assert any("it falls" in one for one in cautions(parse_robot(text)))
