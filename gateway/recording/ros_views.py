"""Views: each tick and the belief after it as ROS 2 messages for other tools, at reduced rates.

Rules. The only state is what was last sent: equal ticks and beliefs give equal messages, to the byte. The raw
tick is recorded beside them, so nothing is lost: every frame and sensor reading has a view, the estimate at
most 50 per second, the map one, the diagnostics two or one per change of state.

| topic | type | when |
|---|---|---|
| /BUS/from_can_bus, /BUS/to_can_bus | can_msgs/Frame | each classic frame received, sent |
| /BUS/from_can_bus_fd, /BUS/to_can_bus_fd | ros2_socketcan_msgs/FdFrame | each FD frame received, sent |
| /scan, /imu/data, /fix, /pose, … | as its kind has it (`protocols.sensors`) | each reading of a sensor |
| /odom, /tf | nav_msgs/Odometry, tf2_msgs/TFMessage | a new estimate, at most 50 Hz; map → odom → base_link |
| /estimate | geometry_msgs/PoseWithCovarianceStamped | beside /odom: in map |
| /wheel_odom | nav_msgs/Odometry | beside /odom: the wheels alone |
| /tf_static | tf2_msgs/TFMessage | once, at the start: the sensors' mountings |
| /joint_states | sensor_msgs/JointState | new feedback, at most 50 Hz |
| /map | nav_msgs/OccupancyGrid | a new version, at most 1 Hz |
| /battery_state | sensor_msgs/BatteryState | 1 Hz, the mean of what motors measure; not recorded |
| /plan, /goal_pose | nav_msgs/Path, geometry_msgs/PoseStamped | on change |
| /diagnostics | diagnostic_msgs/DiagnosticArray | 2 Hz, on a change of state, with every note |
| /rosout | rcl_interfaces/Log | each note |

Bytes of serial buses are in the raw tick only: ROS has no message type for them.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from brain.belief import Belief, BrainState
from brain.perception.mount import Mount
from gateway.core.tick import Note, Tick
from gateway.recording import ros_cdr, ros_messages
from gateway.recording.ros_messages import Message
from protocols import messages as msg
from protocols import sensors
from protocols.frames import CanFrame, Packet
from protocols.messages import MILLISECOND, SECOND, Event, Mode, Nanos
from protocols.sensors import RosView, SensorKind

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

BELIEF_PERIOD = 20 * MILLISECOND
MAP_PERIOD = SECOND
DIAGNOSTICS_PERIOD = 500 * MILLISECOND
BATTERY_PERIOD = SECOND

UINT64 = 2**64 - 1
OF_SENSORS = {kind.ros.topic: kind.ros.type for kind in sensors.OURS if kind.ros}
"""Topics of our kinds of sensors, with their types."""
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
JOINT_STATE, POSE = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseWithCovarianceStamped"
BATTERY = "sensor_msgs/msg/BatteryState"
_BY_STRUCT = (
    ros_messages.CAN_FRAME,
    ros_messages.FD_FRAME,
    *OF_SENSORS.values(),
    ODOMETRY,
    TRANSFORMS,
    POSE,
    JOINT_STATE,
)
_BY_SERIALISER = (
    TRANSFORMS,
    BATTERY,
    "nav_msgs/msg/OccupancyGrid",
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseStamped",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rcl_interfaces/msg/Log",
)

TOPICS = {
    **OF_SENSORS,
    "/odom": ODOMETRY,
    "/estimate": POSE,
    "/wheel_odom": ODOMETRY,
    "/tf": TRANSFORMS,
    "/tf_static": TRANSFORMS,
    "/joint_states": JOINT_STATE,
    "/battery_state": BATTERY,
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/plan": "nav_msgs/msg/Path",
    "/goal_pose": "geometry_msgs/msg/PoseStamped",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/rosout": "rcl_interfaces/msg/Log",
}
"""The type of each topic, but those of frames (`frame_topics`) and of others' sensors (`topics`)."""

_OK, _WARN, _ERROR, _STALE = 0, 1, 2, 3
_BRAIN_LEVELS = {
    BrainState.INITIALISING: _WARN,
    BrainState.READY: _OK,
    BrainState.RUNNING: _OK,
    BrainState.DEGRADED: _WARN,
    BrainState.STOPPED: _ERROR,
}
_MODE_LEVELS = {
    Mode.INITIALISING: _WARN,
    Mode.READY: _OK,
    Mode.ARMED: _OK,
    Mode.FAULT: _ERROR,
    Mode.OFFLINE: _STALE,
}
_NOTE_LEVELS = {"info": _OK, "warning": _WARN, "error": _ERROR}


