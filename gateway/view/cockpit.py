"""The cockpit's end of the wire: what its page is sent, and what it asks.

To the page, JSON as text, or binary: a header's length (uint32, little-endian), the header as JSON, padding
to four bytes, then arrays one after the other. Each has a "kind":

| kind | as | when | what |
|---|---|---|---|
| hello | text | on opening | what does not change (`Scene.hello`), `steer` |
| settings | text | with it, and after a change | what can be changed (`Scene.settings`) |
| signals | binary | every 20 ms | `clock`: when it was made [ms]; what is plotted, as below |
| joints | text | every 100 ms | a row for each joint (`Scene.joints`) |
| state | text | every 100 ms | pose, states, goal, faults, buses … (`Scene.state`) |
| note | text | at once | what happened, for a person |
| answer | text | at once | to what was asked, with its `id`, or `held`: `ok`, `text` |
| camera | text | every 100 ms | what cameras saw (`Scene.cameras`), where there are any |
| picture | binary | each second, if idle | `name`, `t`, `wide`, `tall`: tangents of half the view; a JPEG |
| path | binary | when it changes | `version`; float32 x, y [m] for each point |
| scan | binary | every 100 ms | `lidars`: `t`, mount, `poses`, `min`, `step`, `count`, `near`, `far`: f32 |
| tiles | binary | every 20 ms, if new | map: `resolution`, `corner`, `size`, `keys` (row, column); int8 |
| mesh | binary | on opening, in pieces | `mesh`: its number; `low`, `step` [m]; uint16: 3 corners, x, y, z |

From the page, JSON as text: `{"ask": LINE, "id": N, "heard": N}`, a line of the operator's language, with the
newest `clock`; `{"held": LINE, "heard": N}`, the same for as long as it is repeated;
`{"plot": {"id": N, "signals": [[JOINT, QUANTITY], …]}}`; `{"record": true}`; `{"play": {…}}` in a replay;
`{}`: still there. An `id` is an integer.
Notes and answers are never dropped; of everything else, a slow page gets the newest, but of what it plots
every tick: signals have the `id` of the choice, `t` of the first tick [s], `rows`, how many rows were `lost`
because the page left more unread than are kept, and in each row, as float32, the time since `t` [s] and the
signals in their order (NaN: none).
"""

from __future__ import annotations

import json
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from brain.belief import MapView
from gateway.config.text import read_json
from gateway.core.tick import Tick
from gateway.view.figure import PIECE
from gateway.view.requests import SILENT, Asking, Requests, ViewAnswer
from gateway.view.scene import QUANTITIES, Json, Scene, lidar_mounts, note
from gateway.view.server import Client, Message
from gateway.vision.camera import Seen, packed
from protocols.messages import MILLISECOND, SECOND, Instruction, LaserScan, Nanos, Set

SIGNALS_PERIOD: Nanos = 20 * MILLISECOND
STATE_PERIOD: Nanos = 100 * MILLISECOND
PICTURES_PERIOD: Nanos = SECOND
PICTURE_WIDTH, PICTURE_QUALITY = 320, 50
"""Pixels, and of a JPEG: some 8 kB."""
MAX_SIGNALS = 24
"""That a page may plot."""
KEPT_ROWS = 4000
"""Rows of signals that a page has not read yet: 20 s of 200 ticks a second."""
MAX_TILES = 2
"""Tiles of the map in one message, 4 kB each: a slow link is not kept from the rest by the map."""
KEPT_NOTES = 200
"""Notes that a page gets on opening."""

Act = Callable[[Any], ViewAnswer]
"""What does something that is no instruction of the robot: recording, playback. Gets what the page sent."""


