"""What devices say of themselves, for a person who watches them: modes and faults, in words.

Rules. Drivers of the devices' own languages listen. They speak only before anybody else is there (`meet`),
and say only what every unclaimed device may be asked: some tell what they are only to those who ask. Told is
what changes.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from gateway.core.robot import Robot
from gateway.core.step import by_plugin
from protocols.frames import Packet
from protocols.messages import MILLISECOND, Event, Fault, Mode, Nanos, State
from protocols.plugin import Driver

if TYPE_CHECKING:
    from gateway.buses import Bus

FIRST: Nanos = 500 * MILLISECOND
"""How long getting to know each other takes."""


class DeviceLog:
    """Listens to all devices of a robot."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._drivers: dict[str, list[Driver]] = {
            bus: [plugin.driver(devices) for plugin, devices in by_plugin(robot, bus)] for bus in robot.buses
        }
        self._modes: dict[str, Mode] = {}

    def meet(self, buses: Mapping[str, Bus]) -> Nanos:
        """Get to know the devices on buses of twins, while their world lives its first moments, from 0 on.

        Returns how old the world is then."""
        for now in range(0, FIRST, MILLISECOND):
            for name, bus in buses.items():
                self.handle(bus.read(now)[1])
                for driver in self._drivers[name]:
                    bus.write(now, driver.send(now, ())[1])
        return FIRST

    def handle(self, packets: Sequence[Packet]) -> list[tuple[int, str]]:
        """What there is to tell of what the devices have put on their buses: logging's level, sentence."""
        reported = []
        for packet in packets:
            for driver in self._drivers[packet.bus]:
                for event in driver.receive(packet.t, packet.frame):
                    reported += self._news(event)
        return reported

    def left_armed(self, bus: str) -> str:
        """What becomes of the armed motors of a bus whose host has gone; "" if there are none."""
        armed = [
            motor
            for name, motor in self._robot.motors.items()
            if motor.bus == bus and self._modes.get(name) is Mode.ARMED
        ]
        fates = []
        for motor in armed:
            watchdog = motor.spec.watchdog
            if watchdog.enabled and watchdog.timeout is not None:
                fates.append(
                    f"{motor.name} will be disarmed by its watchdog in {watchdog.timeout / MILLISECOND:g} ms"
                )
            else:
                fates.append(f"{motor.name} stays armed: its watchdog is off")
        return ", ".join(fates)

    def _news(self, event: Event) -> list[tuple[int, str]]:
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
