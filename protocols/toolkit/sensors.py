"""Sensors that stream on a serial line of their own: nothing on it is addressed, nothing is sent to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from protocols.bounds import Invalid
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos
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

    def measured(self, t: Nanos, message: bytes, host: Host[Own]) -> Event | Rx | None:
        """Take a message of the stream that came at t; return what it has measured, if it completes that."""
        raise NotImplementedError

    def state(self, t: Nanos, host: Host[Own]) -> tuple[str, tuple[int, ...]]:
        """Return how it is, for a person, and the codes of its faults, by what has come until t."""
        return "streams", ()

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Own]) -> Sequence[Report[Own] | Rx]:
        """Return what the messages report that a frame completes: one report of all after which the sensor is
        as it was before."""
        if not isinstance(frame, bytes) or self._stream is None:
            return (Rx.IGNORED,)
        (host,) = driver.hosts.values()
        reports: list[Report[Own] | Rx] = []
        events: list[Event] = []
        told, count = None, 0
        for one in self._stream.feed(frame):
            found = self.measured(t, one, host) if isinstance(one, bytes) else one
            if isinstance(found, Rx):
                reports.append(found)
                continue
            detail, faults = self.state(t, host)
            state = Mode.FAULT if faults else Mode.READY, detail, faults
            # What is measured is told behind a state that is new.
            if told and (state != told or (found is not None and not host.knows(*told[:2]))):
                reports.append(Report(host, host.address, *told, events=events, messages=count))
                events, count = [], 0
            if found is not None:
                events.append(found)
            told, count = state, count + 1
        if told:
            reports.append(Report(host, host.address, *told, events=events, messages=count))
        return reports

    def refuse(self, host: Host[Own], command: Command) -> str:
        return "a sensor takes no commands"

    def release(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        return ()
