"""The report as one HTML file. Everything that others have written is escaped here, and only here.

Rules. The page needs nothing but itself: style, script, the plotting library and the data are in it. Its
policy (Content-Security-Policy) names the digests of its scripts, so a text that got through as markup could
still run nothing. The data are JSON in an element of their own, in which no `<` stands; the script puts texts
into the page as text only.
"""

from __future__ import annotations

import json
import struct
import zlib
from base64 import b64encode
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from html import escape
from importlib.resources import files
from math import degrees, hypot
from pathlib import Path

import numpy as np

from brain.belief import MapView, Pose
from gateway.core.message_text import escaped
from gateway.errors import UserError
from gateway.recording.new_file import replace_with
from gateway.replay.signal_log import QUANTITIES
from gateway.report.collect import Collector, group_of
from gateway.report.series import DrivenTrack
from protocols.messages import MILLISECOND, SECOND, Nanos

SVG = "xmlns='http://www.w3.org/2000/svg' width='1000'"
"""What the map needs to be a file of its own."""
POINTS = 240_000
"""The most points of all plots together: at about 6 bytes each, 1.5 MB."""
MAP_CELLS = 4_000_000
"""The most cells of the map that are drawn: of a larger one every second, third, …"""
TEXT = 600
"""The most characters of a note."""
PATH_POINTS = 200
"""The most points of a planned path."""
UNITS = {
    ("base", "velocity"): "m/s",
    ("base", "turning"): "rad/s",
    ("base", "error of the pose"): "m",
    ("base", "beside the path"): "cm",
    ("base", "consistency"): "NIS per degree of freedom",
    ("bus", "load"): "%",
}


@dataclass(frozen=True, slots=True)
class Facts:
    """What a report states of a run beside what its ticks show."""

    what: str
    """The kind of run: "run", "demo", "replay" …"""
    ok: bool
    result: str
    """How it ended, in a sentence or some lines."""
    rows: tuple[tuple[str, str], ...] = ()
    """More about it: name and value."""
    figures: tuple[str, ...] = ()
    """More figures, a line each."""
    walls: tuple[tuple[tuple[float, float], ...], ...] = field(default=())
    """True outlines [m] in the frame "map", where they are known."""


def write(file: Path, collector: Collector, facts: Facts) -> None:
    """Write the report of a run; a file that exists is replaced. Raises UserError if it cannot be written."""
    try:
        replace_with(file, page(collector, facts).encode(errors="replace"))
    except OSError as error:
        raise UserError(f"{file}: {error.strerror}") from error


