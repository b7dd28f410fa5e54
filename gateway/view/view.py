"""The live view: one port with the cockpit's page and its clients, polled once per tick."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources

from brain.belief import Belief
from gateway.core.tick import Tick
from gateway.view.access import Access, Address
from gateway.view.cockpit import Act, Cockpit
from gateway.view.requests import Requests
from gateway.view.scene import Scene
from gateway.view.server import Page, Server
from protocols.messages import Instruction, Nanos

COCKPIT = "/cockpit"
"""Path of the cockpit's WebSocket."""
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
        scene: what is shown.
        address: where to listen.
        access: who may connect.
        steer: whether clients may do more than look and stop.
        acts: what pages can ask that is no instruction of the robot, by its name.

    Raises:
        UserError: the address cannot be opened.
    """

    def __init__(
        self,
        scene: Scene,
        address: Address,
        access: Access,
        *,
        steer: bool = False,
        acts: Mapping[str, Act] | None = None,
    ) -> None:
        self.scene = scene
        self._requests = Requests(scene.robot, steer)
        self._cockpit = Cockpit(scene, self._requests, acts or {})
        self._server = Server(address, access, pages(), {COCKPIT: ("",)})
        token = f"?token={access.token}" if access.token else ""
        self.url = f"http://{self._server.address}/{token}"
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
        for client, message in self._server.poll(now):
            instructions += self._cockpit.receive(now, client, message)
        instructions += self._cockpit.leave(self._server.clients)
        return instructions + self._requests.expired(now)

    def show(self, now: Nanos, tick: Tick, belief: Belief) -> None:
        """Send clients what a tick brought. Never waits."""
        self.scene.observe(tick, belief)
        self._cockpit.show(now, self._server.clients, tick)
        self._server.flush(now)

    def close(self) -> None:
        """Tell every client that it ends."""
        self._server.close()


def pages() -> dict[str, Page]:
    """Return the pages by their paths: the files of `page/`, and "/" for its index."""
    folder = resources.files("gateway.view") / "page"
    found = {
        f"/{one.name}": Page(_KINDS[one.name.rpartition(".")[2]], one.read_bytes())
        for one in folder.iterdir()
        if one.name.rpartition(".")[2] in _KINDS
    }
    return found | {"/": found["/index.html"]} if "/index.html" in found else found
