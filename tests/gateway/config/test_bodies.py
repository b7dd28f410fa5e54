"""Bodies are found, not listed: an unseen one, in a distribution of its own, drives by its robot file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

import gateway as gw
from gateway.config.bodies import GROUP, load_body, names
from tests.distributions import ROOT, Site

UNSEEN = '''
from dataclasses import dataclass
from typing import ClassVar

from brain.bodies.body import Base, Setpoint, Travel


@dataclass(frozen=True, slots=True, kw_only=True)
class Cart(Base):
    """Two wheels, the right one first."""

    kind: ClassVar[str] = "cart"
    pair: tuple[str, str]
    wheel: float
    gauge: float

    @classmethod
    def motor_keys(cls):
        return ("pair",)

    @property
    def joints(self):
        return self.pair

    @property
    def top_speeds(self):
        return (19.0, 19.0)

    @property
    def rolling(self):
        return (self.wheel, self.wheel)

    def inverse(self, twist, positions=()):
        turn = twist.angular * self.gauge / 2.0
        return tuple(Setpoint((twist.linear + side) / self.wheel) for side in (turn, -turn))

    def travel(self, before, after):
        right, left = (self.wheel * (b - a) for a, b in zip(before, after))
        half, lever = self.wheel / 2.0, self.wheel / self.gauge
        turn = (right - left) / self.gauge
        return Travel((left + right) / 2.0, turn, 0.0, (half, half), (lever, -lever), (0.0, 0.0))
'''

TABLE = """
[brain.cart]
pair = ["right", "left"]
wheel = 0.0512
gauge = 0.22
radius = 0.25
max_linear = 0.5
max_angular = 1.5
max_linear_acceleration = 0.8
max_angular_acceleration = 4.0

"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    return Site(tmp_path / "site", monkeypatch)


def robot_text() -> str:
    """The diffbot's file with another body."""
    text = (ROOT / "fixtures" / "robots" / "diffbot.toml").read_text()
    head, _, rest = text.partition('[brain]\nbody = "differential"')
    return f'{head}[brain]\nbody = "cart"\n{TABLE}[brain.perception]{rest.partition("[brain.perception]")[2]}'


def test_an_unseen_body_drives_by_robot_file_alone(site: Site, tmp_path: Path) -> None:
    site.install("my-cart", "cart = my_cart:Cart", UNSEEN, group=GROUP)
    assert "cart" in names()
    path = tmp_path / "cart.toml"
    path.write_text(robot_text())
    robot = gw.load_robot(path)
    assert robot.brain.body.kind == "cart"
    with gw.open_session(robot, simulated=True) as session:
        for i, _ in enumerate(session.run(seconds=1.5)):
            if i % 20 == 10 and i < 180:
                session.submit(gw.Drive(0.4, 0.4))
        assert session.twins is not None
        true, pose = session.twins.world.truth(), session.pose
    assert pose is not None
    assert math.hypot(true.x, true.y) > 0.2
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((true.x, true.y, true.yaw), abs=0.03)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("Cart = 3", "is not a brain.bodies.body.Body"),
        (UNSEEN.replace('"cart"', '"boat"'), "it calls itself 'boat'"),
        ("import nothing_such", "is broken: ModuleNotFoundError"),
        (UNSEEN.replace("def travel", "def walk"), "my_cart:Cart lacks travel"),
    ],
)
def test_a_broken_body_is_named(site: Site, source: str, message: str) -> None:
    site.install("my-cart", "cart = my_cart:Cart", source, group=GROUP)
    with pytest.raises(gw.UserError, match=message):
        load_body("cart")
