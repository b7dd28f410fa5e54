"""The loop's end of the graph: ticks → messages, and what comes from others → instructions of the next tick.

Rules. Polled and fed once per step, as the live view is, and never waits: the pipe's other end has the
sockets. A message is made only if somebody listens. Times in headers are of the calendar (`epoch` after our
clock's zero), and /clock has them for who follows a robot in slow motion, or a recording. Whatever comes,
nothing here raises: what is refused is in the log and in /rosout, once, until it is not any more.

| what comes | answer |
|---|---|
| a command of which the publisher falls silent | what it held ends, after `[ros] cmd_vel_timeout_ms` |
| a second publisher of it | counts for nothing, until the first is silent |
| more than one in a step | the newest counts |
| goals, trajectories, requests beyond 20 a second | refused |
| a number that is not finite, another type's bytes | refused |
| whatever moves, against a stop or soon after a person | refused, until it has let go |
| our process with the sockets dies | what was held ends; the robot runs on |
"""

from __future__ import annotations

import logging
import select
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import dist, pi
from typing import Any

import numpy as np

from brain.belief import Belief, BrainState
from gateway.config.mission import cannot
from gateway.core.robot import Robot
from gateway.core.tick import Note, Tick
from gateway.errors import UserError
from gateway.recording import ros_messages
from gateway.recording.ros_views import OF_SENSORS, ViewMessage, Views
from gateway.ros import actions, asked, graph, images, parameters, trajectory, types
from gateway.ros.actions import ABORTED, CANCELED, CANCELING, EXECUTING, SUCCEEDED, Action, Token
from gateway.ros.asked import Held
from gateway.ros.graph import FOLLOW, NAVIGATE, Row
from gateway.ros.images import Camera, ImageTopics
from gateway.ros.link import Link
from gateway.ros.map_topics import MAP, UPDATES, MapTopics
from gateway.ros.types import decode, encode, make
from gateway.view.requests import Budget, Requests
from gateway.view.scene import Scene
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Goal, Instruction, Nanos

log = logging.getLogger("gateway")

MAP_TOPICS = frozenset((MAP, UPDATES))
CLOCK, ROSOUT = "/clock", "/rosout"
CLOCK_PERIOD: Nanos = 20 * MILLISECOND
FEEDBACK_PERIOD: Nanos = 200 * MILLISECOND
LATE: Nanos = 100 * MILLISECOND
"""After which who has come gets what there is."""
TAKEN: Nanos = 2 * SECOND
"""Within which the robot must have taken a goal."""
PER_SECOND, AT_ONCE = 20, 40
"""Goals, trajectories and requests that are granted,"""
IN_A_STEP, MOST_WAITING = 4, 200
"""and that are looked at in one step, and wait for the next; a stop does not."""
BYTES_IN_A_STEP = 8192
"""Of these, after which no further one is looked at in a step; a request for parameters counts as so many."""
MOST_REASONS = 10
"""Why something of one name is refused, that are said before any of it is done again."""
STOP = "~/stop"
START_S, END_S = 60.0, 2.0
"""How long the process may take to begin, and to end."""
ARRIVED, SETTLING = 0.05, 2.0
"""rad by which a joint may be off when a trajectory is over, and s that it may take, unless the goal says."""
WAIT = "it was not taken"
MOVES = (msg.Goal, msg.Drive, msg.Mission, msg.Resume, msg.Stop, *msg.COMMANDS)
"""What of a person is above us."""
MAP_EVERY: Nanos = SECOND
"""A map that comes sooner after the last waits so long, or until a newer one comes in its place: planning
on a large one takes part of a step"""
PATH_VIOLATED, GOAL_VIOLATED = -4, -5
NAV_UNKNOWN = 9000


@dataclass(slots=True)
class _Navigation:
    """The goal of navigate_to_pose under way."""

    goal: actions.Goal
    mission: str
    began: Nanos
    asked: Goal
    seen: bool = False
    told: Nanos = 0