class ViewMessage(NamedTuple):
    """One ROS 2 message."""

    topic: str
    type: str
    """package/msg/Name"""
    t: Nanos
    """Time of measurement, estimate or sending, clamped to 64 bits unsigned as in a file."""
    data: bytes
    """CDR"""


@cache
def typestore() -> Typestore:
    """Return ROS 2 Jazzy's message types, and the two for CAN frames that are not part of it."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(ros_messages.CAN_FRAME_DEFINITION, ros_messages.CAN_FRAME))
    store.register(get_types_from_msg(ros_messages.FD_FRAME_DEFINITION, ros_messages.FD_FRAME))
    for kind in sensors.kinds().strangers:
        if kind.ros and kind.ros.definition and kind.ros.type not in store.types:
            with contextlib.suppress(Exception):  # whatever a third party wrote; `views_of_sensors` names it
                store.register(get_types_from_msg(kind.ros.definition, kind.ros.type))
    return store


def views_of_sensors(store: Typestore) -> tuple[dict[type[msg.Measurement], RosView], list[Note]]:
    """Return the view of each kind of sensor that has one, and why others' are left out."""
    views = {kind.message: kind.ros for kind in sensors.OURS if kind.ros}
    left_out: list[Note] = []
    for kind in sensors.kinds().strangers:
        if kind.ros is None:
            continue
        if wrong := _wrong(store, kind, kind.ros, {*TOPICS, *(view.topic for view in views.values())}):
            left_out.append(Note("warning", kind.name, f"its readings have no ROS view: {wrong}"))
        else:
            views[kind.message] = kind.ros
    return views, left_out


def _wrong(store: Typestore, kind: SensorKind, view: RosView, taken: Container[str]) -> str:
    """Return why others' readings cannot be shown so, "" if they can."""
    if view.topic in taken or not _TOPIC.fullmatch(view.topic):
        return f"its topic {view.topic!r} is taken, or is none"
    try:
        data = ros_cdr.reading(ros_cdr.Layouts(), view, kind.sample("sensor", 0, 1))
        message = store.deserialize_cdr(data, view.type)
        same = bytes(store.serialize_cdr(message, view.type, little_endian=True)) == data
    except Exception as error:  # noqa: BLE001 -- a third party's, which may raise anything
        return f"{type(error).__name__}: {error}"
    return "" if same else f"its numbers are not those of a {view.type}"


def topics(store: Typestore) -> dict[str, str]:
    """Return the type of each topic, with those of others' sensors."""
    return TOPICS | {view.topic: view.type for view in views_of_sensors(store)[0].values()}


@cache
def _definition(store: Typestore, type_: str) -> str:
    return store.generate_msgdef(type_, ros_version=2)[0]


def to_view(store: Typestore, topic: str, t: Nanos, message: Message) -> ViewMessage:
    """Return a message as it is sent, or stands in a file."""
    type_ = message.__msgtype__
    return ViewMessage(
        topic, type_, _stamp(t), bytes(store.serialize_cdr(message, type_, little_endian=True))
    )


@dataclass(slots=True)
class _MotorStatus:
    """Last reported values of a motor, at its joint's output shaft."""

    mode: Mode = Mode.INITIALISING
    detail: str = ""
    faults: dict[int, str] = field(default_factory=dict)
    measured: dict[str, float] = field(default_factory=dict)
    """Last value by field of `Feedback`."""


