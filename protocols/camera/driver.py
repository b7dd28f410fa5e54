"""The host's end: it listens. What a camera sees in its pictures comes as measurements, pixels never do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.camera import table
from protocols.camera.table import Picture
from protocols.messages import MILLISECOND, Marker, Nanos
from protocols.plugin import Device
from protocols.toolkit.host import Host
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.sensors import SensorAdapter


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    delay_ms: Annotated[float, Bounds(0.0, 500.0)] = 0.0
    """From the middle of a picture's exposure to its stamp, which is that of its last line"""
    offline_ms: Annotated[float, Bounds(50.0, 60_000.0)] = 1000.0
    """Time without a picture after which it is offline"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(slots=True)
class Pictures:
    """What is known of a camera. Plain data."""

    last: Picture | None = None
    """The newest one"""
    lost: int = 0
    """Pictures of which nothing came, since the start"""

    def forget(self) -> None:
        """Begin anew."""
        self.last = None

    def add(self, picture: Picture) -> None:
        """Take a picture; count those between it and the last."""
        ahead = 0 if self.last is None else (picture.number - self.last.number) & 0xFFFFFFFF
        self.lost += max(0, ahead - 1) if ahead < 1 << 31 else 0
        self.last = picture


class CameraAdapter(SensorAdapter[Pictures]):
    """What cameras report."""

    name, faults = table.NAME, table.FAULTS

    def __init__(self) -> None:
        super().__init__(table.FRAMING)

    def own(self, device: Device) -> Pictures:
        return Pictures()

    def measured(self, t: Nanos, message: bytes, host: Host[Pictures]) -> Marker | Rx | None:
        delay = round(host.options.delay_ms * MILLISECOND)
        found = table.decode(message, t - delay, host.name)
        if found is None:
            return Rx.MALFORMED
        picture, seen = found
        host.own.add(picture)
        return None if picture.faults & table.SIZE else seen

    def state(self, t: Nanos, host: Host[Pictures]) -> tuple[str, tuple[int, ...]]:
        picture, lost = host.own.last, host.own.lost
        if picture is not None and picture.faults:
            return picture.text, tuple(table.faults_of(picture.faults))
        return f"sees, {lost} pictures lost" if lost else "sees", ()