@dataclass(slots=True)
class _Motion:
    """A trajectory under way; of an action, or of a topic (None)."""

    follower: trajectory.Follower
    goal: actions.Goal | None
    tolerances: dict[str, float]
    path_tolerances: dict[str, float]
    settling: Nanos
    told: Nanos = 0
    arrived: bool = False
    """Whether its last sample was given."""


def open_bridge(
    scene: Scene, address: str, domain: int, epoch: Nanos, cameras: Sequence[Camera] = ()
) -> Bridge:
    """Return the bridge once its process has opened the network. `cameras`: whose images are shown.

    Raises UserError if it cannot be opened, or the robot file remaps what there is not."""
    names = [one.name for one in cameras]
    rows = graph.rows(scene.robot, steers=scene.kind == "live", cameras=names)
    ours, theirs = socket.socketpair()
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "gateway.ros.process"],
            stdin=theirs.fileno(),
            start_new_session=True,  # what is sent to our group, or by our terminal, does not reach it
        )
    link = Link(ours)
    link.send(*setup(scene.robot, rows, address, domain))
    first: list[list[Any]] = []
    while not first and not link.closed and select.select([link], [], [], START_S)[0]:
        first = link.receive()
    if not first or first[0][0] != "opened":
        link.close()
        process.kill()
        process.wait()
        raise UserError(f"--ros: {first[0][1] if first else 'its process has not begun'}")
    return Bridge(scene, rows, link, process, first[0][1], epoch, first[1:], cameras)


def setup(robot: Robot, rows: Sequence[Row], address: str, domain: int) -> Sequence[Any]:
    """Return what the process with the sockets has to know: the fields of its `Setup`."""
    described = [
        (r.kind, r.shown, r.type, r.hash, r.qos.reliable, r.qos.transient, r.qos.depth) for r in rows
    ]
    return address, domain, graph.node_name(robot), robot.ros.namespace, described


