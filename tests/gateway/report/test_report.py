"""A report: the same of a run and of its recording, whole in itself, bounded, and deaf to what names say."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import gateway as gw
from brain.belief import MapView
from gateway.core.tick import Note, Outputs, Tick
from gateway.errors import UserError
from gateway.report import Collector, Facts, write
from gateway.report.page import page
from gateway.report.series import INTERVALS, Signals
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.view.chromium import chromium

FACTS = Facts("run", ok=True, result="it ended well", rows=(("date", "today"),), figures=("goal 1: reached",))
HOSTILE = (
    "</script><script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "<!--<script>",
    "]]>&lt;b&gt;\u2028\x1b[31m",
)


class Page(HTMLParser):
    """A page as a browser reads it: its elements with their attributes, and the texts within."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self._texts: list[str] = [""]
        """Of each element, what stands behind its beginning; first, what stands before all of them."""
        self._ended = 0
        """Number of texts when the last script ended: what follows is not of it."""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._texts.append("")

    def handle_data(self, data: str) -> None:
        if self._ended != len(self._texts):
            self._texts[-1] += data

    def handle_endtag(self, tag: str) -> None:
        if tag == "script":
            self._ended = len(self._texts)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def texts(self, tag: str) -> list[str]:
        return [text for (name, _), text in zip(self.elements, self._texts[1:], strict=True) if name == tag]

    @property
    def scripts(self) -> list[str]:
        return self.texts("script")

    @property
    def text(self) -> str:
        return "\n".join(
            text for tag in {tag for tag, _ in self.elements} - {"script"} for text in self.texts(tag)
        )


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Collector, Path]:
    """A short drive, collected while it ran, and its recording."""
    path = tmp_path_factory.mktemp("report") / "drive.mcap"
    with gw.open_session("diffbot", simulated=True, record=path, seed=3) as session:
        world = session.twins.world if session.twins is not None else None
        assert world is not None
        collector = Collector(session.gateway, world.truth)
        session.watch(collector.take)
        session.submit(gw.Goal(0.4, 0.1))
        for _ in session.run(seconds=4):
            pass
    return collector, path


def test_the_report_of_a_recording_is_that_of_the_run(drive: tuple[Collector, Path], tmp_path: Path) -> None:
    live, path = drive
    file = tmp_path / "drive.html"
    assert gw.write_report(path, file).ok
    kept = json.loads(Page(file.read_text()).scripts[0])
    ran = json.loads(Page(page(live, FACTS)).scripts[0])
    (base,) = (group for group in ran["groups"] if group["name"] == "base")
    (error,) = (plot for plot in base["plots"] if plot["title"] == "error of the pose")
    error["lines"] = [line for line in error["lines"] if line["name"] != "true"]  # which no recording knows
    assert kept == ran


def test_the_map_alone_is_a_file_of_its_own(drive: tuple[Collector, Path], tmp_path: Path) -> None:
    text = gw.draw_map(drive[1])
    root = ET.fromstring(text)
    found = {one.get("class") for one in root.iter() if one.tag.endswith("polyline")}
    assert {"planned", "driven", "raw"} <= found
    (robot,) = (one for one in root.iter() if one.get("id") == "robot")
    x, y = (float(one) for one in re.findall(r"-?\d\.\d+", str(robot.get("transform")))[:2])
    assert (x, -y) == pytest.approx((0.4, 0.1), abs=0.05)


def test_it_shows_the_drive(drive: tuple[Collector, Path]) -> None:
    live, _ = drive
    shown = Page(page(live, FACTS))
    data = json.loads(shown.scripts[0])
    assert [group["name"] for group in data["groups"]] == ["base", "joint left", "joint right", "bus"]
    left = {plot["title"]: plot for plot in data["groups"][1]["plots"]}
    assert [line["name"] for line in left["velocity"]["lines"]] == ["measured", "commanded"]
    commanded, measured = (
        max(value for value in line["values"] if value is not None) for line in left["velocity"]["lines"]
    )
    assert commanded == pytest.approx(measured, rel=0.2)
    assert all(len(line["values"]) == len(data["times"]) for line in left["velocity"]["lines"])
    assert data["poses"][-1][1:3] == pytest.approx([0.4, 0.1], abs=0.05)
    kinds = [attributes["class"] for attributes in shown.of("polyline")]
    assert {"planned", "driven", "true", "raw"} <= set(kinds)
    assert shown.of("image")[0]["href"].startswith("data:image/png;base64,")  # type: ignore[union-attr]
    for text in ("it ended well", "goal 1: reached", "path driven", "NIS", "0.40, 0.10 m", "brain"):
        assert text in shown.text


def test_tables_and_the_log_say_what_they_are(drive: tuple[Collector, Path]) -> None:
    shown = Page(page(drive[0], FACTS))
    assert {one.get("scope") for one in shown.of("th")} == {"row", "col"}
    (log,) = (one for one in shown.of("div") if one.get("class") == "wide log")
    assert log == {"class": "wide log", "role": "region", "aria-label": "log", "tabindex": "0"}
    assert "Ctrl and the wheel to zoom" in shown.text