def page(collector: Collector, facts: Facts) -> str:
    """Return the report as HTML."""
    robot = collector.gateway.robot
    view = files("gateway") / "view" / "page"
    own = files("gateway") / "report" / "page"
    scripts = [(view / "uplot.js").read_text("utf-8"), (own / "report.js").read_text("utf-8")]
    styles = [file.read_text("utf-8") for file in (view / "uplot.css", own / "map.css", own / "report.css")]
    allowed = " ".join(f"'sha256-{b64encode(sha256(s.encode()).digest()).decode()}'" for s in scripts)
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}"
    title = f"{robot.name}: {facts.what}, {_seconds(collector.end - collector.start)}"
    licence = (view / "uplot.LICENSE").read_text("utf-8")
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{_text(title)}</title>
<style>{"".join(styles)}</style>
</head>
<body>
<header>
<h1>{_text(title)}</h1>
<p class="result {"good" if facts.ok else "bad"}">{_text(facts.result)}</p>
</header>
<main>
{_map_section(collector, facts)}
{_rows("Figures", figures(collector), facts.figures)}
{_joints(collector)}
<section><h2>Over time</h2>
<p class="hint">Drag over a plot to zoom all of them, double-click to see all again.</p>
<div id="plots"></div>
</section>
{_log(collector)}
{_rows("What ran", [("robot", robot.name), *facts.rows], ())}
</main>
<footer>Plots by uPlot:<details><summary>its licence</summary><pre>{_text(licence)}</pre></details></footer>
<script type="application/json" id="data">{_json(_data(collector))}</script>
<script>{scripts[0]}</script>
<script>{scripts[1]}</script>
</body>
</html>
"""


def figures(collector: Collector) -> list[tuple[str, str]]:
    """Return the figures that the ticks give: name and value."""
    c, belief = collector, collector.belief
    passed = max(c.end - c.start, 1)
    rows = [
        ("duration", f"{_seconds(passed)}, {c.ticks} ticks, at most {c.longest / MILLISECOND:.1f} ms apart"),
        *(
            (
                f"bus {name}",
                f"{c.received[name]} packets in, {c.sent[name]} out, load {_load(c, name)}",
            )
            for name in c.busy
        ),
        ("state at the end", f"{belief.state}{f': {belief.reason}' if belief.reason else ''}"),
    ]
    if belief.mission is not None:
        why = f": {belief.mission.reason}" if belief.mission.reason else ""
        rows.append((f"mission {belief.mission.name}", f"{belief.mission.phase}{why}"))
    if belief.estimate is not None:
        rows.append(("goals reached", f"{belief.reached}"))
        rows.append(("path driven", f"{c.driven.length:.2f} m by the estimate{_true_length(c)}"))
    if c.off_rms is not None:
        farthest, t = c.off
        rows.append(
            (
                "beside the path that is followed",
                f"RMS {100 * c.off_rms:.1f} cm, at most {100 * farthest:.1f} cm at {_seconds(t - c.start)}",
            )
        )
    if c.true.points:
        error, t = c.error
        rows.append(("estimate off the true position", f"at most {error:.3f} m, at {_seconds(t - c.start)}"))
    rows += [
        (
            f"consistency of {name}",
            f"NIS {nis.mean:.2f} (1 if consistent), {nis.beyond / nis.count:.1%} of {nis.count} beyond 95 %",
        )
        for name, nis in c.gateway.brain.nis.items()
        if nis.count
    ]
    if refused := [f"{count} of {name}" for name, count in belief.rejected.items() if count]:
        rows.append(("measurements rejected", ", ".join(refused)))
    rows += [
        (f"{protocol} on {bus}", f"{counted.malformed} messages malformed, {counted.ignored} ignored")
        for bus, protocol, counted in c.gateway.rx_counters()
        if counted.malformed
    ]
    return rows


def _load(collector: Collector, bus: str) -> str:
    mean = 100.0 * collector.busy[bus] / max(collector.end - collector.start, 1)
    signal = collector.signals.get("bus", "load", bus)
    return f"{mean:.1f} %" + (f", at most {signal.range[1]:.1f} % over 50 ms" if signal is not None else "")


def _true_length(collector: Collector) -> str:
    return f", {collector.true.length:.2f} m truly" if collector.true.points else ""


def _seconds(t: Nanos) -> str:
    return f"{t / SECOND:.1f} s"


# -- texts --------------------------------------------------------------------------------------------


def _text(text: str) -> str:
    """Return a text of whatever origin as HTML."""
    return escape(escaped(text, keep="\n"))


def _json(data: object) -> str:
    """Return JSON that cannot end the element it stands in, nor begin another."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _rows(title: str, rows: Iterable[tuple[str, str]], lines: Sequence[str]) -> str:
    cells = "".join(
        f"<tr><th scope='row'>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows
    )
    more = f"<pre>{_text(chr(10).join(lines))}</pre>" if lines else ""
    return f"<section><h2>{title}</h2><div class='wide'><table>{cells}</table></div>{more}</section>"


def _joints(collector: Collector) -> str:
    """Return the table of joints: what each ended as, and the range of what it measured."""
    signals, joints = collector.signals, collector.gateway.joints.values()
    shown = [
        q for q in QUANTITIES if any(signals.get(group_of(joint.name), q, "measured") for joint in joints)
    ]
    head = "".join(f"<th scope='col'>{quantity} [{QUANTITIES[quantity]}]</th>" for quantity in shown)
    body = ""
    for joint in joints:
        ranges = [signals.get(group_of(joint.name), quantity, "measured") for quantity in shown]
        cells = "".join(
            f"<td>{'' if one is None else f'{one.range[0] + 0.0:.4g} … {one.range[1] + 0.0:.4g}'}</td>"
            for one in ranges
        )
        faults = "; ".join(fault.name for fault in joint.faults.values())
        mode = f"{joint.mode}{f': {faults}' if faults else ''}"
        body += f"<tr><th scope='row'>{_text(joint.name)}</th><td>{_text(mode)}</td>{cells}</tr>"
    return (
        "<section><h2>Each joint</h2><div class='wide'><table class='grid'>"
        f"<tr><td></td><th scope='col'>at the end</th>{head}</tr>{body}</table></div></section>"
    )


def _log(collector: Collector) -> str:
    """Return the notes, with their times."""
    notes = [*collector.notes, *collector.last_notes]
    left_out = collector.note_count - len(notes)
    rows = [
        f"<tr class='{note.level}'><td>{(t - collector.start) / SECOND:.3f}</td>"
        f"<td>{_text(note.source)}</td><td>{_text(note.text[:TEXT])}</td></tr>"
        for t, note in notes
    ]
    if left_out:
        rows.insert(len(collector.notes), f"<tr><td></td><td></td><td>… {left_out} notes more …</td></tr>")
    table = f"<table>{''.join(rows)}</table>" if rows else "<p>Nothing was noted.</p>"
    box = "class='wide log' role='region' aria-label='log' tabindex='0'"  # tabindex: scrolled by keys
    return f"<section><h2>Log</h2><div {box}>{table}</div></section>"


