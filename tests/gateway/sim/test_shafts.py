"""Bare shafts: each against its formula, and the bench as a world without MuJoCo."""

from __future__ import annotations

import math
import sys

import pytest

from brain.belief import Pose
from gateway.sim import World, WorldError, parse_world
from gateway.sim.files import BenchFile, ShaftFile
from gateway.sim.shafts import Shaft, Shafts
from tests.gateway.world_helpers import robot


def turn(shaft: Shaft, torque: float, steps: int) -> Shaft:
    for _ in range(steps):
        shaft.step(torque)
    return shaft


def test_free_shaft_speeds_up_evenly() -> None:
    shaft = turn(Shaft(ShaftFile(inertia=0.01, damping=0.0, friction=0.0)), 0.5, 1000)
    assert shaft.velocity == pytest.approx(50.0)
    assert shaft.position == pytest.approx(25.0, rel=2e-3)


def test_damping_gives_an_end_speed() -> None:
    shaft = turn(Shaft(ShaftFile(inertia=0.01, damping=0.1, friction=0.0)), -0.5, 2000)
    assert shaft.velocity == pytest.approx(-5.0, rel=1e-3)


def test_dry_friction_holds_and_never_turns_round() -> None:
    held = turn(Shaft(ShaftFile(friction=0.1, damping=0.0)), 0.099, 1000)
    assert (held.position, held.velocity) == (0.0, 0.0)
    assert turn(held, 0.2, 200).velocity == pytest.approx((0.2 - 0.1) * 0.2 / 0.006)
    seen = []
    for _ in range(1000):
        held.step(0.0)
        seen.append(held.velocity)
    assert min(seen) == 0.0
    assert seen[-1] == 0.0


def test_a_weight_turns_the_shaft_back() -> None:
    loaded = Shaft(ShaftFile(load=-0.5, friction=0.02))
    assert turn(loaded, 0.5, 100).velocity == 0.0
    assert turn(loaded, 0.3, 100).velocity < -1.0


def test_hard_stops_take_the_motion_and_are_counted_once() -> None:
    shaft = turn(Shaft(ShaftFile(stops=(-1.0, 0.5))), 0.5, 1000)
    assert (shaft.position, shaft.velocity, shaft.touches) == (0.5, 0.0, 1)
    turn(shaft, -0.5, 1000)
    assert (shaft.position, shaft.velocity, shaft.touches) == (-1.0, 0.0, 2)


def test_the_bench_is_a_world_without_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    file = parse_world('kind = "bench"\nname = "b"\n[shafts.right]\nstops = [-0.1, 0.1]\n')
    bench = World(file, None, robot(sensors=False), 1)
    for _ in range(500):
        bench.step({"left": 0.3, "right": -0.3})
    assert bench.shaft("left")[0] > 1.0
    assert bench.shaft("right") == (-0.1, 0.0)
    assert bench.contacts() == 1
    assert bench.truth() == Pose(0.0, 0.0, 0.0)
    assert bench.readings() == ()
    assert bench.outlines() == []
    assert bench.now == 500_000_000
    with pytest.raises(ValueError, match="finite"):
        bench.step({"left": math.inf})


def test_a_bench_reports_what_it_lacks() -> None:
    file = parse_world('kind = "bench"\nname = "b"\n[shafts.middle]\n')
    with pytest.raises(WorldError) as caught:
        World(file, None, robot(), 1)
    assert len(caught.value.mistakes) == 3
    assert "no motor 'middle'" in str(caught.value)
    assert "no sensor 'lidar': there is none" in str(caught.value)


def test_a_shaft_with_a_given_motion_has_it_whatever_its_torque() -> None:
    shafts = Shafts(BenchFile(), ["left"])
    shafts.give("left", (2.0, 3.0))
    for _ in range(1000):
        shafts.step({"left": -1.0})
    assert shafts.shaft("left") == pytest.approx((5.0, 3.0), abs=0.01)
    shafts.give("left", None)
    shafts.step({"left": -1.0})
    assert shafts.shaft("left")[1] < 3.0