def test_what_a_plot_is_zoomed_to_stays_when_it_gets_dark(
    drive: tuple[Collector, Path], tmp_path: Path
) -> None:
    file = tmp_path / "drive.html"
    write(file, drive[0], FACTS)
    with chromium(tmp_path / "profile") as browser:
        tab = browser.open(file.as_uri())
        tab.until("document.querySelector('.u-over')")
        x, y = tab.middle(".u-over")
        tab.select((x, y), (x + 60, y))
        tab.run("document.querySelector('.u-over').old = true")
        dark = {"name": "prefers-color-scheme", "value": "dark"}
        tab.call("Emulation.setEmulatedMedia", features=[dark])
        tab.until("!document.querySelector('.u-over').old")
        left = "(b => [b.left + 2, b.top + 20])(document.querySelector('.u-over').getBoundingClientRect())"
        tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=tab.run(left)[0], y=tab.run(left)[1])
        tab.until("parseFloat(document.querySelector('.u-value').textContent) > 1")


def test_it_is_whole_in_itself_and_lets_no_other_script_run(drive: tuple[Collector, Path]) -> None:
    shown = Page(page(drive[0], FACTS))
    for tag, attributes in shown.elements:
        assert not {"src", "srcset", "action", "data"} & attributes.keys()
        assert tag != "link"
        assert (attributes.get("href") or "data:").startswith("data:")
    styles = "".join(shown.texts("style"))
    assert "url(" not in styles
    assert "@import" not in styles
    (policy,) = (one["content"] for one in shown.of("meta") if "http-equiv" in one)
    assert policy is not None
    assert "default-src 'none'" in policy
    allowed = re.findall(r"'sha256-([^']+)'", policy)
    data, *code = shown.scripts
    assert [b64encode(sha256(one.encode()).digest()).decode() for one in code] == allowed
    assert shown.of("script") == [{"type": "application/json", "id": "data"}, {}, {}]
    assert not re.search("[<>&]", data)


def hostile(live: Collector, text: str) -> Collector:
    """A run of one tick, on a robot whose every text is this one."""
    (bus, settings), *_ = live.gateway.robot.buses.items()
    (_, motor), *_ = live.gateway.robot.motors.items()
    robot = replace(
        live.gateway.robot,
        name=text,
        buses={text: replace(settings, name=text)},
        motors={},
        sensors={},
    )
    collector = Collector(gw.Gateway(live.gateway.robot))
    collector.gateway.robot = robot
    collector.gateway.joints = {text: gw.Joint(text, motor.joint, motor.spec)}
    collector.received, collector.sent, collector.busy = {text: 0}, {text: 0}, {text: 0}
    collector.gateway.joints[text].on_event(gw.Feedback(text, 1, position=1.0, velocity=2.0))
    note = Note("warning", text, text)
    for t in (SECOND, 2 * SECOND):
        belief = replace(live.belief, reason=text, rejected={text: 1})
        collector.take(Tick(0, t, gw.Inputs(), Outputs(notes=(note,))), belief)
    assert bus
    return collector


@pytest.mark.parametrize("text", HOSTILE)
def test_no_name_or_note_becomes_markup(drive: tuple[Collector, Path], text: str) -> None:
    def read(text: str) -> Page:
        facts = Facts(text, ok=False, result=text, rows=((text, text),), figures=(text,))
        return Page(page(hostile(drive[0], text), facts))

    shown, harmless = read(text), read("harmless")
    assert [(tag, *sorted(one)) for tag, one in shown.elements] == [
        (tag, *sorted(one)) for tag, one in harmless.elements
    ]
    assert shown.scripts[1:] == harmless.scripts[1:]
    names = [group["name"] for group in json.loads(shown.scripts[0])["groups"]]
    assert f"joint {text}" in names
    start = text[:8].partition("\x1b")[0]
    assert shown.text.count(start) >= 9
    assert "\x1b" not in shown.text


def test_an_hour_of_a_large_robot_is_less_than_3_mb(drive: tuple[Collector, Path]) -> None:
    live, _ = drive
    core = gw.Gateway(live.gateway.robot)
    core.joints = {f"{n}": core.joints["left"] for n in range(24)}
    collector = Collector(core)
    for _, pose in live.driven.points:
        collector.driven.add(0, pose)
    signals = collector.signals = Signals(10 * MILLISECOND)
    rows = np.random.default_rng(5).normal(size=(INTERVALS, 24 * 10))
    for i, row in enumerate(rows):
        signals.move_to(i * signals.width)
        for joint in range(24):
            for number in range(10):
                signals.add(float(row[10 * joint + number]), f"joint {joint}", "torque", f"{number}")
    note = Note("info", "brain", "a note of some length, as they are" * 5)
    notes = [(i * SECOND, note) for i in range(500)]
    collector.notes, collector.note_count = notes, 100_000
    collector.last_notes.extend(notes)
    tile = np.random.default_rng(6).integers(-3, 4, size=(900, 900)).astype(np.float32)
    collector.belief = replace(live.belief, map=MapView(1, 0.05, {(0, 0): tile}))
    text = page(collector, FACTS)
    assert "… 99000 notes more …" in text
    assert 1_000_000 < len(text.encode()) < 3_000_000


@pytest.mark.parametrize("robot", ["bench", "arm"])
def test_of_a_robot_without_a_base(robot: str, tmp_path: Path) -> None:
    with gw.open_session(robot, simulated=True) as session:
        collector = Collector(session.gateway)
        session.watch(collector.take)
        for _ in session.run(seconds=0.5):
            pass
    write(tmp_path / "x.html", collector, FACTS)
    shown = Page((tmp_path / "x.html").read_text())
    assert not shown.of("svg")
    assert {f"joint {name}" for name in session.joints} <= {
        group["name"] for group in json.loads(shown.scripts[0])["groups"]
    }


def test_a_file_that_cannot_be_written(drive: tuple[Collector, Path], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no-such-folder"):
        write(tmp_path / "no-such-folder" / "x.html", drive[0], FACTS)