# -- the map --------------------------------------------------------------------------------------------


def picture(collector: Collector) -> str:
    """Return the map with the paths and the robot where it ended, as an SVG file. Raises UserError."""
    if not collector.driven.points:
        raise UserError("there is no map to draw: the robot has no base, or never knew where it was")
    style = (files("gateway") / "report" / "page" / "map.css").read_text("utf-8")
    _, pose = collector.driven.points[-1]
    at = f"translate({pose.x:.3f} {-pose.y:.3f}) rotate({-degrees(pose.yaw):.2f})"
    robot = f"<path id='robot' style='visibility:visible' transform='{at}'"
    drawn = _map(collector, ()).replace("<path id='robot'", robot)
    return drawn.replace(" id='map'", f" id='map' {SVG}").replace(">", f"><style>{style}</style>", 1)


def _map_section(collector: Collector, facts: Facts) -> str:
    """Return the map with its legend, and the goals that were reached."""
    if not collector.driven.points:
        return ""
    legend = [("planned", "planned"), ("driven", "believed")]
    legend += [("true", "true")] * bool(collector.true.points) + [("raw", "by the wheels alone")]
    legend += [("wall", "true walls")] * bool(facts.walls)
    names = " ".join(f"<span class='{kind}'>{name}</span>" for kind, name in legend)
    return (
        f"<section><h2>Map</h2><p class='legend'>{names}</p>{_map(collector, facts.walls)}"
        "<p class='hint'>On the map: drag to move, Ctrl and the wheel to zoom, double-click for all.</p>"
        f"{_arrivals(collector)}</section>"
    )


def _map(collector: Collector, walls: Sequence[Sequence[tuple[float, float]]]) -> str:
    """Return the map with the paths, as SVG whose y points down: everything is mirrored into it."""
    view = collector.belief.map
    parts, places = [], [(p.x, p.y) for _, p in collector.driven.points]
    places += [(p.x, p.y) for _, p in collector.true.points]
    places += [(one.goal.x, one.goal.y) for one in collector.arrivals]
    places += [point for wall in walls for point in wall]
    if view is not None and view.tiles:
        image, corners = _map_image(view)
        parts.append(image)
        places += corners
    closed = [(*wall, wall[0]) for wall in walls if wall]
    parts += [_line("wall", wall) for wall in closed]
    parts += [_line("planned", _thinned(path)) for _, path in collector.paths]
    parts += [
        _track("raw", collector.raw),
        _track("true", collector.true),
        _track("driven", collector.driven),
    ]
    xs, ys = [x for x, _ in places], [y for _, y in places]
    left, top = min(xs) - 0.5, -max(ys) - 0.5
    width, height = max(xs) - min(xs) + 1.0, max(ys) - min(ys) + 1.0
    radius = 0.008 * max(width, height)
    for number, arrival in enumerate(collector.arrivals, 1):
        x, y = arrival.goal.x, -arrival.goal.y
        parts.append(f"<circle class='goal' cx='{x:.3f}' cy='{y:.3f}' r='{radius:.3f}'/>")
        parts.append(f"<text x='{x + radius:.3f}' y='{y - radius:.3f}'>{number}</text>")
    parts.append(f"<path id='robot' d='{_outline(collector)}'/>")
    letters = f"font-size='{3.0 * radius:.3f}'"
    box = f"{left:.3f} {top:.3f} {width:.3f} {height:.3f}"
    return (
        f"<svg id='map' viewBox='{box}' role='img' aria-label='map'>"
        f"<g id='world' {letters}>{''.join(parts)}</g></svg>"
    )


def _arrivals(collector: Collector) -> str:
    """Return the table of goals that were reached."""
    if not collector.arrivals:
        return ""
    rows = ""
    for number, one in enumerate(collector.arrivals, 1):
        places = [("believed", one.believed), ("true", one.true)]
        off = ", ".join(
            f"{name} {hypot(p.x - one.goal.x, p.y - one.goal.y):.3f} m" for name, p in places if p is not None
        )
        yaw = "" if one.goal.yaw is None else f", {degrees(one.goal.yaw):.0f}°"
        rows += (
            f"<tr><th scope='row'>{number}</th><td>{one.goal.x:.2f}, {one.goal.y:.2f} m{yaw}</td>"
            f"<td>{_seconds(one.t - collector.start)}</td><td>{off}</td></tr>"
        )
    head = "".join(f"<th scope='col'>{title}</th>" for title in ("goal", "reached after", "off by"))
    return f"<div class='wide'><table class='grid'><tr><td></td>{head}</tr>{rows}</table></div>"


