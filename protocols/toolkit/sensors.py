"""Sensors that stream on a serial line of their own: nothing on it is addressed, nothing is sent to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from protocols.bounds import Invalid
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Nanos
from protocols.plugin import Device, FeedbackKind, Range, Spec, Watchdog
from protocols.toolkit.host import Host, Own, Report
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import MotorDriver, Rx

ADDRESS = 1
"""Of the sensor of a line."""


def nothing(_: Frame) -> bool:
    """Return False: there is nothing that may be sent to it."""
    return False


def serial_sensor(device: Device, ranges: Mapping[str, Range], period: Nanos, **others: Any) -> Spec:  # noqa: ANN401
    """Return the spec of a sensor that is offline after `offline_ms` of its options. Raises ValueError for an
    address that it cannot have.

    Args:
        device: the sensor.
        ranges: what its readings can carry, as in `Spec`.
        period: at which it reports, at the slowest.
        others: its other fields.
    """
    if device.address != ADDRESS:
        text = f"address {device.address} of {device.name}: it must be 1, one sensor is on a line"
        raise Invalid(("address", text))
    usual: dict[str, Any] = {
        "bus": "serial",
        "kind": "sensor",
        "sends": (),
        "expects": (),
        "read_only": nothing,
        "feedback": FeedbackKind.CYCLIC,
        "feedback_period": period,
        "offline_after": round(device.options.offline_ms * MILLISECOND),
        "commands": frozenset(),
        "requests": frozenset(),
        "ranges": ranges,
        "watchdog": Watchdog(None, enabled=False),
        "holds_unattended": False,
        "stop_clears_faults": False,
    }
    return Spec(**usual | others)


class SensorAdapter(LineAdapter[Own]):
    """What a protocol adds to `MotorDriver` for such a sensor."""

    def measured(self, t: Nanos, message: bytes, host: Host[Own]) -> Report[Own] | Rx:
        """Return what a message of the stream reports."""
        raise NotImplementedError

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Own]) -> Sequence[Report[Own] | Rx]:
        if not isinstance(frame, bytes) or self._stream is None:
            return (Rx.IGNORED,)
        (host,), found, told = driver.hosts.values(), list[Report[Own] | Rx](), None
        for one in self._stream.feed(frame):
            report = self.measured(t, one, host) if isinstance(one, bytes) else one
            if isinstance(report, Report):
                state = report.mode, report.detail, report.faults
                if state == told and not report.events:
                    report = Rx.TOLD
                told = state
            found.append(report)
        return found

    def refuse(self, host: Host[Own], command: Command) -> str:
        return "a sensor takes no commands"

    def release(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        return ()
