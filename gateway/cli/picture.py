"""The picture of a tour: what was believed, wanted and true, and how the buses bore it.

Matplotlib is imported here only, and here only when a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gateway.cli.demo import Figures, Log
from protocols.messages import SECOND

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from brain.belief import Floats, MapView, Pose

TRUE, BELIEVED, WANTED, RAW = "#1b9e77", "#1f4fa8", "#d95f02", "#999999"
SIGMAS = 3.0
ENLARGED = 5.0
"""An ellipse of a few centimetres would hide under the line."""
WINDOW = 4
"""Samples over which the bus load is averaged: two scans of the lidar."""


def draw(log: Log, figures: Figures, outlines: Sequence[Sequence[tuple[float, float]]], file: Path) -> None:
    """Write a PNG: the map with the paths above, bus load and age of commands below.

    `outlines` are the true walls and boxes, as polygons [m] in the frame "odom".
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 11), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 1, height_ratios=(5, 1, 1))
    _map(figure.add_subplot(grid[0]), log, figures, outlines)
    seconds = np.array(log.t) / SECOND
    _load(figure.add_subplot(grid[1]), log, seconds)
    _age(figure.add_subplot(grid[2]), log, seconds)
    figure.savefig(file, dpi=110, metadata={"Software": None})


def _map(axes: Axes, log: Log, figures: Figures, outlines: Sequence[Sequence[tuple[float, float]]]) -> None:
    belief = log.belief
    if belief is not None and belief.map is not None:
        _grid(axes, belief.map)
    for outline in outlines:
        closed = [*outline, outline[0]]
        axes.plot([x for x, _ in closed], [y for _, y in closed], color="#c0392b", lw=0.8)
    for i, path in enumerate(log.paths):
        name = "wanted" if i == 0 else None
        axes.plot([x for x, _ in path], [y for _, y in path], color=WANTED, lw=2.5, alpha=0.5, label=name)
    sigma = f"believed, with {SIGMAS:g}-sigma ellipses × {ENLARGED:g}"
    for label, poses, colour, style in (
        ("raw odometry", log.raw, RAW, ":"),
        ("true", log.true, TRUE, "-"),
        (sigma, log.believed, BELIEVED, "--"),
    ):
        axes.plot([p.x for p in poses], [p.y for p in poses], style, color=colour, lw=1.4, label=label)
    _ellipses(axes, log.believed, log.covariance)
    for i, arrival in enumerate(log.arrivals, 1):
        axes.plot(arrival.x, arrival.y, "*", color=WANTED, ms=14, mec="black")
        axes.annotate(str(i), (arrival.x, arrival.y), textcoords="offset points", xytext=(8, 6))
    error = 100 * figures.believed_error / max(figures.length, 1e-9)
    axes.set_title(
        f"{figures.length:.1f} m driven; believed path within {error:.2f} % of that from the true one; "
        f"{sum(a.near for a in figures.arrivals)} of {figures.goals} goals, {figures.contacts} touches"
    )
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(loc="upper right")
    points = [p for outline in outlines for p in outline] or [(p.x, p.y) for p in log.true] or [(0.0, 0.0)]
    xs, ys = zip(*points, strict=True)
    axes.set_xlim(min(xs) - 0.3, max(xs) + 0.3)
    axes.set_ylim(min(ys) - 0.3, max(ys) + 0.3)


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


def _ellipses(axes: Axes, poses: Sequence[Pose], covariances: Sequence[Floats]) -> None:
    """Every two seconds, the ellipse that should hold the true position (3 sigma), enlarged."""
    from matplotlib.patches import Ellipse

    for pose, covariance in list(zip(poses, covariances, strict=True))[::40]:
        values, vectors = np.linalg.eigh(np.asarray(covariance)[:2, :2])
        width, height = 2 * SIGMAS * ENLARGED * np.sqrt(np.maximum(values, 0.0))
        angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
        axes.add_patch(
            Ellipse((pose.x, pose.y), width, height, angle=angle, fill=False, color=BELIEVED, lw=0.8)
        )


def _load(axes: Axes, log: Log, seconds: Floats) -> None:
    for name in log.load[-1] if log.load else ():
        load = np.array([100 * sample.get(name, 0.0) for sample in log.load])
        mean = np.convolve(load, np.full(WINDOW, 1 / WINDOW), mode="same")
        axes.plot(seconds, mean, lw=0.8, label=name)
    axes.set_ylabel("bus load [%]")
    axes.set_ylim(bottom=0.0)
    if log.load:
        axes.legend(loc="upper right", ncols=3)


def _age(axes: Axes, log: Log, seconds: Floats) -> None:
    axes.plot(seconds, log.age, lw=0.8, color=BELIEVED)
    axes.set_ylabel("age of what\ncommands\nrest on [ms]")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
