"""A recording without what says when, where and with which single devices it was made.

Rules. Times begin at 1 s. Of the facts, date, platform and names of files go. In the robot file, comments
go, ports are numbered, serial numbers and the datum are 0. What sensors of places on the earth sent is left
out, and so are scans for devices, whose answers have serial numbers. What remains is run anew. Maps, readings
of lidars and what a person typed stay.
"""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import count

from gateway.config import parse_robot
from gateway.core.tick import Inputs
from gateway.recording.environment import PACKAGE, PLUGIN, PROGRAM, SENSOR
from gateway.replay.input_log import InputLog, run
from protocols.frames import CanFrame, Packet, any_matches
from protocols.messages import SECOND, Fix, Scan

KEPT = (PROGRAM, PACKAGE, PLUGIN, SENSOR, "processor ", "machine", "numpy blas")
"""How the names of facts begin that stay: a replay needs them"""
_OUTSIDE_STRINGS = re.compile(
    r"\"{3}.*?\"{3}|'{3}.*?'{3}|\"(?:\\.|[^\"\\\n])*\"|'[^'\n]*'|(?P<comment>[ \t]*#[^\n]*)", re.DOTALL
)
_PORT = re.compile(r"""(?P<key>\binterface[ \t]*=[ \t]*["'])(?P<kind>\w+):[^"'\n]*""")
_NUMBER = re.compile(r"(?m)(?P<key>\b(?:serial_number|latitude|longitude)[ \t]*=[ \t]*)[-+\d._xXa-fA-F]+")


def anonymous(log: InputLog) -> tuple[InputLog, list[str]]:
    """Return inputs without time, place and serial numbers, and what was left out, in words.

    Raises ConfigError if the robot file cannot be read without them."""
    places = _places(log)
    told = [
        f"left out: all of bus {bus}, on which {name} told places on the earth"
        for bus, name in places.items()
    ]
    text = anonymous_text(log.robot_text)
    robot = parse_robot(text, "the anonymous robot.toml")
    specs = [one.spec for one in log.robot.devices()]
    answers = [mask for spec in specs for mask in spec.receives_also]
    own = [mask for spec in specs for mask in spec.expects]
    scans = sum(isinstance(one, Scan) for given in log.ticks for one in given.inputs.instructions)

    def is_kept(packet: Packet) -> bool:
        frame = packet.frame
        if packet.bus in places or not (scans and isinstance(frame, CanFrame)):
            return packet.bus not in places
        return any_matches(own, frame) or not any_matches(answers, frame)

    by = SECOND - log.ticks[0].now if log.ticks else 0
    ticks = []
    for given in log.ticks:
        states, packets, instructions = given.inputs.states, given.inputs.packets, given.inputs.instructions
        asked = tuple(one for one in instructions if not isinstance(one, Scan))
        inputs = Inputs(states, tuple(filter(is_kept, packets)), asked)
        ticks.append(given._replace(inputs=inputs).later(by))
    told += [f"left out: {scans} scans for devices"] * bool(scans)
    facts = {name: value for name, value in log.facts.items() if name.startswith(KEPT)}
    return replace(log, robot_text=text, robot=robot, facts=facts, ticks=ticks), told


def anonymous_text(robot_text: str) -> str:
    """Return a robot file without comments, ports, serial numbers and datum."""
    text = _OUTSIDE_STRINGS.sub(lambda found: "" if found["comment"] else found[0], robot_text)
    ports = count(1)
    text = _PORT.sub(lambda found: f"{found['key']}{found['kind']}:{next(ports)}", text)
    return _NUMBER.sub(lambda found: f"{found['key']}0", text)


def _places(log: InputLog) -> dict[str, str]:
    """Return the sensors that told places on the earth, by their buses."""
    found = {event.sensor for tick, _ in run(log) for event in tick.outputs.events if isinstance(event, Fix)}
    return {one.bus: one.name for one in log.robot.devices() if one.name in found}