@dataclass(slots=True, eq=False)
class _Page:
    """One page, and what it has."""

    client: Client
    asking: Asking
    path: int = -1
    """Version of the path it has."""
    pictures: Nanos = 0
    """When it gets the next pictures of cameras."""
    mesh: tuple[int, int] = (0, 0)
    """Of the robot's meshes, the next piece that it gets: the mesh, and its first triangle."""
    tiles: dict[tuple[int, int], object] = field(default_factory=dict)
    corner: tuple[float, float] | None = None
    plot: int = 0
    """The number that the page gave to its choice of signals."""
    signals: tuple[tuple[str, str], ...] = ()
    """What it plots: joints and quantities."""
    rows: deque[list[float]] = field(default_factory=lambda: deque(maxlen=KEPT_ROWS))
    """Of it, what is not sent yet: times [s], and values."""
    lost: int = 0
    """Rows that were not read in time."""

    def choose(self, asked: object, scene: Scene) -> ViewAnswer:
        """Plot other signals from now on."""
        chosen = asked if isinstance(asked, dict) else {}
        number, listed = chosen.get("id"), chosen.get("signals")
        if not isinstance(number, int) or abs(number) >= 1 << 53 or not isinstance(listed, list):
            return ViewAnswer(ok=False, text="plot: an id and a list of signals are expected")
        if len(listed) > MAX_SIGNALS:
            return ViewAnswer(ok=False, text=f"plot: at most {MAX_SIGNALS} signals are plotted at once")
        joints = scene.gateway.joints
        for one in listed:
            if not (
                isinstance(one, list)
                and len(one) == 2
                and all(isinstance(word, str) for word in one)
                and one[0] in joints
                and one[1] in QUANTITIES
            ):
                known = f"one of {', '.join(joints)}, and one of {', '.join(QUANTITIES)}"
                return ViewAnswer(
                    ok=False, text=f"plot: {one!r:.80} is no signal: a pair is expected, {known}"
                )
        self.plot, self.signals, self.lost = number, tuple((one[0], one[1]) for one in listed), 0
        self.rows.clear()
        return SILENT

    def take(self, scene: Scene) -> None:
        """Take a row of what it plots."""
        if self.signals:
            self.lost += len(self.rows) == KEPT_ROWS
            self.rows.append([scene.now / SECOND, *scene.values(self.signals)])

    def read(self, now: Nanos) -> bytes:
        """Return what there is of its signals, and forget it."""
        header: Json = {"clock": now // MILLISECOND, "id": self.plot, "rows": len(self.rows)}
        rows = np.array(self.rows, dtype=np.float64)
        if self.rows:
            header |= {"t": self.rows[0][0]} | ({"lost": self.lost} if self.lost else {})
            rows[:, 0] -= self.rows[0][0]
        self.rows.clear()
        self.lost = 0
        return _binary("signals", header, rows.astype("<f4"))


class Cockpit:
    """All pages.

    Args:
        scene: what is shown.
        requests: what takes their lines.
        acts: by the key of a message: "record", "play".
    """

    def __init__(self, scene: Scene, requests: Requests, acts: Mapping[str, Act]) -> None:
        self.scene, self._requests, self._acts = scene, requests, acts
        self._pages: dict[Client, _Page] = {}
        self._notes: deque[str] = deque(maxlen=KEPT_NOTES)
        self._signals_due: Nanos = 0
        self._state_due: Nanos = 0
        self._settings_of: object = scene.gateway
        """The gateway whose settings pages have been sent; None: they have changed since."""

    def receive(self, now: Nanos, client: Client, messages: Sequence[Message]) -> Sequence[Instruction]:
        """Return what a page asks of the robot; answer it. Of what is held the newest counts."""
        page = self._pages.get(client) or self._enter(client)
        instructions: list[Instruction] = []
        held: list[Json] = []
        for message in messages:
            asked = read_json(message)
            if asked is None:
                client.end(1003, "JSON is expected: an object")
                return instructions
            answer = SILENT
            if isinstance(line := asked.get("ask"), str):
                instruction, answer = self._requests.line(now, page.asking, line, _heard(asked))
                instructions += [] if instruction is None else [instruction]
            elif isinstance(asked.get("held"), str):
                held.append(asked)
            elif "plot" in asked:
                why = self._requests.refused(now, page.asking, reads=True)
                answer = ViewAnswer(ok=False, text=why) if why else page.choose(asked["plot"], self.scene)
            else:
                for key in self._acts.keys() & asked.keys():
                    why = self._requests.refused(now, page.asking, reads=True)
                    answer = ViewAnswer(ok=False, text=why) if why else self._acts[key](asked[key])
            _answer(client, asked, answer)
        if held:
            newest = held[-1]
            begun, answer = self._requests.hold(now, page.asking, newest["held"], _heard(newest), len(held))
            instructions += begun
            _answer(client, newest, answer)
        return instructions

    def leave(self, clients: Sequence[Client]) -> list[Instruction]:
        """Forget pages that are not among these; return what ends what they held."""
        gone = [page for client, page in self._pages.items() if client not in clients]
        return [end for page in gone for end in self._requests.leave(self._pages.pop(page.client).asking)]

    def take(self, tick: Tick) -> None:
        """Take what is plotted of a tick, and send its notes."""
        for page in self._pages.values():
            page.take(self.scene)
        if any(isinstance(one, Set) for one in tick.inputs.instructions):
            self._settings_of = None
        for one in tick.outputs.notes:
            text = _text("note", note(tick.now, one))
            self._notes.append(text)
            for client in self._pages:
                client.send(text)

    def show(self, now: Nanos, clients: Sequence[Client]) -> None:
        """Greet who is new, and send what is due."""
        for client in clients:
            if client not in self._pages:
                self._enter(client)
        # Due at multiples of the period: a tick that is late must not make the next ones late.
        if now >= self._signals_due:
            self._signals_due = now - now % SIGNALS_PERIOD + SIGNALS_PERIOD
            for page in self._pages.values():
                page.client.sample("signals", partial(page.read, now))
                view = self.scene.belief.map
                if page.client.idle(now) and not self._send_mesh(page) and view is not None:
                    self._send_tiles(page, view)
        if now >= self._state_due:
            self._state_due = now - now % STATE_PERIOD + STATE_PERIOD
            self._slow(now)

    def _slow(self, now: Nanos) -> None:
        """Send what is sent ten times a second."""
        scene = self.scene
        self._sample("joints", _once(lambda: _text("joints", scene.joints())))
        self._sample("state", _once(lambda: _text("state", scene.state())))
        if scene.sightings:
            self._sample("camera", _once(lambda: _text("camera", scene.cameras())))
        pictures = {name: _once(partial(_picture, name, seen)) for name, seen in scene.pictures().items()}
        for page in self._pages.values():
            if pictures and now >= page.pictures and page.client.idle(now):
                page.pictures = now + PICTURES_PERIOD
                for name, picture in pictures.items():
                    page.client.sample(f"picture {name}", picture)
        if scene.scans:
            self._sample("scan", _once(partial(_scan, scene)))
        version, points = scene.belief.path_version, scene.belief.path
        path = _once(lambda: _binary("path", {"version": version}, np.asarray(points, dtype="<f4")))
        for page in self._pages.values():
            if page.path != version:
                page.path = version
                page.client.sample("path", path)
        if self._settings_of is not scene.gateway:
            self._settings_of = scene.gateway
            self._sample("settings", _once(lambda: _text("settings", {"rows": scene.settings()})))

    def _enter(self, client: Client) -> _Page:
        """Greet a page."""
        page = self._pages[client] = _Page(client, self._requests.enter())
        client.send(_text("hello", self.scene.hello() | {"steer": self._requests.steer}))
        client.send(_text("settings", {"rows": self.scene.settings()}))
        for text in self._notes:
            client.send(text)
        return page

    def _sample(self, key: str, message: Callable[[], Message]) -> None:
        for client in self._pages:
            client.sample(key, message)

    def _send_mesh(self, page: _Page) -> bool:
        """Send the next piece of the robot's meshes; return whether there was one."""
        (number, first), meshes = page.mesh, self.scene.figure.meshes
        if number >= len(meshes):
            return False
        mesh = meshes[number]
        page.mesh = (number, first + PIECE) if first + PIECE < len(mesh) else (number + 1, 0)
        low = mesh.min(axis=(0, 1))
        step = float((mesh.max(axis=(0, 1)) - low).max()) / 65535.0 or 1.0
        corners = np.round((mesh[first : first + PIECE] - low) / step).astype("<u2")
        header = {"mesh": number, "low": [float(one) for one in low], "step": step, "count": len(corners)}
        page.client.send(_binary("mesh", header, corners))
        return True

    def _send_tiles(self, page: _Page, view: MapView) -> None:
        """Send the tiles that a page does not have, some at a time; first that it has none, if they moved."""
        has = page.tiles
        moved = page.corner != view.corner or any(key not in view.tiles for key in has)
        if moved:
            page.corner = view.corner
            has.clear()
        new = [(key, tile) for key, tile in view.tiles.items() if has.get(key) is not tile][:MAX_TILES]
        if not new and not moved:
            return
        has.update(new)
        header = {
            "resolution": view.resolution,
            "corner": list(view.corner),
            "size": new[0][1].shape[0] if new else 0,
            "keys": [list(key) for key, _ in new],
            "reset": moved,
        }
        page.client.send(_binary("tiles", header, *(tile for _, tile in new)))


def _answer(client: Client, asked: Json, answer: ViewAnswer) -> None:
    """Answer a page, if there is an answer, with its own number of what it asked."""
    if answer.text:
        number = asked.get("id")
        shown = number if isinstance(number, int) and abs(number) < 1 << 53 else None
        held = {"held": True} if "held" in asked else {}
        client.send(_text("answer", {"id": shown, "ok": answer.ok, "text": answer.text} | held))


def _heard(asked: Json) -> Nanos | None:
    """Return the newest time of ours that a page had when it sent something; None: none."""
    clock = asked.get("heard")
    return clock * MILLISECOND if isinstance(clock, int) and clock >= 0 else None


def _once(make: Callable[[], Message]) -> Callable[[], Message]:
    """Return what makes a message once, for however many clients."""
    made: list[Message] = []

    def message() -> Message:
        if not made:
            made.append(make())
        return made[0]

    return message


def _scan(scene: Scene) -> bytes:
    mounts = lidar_mounts(scene.robot)
    lidars, ranges = [], list[npt.NDArray[np.float32]]()
    for name, scan in scene.scans.items():
        lidars.append(_lidar(scan, mounts[name]) | {"name": name, "poses": scene.swept[name]})
        ranges.append(np.asarray(scan.ranges, dtype="<f4"))
    return _binary("scan", {"lidars": lidars}, *ranges)


def _picture(name: str, seen: Seen) -> bytes:
    rows, columns, _ = seen.image.shape
    wide, tall = columns / 2.0 / seen.intrinsics.fx, rows / 2.0 / seen.intrinsics.fy
    header = {"name": name, "t": seen.t / SECOND, "wide": wide, "tall": tall}
    made = packed(seen.image, PICTURE_WIDTH, PICTURE_QUALITY)
    return _binary("picture", header, np.frombuffer(made, np.uint8))


def _lidar(scan: LaserScan, mount: tuple[float, float, float]) -> Json:
    x, y, yaw = mount
    return {
        "x": x,
        "y": y,
        "yaw": yaw,
        "t": scan.t / SECOND,
        "min": scan.angle_min,
        "step": scan.angle_increment,
        "count": len(scan.ranges),
        "near": scan.range_min,
        "far": scan.range_max,
    }


def _text(kind: str, content: Json) -> str:
    return json.dumps({"kind": kind} | content, separators=(",", ":"), allow_nan=False, default=float)


def _binary(kind: str, header: Json, *arrays: npt.NDArray[Any]) -> bytes:
    head = _text(kind, header).encode()
    head += b" " * (-len(head) % 4)
    return b"".join([struct.pack("<I", len(head)), head, *(array.tobytes() for array in arrays)])