class Views:
    """Converts ticks and beliefs to messages. State: what was last sent, and the motors' last values.

    Args:
        mounts: where the sensors are, for /tf_static.
        store: the message types, if they are at hand (`typestore`).
        wanted: the topics to make messages for, looked at in each tick; None: all.
        epoch: added to all times but those of frames, where they are to be those of another clock.
    """

    def __init__(
        self,
        mounts: Mapping[str, Mount] | None = None,
        store: Typestore | None = None,
        wanted: Container[str] | None = None,
        epoch: Nanos = 0,
    ) -> None:
        self._mounts, self._wanted, self._epoch = dict(mounts or {}), wanted, epoch
        self._store = store or typestore()
        self._types: ros_messages.Types = self._store.types
        self._layouts = ros_cdr.Layouts()
        self._of_sensors, self._left_out = views_of_sensors(self._store)
        self._topics: dict[tuple[str, str, bool], str] = {}
        """Topics of frames, by bus, direction and FD."""
        self._sent: dict[str, Nanos] = {}
        """Time of the last message, by topic."""
        self._shown: dict[str, object] = {}
        """Key of the last message, by topic: a message is sent when it differs."""
        self._motors: dict[str, _MotorStatus] = {}
        self._moved = False
        """True if feedback came since the last joint state."""

    def messages(self, tick: Tick, belief: Belief) -> list[ViewMessage]:
        """Return the messages for a tick, in a fixed order."""
        if self._epoch:
            tick, belief = self._moved_to_epoch(tick, belief)
        views = self._mounts_view(tick.now)
        views += self._frames(tick.inputs.packets, "from")
        views += self._events(tick.outputs.events)
        views += self._frames(tick.outputs.packets, "to")
        views += self._estimate_and_map(tick.now, belief)
        views += self._goal_and_plan(tick.now, belief)
        views += self._joints(tick.now)
        views += self._battery(tick.now)
        if self._wants("/rosout"):
            views += [
                self._view("/rosout", tick.now, ros_messages.log(self._types, tick.now, note))
                for note in (*tick.outputs.notes, *self._left_out)
            ]
            self._left_out.clear()
        views += self._diagnostics(tick, belief)
        return views

    def reset(self) -> None:
        """Send everything again, as after a gap in a recording."""
        self._sent.clear()
        self._shown.clear()

    def definition(self, type_: str) -> str:
        """Return the definition of a message type, with those of all types in it (ros2msg)."""
        return _definition(self._store, type_)

    def prepare(self) -> None:
        """Prepare all message types now (the first time 0.1 s): they would delay the first messages."""
        for type_ in (*_BY_STRUCT, *_BY_SERIALISER):
            self.definition(type_)
        for type_ in _BY_SERIALISER:
            self._store.get_msgdef(type_)

    def deserialise(self, view: ViewMessage) -> object:
        """Return the message as an object with its fields; or why its bytes are none, as a text."""
        from rosbags.serde import SerdeError

        try:
            return self._store.deserialize_cdr(view.data, view.type)
        except SerdeError as error:
            return f"no {view.type}: {error}"

    # -- what is wanted, and at which rate --------------------------------------------------------

    def _wants(self, topic: str) -> bool:
        return self._wanted is None or topic in self._wanted

    def _due(self, topic: str, now: Nanos, period: Nanos) -> bool:
        last = self._sent.get(topic)
        if last is not None and now - last < period:
            return False
        self._sent[topic] = now
        return True

    def _is_new(self, topic: str, shown: object) -> bool:
        if self._shown.get(topic) == shown:
            return False
        self._shown[topic] = shown
        return True

    def _new_and_due(self, topic: str, shown: object, now: Nanos, period: Nanos) -> bool:
        return (
            self._shown.get(topic) != shown and self._due(topic, now, period) and self._is_new(topic, shown)
        )

    def _view(self, topic: str, t: Nanos, message: Message) -> ViewMessage:
        return to_view(self._store, topic, t, message)

    def _moved_to_epoch(self, tick: Tick, belief: Belief) -> tuple[Tick, Belief]:
        """Return what is shown, but frames, with the times of the other clock."""
        epoch, estimate = self._epoch, belief.estimate
        events = tuple(
            replace(one, t=one.t + epoch) if isinstance(one, msg.Measurement) else one
            for one in tick.outputs.events
        )
        moved = replace(tick, now=tick.now + epoch, outputs=replace(tick.outputs, events=events))
        return moved, replace(belief, estimate=estimate and replace(estimate, t=estimate.t + epoch))

    # -- frames and events ------------------------------------------------------------------------

    def _frames(self, packets: Sequence[Packet], direction: str) -> list[ViewMessage]:
        return [
            self._frame(topic, p, p.frame)
            for p in packets
            if isinstance(p.frame, CanFrame)
            and self._wants(topic := self._topic(p.bus, direction, p.frame.fd))
        ]

    def _topic(self, bus: str, direction: str, fd: bool) -> str:
        topic = self._topics.get((bus, direction, fd))
        if topic is None:
            topic = self._topics[bus, direction, fd] = _frame_topic(bus, direction, fd)
        return topic

    def _frame(self, topic: str, packet: Packet, frame: CanFrame) -> ViewMessage:
        if frame.fd:
            data = ros_cdr.fd_frame(self._layouts, packet.t, packet.bus, frame)
            return ViewMessage(topic, ros_messages.FD_FRAME, _stamp(packet.t), data)
        data = ros_cdr.can_frame(self._layouts, packet.t, packet.bus, frame)
        return ViewMessage(topic, ros_messages.CAN_FRAME, _stamp(packet.t), data)

    def _events(self, events: Sequence[Event]) -> list[ViewMessage]:
        views: list[ViewMessage] = []
        motors = any(map(self._wants, _OF_MOTORS))
        for event in events:
            if isinstance(event, msg.Measurement):
                views += self._reading(event)
            elif motors:
                self._on_motor_event(event)
        return views

    def _reading(self, event: msg.Measurement) -> list[ViewMessage]:
        view = self._of_sensors.get(type(event))
        if view is None or not self._wants(view.topic):
            return []
        try:
            data = ros_cdr.reading(self._layouts, view, event)
        except Exception as error:  # noqa: BLE001 -- a third party's view may raise anything: once
            del self._of_sensors[type(event)]
            failed = f"its readings have no ROS view from now on: {type(error).__name__}: {error}"
            self._left_out.append(Note("warning", event.sensor, failed))
            return []
        return [ViewMessage(view.topic, view.type, _stamp(event.t), data)]

    def _on_motor_event(self, event: Event) -> None:
        match event:
            case msg.Feedback():
                status = self._motor(event.motor)
                for name in _MEASURED:
                    if (value := getattr(event, name)) is not None:
                        status.measured[name] = value
                self._moved = True
            case msg.State(motor, _, mode, detail) if motor not in self._mounts:
                status = self._motor(motor)
                status.mode, status.detail = mode, detail
            case msg.Fault(motor, _, code, name) if motor not in self._mounts:
                self._motor(motor).faults[code] = name
            case msg.Done(_, "ClearFault", name) if name in self._motors:
                self._motors[name].faults.clear()
            case _:
                pass

    def _motor(self, name: str) -> _MotorStatus:
        return self._motors.setdefault(name, _MotorStatus())

    # -- belief -----------------------------------------------------------------------------------

    def _mounts_view(self, now: Nanos) -> list[ViewMessage]:
        if not self._mounts or not self._wants("/tf_static") or not self._is_new("/tf_static", True):
            return []
        return [self._view("/tf_static", now, ros_messages.mount_transforms(self._types, now, self._mounts))]

    def _estimate_and_map(self, now: Nanos, belief: Belief) -> list[ViewMessage]:
        views: list[ViewMessage] = []
        estimate = belief.estimate if any(map(self._wants, _OF_ESTIMATE)) else None
        if estimate is not None and self._new_and_due("/odom", estimate.t, now, BELIEF_PERIOD):
            t, layouts = _stamp(estimate.t), self._layouts
            if self._wants("/odom"):
                views.append(ViewMessage("/odom", ODOMETRY, t, ros_cdr.odometry(layouts, estimate)))
            if self._wants("/tf"):
                views.append(ViewMessage("/tf", TRANSFORMS, t, ros_cdr.transforms(layouts, estimate)))
            if self._wants("/estimate"):
                views.append(ViewMessage("/estimate", POSE, t, ros_cdr.pose_in_map(layouts, estimate)))
            if belief.raw is not None and self._wants("/wheel_odom"):
                raw = ros_cdr.dead_reckoning(layouts, estimate.t, belief.raw)
                views.append(ViewMessage("/wheel_odom", ODOMETRY, t, raw))
        grid = belief.map if self._wants("/map") else None
        if grid is not None and self._new_and_due("/map", grid.version, now, MAP_PERIOD):
            views.append(self._view("/map", now, ros_messages.occupancy(self._types, now, grid)))
        return views

    def _goal_and_plan(self, now: Nanos, belief: Belief) -> list[ViewMessage]:
        views: list[ViewMessage] = []
        if belief.goal != self._shown.get("/goal_pose") and self._wants("/goal_pose"):
            self._shown["/goal_pose"] = belief.goal
            if belief.goal is not None:
                views.append(
                    self._view("/goal_pose", now, ros_messages.goal_pose(self._types, now, belief.goal))
                )
        nothing_yet = "/plan" not in self._shown and not belief.path
        if not nothing_yet and self._wants("/plan") and self._is_new("/plan", belief.path_version):
            views.append(self._view("/plan", now, ros_messages.path(self._types, now, belief.path)))
        return views

    def _joints(self, now: Nanos) -> list[ViewMessage]:
        wanted = self._moved and self._wants("/joint_states")
        if not wanted or not self._due("/joint_states", now, BELIEF_PERIOD):
            return []
        self._moved = False
        measured = {
            name: (m.measured.get("position"), m.measured.get("velocity"), m.measured.get("torque"))
            for name, m in self._motors.items()
        }
        return [ViewMessage("/joint_states", JOINT_STATE, _stamp(now), ros_cdr.joint_state(now, measured))]

    def _battery(self, now: Nanos) -> list[ViewMessage]:
        topic = "/battery_state"
        if self._wanted is None or topic not in self._wanted:  # older recordings lack it, and are compared
            return []
        measured = [volts for m in self._motors.values() if (volts := m.measured.get("voltage")) is not None]
        if not measured or not self._due(topic, now, BATTERY_PERIOD):
            return []
        volts = sum(measured) / len(measured)
        return [self._view(topic, now, ros_messages.battery(self._types, now, volts))]

    # -- diagnostics ------------------------------------------------------------------------------

    def _diagnostics(self, tick: Tick, belief: Belief) -> list[ViewMessage]:
        if not self._wants("/diagnostics"):
            return []
        motors = tuple((name, m.mode, m.detail, tuple(m.faults)) for name, m in self._motors.items())
        changed = self._is_new("/diagnostics", (belief.state, motors))
        due = self._due("/diagnostics", tick.now, DIAGNOSTICS_PERIOD)
        if not (changed or due or tick.outputs.notes):
            return []
        self._sent["/diagnostics"] = tick.now
        statuses = [self._brain_status(belief)]
        statuses += [self._motor_status(name, status) for name, status in self._motors.items()]
        statuses += [self._note_status(note) for note in tick.outputs.notes]
        return [
            self._view("/diagnostics", tick.now, ros_messages.diagnostics(self._types, tick.now, statuses))
        ]

    def _brain_status(self, belief: Belief) -> Message:
        values = {f"rejected {name}": str(count) for name, count in sorted(belief.rejected.items())}
        values["goals reached"] = str(belief.reached)
        if (mission := belief.mission) is not None:
            values["mission"] = (
                f"{mission.name}: {mission.phase}, step {mission.step or '-'} of {mission.steps}"
            )
        for system in belief.systems:
            values[system.name] = f"{system.state}: {system.reason}" if system.reason else system.state
        message = f"{belief.state.value}: {belief.reason}" if belief.reason else belief.state.value
        return ros_messages.diagnostic_status(
            self._types, _BRAIN_LEVELS[belief.state], "/gateway/brain", message, values
        )

    def _motor_status(self, name: str, status: _MotorStatus) -> Message:
        message = f"{status.mode.value}: {status.detail}" if status.detail else status.mode.value
        if status.faults:
            message += "; faults: " + ", ".join(status.faults.values())
        level = _ERROR if status.faults else _MODE_LEVELS[status.mode]
        values = {
            f"{quantity} [{unit}]": repr(value)
            for quantity, unit in _REPORTED.items()
            if (value := status.measured.get(quantity)) is not None
        }
        return ros_messages.diagnostic_status(self._types, level, f"/gateway/motors/{name}", message, values)

    def _note_status(self, note: Note) -> Message:
        return ros_messages.diagnostic_status(
            self._types, _NOTE_LEVELS[note.level], f"/gateway/notes/{note.source}", note.text, {}
        )


_MEASURED = ("position", "velocity", "torque", "current", "voltage", "temperature")
_REPORTED = {"current": "A", "voltage": "V", "temperature": "degC"}
_OF_MOTORS = ("/joint_states", "/diagnostics", "/battery_state")
_OF_ESTIMATE = ("/odom", "/tf", "/estimate", "/wheel_odom")
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def frame_topics(bus: str, *, fd: bool) -> dict[str, str]:
    """Return the topics of a CAN bus's frames, with their types."""
    kinds = ((False, ros_messages.CAN_FRAME), (True, ros_messages.FD_FRAME))[: 1 + fd]
    return {_frame_topic(bus, way, kind): type_ for kind, type_ in kinds for way in ("from", "to")}


def _frame_topic(bus: str, direction: str, fd: bool) -> str:
    return f"/{topic_name(bus)}/{direction}_can_bus{'_fd' if fd else ''}"


def _stamp(t: Nanos) -> Nanos:
    return max(0, min(UINT64, t))


def topic_name(name: str) -> str:
    """Return a name as part of a ROS topic: letters, digits and underscores, no leading digit."""
    clean = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"_{clean}" if clean[0].isdigit() else clean