class Bridge:
    """A robot in the graph. Made by `open_bridge`.

    `process`: with the sockets; None if this one has the pipe's other end, too."""

    def __init__(
        self,
        scene: Scene,
        rows: Sequence[Row],
        link: Link,
        process: subprocess.Popen[bytes] | None,
        where: str,
        epoch: Nanos,
        first: Sequence[list[Any]] = (),
        cameras: Sequence[Camera] = (),
    ) -> None:
        self.scene, self.where = scene, where
        self.rows = rows
        self._link, self._process, self._epoch = link, process, epoch
        self._early = list(first)
        self._index = {row.name: i for i, row in enumerate(rows) if row.kind == "publish"}
        self._serves = {row.name: i for i, row in enumerate(rows) if row.kind == "serve"}
        self._counts: dict[int, int] = {}
        self.wanted: set[str] = set()
        """Topics that somebody listens to,"""
        self._in_ticks: set[str] = set()
        """and those that are made of each tick: all but map and images, which are sent in slices."""
        self._store = types.store()
        parts = {"serve": ("_Request", "_Response")}
        types.prepare(f"{row.type}{part}" for row in rows for part in parts.get(row.kind, ("",)))
        self._gateway = scene.gateway
        self._mounts = {name: sensor.mount for name, sensor in scene.robot.sensors.items()}
        self._mounts |= {images.frame(one.name): images.optical(one.mount) for one in cameras}
        self._views = Views(self._mounts, self._store, self._in_ticks, epoch=epoch)
        self._views.prepare()
        may_drop = partial(self._publish, may_drop=True)
        self._map = MapTopics(may_drop, epoch)
        self._images = ImageTopics(cameras, self._index, link, may_drop, epoch)
        self._sliced = MAP_TOPICS | self._images.names
        self._new: set[str] = set()
        """Topics that somebody has begun to listen to: who comes gets what there is now, but no old scan."""
        self._new_at: Nanos = 0
        self._clock_at: Nanos = -CLOCK_PERIOD
        self._troubles: dict[str, set[str]] = {}
        self._requests = Requests(scene.robot, steer=True, live=scene.kind == "live")
        self._asking = self._requests.enter()
        self._budget = Budget(PER_SECOND, AT_ONCE)
        timeout = scene.robot.ros.cmd_vel_timeout
        self._held = {name: Held(timeout) for name in ("/cmd_vel", *graph.JOINT_COMMANDS)}
        self._instructions: list[Instruction] = []
        self._waiting: deque[Sequence[Any]] = deque()
        """Goals and requests that are still to be looked at."""
        self._settings: Sequence[Any] = ()
        """As they were read last; empty after a change"""
        self._zeroing: dict[str, list[Token]] = {}
        """Who waits for an answer, by motor"""
        self._stopped = ""
        self._warned = ""
        """The last warning of the robot."""
        self._actions = {
            name: Action(name, type_, self._publish, self._answer)
            for name, type_ in (("/navigate_to_pose", NAVIGATE), (_FOLLOW, FOLLOW))
            if f"{name}/_action/send_goal" in self._serves
        }
        self._offered: tuple[Row, Any] | None = None
        """A map that is to be planned on, and waits"""
        self._map_from: Nanos = 0
        """until then."""
        self._navigation: _Navigation | None = None
        self._motion: _Motion | None = None
        self._describe()

    # -- what the loop calls ------------------------------------------------------------------------

    def poll(self, now: Nanos, others: Sequence[Instruction] = ()) -> list[Instruction]:
        """Return what is asked since the last poll. Never waits. Raises BrokenPipeError if the process with
        the sockets is gone: then `ends` has what ends all.

        Args:
            now: any clock that keeps step with a person's: what is held times out by it.
            others: what persons ask in this step.
        """
        if any(isinstance(one, MOVES) for one in others):
            for held in self._held.values():
                held.on_person(now)
            self._end_motion("a person has the robot")  # a mission is paused by it, and then ends
        messages, self._early = [*self._early, *self._link.receive()], []
        for message in self._newest(messages):
            if message[0] == "match":
                self._matched(now, *message[1:])
            elif self._is_at_once(message):
                self._use(now, *message)
            elif len(self._waiting) < MOST_WAITING:
                self._waiting.append(message)
        count = size = 0
        while self._waiting and count < IN_A_STEP and size < BYTES_IN_A_STEP:
            waited = self._waiting.popleft()
            asks_much = self.rows[waited[1]].type in graph.PARAMETERS.values()
            count, size = count + 1, size + (BYTES_IN_A_STEP if asks_much else len(waited[2]))
            self._use(now, *waited)
        if self._offered is not None and now >= self._map_from:
            (row, message), self._offered, self._map_from = self._offered, None, now + MAP_EVERY
            self._guarded(self.rows.index(row), partial(self._plan_on, row, message))
        for name, held in self._held.items():
            if held.ended(now):
                self._say(
                    name, f"its publisher has been silent for {held.timeout // MILLISECOND} ms: it ends"
                )
                self._let_go(name)
        if self._link.closed:
            raise BrokenPipeError("the process with the sockets has ended")
        self._follow()
        asked_, self._instructions = self._instructions, []
        return asked_

    def take(self, tick: Tick, belief: Belief) -> None:
        """Publish what a tick brought, as far as somebody listens."""
        self.scene.observe(tick, belief)
        pressed = any(isinstance(one, msg.Stop) for one in tick.inputs.instructions)
        if any(isinstance(one, msg.Set) for one in tick.inputs.instructions):
            self._settings = ()
        self._stopped = self.scene.gateway.why_stopped()
        self._requests.on_stop(self._stopped, pressed=pressed)
        for held in self._held.values():
            held.on_stop(self._stopped)
        if self._stopped:
            self._end_motions(f"stopped: {self._stopped}")
        for note in tick.outputs.notes:
            if note.level != "info":
                self._warned = note.text
        if self._zeroing:
            self._zeroed(tick.outputs.events)
        if self.scene.gateway is not self._gateway:
            self._gateway = self.scene.gateway
            self._views.reset()
            self._settings = ()
        if self._in_ticks:
            self._send(self._views.messages(tick, belief))
        if CLOCK in self.wanted and not 0 <= tick.now - self._clock_at < CLOCK_PERIOD:
            self._clock_at = tick.now
            self._publish(CLOCK, encode(make(graph.CLOCK, clock=self._stamp(tick.now))))
        self._navigate()

    def show(self, now: Nanos) -> None:
        """Send what is due: the map, and what is latched to who has come. Never waits."""
        if self._new and now - self._new_at >= LATE:
            if MAP_TOPICS & self._new:
                self._map.anew()
            self._views = Views(self._mounts, self._store, self._in_ticks, epoch=self._epoch)
            present = self._views.messages(self.scene.present(), self.scene.belief)
            self._send([one for one in present if one.topic in self._new])
            self._new.clear()
        view = self.scene.belief.map if MAP_TOPICS & self.wanted else None
        if view is not None:
            takers = {name: self._counts.get(self._index[name], 0) for name in MAP_TOPICS}
            self._map.show(now, self.scene.now, view, takers)
        self._images.show(self.wanted)
        self._link.flush()

    def ends(self) -> list[Instruction]:
        """Return what ends all that is held."""
        self._instructions.clear()
        for name, held in self._held.items():
            if held.moves:
                self._let_go(name)
            held.moves, held.writer = False, b""
        ended, self._instructions = self._instructions, []
        return ended

    def close(self) -> None:
        """Leave the graph."""
        self._link.close()
        if self._process is None:
            return
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _is_at_once(self, message: Sequence[Any]) -> bool:
        """Return whether a message waits for no other: a stream's, and a stop."""
        row = self.rows[message[1]]
        return row.name == STOP or (message[0] == "sample" and not row.qos.reliable)

    def _use(self, now: Nanos, kind: str, row: int, *rest: Any) -> None:  # noqa: ANN401 -- as they came
        use = self._sample if kind == "sample" else self._request
        self._guarded(row, partial(use, now, self.rows[row], *rest))

    def _newest(self, messages: Sequence[list[Any]]) -> Sequence[list[Any]]:
        """Return messages without samples of a stream that a newer one follows."""
        if len(messages) < 2:  # as in nearly every step
            return messages
        last: dict[object, int] = {}
        for i, one in enumerate(messages):
            stream = one[0] == "sample" and not self.rows[one[1]].qos.reliable
            last[(one[1], one[3]) if stream else i] = i
        return [messages[i] for i in sorted(last.values())]

    # -- what goes out ------------------------------------------------------------------------------

    def _publish(self, name: str, data: bytes, *, may_drop: bool = False) -> None:
        index = self._index.get(name)
        if index is not None:
            self._link.send("publish", index, data, may_drop=may_drop)

    def _answer(self, name: str, data: bytes, token: Token) -> None:
        self._link.send("answer", self._serves[name], data, token)

    def _send(self, views: Sequence[ViewMessage]) -> None:
        for view in views:
            self._publish(view.topic, view.data, may_drop=view.topic != ROSOUT)

    def _describe(self) -> None:
        text = self.scene.robot.description
        if text:
            self._publish("/robot_description", encode(make(graph.STRING, data=text)))

    def _matched(self, now: Nanos, index: int, count: int) -> None:
        before, self._counts[index] = self._counts.get(index, 0), count
        row = self.rows[index]
        if row.kind != "publish":
            return
        (self.wanted.add if count else self.wanted.discard)(row.name)
        if row.name not in self._sliced:
            (self._in_ticks.add if count else self._in_ticks.discard)(row.name)
        if count > before and row.name not in OF_SENSORS:
            self._new.add(row.name)
            self._new_at = now

    def _stamp(self, t: Nanos) -> Any:  # noqa: ANN401 -- a message
        return ros_messages.stamp(self._store.types, t + self._epoch)

    def _say(self, name: str, why: str) -> None:
        """Log why something is refused, each reason once, and not too many; "" ends that."""
        known = self._troubles.setdefault(name, set())
        if not why:
            known.clear()
        elif why not in known and len(known) < MOST_REASONS:
            known.add(why)
            log.warning("ROS 2: %s: %s", name, why)
            note = Note("warning", "ros", f"{name}: {why}")
            said = ros_messages.log(self._store.types, self.scene.now + self._epoch, note)
            self._publish(ROSOUT, encode(said))

    # -- what comes in ------------------------------------------------------------------------------

    def _guarded(self, row: int, use: Callable[[], None]) -> None:
        """Use what came; what is wrong with it is said."""
        name = self.rows[row].name
        try:
            use()
        except (types.Malformed, asked.Refused, trajectory.Refused) as error:
            self._say(name, str(error))
        except (AttributeError, TypeError, ValueError, OverflowError, KeyError) as error:
            self._say(name, f"nothing was done: {type(error).__name__}: {error}")

    def _plan_on(self, row: Row, message: Any) -> None:  # noqa: ANN401 -- a message
        self._instructions.append(asked.grid(self.scene.robot, message))
        self._say(row.name, "")

    def _sample(self, now: Nanos, row: Row, payload: bytes, writer: bytes, count: int) -> None:  # noqa: ARG002
        if row.qos.reliable:
            self._allow(now)
        self._checked(row, payload)
        message: Any = None if row.type == graph.TRAJECTORY else decode(row.type, payload)
        match row.name:
            case "/cmd_vel":
                twist = message.twist if row.type == graph.TWIST_STAMPED else message
                drive = asked.drive(self.scene.robot, twist)
                rests = not (drive.linear or drive.angular or drive.lateral)
                self._hold(now, row.name, writer, [drive], rests=rests)
            case "/goal_pose":
                goal = asked.goal(self.scene.robot, message)
                self._check_stop()
                self._end_motions("another goal has come")
                self._take_over()
                self._instructions += [*self._dropped(), goal]
                self._say(row.name, "")
            case "/map":
                self._offered = row, message
            case "/initialpose":
                self._instructions.append(asked.located(self.scene.robot, message))
                self._say(row.name, "")
            case graph.TRAJECTORIES:
                self._check_stop()
                self._begin_motion(self._read(trajectory.unpacked(payload)[0]), None)
                self._say(row.name, "")
            case name:
                kind = graph.JOINT_COMMANDS[name]
                wanted = asked.targets(self.scene.robot, kind, message.data)
                rests = kind != "position" and not any(message.data)
                self._hold(now, name, writer, wanted, rests=rests)

    def _hold(
        self, now: Nanos, name: str, writer: bytes, wanted: Sequence[Instruction], *, rests: bool
    ) -> None:
        waits = self.scene.belief.state is BrainState.INITIALISING
        why = "the robot is not ready yet" if waits and not rests else ""
        changes, refused = (False, why) if why else self._held[name].take(now, writer, rests=rests)
        self._say(name, refused)
        if changes:
            if not (name == "/cmd_vel" and self.scene.robot.brain.pursuit.given):  # it drives to that goal
                self._end_motions(f"{name} moves the robot")
            self._instructions += wanted

    def _let_go(self, name: str) -> None:
        if name == "/cmd_vel":
            self._instructions.append(msg.Drive(0.0, 0.0))
            return
        kind = graph.JOINT_COMMANDS[name]
        joints = self.scene.robot.brain.abilities(self.scene.robot.motors).joints
        if kind == "velocity":
            self._instructions += [msg.Velocity(joint, 0.0) for joint in joints]
        elif kind == "effort":
            self._instructions += [msg.Torque(joint, 0.0) for joint in joints]

    @staticmethod
    def _checked(row: Row, payload: bytes) -> bytes:
        """Return the bytes of a message if they are not too many to be looked at. Raises Refused."""
        if len(payload) > (most := graph.MOST_BYTES.get(row.type, graph.LARGEST)):
            raise asked.Refused(f"{len(payload)} bytes: {most} at most are read of a {row.type}")
        return payload

    def _check_stop(self) -> None:
        if self._stopped:
            raise asked.Refused(f"stopped: {self._stopped}")

    def _allow(self, now: Nanos) -> None:
        if not self._budget.take(now):
            raise asked.Refused(f"too many: {PER_SECOND} a second are taken")

    def _take_over(self) -> None:
        """Let a goal follow what was held: the zeros with which that ends may come after it."""
        for held in self._held.values():
            held.moves = False

    def _dropped(self) -> list[Instruction]:
        """Return what ends the goals and missions that there are."""
        belief = self.scene.belief
        running = belief.mission is not None and belief.mission.phase in ("running", "paused")
        return [msg.Drop()] if running or belief.goal is not None else []

    # -- services -----------------------------------------------------------------------------------

    def _request(self, now: Nanos, row: Row, payload: bytes, token: Token) -> None:
        name = row.name.removeprefix("~/")
        if row.type == graph.TRIGGER:
            self._trigger(now, row, name, token)
            return
        self._checked(row, payload)
        if row.type == f"{FOLLOW}_SendGoal":
            _, id_, follow = trajectory.unpacked(payload)
            self._goal(now, self._actions[_FOLLOW], id_, follow, token)
            return
        request = decode(f"{row.type}_Request", payload)
        if name in graph.PARAMETERS:
            self._settings = self._settings or self.scene.settings()
            response = parameters.answer(name, request, self._settings, lambda line: self._line(now, line))
            self._answer(row.name, encode(response), token)
            return
        action_name, _, part = name.partition("/_action/")
        action = self._actions[action_name]
        if part == "get_result":
            action.get_result(request, token)
        elif part == "cancel_goal":
            for goal in action.cancel(request, token):
                self._cancelled(action, goal)
        else:
            self._goal(now, action, bytes(request.goal_id.uuid), request.goal, token)

    def _trigger(self, now: Nanos, row: Row, name: str, token: Token) -> None:
        motor = name.removesuffix(f"/{graph.ZERO}") if name not in graph.TRIGGERS else ""
        why = self._line(now, f"zero {motor}" if motor else graph.TRIGGERS[name])
        if motor and not why:
            self._zeroing.setdefault(motor, []).append(token)
        else:
            self._respond(row.name, token, why or "accepted", success=not why)

    def _zeroed(self, events: Sequence[msg.Event]) -> None:
        """Tell who wants a shaft's place to be zero whether it is."""
        for event in events:
            if isinstance(event, msg.Done | msg.Refused) and event.request == msg.Zero.__name__:
                text = event.reason if isinstance(event, msg.Refused) else event.detail or "it is zero now"
                for token in self._zeroing.pop(event.name, ()):
                    done = isinstance(event, msg.Done)
                    self._respond(f"~/{event.name}/{graph.ZERO}", token, text, success=done)

    def _respond(self, name: str, token: Token, text: str, *, success: bool) -> None:
        response = make(f"{graph.TRIGGER}_Response", success=success, message=text)
        self._answer(name, encode(response), token)

    def _line(self, now: Nanos, line: str) -> str:
        """Ask for a line of the operator's; return why not, or ""."""
        instruction, answer = self._requests.line(now, self._asking, line, now)
        if instruction is not None:
            self._instructions.append(instruction)
        return "" if answer.ok else answer.text

    # -- actions ------------------------------------------------------------------------------------

    def _goal(self, now: Nanos, action: Action, id_: bytes, sent: Any, token: Token) -> None:  # noqa: ANN401
        made: list[Any] = []

        def refused(content: Any) -> str:  # noqa: ANN401
            try:
                self._check_stop()
                self._allow(now)
                navigates = action.type == NAVIGATE
                made.append(
                    asked.goal(self.scene.robot, content.pose)
                    if navigates
                    else self._read(content.trajectory)
                )
            except (asked.Refused, trajectory.Refused) as error:
                self._say(action.name, str(error))
                return str(error)
            self._say(action.name, "")
            return ""

        before = action.active
        goal = action.send_goal(id_, sent, self._stamp(self.scene.now), token, refused)
        if goal is None:
            return
        if before is not None:
            self._end(action, before, ABORTED, "another goal has taken its place")
        if action.type == NAVIGATE:
            self._take_over()
            mission = f"navigate_to_pose {goal.id.hex()[:8]}"
            self._instructions += [*self._dropped(), msg.Mission(mission, (made[0],))]
            self._navigation = _Navigation(goal, mission, self.scene.now, made[0])
        else:
            self._begin_motion(made[0], goal)
        action.set(goal, EXECUTING)

    def _cancelled(self, action: Action, goal: actions.Goal) -> None:
        if action.type == NAVIGATE:
            self._instructions += self._dropped()
        else:
            self._instructions += self._holding()
            self._motion = None
        self._end(action, goal, CANCELED, "cancelled")

    def _end(self, action: Action, goal: actions.Goal, status: int, why: str, code: int = 0) -> None:
        if action.type == NAVIGATE:
            code = code or (0 if status == SUCCEEDED else NAV_UNKNOWN)
            result = make(f"{NAVIGATE}_Result", error_code=code, error_msg=why)
            self._navigation = (
                None if self._navigation and self._navigation.goal is goal else self._navigation
            )
        else:
            result = make(f"{FOLLOW}_Result", error_code=code, error_string=why)
        action.set(goal, status, result)

    def _end_motions(self, why: str) -> None:
        """Abort what is under way, since something else moves the robot, or nothing may."""
        if (one := self._navigation) is not None:
            self._end(self._actions["/navigate_to_pose"], one.goal, ABORTED, why)
            self._instructions += self._dropped()
        self._end_motion(why)

    def _end_motion(self, why: str) -> None:
        """Give no more samples of a trajectory."""
        motion, self._motion = self._motion, None
        if motion is not None and motion.goal is not None:
            self._end(self._actions[_FOLLOW], motion.goal, ABORTED, why)

    def _navigate(self) -> None:
        """Look how far the robot is with the goal of navigate_to_pose."""
        one = self._navigation
        if one is None:
            return
        action, belief, now = self._actions["/navigate_to_pose"], self.scene.belief, self.scene.now
        mission = belief.mission
        if mission is None or mission.name != one.mission:
            if one.seen or now - one.began > TAKEN:
                self._end(
                    action,
                    one.goal,
                    ABORTED,
                    "something else took its place" if one.seen else self._warned or WAIT,
                )
            return
        one.seen = True
        if mission.phase == "done":
            self._end(action, one.goal, SUCCEEDED, "")
        elif mission.phase != "running":
            self._instructions += self._dropped()
            status = CANCELED if one.goal.status == CANCELING else ABORTED
            self._end(action, one.goal, status, mission.reason or mission.phase)
        elif now - one.told >= FEEDBACK_PERIOD and belief.estimate is not None:
            one.told = now
            action.feedback(one.goal, self._progress(one, belief))

    def _progress(self, one: _Navigation, belief: Belief) -> Any:  # noqa: ANN401 -- a message
        assert belief.estimate is not None
        pose = belief.estimate.pose
        stamped = ros_messages.goal_pose(
            self._store.types, self.scene.now + self._epoch, Goal(pose.x, pose.y, pose.yaw)
        )
        points = [(pose.x, pose.y), *_ahead((pose.x, pose.y), belief.path), (one.asked.x, one.asked.y)]
        left = sum(dist(a, b) for a, b in pairwise(points))
        took = self.scene.now - one.began
        return make(
            f"{NAVIGATE}_Feedback",
            current_pose=stamped,
            navigation_time=_duration(took),
            distance_remaining=left,
        )

    # -- trajectories -------------------------------------------------------------------------------

    def _read(self, points: trajectory.Points | str) -> trajectory.Trajectory:
        joints = self.scene.robot.brain.abilities(self.scene.robot.motors).joints
        now = {name: self.scene.gateway.joints[name].feedback.position for name in joints}
        read = trajectory.read(points, joints, now)
        ends = (msg.Position(name, position) for name, position in read.goal.items())
        if wrong := next(filter(None, (cannot(one, self.scene.robot) for one in ends)), ""):
            raise trajectory.Refused(wrong)
        return read

    def _begin_motion(self, motion: trajectory.Trajectory, goal: actions.Goal | None) -> None:
        self._end_motions("another trajectory has come")
        content = None if goal is None else goal.content
        self._motion = _Motion(
            trajectory.Follower(motion, self.scene.now),
            goal,
            _tolerances(content.goal_tolerance) if content else {},
            _tolerances(content.path_tolerance) if content else {},
            content.goal_time_tolerance if content else 0,
        )

    def _holding(self) -> list[Instruction]:
        """Return what ends a trajectory where the joints are."""
        joints = self._motion.follower.trajectory.joints if self._motion is not None else ()
        at = {name: self.scene.gateway.joints[name].feedback.position for name in joints}
        return [msg.Position(name, position) for name, position in at.items() if position is not None]

    def _follow(self) -> None:
        """Ask for the next samples of the trajectory, and look how near the joints are."""
        one = self._motion
        if one is None:
            return
        now = self.scene.now
        over = one.follower.over(now)
        samples = one.follower.samples(now + self.scene.robot.period)
        if not one.arrived:
            self._instructions += samples
        one.arrived = over
        at = {s.motor: self.scene.gateway.joints[s.motor].feedback.position for s in samples}
        errors = {s.motor: s.position - (at[s.motor] or 0.0) for s in samples}
        if one.goal is None:
            self._motion = None if over else one
            return
        action = self._actions[_FOLLOW]
        if far := [
            n for n, e in errors.items() if n in one.path_tolerances and abs(e) > one.path_tolerances[n]
        ]:
            self._instructions += self._holding()
            self._fail(f"{far[0]} is {errors[far[0]]:.3g} off its path", PATH_VIOLATED)
        elif over:
            late = [name for name, e in errors.items() if abs(e) > one.tolerances.get(name, ARRIVED)]
            limit = one.settling or round(SETTLING * SECOND)
            end = one.follower.began + round(one.follower.trajectory.end * SECOND)
            if not late:
                self._end(action, one.goal, SUCCEEDED, "")
                self._motion = None
            elif now - end > limit:
                self._fail(f"{late[0]} is {errors[late[0]]:.3g} from where it should be", GOAL_VIOLATED)
        elif now - one.told >= FEEDBACK_PERIOD:
            one.told = now
            action.feedback(one.goal, self._how_far(one, samples, at))

    def _fail(self, why: str, code: int) -> None:
        motion, self._motion = self._motion, None
        assert motion is not None
        if motion.goal is not None:
            self._end(self._actions[_FOLLOW], motion.goal, ABORTED, why, code)

    def _how_far(self, one: _Motion, samples: Sequence[msg.Position], at: dict[str, float | None]) -> Any:  # noqa: ANN401
        kind = "trajectory_msgs/msg/JointTrajectoryPoint"
        wanted = np.array([s.position for s in samples])
        there = np.array([at[s.motor] or 0.0 for s in samples])
        since = _duration(self.scene.now - one.follower.began)
        points = {
            "desired": make(
                kind,
                positions=wanted,
                velocities=np.array([s.velocity for s in samples]),
                time_from_start=since,
            ),
            "actual": make(kind, positions=there, time_from_start=since),
            "error": make(kind, positions=wanted - there, time_from_start=since),
        }
        header = ros_messages.header(self._store.types, self.scene.now + self._epoch, "")
        names = list(one.follower.trajectory.joints)
        return make(f"{FOLLOW}_Feedback", header=header, joint_names=names, **points)


_FOLLOW = "/joint_trajectory_controller/follow_joint_trajectory"


def _ahead(here: tuple[float, float], path: Sequence[tuple[float, float]]) -> Sequence[tuple[float, float]]:
    """Return the points of a path from the nearest on."""
    if not path:
        return ()
    nearest = min(range(len(path)), key=lambda i: dist(here, path[i]))
    return path[nearest:]


def _duration(span: Nanos) -> Any:  # noqa: ANN401 -- a message
    seconds, rest = divmod(span, SECOND)
    return make("builtin_interfaces/msg/Duration", sec=seconds, nanosec=rest)


def _tolerances(given: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Return the largest errors of position that a goal allows; one of -1 allows any."""
    return {name: position if position > 0.0 else 1e3 * pi for name, position in given if position}
