"""Kinds of sensors: ours, and a stranger's, a range finder that comes in a distribution of its own."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgpack
import pytest

from brain.health import Health, HealthLevel, HealthSettings
from gateway import config
from gateway.core.message_text import message_text
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Tick
from gateway.errors import RecordingError
from gateway.monitor.render import measurement_text
from gateway.recording import Recorder, read_recording
from gateway.recording.ros_views import Views, topics, typestore
from gateway.replay import replay_recording
from protocols import entry_points, message_codec, sensors
from protocols.conformance import CLAUSES, check
from protocols.frames import Packet
from protocols.message_codec import kind_in, pack, unpack
from protocols.messages import MILLISECOND, SECOND, Measurement, Nanos
from protocols.plain import plugin as plain
from protocols.plain import table
from protocols.sensors.kind import SensorKind, shaped
from tests.distributions import Site

PAGE = (Path(__file__).parents[3] / "docs" / "adding-a-sensor.md").read_text("utf-8")
SOURCE = PAGE.partition("```python\n")[2].partition("```")[0]
CACHES = (entry_points._search, sensors.kinds, message_codec._others, table._limited, typestore)
ROBOT = (
    (files("gateway.fixtures") / "robots" / "diffbot.toml").read_text("utf-8")
    + """
[sensors.ranger]
protocol = "plain"
bus = "sensors"
address = 3
mount = { x = 0.2 }
timeout_ms = 100
"""
)
WORDS = "measurements_arrive", "only_finite_numbers", "only_normal_numbers"


def forget() -> None:
    for cached in CACHES:
        cached.cache_clear()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    forget()
    yield Site(tmp_path / "site", monkeypatch)
    monkeypatch.undo()
    forget()


def installed(site: Site, source: str = SOURCE) -> SensorKind:
    site.install("acme-range", "acme_range = acme_range:KIND", source, group="motor_gateway.sensors")
    assert not sensors.kinds().broken
    (kind,) = sensors.kinds().strangers
    return kind


def test_a_distribution_that_cannot_be_read_hides_no_other_and_is_named(site: Site) -> None:
    site.install("acme-brakes", "brakes = acme_brakes:KIND", group="motor_gateway.sensors")
    next(site.path.glob("acme_brakes*/entry_points.txt")).write_bytes(b"\xff\xfe")
    installed(site)
    (text,) = sensors.kinds().left_out
    assert text.startswith("of acme-brakes no kind of sensor is used: its entry points cannot be read: ")


def reading(kind: SensorKind, t: Nanos, distance: float, sensor: str = "ranger") -> Measurement:
    return replace(kind.sample(sensor, t, 1), distance=distance)  # type: ignore[call-arg]  # its own field


# -- ours --------------------------------------------------------------------------------------------------


def test_ours_are_as_sound_as_a_strangers_must_be() -> None:
    for kind in sensors.OURS:
        assert not sensors.kind.mistake(replace(kind, code=None), kind.name)
    assert len({kind.code for kind in sensors.OURS}) == len(sensors.OURS)


@pytest.mark.parametrize("kind", sensors.OURS, ids=lambda kind: str(kind.name))
def test_a_sample_leaves_nothing_out_and_is_within_its_limits(kind: SensorKind) -> None:
    sample = kind.sample("s", 5, 3)
    assert unpack(pack(sample)) == sample
    frame = table.encode(1, sample, 5)
    assert table.decode(frame[:-4], 5, "s") == sample
    assert sample != kind.sample("s", 5, 4)
    for name, quantity in kind.quantities.items():
        value = getattr(sample, name)
        assert value is not None
        numbers = value if isinstance(value, tuple) else (value,)
        assert all(quantity.low <= number <= quantity.high for number in numbers)


def test_a_reading_of_given_numbers_leaves_out_what_is_not_given() -> None:
    fix = next(kind for kind in sensors.OURS if kind.name == "fix")
    made: Any = shaped(fix, "gps", 7, {"latitude": 12.5})
    assert (made.sensor, made.t, made.latitude) == ("gps", 7, 12.5)
    assert made.altitude is made.variance is None


# -- a stranger's ------------------------------------------------------------------------------------------


def test_a_strangers_reading_is_packed_by_its_kinds_name(site: Site) -> None:
    kind = installed(site)
    made = kind.sample("ranger", 7, 2)
    packed = msgpack.packb(["acme_range", "ranger", 7, 3.0, [-0.1, 0.1], 2])
    assert pack(made) == packed
    assert unpack(packed) == made
    assert kind_in(packed) == "acme_range"
    assert unpack(msgpack.packb(["acme_ringe", "ranger", 7, 3.0, None, 2])) is None
    for bad in (math.nan, math.inf, "1", None):
        with pytest.raises(ValueError, match="RangeReading"):
            pack(reading(kind, 7, bad))  # type: ignore[arg-type]  # what a careless caller may do


def test_a_plain_device_sends_it_and_keeps_the_contract(site: Site) -> None:
    installed(site)
    options = [plain.options(kind="sensor")]
    results = check(plain, options=options, clauses=[c for c in CLAUSES if c.check.__name__ in WORDS])
    assert [result.outcome for result in results] == ["passed"] * len(WORDS)
    spec = plain.spec(replace_device(plain))
    assert spec.ranges["RangeReading.distance"].high == 50.0


def replace_device(plugin: Any) -> Any:
    from protocols.plugin import Device

    return Device("ranger", 3, plugin.options(kind="sensor"), plugin.settings())


def test_it_is_shown_with_its_units(site: Site) -> None:
    made = reading(installed(site), 7, 2.5)
    assert measurement_text(made) == "distance 2.5 m, cone -0.1, 0.1 rad"
    assert message_text(made) == "ranger: RangeReading distance 2.5 m, cone (-0.1, 0.1) rad, hits 1"


def test_health_waits_for_it_and_names_it(site: Site) -> None:
    kind = installed(site)
    health = Health([], ["ranger"], {"ranger": 100 * MILLISECOND}, HealthSettings())
    assert "a reading of ranger" in health.missing()
    health.observe([reading(kind, SECOND, 1.0)])
    assert health.missing() == ""
    assert health.assess(SECOND, {}).level is HealthLevel.OK
    late = health.assess(SECOND + 95 * MILLISECOND, {})
    assert (late.level, late.reason) == (HealthLevel.HALT, "ranger: no echo for more than 90 ms")


def ticked(gateway: Gateway, number: int, now: Nanos, data: bytes) -> Tick:
    """One step, to which these bytes have come."""
    inputs = Inputs(packets=(Packet(now, "sensors", data),))
    return Tick(number, now, inputs, gateway.step(now, inputs))


def run(path: Path, kind: SensorKind, count: int = 40) -> list[Measurement]:
    """Record a robot whose ranger sends readings; return those that it reported."""
    robot = config.parse_robot(ROBOT)
    mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
    gateway, recorder = Gateway(robot), Recorder(path, robot.text, {}, mounts)
    found: list[Measurement] = []
    for at in range(count):
        now = SECOND + at * robot.period
        data = table.encode(3, reading(kind, now, 1.0 + at / 10), now)
        tick = ticked(gateway, at, now, data)
        recorder.record(tick, gateway.belief())
        found += [event for event in tick.outputs.events if isinstance(event, Measurement)]
    recorder.close()
    return found


def test_it_is_recorded_and_replayed_with_its_version_and_ros_view(site: Site, tmp_path: Path) -> None:
    kind, path = installed(site), tmp_path / "a.mcap"
    found = run(path, kind)
    assert [event.distance for event in found] == [1.0 + at / 10 for at in range(40)]  # type: ignore[attr-defined]
    recording = read_recording(path)
    assert recording.facts["sensor acme_range"] == "acme-range 1.0"
    assert replay_recording(recording).ok
    shown = [view for step in recording.steps for view in step.views if view.topic == "/range"]
    assert len(shown) == 40
    message: Any = typestore().deserialize_cdr(shown[7].data, shown[7].type)
    assert (message.header.frame_id, message.range, message.max_range) == (
        "ranger",
        struct.unpack("f", struct.pack("f", 1.7))[0],
        50.0,
    )
    assert topics(typestore())["/range"] == "sensor_msgs/msg/Range"


def test_without_its_package_a_recording_names_what_is_missing(site: Site, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    run(path, installed(site), 3)
    next(site.path.glob("*.dist-info/entry_points.txt")).write_text("")
    forget()
    with pytest.raises(RecordingError) as raised:
        list(read_recording(path).ticks)
    text = (
        "it holds readings of the kind of sensor 'acme_range' of acme-range 1.0, which is not installed here"
    )
    assert str(raised.value) == f"{path}: {text}"


# What is changed in its source, and the reason for which it is left out.
BROKEN: list[tuple[str, str, str, str]] = [
    ("an error at import", "@value", "1 / 0\n@value", "ZeroDivisionError: division by zero"),
    ("the end of the program", "@value", "raise SystemExit(3)\n@value", "SystemExit: 3"),
    ("no kind", "KIND = SensorKind(", "KIND = dict(", "it is not a protocols.sensors.SensorKind"),
    ("another name", 'name="acme_range"', 'name="other"', "it calls itself 'other'"),
    ("a code of ours", 'name="acme_range"', 'name="acme_range", code=78', "only our own kinds have"),
    ("no value", "@value", "", "its message is not a class made by"),
    ("no unit", '"cone": Quantity("rad", -1.0, 1.0)', "", "RangeReading.cone has no unit"),
    ("a unit of nothing", '"cone"', '"corn": Quantity("m", 0.0, 1.0), "cone"', "has no corn"),
    ("a list", "hits: int = 0", "hits: list = 0", "RangeReading.hits is a <class 'list'>"),
    ("a duration in seconds", "hits: int", "duration: float = 0.0\n    hits: int", "duration"),
    ("checks", "hits: int = 0", "hits: int = 0\n    def __post_init__(self): 1 / 0", "has a __post_init__"),
    ("a sample that raises", "1.0 + count % 7", "1 / 0", "ZeroDivisionError"),
    ("another's sample", "RangeReading(sensor, t, 1.0", "SensorKind(sensor, t, 1.0", ""),
    ("the name of ours", "class RangeReading", "class Fix", "NameError"),
    ("a view that raises", "e.distance", "e.distanz", "AttributeError"),
]


@pytest.mark.parametrize(("old", "new", "reason"), [b[1:] for b in BROKEN], ids=[b[0] for b in BROKEN])
def test_a_broken_kind_is_named_and_left_out(site: Site, old: str, new: str, reason: str) -> None:
    assert old in SOURCE
    source = SOURCE.replace(old, new)
    site.install("acme-range", "acme_range = acme_range:KIND", source, group="motor_gateway.sensors")
    found = sensors.kinds()
    assert tuple(found.by_type.values()) == sensors.OURS
    assert reason in found.broken["acme_range"]
    (text,) = found.left_out
    assert text in config.cautions(config.parse_robot(ROBOT))
    assert unpack(msgpack.packb(["acme_range", "ranger", 7, 3.0, None, 2])) is None


# What is changed in its ROS view, and why the view is left out, of which the step knows nothing.
VIEWS: list[tuple[str, str, str, str]] = [
    ("the gateway's topic", '"/range"', '"/map"', "its topic '/map' is taken"),
    ("no topic", '"/range"', '"range 1"', "its topic 'range 1' is taken, or is none"),
    ("no such type", "sensor_msgs/msg/Range", "acme_msgs/msg/Rang", "KeyError"),
    ("other numbers", '"B5f"', '"B5d"', "SerdeError"),
    ("too few", "e.distance, 0.0)", "e.distance)", "error: pack expected"),
]


@pytest.mark.parametrize(("old", "new", "reason"), [b[1:] for b in VIEWS], ids=[b[0] for b in VIEWS])
def test_a_wrong_ros_view_is_left_out_in_words(site: Site, old: str, new: str, reason: str) -> None:
    kind = installed(site, SOURCE.replace(old, new))
    assert "/range" not in topics(typestore())
    assert reason in said(kind)


def said(kind: SensorKind) -> str:
    """Return what the log of a run says of a kind, in which each reading is reported; once."""
    views, gateway = Views(), Gateway(config.parse_robot(ROBOT))
    texts: list[str] = []
    for at in range(5):
        now = SECOND + at * 5 * MILLISECOND
        data = table.encode(3, reading(kind, now, 1.0 + at), now)
        tick = ticked(gateway, at, now, data)
        (event,) = (event for event in tick.outputs.events if isinstance(event, Measurement))
        assert type(event) is kind.message
        for view in views.messages(tick, gateway.belief()):
            if view.topic == "/rosout":
                texts += [str(views.deserialise(view))]
    found = [text for text in texts if "no ROS view" in text]
    assert len(found) == 1
    return found[0]


def test_a_view_that_fails_later_is_left_out_from_then_on(site: Site) -> None:
    kind = installed(site, SOURCE.replace("e.distance, 0.0", "1 / (e.distance - 3.0), 0.0"))
    assert "no ROS view from now on: ZeroDivisionError" in said(kind)


def test_a_text_that_fails_is_a_text(site: Site) -> None:
    source = SOURCE.replace("    ros=", "    text=lambda e: f'{1 / (e.distance - 3):.1f}',\n    ros=")
    kind = installed(site, source)
    assert measurement_text(reading(kind, 0, 5.0)) == "0.5"
    assert measurement_text(reading(kind, 0, 3.0)).startswith(
        "(the text of acme_range fails: ZeroDivisionError"
    )
