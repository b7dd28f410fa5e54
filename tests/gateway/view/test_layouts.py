"""Layouts for Foxglove and PlotJuggler: what they name is what a robot shows."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway import open_session
from gateway.cli.main import main
from gateway.config import load_robot
from gateway.recording.ros_views import TOPICS, Views
from gateway.view.foxglove_services import SERVICES
from gateway.view.layouts import KINDS, foxglove, plotjuggler

NAMES = ("diffbot", "bench", "arm", "quadruped", "mobile_arm", "twelve")
LAYOUTS = Path(__file__).parents[3] / "examples" / "layouts"


@pytest.fixture(scope="module")
def shown() -> dict[str, Any]:
    """The last message of each topic of a robot, decoded by rosbags."""
    from rosbags.typesys import Stores, get_typestore

    store, views, found = get_typestore(Stores.ROS2_JAZZY), Views(), dict[str, Any]()
    with open_session("diffbot", simulated=True) as session:
        for tick in session.run(seconds=0.5):
            for one in views.messages(tick, session.gateway.belief()):
                if one.type in store.fielddefs:
                    found[one.topic] = store.deserialize_cdr(one.data, one.type)
    return found


def panels(layout: Any) -> Iterator[str]:
    """Yield the panels of a mosaic."""
    if isinstance(layout, str):
        yield layout
    else:
        assert layout["direction"] in ("row", "column")
        assert 0 < layout["splitPercentage"] < 100
        yield from (*panels(layout["first"]), *panels(layout["second"]))


@pytest.mark.parametrize("name", NAMES)
def test_every_panel_of_foxglove_stands_somewhere_and_has_its_settings(name: str) -> None:
    layout = json.loads(foxglove(load_robot(name)))
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    for panel in layout["configById"].values():
        named = [
            *panel.get("topics", {}),
            *(panel[key] for key in ("topicToRender", "topicPath") if key in panel),
            *(path["value"].partition(".")[0] for path in panel.get("paths", [])),
        ]
        assert set(named) <= set(TOPICS)
        assert panel.get("serviceName", "/stop") in {one.name for one in SERVICES}


def test_what_foxglove_plots_is_a_number_in_what_the_robot_shows(shown: dict[str, Any]) -> None:
    layout = json.loads(foxglove(load_robot("diffbot")))
    paths = [path["value"] for one in layout["configById"].values() for path in one.get("paths", [])]
    assert len(paths) == 2 + 3 * 2
    for path in paths:
        topic, *fields = path.split(".")
        value = shown[topic]
        for field in fields:
            name, _, index = field.partition("[")
            value = getattr(value, name)
            value = value[int(index[:-1])] if index else value
        assert isinstance(float(value), float)


def test_plotjuggler_has_every_joint_by_its_name(shown: dict[str, Any]) -> None:
    """As its parser names them: /TOPIC/JOINT/position, which wants as many of each as there are names."""
    joints = shown["/joint_states"]
    assert len(joints.name) == len(joints.position) == len(joints.velocity) == len(joints.effort) == 2
    known = {
        f"/joint_states/{name}/{one}" for name in joints.name for one in ("position", "velocity", "effort")
    }
    odom = {"/odom/twist/twist/linear/x", "/odom/twist/twist/angular/z"}
    layout = ET.fromstring(plotjuggler(load_robot("diffbot")))
    assert {one.attrib["name"] for one in layout.iter("curve")} == known | odom
    assert [one.attrib["name"] for one in layout.findall("tabbed_widget")] == ["Main Window"]
    for splitter in layout.iter("DockSplitter"):
        areas = splitter.findall("DockArea")
        assert int(splitter.attrib["count"]) == len(areas) == len(splitter.attrib["sizes"].split(";"))
        assert all(len(area.findall("plot")) == 1 for area in areas)
    assert all(re.fullmatch("#[0-9a-f]{6}", one.attrib["color"]) for one in layout.iter("curve"))


@pytest.mark.parametrize(
    ("program", "file"), [("foxglove", "foxglove.json"), ("plotjuggler", "plotjuggler.xml")]
)
def test_those_that_ship_are_the_diffbot_s(
    program: str, file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["layout", program, "diffbot"]) == 0
    assert capsys.readouterr().out == (LAYOUTS / file).read_text() == KINDS[program](load_robot("diffbot"))
    out = tmp_path / file
    assert main(["layout", program, "diffbot", "--out", str(out)]) == 0
    assert out.read_text() == (LAYOUTS / file).read_text()
    assert main(["layout", program, "diffbot", "--out", str(out)]) == 2
    assert "cannot be written: exists already" in capsys.readouterr().err