def _line(kind: str, points: Iterable[tuple[float, float]]) -> str:
    text = " ".join(f"{x:.3f},{-y:.3f}" for x, y in points)
    return f"<polyline class='{kind}' points='{text}'/>"


def _track(kind: str, track: DrivenTrack) -> str:
    return _line(kind, ((pose.x, pose.y) for _, pose in track.points))


def _thinned(path: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    step = 1 + len(path) // PATH_POINTS
    return [*path[:-1:step], path[-1]]


def _outline(collector: Collector) -> str:
    """Return the robot's outline, with a line to its front, as a path about its origin."""
    base = collector.gateway.robot.brain.base
    corners = base.outline if base is not None else ()
    if not corners:
        return ""
    front = max(x for x, _ in corners)
    return "M" + "L".join(f"{x:.3f},{-y:.3f}" for x, y in corners) + f"ZM0,0L{front:.3f},0"


def _map_image(view: MapView) -> tuple[str, list[tuple[float, float]]]:
    """Return the map as an image, and two opposite corners [m]."""
    log_odds = view.log_odds
    known = np.argwhere(log_odds != 0.0)
    if not len(known):
        return "", []
    (top, left), (bottom, right) = known.min(axis=0), known.max(axis=0) + 1
    step = 1
    while (bottom - top) * (right - left) > MAP_CELLS * step * step:
        step += 1
    cells = log_odds[top:bottom:step, left:right:step][::-1]  # the first row of an image is the uppermost
    shade = (255.0 / (1.0 + np.exp(np.clip(2.0 * cells, -20.0, 20.0)))).astype(np.uint8)
    pixels = np.stack([shade, np.where(cells == 0.0, 0, 255).astype(np.uint8)], axis=-1)
    size = view.resolution * step
    x0, y0 = view.origin_x + left * view.resolution, view.origin_y + top * view.resolution
    width, height = cells.shape[1] * size, cells.shape[0] * size
    data = b64encode(_png(pixels)).decode()
    image = (
        f"<image x='{x0:.3f}' y='{-(y0 + height):.3f}' width='{width:.3f}' height='{height:.3f}' "
        f"preserveAspectRatio='none' href='data:image/png;base64,{data}'/>"
    )
    return image, [(x0, y0), (x0 + width, y0 + height)]


def _png(pixels: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> bytes:
    """Return rows of (grey, opacity) as a PNG (W3C, Portable Network Graphics, sections 5.3 and 11.2)."""
    height, width, _ = pixels.shape
    rows = np.zeros((height, 1 + 2 * width), dtype=np.uint8)  # each begins with its filter: none
    rows[:, 1:] = pixels.reshape(height, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 4, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, data) for kind, data in parts)


# -- the plots --------------------------------------------------------------------------------------------


def _data(collector: Collector) -> dict[str, object]:
    """Return what the script draws: plots by group, and the pose over time."""
    signals = collector.signals
    signals.shrink(POINTS)
    plots: dict[tuple[str, str], list[dict[str, object]]] = {}
    for (group, title, name), values in signals.values():
        plots.setdefault((group, title), []).append({"name": name, "values": [_short(v) for v in values]})
    groups: dict[str, list[dict[str, object]]] = {}
    for (group, title), lines in sorted(plots.items(), key=_order(collector)):
        unit = UNITS.get((group, title)) or QUANTITIES.get(title, "ms")
        groups.setdefault(group, []).append({"title": title, "unit": unit, "lines": lines})
    return {
        "times": [round(t, 3) for t in signals.times()],
        "groups": [{"name": name, "plots": plots} for name, plots in groups.items()],
        "poses": [_pose(t - collector.start, pose) for t, pose in collector.driven.points],
    }


def _order(collector: Collector) -> Callable[[tuple[tuple[str, str], object]], tuple[int, int]]:
    """Return the order of plots: of the base, of each joint, of the buses; within, the quantities' own."""
    groups = ["base", *map(group_of, collector.gateway.joints), "bus"]
    titles = [*QUANTITIES]

    def order(item: tuple[tuple[str, str], object]) -> tuple[int, int]:
        (group, title), _ = item
        return groups.index(group), titles.index(title) if title in titles else len(titles)

    return order


def _pose(since: Nanos, pose: Pose) -> list[float]:
    return [round(since / SECOND, 2), round(pose.x, 3), round(pose.y, 3), round(degrees(pose.yaw), 1)]


def _short(value: float | None) -> float | None:
    """Return a value with as many digits as a plot shows."""
    return None if value is None else float(f"{value:.4g}")
