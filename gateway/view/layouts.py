"""Layouts for Foxglove and PlotJuggler: what of a robot stands where, to begin with.

Rules. What is named is what the live view and recordings have (`gateway.recording.ros_views`). Of
/joint_states, which has motors in the order in which they reported first, PlotJuggler plots by name; Foxglove
by index, beside a panel with the names.

Sources: defaultLayout.ts of Foxglove Studio, the last that was open (a mosaic of panels, "TYPE!ID", and the
settings of each); PlotJuggler's MainWindow::xmlLoadState, and ParserROS for how it names joints.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import Any, TypeAlias

from gateway.core.robot import Robot

Mosaic: TypeAlias = "str | dict[str, Any]"
FIELDS = ("position", "velocity", "effort")
BASE = ("/odom.twist.twist.linear.x", "/odom.twist.twist.angular.z")
SHOWN = ("/map", "/scan", "/plan", "/goal_pose", "/odom", "/estimate")
COLOURS = ("#1f77b4", "#d62728", "#1ac938", "#ff7f0e", "#f14cc1", "#9467bd", "#17becf", "#bcbd22")
MOST = 24
"""Joints of a plot."""
LAST = 60
"""s that are followed."""


def foxglove(robot: Robot) -> str:
    """Return a layout of Foxglove as JSON: the place, the joints, what is wrong, and a button to stop."""
    number = min(len(robot.motors), MOST)
    panels: dict[str, Any] = {
        f"Plot!{field}": _plot(field, [f"/joint_states.{field}[{i}]" for i in range(number)])
        for field in FIELDS
    }
    panels["RawMessages!joints"] = {"topicPath": "/joint_states", "diffEnabled": False}
    panels["DiagnosticSummary!all"] = {"topicToRender": "/diagnostics", "minLevel": 0, "sortByLevel": True}
    panels["RosOut!log"] = {"topicToRender": "/rosout", "minLogLevel": 1, "searchTerms": []}
    panels["CallService!stop"] = {
        "serviceName": "/stop",
        "requestPayload": "{}",
        "buttonText": "STOP",
        "buttonColor": "#d01924",
        "layout": "vertical",
    }
    left = _stack("Plot!position", "Plot!velocity", "Plot!effort")
    right = _stack("CallService!stop", "DiagnosticSummary!all", "RosOut!log", "RawMessages!joints")
    whole = {"direction": "row", "first": left, "second": right, "splitPercentage": 65}
    if (base := robot.brain.base) is not None:
        panels["Plot!base"] = _plot("base", list(BASE))
        panels["3D!place"] = {
            "followMode": "follow-position",
            "followTf": "base_link",
            "topics": {topic: {"visible": True} for topic in SHOWN},
            "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True}},
            "publish": {"type": "pose", "poseTopic": "/goal_pose"},
        }
        forward, turn = round(0.5 * base.max_linear, 3), round(0.5 * base.max_angular, 3)
        panels["Teleop!drive"] = {
            "topic": "/cmd_vel",
            "publishRate": 20,
            "upButton": {"field": "linear-x", "value": forward},
            "downButton": {"field": "linear-x", "value": -forward},
            "leftButton": {"field": "angular-z", "value": turn},
            "rightButton": {"field": "angular-z", "value": -turn},
        }
        place = _stack("3D!place", "Teleop!drive", share=75)
        left = _stack("Plot!base", "Plot!velocity", "Plot!effort", "Plot!position")
        rest = {"direction": "row", "first": left, "second": right, "splitPercentage": 55}
        whole = {"direction": "row", "first": place, "second": rest, "splitPercentage": 40}
    made = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": whole,
    }
    return json.dumps(made, indent=1) + "\n"


def plotjuggler(robot: Robot) -> str:
    """Return a layout of PlotJuggler as XML: a plot each for position, velocity and torque of all joints,
    and for a base its velocity and its path."""
    joints = list(robot.motors)[:MOST]
    tabs: dict[str, list[tuple[str, list[str]]]] = {
        "joints": [(one, [f"/joint_states/{joint}/{one}" for joint in joints]) for one in FIELDS]
    }
    if robot.brain.base is not None:
        tabs["base"] = [("velocity", [one.replace(".", "/") for one in BASE])]
    root = ET.Element("root")
    widget = ET.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    for name, plots in tabs.items():
        container = ET.SubElement(ET.SubElement(widget, "Tab", containers="1", tab_name=name), "Container")
        sizes = ";".join(f"{1.0 / len(plots):.6f}" for _ in plots)
        splitter = ET.SubElement(
            container, "DockSplitter", orientation="-", sizes=sizes, count=str(len(plots))
        )
        for title, curves in plots:
            plot = ET.SubElement(
                ET.SubElement(splitter, "DockArea", name=title),
                "plot",
                mode="TimeSeries",
                style="Lines",
                flip_x="false",
                flip_y="false",
            )
            ET.SubElement(plot, "limitY")
            for curve, colour in zip(curves, cycle(COLOURS), strict=False):
                ET.SubElement(plot, "curve", name=curve, color=colour)
    ET.SubElement(widget, "currentTabIndex", index="0")
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    for empty in ("customMathEquations", "snippets"):
        ET.SubElement(root, empty)
    ET.indent(root, " ")
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{ET.tostring(root, encoding='unicode')}\n"


KINDS: Mapping[str, Callable[[Robot], str]] = {"foxglove": foxglove, "plotjuggler": plotjuggler}
"""By the program that opens it."""


def _plot(title: str, paths: Sequence[str]) -> dict[str, Any]:
    return {
        "title": title,
        "paths": [
            {"value": path, "enabled": True, "timestampMethod": "receiveTime", "color": colour}
            for path, colour in zip(paths, cycle(COLOURS), strict=False)
        ],
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "followingViewWidth": LAST,
    }


def _stack(*panels: Mosaic, share: float | None = None) -> Mosaic:
    """Return panels below each other, of equal heights unless the first has a share [%]."""
    first, *rest = panels
    if not rest:
        return first
    parts = {"direction": "column", "first": first, "second": _stack(*rest)}
    return parts | {"splitPercentage": share or 100.0 / len(panels)}
