"""The picture of a tour: believed, planned and true path, the robot's outline, people; speed, bus load and
age of feedback over time. Of a robot that stays where it is: its joints over time.

Matplotlib is imported here only, and only when a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brain.belief import Pose
from brain.bodies.plane import moved
from gateway.bench.joint_trace import JointTrace
from gateway.bench.tune import Identified, simulated
from gateway.cli.side_view import draw_arms
from gateway.cli.tour import Tour
from gateway.errors import UserError
from gateway.recording.new_file import replace_with
from protocols.messages import SECOND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from brain.belief import Floats, MapView

TRUE, BELIEVED, PLANNED, RAW, PERSON = "#1b9e77", "#1f4fa8", "#d95f02", "#999999", "#c2185b"
TAG = "#7b5ea7"
SIGMAS = 3.0
ENLARGED = 5.0
"""Magnification of the ellipses: one of a few centimetres would be hidden under the line."""
APART = 0.8
"""m of path between two outlines of the robot."""
MOMENTS = 60
"""Samples between two places of a person: 3 s."""
WINDOW = 4
"""Number of samples over which the bus load is averaged: two scans of the lidar."""

LEGEND_WIDTH = 110
"""Characters of its names, and 5 for each of its lines, that fit above the axes"""


def draw_sweep(
    key: str, runs: Mapping[float, Sequence[Mapping[str, Any]]], names: Sequence[str], file: Path
) -> None:
    """Write a picture of a sweep, by the end of its name SVG or PNG: each figure of each run over the value
    of the setting, and the mean of each value. Raises UserError if it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [
        name
        for name in names
        if len({one["figures"].get(name) for found in runs.values() for one in found}) > 1
    ]
    figure = Figure(figsize=(8, 2.2 * max(1, len(shown))), layout="constrained")
    FigureCanvasAgg(figure)
    every = figure.subplots(max(1, len(shown)), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(every, shown, strict=False):
        points = [
            (x, one["figures"][name]) for x, found in runs.items() for one in found if name in one["figures"]
        ]
        axes.plot(*zip(*points, strict=True), ".", color=RAW)
        means = [(x, np.mean([y for at, y in points if at == x])) for x in dict(points)]
        axes.plot(*zip(*means, strict=True), color=BELIEVED)
        axes.set_title(name, loc="left", fontsize="small")
    if not shown:
        every[0].set_title("no figure differs", loc="left", fontsize="small")
    every[-1].set_xlabel(key or "all runs")
    kind = "svg" if file.suffix == ".svg" else "png"
    data = BytesIO()
    figure.savefig(data, format=kind, metadata={"Date": None} if kind == "svg" else {})
    try:
        replace_with(file, data.getvalue())
    except OSError as error:
        raise UserError(f"{file}: cannot be written: {error.strerror}") from error


def draw(tour: Tour, file: Path) -> None:
    """Write a PNG: the map with the paths, or the joints, above; speed, bus load and age of feedback
    below. Raises UserError if it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 11), layout="constrained")
    FigureCanvasAgg(figure)
    if tour.samples:
        figure.suptitle(_title(tour))  # above the legend, however many rows that has
        grid = figure.add_gridspec(4, 1, height_ratios=(6, 1, 1, 1))
        _map(figure.add_subplot(grid[0]), tour)
        seconds = np.array([sample.t for sample in tour.samples]) / SECOND
        over_time = figure.add_subplot(grid[1])
        _speed(over_time, tour, seconds)
        _load(figure.add_subplot(grid[2], sharex=over_time), tour, seconds)
        _age(figure.add_subplot(grid[3], sharex=over_time), tour, seconds)
        over_time.set_xlim(0.0, seconds[-1])
    else:
        arms, grid = tour.arms, figure.add_gridspec(2, 1, height_ratios=(2, 1))
        if arms:
            draw_arms(figure.add_subplot(grid[0]), arms, tour)
        _joints(figure.add_subplot(grid[1] if arms else grid[0:]), tour)
    _save(figure, file)


def _save(figure: Figure, file: Path) -> None:
    drawn = BytesIO()
    figure.savefig(drawn, dpi=110, metadata={"Software": None})
    try:
        replace_with(file, drawn.getvalue())
    except OSError as error:
        raise UserError(f"{file}: {error.strerror}") from error


def _title(tour: Tour) -> str:
    """Return how far it drove, how well it knew where it was, and what became of it."""
    error = 100 * tour.error([sample.believed for sample in tour.samples]) / max(tour.length, 1e-9)
    return (
        f"{tour.length:.1f} m driven; believed path within {error:.2f} % of that from the true one; "
        f"{tour.outcome}, {tour.contacts} contacts, {tour.touched_people} with people"
    )


def _map(axes: Axes, tour: Tour) -> None:
    if tour.belief.map is not None:
        _grid(axes, tour.belief.map)
    for outline in tour.outlines:
        closed = [*outline, outline[0]]
        axes.plot([x for x, _ in closed], [y for _, y in closed], color="#c0392b", lw=0.8)
    for number, tag in tour.tags:
        axes.plot(tag.x, tag.y, "s", color=TAG, ms=6)
        before = moved(tag, Pose(0.2, 0.0, 0.0))
        axes.text(before.x, before.y, f"tag {number}", color=TAG, ha="center", va="center", fontsize=8)
    for i, path in enumerate(tour.paths):
        label = "planned" if i == 0 else None
        axes.plot([x for x, _ in path], [y for _, y in path], color=PLANNED, lw=2.5, alpha=0.5, label=label)
    believed = [sample.believed for sample in tour.samples]
    sigma = f"believed, with {SIGMAS:g}-sigma ellipses × {ENLARGED:g}"
    for label, poses, colour, style in (
        ("raw odometry", [sample.raw for sample in tour.samples], RAW, ":"),
        ("true", [sample.true for sample in tour.samples], TRUE, "-"),
        (sigma, believed, BELIEVED, "--"),
    ):
        axes.plot([p.x for p in poses], [p.y for p in poses], style, color=colour, lw=1.4, label=label)
    _ellipses(axes, tour)
    _outlines(axes, tour)
    _people(axes, tour)
    for i, arrival in enumerate(tour.arrivals, 1):
        goal = arrival.goal
        axes.plot(goal.x, goal.y, "*", color=PLANNED, ms=14, mec="black")
        axes.annotate(str(i), (goal.x, goal.y), textcoords="offset points", xytext=(8, 6))
    axes.set_aspect("equal")
    axes.set_facecolor("0.5")  # as what the map does not know
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    _legend_above(axes)
    points = [point for outline in tour.outlines for point in outline]
    points = points or [(sample.true.x, sample.true.y) for sample in tour.samples] or [(0.0, 0.0)]
    xs, ys = zip(*points, strict=True)
    axes.set_xlim(min(xs) - 0.3, max(xs) + 0.3)
    axes.set_ylim(min(ys) - 0.3, max(ys) + 0.3)


def _legend_above(axes: Axes) -> None:
    """Add the legend above the axes, in rows of up to seven that are no wider, where it hides nothing."""
    if labels := axes.get_legend_handles_labels()[1]:
        columns = max(1, min(len(labels), 7, LEGEND_WIDTH // (max(map(len, labels)) + 5)))
        axes.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=columns,
            frameon=False,
            borderaxespad=0.0,
            columnspacing=1.5,
        )


def _grid(axes: Axes, view: MapView) -> None:
    shade = 1.0 - 1.0 / (1.0 + np.exp(-np.asarray(view.log_odds, dtype=float)))
    rows, columns = shade.shape
    extent = (
        view.origin_x,
        view.origin_x + columns * view.resolution,
        view.origin_y,
        view.origin_y + rows * view.resolution,
    )
    axes.imshow(
        shade, origin="lower", extent=extent, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest"
    )


def _ellipses(axes: Axes, tour: Tour) -> None:
    """Draw, every two seconds, the enlarged 3-sigma ellipse, which should contain the true position."""
    from matplotlib.patches import Ellipse

    for sample in tour.samples[::40]:
        x, y = sample.believed.x, sample.believed.y
        values, vectors = np.linalg.eigh(np.asarray(sample.covariance)[:2, :2])
        width, height = 2 * SIGMAS * ENLARGED * np.sqrt(np.maximum(values, 0.0))
        angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
        axes.add_patch(Ellipse((x, y), width, height, angle=angle, fill=False, color=BELIEVED, lw=0.8))


def _outlines(axes: Axes, tour: Tour) -> None:
    """Draw the robot to scale along its true path, with a mark that points forward."""
    driven, ahead = APART, max(x for x, _ in tour.footprint(Pose(0.0, 0.0, 0.0)))
    mark = [Pose(share * ahead, side * ahead, 0.0) for share, side in ((1.0, 0.0), (0.5, 0.25), (0.5, -0.25))]
    for before, sample in zip([tour.samples[0], *tour.samples], tour.samples, strict=False):
        driven += hypot(sample.true.x - before.true.x, sample.true.y - before.true.y)
        if driven < APART and sample is not tour.samples[-1]:
            continue
        driven = 0.0
        corners, tip = tour.footprint(sample.true), [moved(sample.true, corner) for corner in mark]
        axes.fill([x for x, _ in corners], [y for _, y in corners], fill=False, ec=TRUE, lw=0.6, alpha=0.8)
        axes.fill([place.x for place in tip], [place.y for place in tip], color=TRUE, lw=0.0, alpha=0.8)


def _people(axes: Axes, tour: Tour) -> None:
    """Draw where people were, the later the darker."""
    from matplotlib.patches import Circle

    seen = tour.samples[::MOMENTS]
    for i, sample in enumerate(seen):
        for x, y, radius in sample.people:
            shade = 0.1 + 0.5 * i / len(seen)
            axes.add_patch(Circle((x, y), radius, color=PERSON, alpha=shade, lw=0.0))


def _speed(axes: Axes, tour: Tour, seconds: Floats) -> None:
    speeds = np.array(tour.speeds()).reshape(-1, 3)
    for column, name in enumerate(("forward [m/s]", "turn [rad/s]", "left [m/s]")):
        axes.plot(seconds[1:], speeds[:, column], lw=0.8, label=name)
    axes.set_ylabel("true speed")
    _legend_above(axes)


def _joints(axes: Axes, tour: Tour) -> None:
    seconds = np.array(tour.times) / SECOND
    for name, angles in zip(tour.motors, np.array(tour.shafts).T, strict=True):
        axes.plot(seconds, angles, lw=1.2, label=name)
    axes.set_ylabel("true position [rad; sliding: m]")
    axes.set_xlabel("time [s]")
    axes.set_xlim(0.0, seconds[-1])
    _legend_above(axes)


def _load(axes: Axes, tour: Tour, seconds: Floats) -> None:
    for name in tour.samples[-1].load if tour.samples else ():
        load = np.array([100 * sample.load.get(name, 0.0) for sample in tour.samples])
        mean = np.convolve(load, np.full(WINDOW, 1 / WINDOW), mode="same")
        axes.plot(seconds, mean, lw=0.8, label=name)
    axes.set_ylabel("bus load [%]")
    axes.set_ylim(bottom=0.0)
    _legend_above(axes)


def _age(axes: Axes, tour: Tour, seconds: Floats) -> None:
    ages = [sample.age for sample in tour.samples]
    axes.plot(seconds, ages, lw=0.8, color=BELIEVED)
    axes.set_ylabel("age of\nfeedback [ms]")
    axes.set_ylim(0.0, 1.2 * max([1.0, *ages]))
    axes.set_xlabel("time [s]")


def draw_joint(file: Path, one: Identified, trace: JointTrace, torque_limit: float) -> None:
    """Write a PNG: velocity and torque of a joint, as measured and as its twin would do. Raises UserError if
    it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    told = [(t, value) for t, value in trace.commanded if value == value]
    if told:
        upper.plot(*zip(*told, strict=True), color=PLANNED, lw=0.8, label="set-point")
    upper.plot(*zip(*trace.velocity, strict=True), color=TRUE, lw=1.2, label="measured")
    lower.plot(*zip(*trace.torque, strict=True), color=TRUE, lw=1.0, label="reported")
    if one.gain is not None:
        grid, velocity, torque = simulated(one, trace, torque_limit)
        upper.plot(grid, velocity, "--", color=BELIEVED, lw=1.0, label="its twin")
        lower.plot(grid, torque, "--", color=BELIEVED, lw=0.8, label="its twin")
    upper.set_ylabel("velocity [rad/s]")
    lower.set_ylabel("torque [N·m]")
    lower.set_xlabel("time [s]")
    for axes in (upper, lower):
        _legend_above(axes)
    _save(figure, file)
