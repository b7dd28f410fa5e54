"""/map and /map_updates: the map whole, or what has changed of it, as RViz takes them.

Rules. The map is drawn in slices, one version at a time (`gateway.view.foxglove_map`), at most 1 Hz. It is
sent whole to who comes, when its extent changes, and `WHOLE_PERIOD` after the last time; in between, if
everyone who takes the map takes updates, too, only the rectangle that changed, in bands of `BAND` cells, one
in a step. An update replaces cells of the map before it, whatever they were: the next map makes up for one
that is lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from brain.belief import MapView
from gateway.recording import ros_messages
from gateway.recording.ros_cdr import MAP as FRAME
from gateway.ros.types import encode, make, store
from gateway.view.foxglove_map import Drawing, MapLayout, Rectangle
from protocols.messages import SECOND, Nanos

MAP, UPDATES = "/map", "/map_updates"
UPDATE = "map_msgs/msg/OccupancyGridUpdate"
WHOLE_PERIOD: Nanos = 10 * SECOND
BAND = 1 << 16
"""Cells"""


class MapTopics:
    """What is drawn, and what of it is still to be sent.

    Args:
        publish: sends a message on a topic of the table.
        epoch: of the calendar, at our clock's zero.
    """

    def __init__(self, publish: Callable[[str, bytes], None], epoch: Nanos) -> None:
        self._publish, self._epoch = publish, epoch
        self._drawing = Drawing()
        self._layout: MapLayout | None = None
        """Of the newest map that was sent whole; None: the next one is"""
        self._whole_at: Nanos = 0
        self._bands: deque[Rectangle] = deque()

    def anew(self) -> None:
        """Send the newest version whole next: somebody has come."""
        self._drawing.anew()
        self._layout = None

    def show(self, now: Nanos, t: Nanos, view: MapView, takers: Mapping[str, int]) -> None:
        """Draw and send what is due. `t`: the time of the map; `takers`: how many take each topic."""
        drawing = self._drawing
        if self._bands:
            self._send_band(self._bands.popleft())
        elif drawing.draw(now, t, view):
            changed, whole_at = drawing.take_changes(), self._whole_at
            updated = takers.get(UPDATES, 0) >= takers.get(MAP, 0) and drawing.layout == self._layout
            if updated and now - whole_at < WHOLE_PERIOD:
                self._bands += changed.bands(BAND)
            else:
                self._layout, self._whole_at = drawing.layout, now
                self._send_whole()

    def _send_whole(self) -> None:
        layout, t = self._drawing.layout, self._drawing.t + self._epoch
        cells = self._drawing.cells
        self._publish(
            MAP, encode(ros_messages.grid(store().types, t, layout.resolution, layout.origin, cells))
        )

    def _send_band(self, band: Rectangle) -> None:
        header = ros_messages.header(store().types, self._drawing.t + self._epoch, FRAME)
        rows, columns = (
            slice(start, start + size) for start, size in ((band.y, band.height), (band.x, band.width))
        )
        cells = self._drawing.cells[rows, columns].reshape(-1)
        self._publish(UPDATES, encode(make(UPDATE, header=header, data=cells, **band._asdict())))
