"""The live view: one port with the cockpit's page, its clients and Foxglove's, polled once per tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources

from brain.belief import Belief
from gateway.core.tick import Tick
from gateway.view.access import Access, Address
from gateway.view.cockpit import Act, Cockpit
from gateway.view.foxglove import Foxglove
from gateway.view.foxglove_wire import SUBPROTOCOLS
from gateway.view.requests import Requests
from gateway.view.scene import Scene
from gateway.view.server import Client, Page, Server
from protocols.messages import Instruction, Nanos, Stop

COCKPIT = "/cockpit"
"""Path of the cockpit's WebSocket; of the second scene "/cockpit/2"."""
FOXGLOVE = "/"
"""Path of Foxglove's, of the first scene."""
_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "json": "application/manifest+json",
}


class View:
    """One port. Use it as a context manager, or close it.

    Args:
        scenes: what is shown: one, or two beside each other. Requests go to the first.
        address: where to listen.
        access: who may connect.
        steer: whether clients may do more than look and stop.
        acts: what pages can ask that is no instruction of the robot, by its name.

    Raises:
        UserError: the address cannot be opened.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        address: Address,
        access: Access,
        *,
        steer: bool = False,
        acts: Mapping[str, Act] | None = None,
    ) -> None:
        self._requests = Requests(scenes[0].robot, steer, live=scenes[0].kind == "live")
        self._scenes = scenes
        for scene in scenes:
            _ = scene.figure  # read now: files take time, and pages come while the robot moves
        self._cockpits = {
            COCKPIT + f"/{number}" * (number > 1): Cockpit(scene, self._requests, acts or {})
            for number, scene in enumerate(scenes, 1)
        }
        foxglove = Foxglove(scenes[0], self._requests, acts or {})
        self._speakers: dict[str, Cockpit | Foxglove] = {**self._cockpits, FOXGLOVE: foxglove}
        subprotocols = {**dict.fromkeys(self._cockpits, ("",)), FOXGLOVE: SUBPROTOCOLS}
        self._server = Server(address, access, pages(), subprotocols)
        token = f"?token={access.token}" if access.token else ""
        page = "pair.html" if len(scenes) > 1 else ""
        self.url = f"http://{self._server.name}/{page}{token}"
        """What to open in a browser."""

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def poll(self, now: Nanos) -> list[Instruction]:
        """Return what clients ask of the robot since the last poll. Never waits.

        Args:
            now: any clock that keeps step with a person's: what is held times out by it.
        """
        instructions: list[Instruction] = []
        for client, messages in self._server.poll(now):
            instructions += self._speakers[client.path].receive(now, client, messages)
        for path, speaker in self._speakers.items():
            instructions += speaker.leave(self._clients(path))
        return instructions + self._requests.expired(now)

    def ends(self) -> list[Instruction]:
        """Return what ends all that is held, before the view is closed."""
        return self._requests.ends()

    def take(self, tick: Tick, belief: Belief, scene: int = 0) -> None:
        """Take a tick of one of the scenes: its notes are sent at once, all else when it is due."""
        self._scenes[scene].observe(tick, belief)
        if scene == 0:
            pressed = any(isinstance(one, Stop) for one in tick.inputs.instructions)
            self._requests.on_stop(self._scenes[0].gateway.why_stopped(), pressed=pressed)
        for speaker in self._speakers.values():
            if speaker.scene is self._scenes[scene]:
                speaker.take(tick)

    def show(self, now: Nanos) -> None:
        """Send clients what is due. Never waits."""
        for path, speaker in self._speakers.items():
            speaker.show(now, self._clients(path))
        self._server.flush(now)

    def close(self) -> None:
        """Send every client the end, and close the port."""
        self._server.close()

    def _clients(self, path: str) -> list[Client]:
        return [client for client in self._server.clients if client.path == path]


def pages() -> dict[str, Page]:
    """Return the pages by their paths: the files of `page/`, and "/" for its index."""
    folder = resources.files("gateway.view") / "page"
    found = {
        f"/{one.name}": Page(_KINDS[one.name.rpartition(".")[2]], one.read_bytes())
        for one in folder.iterdir()
        if one.name.rpartition(".")[2] in _KINDS
    }
    return found | {"/": found["/index.html"]} if "/index.html" in found else found
