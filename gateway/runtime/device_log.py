"""The log of simulated devices: changes of their states and faults, in words.

Rules. Drivers of the devices' own protocols decode what the devices send. The drivers send only before any
other program is there (`warm_up`), and only read-only frames: some devices identify themselves only when
polled. Only changes are logged.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from gateway.core.robot import Robot
from protocols.frames import Packet
from protocols.line import Ended, Line
from protocols.messages import MILLISECOND, Event, Fault, Mode, Nanos, State
from protocols.plugin import Driver, LineDriver

if TYPE_CHECKING:
    from gateway.buses import Bus

WARM_UP: Nanos = 500 * MILLISECOND
"""How long the drivers may identify the devices."""


class DeviceLog:
    """Decodes what all devices of a robot send."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._drivers: dict[str, list[Driver]] = {
            bus: [plugin.driver(devices) for plugin, devices in robot.by_protocol(bus)] for bus in robot.buses
        }
        self._modes: dict[str, Mode] = {}

    def warm_up(self, buses: Mapping[str, Bus]) -> Nanos:
        """Identify the devices on simulated buses, from time 0 on; return the world's age afterwards."""
        lines = {
            name: Line(bus.baudrate, half_duplex=bus.line == "half-duplex", slack=2 * MILLISECOND)
            for name, bus in self._robot.buses.items()
            if bus.line != "free"
        }
        for now in range(0, WARM_UP, MILLISECOND):
            for name, bus in buses.items():
                packets = bus.read(now)[1]
                if name in lines:
                    bus.write(now, self._exchange(now, lines[name], self._drivers[name], packets))
                    continue
                self.update(packets)
                for driver in self._drivers[name]:
                    bus.write(now, driver.send(now, ())[1])
        return WARM_UP

    def _exchange(
        self, now: Nanos, line: Line, drivers: Sequence[Driver], packets: Sequence[Packet]
    ) -> list[bytes]:
        """Decode what came on a line; return what is sent on it now."""
        ended: list[Ended] = []
        for packet in packets:
            if isinstance(packet.frame, bytes):
                ended += line.receive(packet.t, packet.frame)[0]
        for each in (*ended, *line.expire(now)):
            driver: LineDriver = drivers[each.owner]  # type: ignore[assignment]
            for event in driver.answer(now, each.exchange, each.data):
                self._change(event)
        for owner, one in enumerate(drivers):
            line.put(owner, [frame for frame in one.send(now, ())[1] if isinstance(frame, bytes)])
        return [bytes(frame) for _, frame in line.take(now)]

    def update(self, packets: Sequence[Packet]) -> list[tuple[int, str]]:
        """Decode packets of the devices; return (logging level, text) for each change."""
        changes = []
        for packet in packets:
            for driver in self._drivers[packet.bus]:
                for event in driver.receive(packet.t, packet.frame):
                    changes += self._change(event)
        return changes

    def left_armed(self, bus: str) -> str:
        """Return what becomes of the armed motors of a bus whose host is gone; "" if none is armed."""
        armed = [
            motor
            for name, motor in self._robot.motors.items()
            if motor.bus == bus and self._modes.get(name) is Mode.ARMED
        ]
        outcomes = []
        for motor in armed:
            watchdog = motor.spec.watchdog
            if watchdog.enabled and watchdog.timeout is not None:
                outcomes.append(
                    f"{motor.name} will be disarmed by its watchdog in {watchdog.timeout / MILLISECOND:g} ms"
                )
            else:
                outcomes.append(f"{motor.name} stays armed: its watchdog is off")
        return ", ".join(outcomes)

    def _change(self, event: Event) -> list[tuple[int, str]]:
        if isinstance(event, State):
            before = self._modes.get(event.motor)
            self._modes[event.motor] = event.mode
            if before is event.mode:
                return []
            detail = f" ({event.detail})" if event.detail else ""
            level = logging.WARNING if event.mode is Mode.FAULT else logging.INFO
            return [(level, f"{event.motor}: {event.mode}{detail}")]
        if isinstance(event, Fault):
            return [(logging.WARNING, f"{event.motor}: fault: {event.name}")]
        return []
