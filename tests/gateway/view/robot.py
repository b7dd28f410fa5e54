"""A robot on twins with its live view: `python -m tests.gateway.view.robot ROBOT [steer]`.

Its first line is the address. A line to its standard input is answered by a line of JSON; the end of it
ends the run.

| line | what it does |
|---|---|
| look | the true pose, the joints' velocities, and what the robot was asked, with the number of the tick |
| provoke MOTOR | the first fault that the device's specification lists |
| rest | releases, clears, drops and idles what there is; drives back from far away; then as look |
| forget | what it was asked is forgotten |
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Sequence
from typing import Any

import gateway
from gateway.core.tick import Tick
from gateway.operator import commands
from gateway.operator.commands import parse
from protocols.messages import SECOND, Drive, Goal, Instruction, Nanos, Stop, Torque, Velocity

FAR, HOME = 0.7, Goal(0.0, 0.0)
"""m from where it began, from where it drives back: what is held drives as long as a busy machine takes."""


class Robot:
    """A session that a test looks at."""

    def __init__(self, session: Any) -> None:
        self.session = session
        self.asked: list[tuple[int, str]] = []
        """But what is held, which comes 20 times a second."""
        self.held: tuple[int, str] = (0, "")
        self.stop: dict[str, Any] = {}
        """Of the last Stop: what each joint was sent in the tick before and in the tick that took it."""
        self.sent: dict[str, float] = {}
        self.number, self.now = 0, Nanos(0)
        self.lines: list[str] = []
        self.unread = b""
        self.ended = False

    def take(self, tick: Tick, _belief: object) -> None:
        """See a tick."""
        self.number, self.now = tick.number, tick.now
        for one in tick.inputs.instructions:
            if isinstance(one, Drive | Torque | Velocity):
                self.held = tick.number, repr(one)
            else:
                self.asked.append((tick.number, repr(one)))
        sent = {name: getattr(one.sent, "velocity", 0.0) for name, one in self.session.joints.items()}
        if any(isinstance(one, Stop) for one in tick.inputs.instructions):
            self.stop = {"before": self.sent, "after": sent}
        self.sent = sent

    def poll(self) -> Sequence[Instruction]:
        """Answer what a test has asked. Never waits."""
        try:
            data = os.read(0, 4096)
        except BlockingIOError:
            return ()
        self.ended = self.ended or not data
        *lines, self.unread = (self.unread + data).split(b"\n")
        for line in lines:
            print(json.dumps(self.answer(line.decode().split())), flush=True)
        asked_for, self.lines = self.lines, []
        return [
            asked for line in asked_for if isinstance(asked := parse(line, self.session.robot), Instruction)
        ]

    def answer(self, words: list[str]) -> dict[str, Any]:
        """Do what a line asks."""
        session, truth = self.session, self.session.twins.world.truth()
        far = math.hypot(truth.x, truth.y) > FAR
        if words[0] == "provoke":
            code = min(session.robot.motors[words[1]].spec.faults)
            session.twins.twin(words[1]).provoke(code)
            fault = session.robot.motors[words[1]].spec.faults[code]
            return {"name": fault.name, "cause": fault.cause, "remedy": fault.remedy}
        if words[0] == "rest":
            self.lines += ["release"] * bool(session.gateway.stopped)
            self.lines += ["clear all"] * bool(session.gateway.in_fault())
            goal = session.gateway.belief().goal
            self.lines += ["drop"] * (goal is not None and not (far and goal == HOME))
            self.lines += ["goal 0 0"] * (far and goal is None)
            bare = session.robot.brain.body.bare
            self.lines += [f"idle {name}" for name, joint in session.joints.items() if bare and joint.armed]
        if words[0] == "forget":
            self.asked.clear()
        speeds = {name: joint.feedback.velocity for name, joint in session.joints.items()}
        asked = {"asked": self.asked, "held": self.held, "stop": self.stop}
        return {
            "state": session.gateway.belief().state.value,
            "tick": self.number,
            "t": self.now / 1e9,
            "pose": (truth.x, truth.y),
            "far": far,
            "speeds": speeds,
        } | asked


def main(name: str, *words: str) -> None:
    """Run until standard input ends. What is held counts here however busy the machine is."""
    commands.FRESH = 60 * SECOND
    os.set_blocking(0, False)
    with gateway.open_session(name) as session:
        robot = Robot(session)
        session.watch(robot.take)
        print(session.view("0", steer="steer" in words), flush=True)
        for _ in session.run(poll=robot.poll):
            if robot.ended:
                break


if __name__ == "__main__":
    main(*sys.argv[1:])
