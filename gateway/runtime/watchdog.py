"""The loop's end of the watchdog: a small process that sends the stop action if the loop dies or hangs.

Rules. It covers motors on buses that several processes can use at once (`BusSettings.shareable`); a port or
an adapter that is opened by this process alone leaves it no way. The frames are made here, by `rehearse`, and
passed the guard; they are made anew when what they depend on has changed, one driver per tick at most, and
handed over by a pipe that is never waited for. The other end is `gateway.runtime.watchdog_process`.
"""

from __future__ import annotations

import json
import logging
import os
import select
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple
from typing import TypeAlias

from gateway.core.clock import Clock
from gateway.core.joint import Joint
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from protocols.frames import CanFrame, Packet
from protocols.messages import MILLISECOND, Idle, Nanos

log = logging.getLogger("gateway")

BEATS = 10
"""Signs of life within the time that the loop may stand."""
CHANGING: Nanos = 20 * MILLISECOND
"""While a device is being armed or disarmed, its frames are made anew with this period."""
PLACE = 0.05
"""s at the limit of velocity: after such a way, the place to hold is another."""
LOAD = 0.05
"""Share of the limit of torque: after such a change, the torque to hold with is another."""
START = 20.0
"""s that the process may take to begin; a machine may have other things to do"""
END = 10.0
"""s that are waited for its end, however busy the machine is; after that it hangs, and is killed"""

State: TypeAlias = tuple[object, ...]


def covered(robot: Robot) -> list[str]:
    """Return the motors that the watchdog process can stop."""
    return [name for name, motor in robot.motors.items() if robot.buses[motor.bus].shareable]


class WatchdogProcess:
    """The process, started; `ready` waits for it."""

    def __init__(self, robot: Robot, clock: Clock) -> None:
        self._clock, self._limit = clock, robot.stall_timeout
        self._groups = {
            (bus, plugin.name): [one.name for one in devices if one.name in robot.motors]
            for bus, settings in robot.buses.items()
            if settings.shareable
            for plugin, devices in robot.by_protocol(bus)
        }
        """The motors of each driver."""
        self._known: dict[tuple[str, str], State] = {}
        """What the frames that were handed over depended on."""
        self._unsent = bytearray()
        self._sent: Nanos = 0
        """When the last line was handed over."""
        self._armed = False
        """Whether a motor was armed then."""
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "gateway.runtime.watchdog_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # what is sent to our group, or by our terminal, does not reach it
        )
        assert self._process.stdin is not None
        self._pipe: int | None = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)
        buses = [
            (name, bus.kind, bus.interface, bus.bitrate, bus.data_bitrate)
            for name, bus in robot.buses.items()
            if any(name == used for used, _ in self._groups)
        ]
        self._hand_over({"limit": self._limit, "buses": buses})

    def ready(self) -> str:
        """Wait until the process watches; return why it does not, "" if it does."""
        output = self._process.stdout
        assert output is not None
        began = select.select([output], [], [], START)[0]
        answer = output.readline().decode().strip() if began else f"it has not begun within {START:g} s"
        output.close()
        if answer == "ready":
            return ""
        self.close()
        return answer or "it could not be started"

    def beat(self, gateway: Gateway) -> str:
        """Tell that the loop goes on, and what to send if it does not.

        Returns "", or why the run must end: the loop has stood for so long that its motors were stopped."""
        if self._pipe is None or not self._flush():
            return ""
        made = self._made(self._clock.now(), gateway)
        now = self._clock.now()
        if not made and now - self._sent < self._limit // BEATS:
            return ""
        self._hand_over(made)
        stood, was_armed = self._clock.now() - self._sent, self._armed
        self._sent, self._armed = now, any(joint.owned and joint.armed for joint in gateway.joints.values())
        if stood <= self._limit or not was_armed:
            return ""
        stood_ms, limit_ms = round(stood / MILLISECOND), round(self._limit / MILLISECOND)
        return f"the loop has stood for {stood_ms} ms: after {limit_ms} ms the watchdog stops the motors"

    def rest(self) -> None:
        """Tell that the loop has left: nothing is sent until it begins again."""
        self._known.clear()
        self._armed = False
        self._hand_over(None)

    def close(self) -> None:
        """Let the process end."""
        self._pipe = None
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                pipe.close() if pipe is not None else None
        try:
            self._process.wait(END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _made(self, now: Nanos, gateway: Gateway) -> dict[str, Sequence[object]]:
        """Return the frames of the first driver whose state has changed, by its name; {} if none has."""
        for (bus, protocol), motors in self._groups.items():
            state = _state(now, [gateway.joints[name] for name in motors])
            if state == self._known.get((bus, protocol), ()):
                continue
            self._known[bus, protocol] = state
            try:
                packets = gateway.rehearse(now, bus, protocol)
            except Exception as error:  # noqa: BLE001 -- a plugin's; what was handed over before stays
                log.error("the watchdog has no new frames for %s on %s: %r", protocol, bus, error)
                return {}
            return {f"{bus} {protocol}": _frames(packets)}
        return {}

    def _hand_over(self, line: Mapping[str, object] | None) -> None:
        self._unsent += json.dumps(line).encode() + b"\n"
        self._flush()

    def _flush(self) -> bool:
        """Hand over what waits; True if nothing does."""
        if self._pipe is not None and self._unsent:
            try:
                del self._unsent[: os.write(self._pipe, self._unsent)]
            except BlockingIOError:  # it does not read: it is stopped, or has no processor
                pass
            except OSError:
                self._pipe = None
                log.error("the watchdog process has ended: if this program dies, it stops no motor")
        return not self._unsent


def _state(now: Nanos, joints: Sequence[Joint]) -> State:
    """Return what the stop action of joints depends on; () before any was commanded."""
    return tuple(_of_joint(now, joint) for joint in joints if joint.owned)


def _of_joint(now: Nanos, joint: Joint) -> State:
    sent = joint.sent
    changing = now // CHANGING if joint.armed is isinstance(sent, Idle) else 0
    held: State = ()
    settings = joint.settings
    if joint.armed and settings.stop_action == "hold" and settings.unattended == "held":
        limits = settings.limits
        place = (joint.feedback.position or 0.0) / (PLACE * limits.velocity)
        held = round(place), round(getattr(sent, "torque", 0.0) / (LOAD * limits.torque))
    return joint.name, joint.armed, joint.mode, type(sent), tuple(joint.faults), changing, held


def _frames(packets: Sequence[Packet]) -> Sequence[object]:
    """Return the frames as JSON has them: bus, id, data, then the flags."""
    made = []
    for packet in packets:
        assert isinstance(packet.frame, CanFrame)
        number, data, *flags = astuple(packet.frame)
        made.append((packet.bus, number, data.hex(), *flags))
    return made
