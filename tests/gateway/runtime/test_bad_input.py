"""What bad input bought sensors give, by their own bytes: each is told in words within its declared time, and
the base is safe. The table of docs/sensors.md; what servos and valves do is in their protocols' tests."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from gateway.buses.virtual.faults import received
from gateway.runtime.scenario import run_scenario
from gateway.runtime.scenario_file import parse_scenario
from gateway.runtime.session import open_session
from protocols.messages import SECOND

PAGE = (Path(__file__).parents[3] / "docs" / "sensors.md").read_text("utf-8")


@dataclass(frozen=True)
class Bad:
    """A row of the page."""

    cause: str
    on: str
    within: float
    """s from when it comes to when it is told"""
    text: str
    at: float = 2.5
    """s: in a drive that begins after one"""
    line: str = "goal 1.6 0.6"
    stands: bool = True


ROWS = {
    "lidar at another baud rate": Bad("another baud rate", "ld06", 0.4, "ld06: no scan for more than 250 ms"),
    "lidar upside down": Bad("lidar: upside down", "ld06", 2.5, "it is mirrored: upside down", 0.0),
    "lidar comes loose": Bad("lidar: turned by 180°", "ld06", 1.0, "ld06"),
    "lidar blocked": Bad("lidar: all zeros", "ld06", 0.7, "0 of 450 rays have returns"),
    "lidar in dust": Bad("lidar: dust", "ld06", 0.5, "beams end within the footprint"),
    "IMU saturates": Bad("IMU saturated at 0.2 rad/s", "imu", 1.0, "turned by", line="turn 180"),
    "IMU at another baud rate": Bad("another baud rate", "imu", 0.2, "imu: no reading", stands=False),
}
STANDS = """[must.stand.robot]
after = "it"
within = 3.0
"""


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ROWS)
def test_it_is_told_within_its_time_and_the_base_stands(name: str) -> None:
    """Without an IMU it drives on, slowly."""
    row = ROWS[name]
    text = f"""name = "{name}"
robot = "diffbot_sensors"
seconds = 5.6
asks.go = {{ at = 1.0, line = "{row.line}" }}
faults.it = {{ at = {row.at}, cause = "{row.cause}", on = "{row.on}" }}
must.tell.it = {{ after = "it", within = {row.within}, on = "{row.on}", text = "{row.text}" }}
{STANDS if row.stands else ""}
[never]
touches = 0
"""
    result = run_scenario(parse_scenario(text, Path("x.toml")))
    assert not [one for one in result.verdicts if not one.holds], result.verdicts


@pytest.mark.parametrize(
    ("robot", "sensor", "code", "name", "detail"),
    [
        ("diffbot_sensors", "ld06", 1, "speed out of range", "turns at 2.0 Hz"),
        ("diffbot_rplidar", "rplidar", 2, "protection stop", "health 2, error 0x8001"),
    ],
)
def test_what_a_sensor_says_of_itself_is_told_and_the_base_stands(
    robot: str, sensor: str, code: int, name: str, detail: str
) -> None:
    """Within the time that it must last, or in which it is asked, and a few steps."""
    told: dict[str, float] = {}
    reasons: set[str] = set()
    with open_session(robot, simulated=True) as session:
        for tick in session.run(seconds=5.0):
            if tick.number == 800:
                assert session.twins is not None
                session.twins.twin(sensor).provoke(code)
            for note in tick.outputs.notes:
                if note.source == sensor:
                    told.setdefault(note.text, tick.now / SECOND - 4.0)
            reasons.add(session.belief.reason)
    (fault,) = (text for text in told if text.startswith(f"{name}; likely cause: "))
    assert told[fault] < 0.8
    assert any(text.startswith("fault (") and detail in text for text in told), told
    assert any(f"{sensor} is in fault: " in reason and reason.endswith("standing") for reason in reasons)


def test_the_page_has_every_row() -> None:
    told = dict(re.findall(r"^\| ([^|]+) \| ([\d.]+) s \|", PAGE, re.M))
    assert {name: float(told.get(name, "nan")) for name in ROWS} == {
        name: row.within for name, row in ROWS.items()
    }


@pytest.mark.parametrize("ratio", [0.5, 2.0, 12.0])
def test_bytes_at_another_rate_are_others(ratio: float) -> None:
    sent = bytes(range(32, 96))
    got = received(sent, ratio)
    assert len(got) > len(sent) * min(ratio, 1.0) / 4
    assert sent[:8] not in got


def test_bytes_at_the_right_rate_are_the_same() -> None:
    assert received(bytes(range(256)), 1.0) == bytes(range(256))
