"""Another program's log of CAN → a recording of ours, so that it can be looked at as one.

Rules. Its frames are what the robot's buses brought; those to its devices are left out, since they would be
another host's commands. The brain is asked nothing, and what the step would have sent itself (questions,
mostly) is in the recording as its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from gateway.buses.log_file import logged, summary
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Tick
from gateway.errors import UserError
from gateway.monitor.heard import places
from gateway.recording import Recorder
from protocols.frames import BusState, CanFrame, Frame, IdSet, Packet, id_number
from protocols.messages import SECOND, Nanos


def record_log(path: Path, robot: Robot, made: Path) -> None:
    """Write a log as a recording.

    Args:
        path: the log.
        robot: whose devices were on its buses.
        made: the new file.

    Raises:
        UserError: it is no log, or of other buses.
        RecordingError: it cannot be written.
    """
    recorder = Recorder(made, robot.text, {"log": path.name})
    try:
        gateway = Gateway(robot)
        for tick in _ticks(path, robot, gateway):
            recorder.record(tick, gateway.belief(), patient=True)
    finally:
        recorder.close()


def _ticks(path: Path, robot: Robot, gateway: Gateway) -> Iterator[Tick]:
    log = summary(path)
    buses = places(robot, log, path)
    specs = {bus: [one.spec for one in robot.devices_on(bus)] for bus in buses.values()}
    sends = {bus: IdSet(ids for one in those for ids in one.sends) for bus, those in specs.items()}
    expects = {bus: IdSet(ids for one in those for ids in one.expects) for bus, those in specs.items()}
    states = tuple((bus, BusState.UP) for bus in buses.values())
    period: Nanos = robot.period
    waiting: list[Packet] = []
    number, now = 0, period

    def step() -> Tick:
        inputs = Inputs(states if number == 0 else (), tuple(waiting))
        return Tick(number, now, inputs, gateway.step(now, inputs))

    with suppress(UserError):  # what can be read of it is shown; the caller tells the rest
        for packet, sent in logged(path):
            bus, t = buses.get(packet.bus), packet.t - log.began
            while t > now:
                yield step()
                waiting.clear()
                number, now = number + 1, now + period
                if t - now > SECOND and not waiting:  # a pause in the log
                    now = t
            if bus is not None and not sent and not _asks(packet.frame, sends[bus], expects[bus]):
                waiting.append(replace(packet, t=t, bus=bus))
    yield step()


def _asks(frame: Frame, sends: IdSet, expects: IdSet) -> bool:
    """True if a frame is one to a device; a question by a remote frame has the id of its answer."""
    if not isinstance(frame, CanFrame):
        return False
    number = id_number(frame)
    return number in sends and (frame.remote or number not in expects)
