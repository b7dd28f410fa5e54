"""The Foxglove app's end of the wire: the robot as ROS 2 topics, its settings as parameters, services.

Spoken on "/" of the view's port, as `gateway.view.foxglove_wire` has it. Topics are those of a recording
(`gateway.recording.ros_views`), and a message is made only if its topic has a subscriber; who
subscribes gets what stays (map, path, mounts, joints) with the next tick, or at once if there is none.

| topics | a slow client |
|---|---|
| /rosout, /diagnostics | gets every message |
| frames, readings of sensors | misses some |
| all others | gets the newest |

Clients publish a goal or, for as long as they repeat it, a motion; they set parameters and call services. All
that is an operator's request, as that of a page. A motion has no time of ours in it, but pings have, which
every client's WebSocket answers by itself, in the order of what it sends: what comes after an answer was sent
after that ping. Nothing here raises, whatever a client sends: what is wrong, or refused, is sent to it as a
status.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from gateway.core.tick import Tick
from gateway.recording.ros_messages import grid
from gateway.recording.ros_views import (
    OF_SENSORS,
    TOPICS,
    ViewMessage,
    Views,
    frame_topics,
    to_view,
    topics,
    typestore,
)
from gateway.view import foxglove_wire as wire
from gateway.view.cockpit import Act
from gateway.view.foxglove_map import Drawing
from gateway.view.foxglove_services import SERVICES, word
from gateway.view.foxglove_wire import ERROR, WARNING, WireError
from gateway.view.requests import Asking, Requests
from gateway.view.scene import Json, Scene
from gateway.view.server import Client, Message
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Instruction, Nanos

EVENTS = frozenset(("/rosout", "/diagnostics"))
"""Topics of which a client gets every message,"""
STATES = frozenset(TOPICS) - EVENTS - frozenset(OF_SENSORS)
"""and those of which it gets the newest."""
TRUE = frozenset(("/odom", "/estimate", "/tf", "/tf_static", "/joint_states"))
"""Topics of simulated devices: what is true, which is in no frame."""
RECEIVED = {"/goal_pose": "PoseStamped", "/move_base_simple/goal": "PoseStamped", "/cmd_vel": "Twist"}
"""Topics that clients may publish, and the type (of geometry_msgs) of each."""
MAP = "/map"
FRAME = "map"
"""In which goals are."""
TIME_PERIOD: Nanos = 20 * MILLISECOND
PING_PERIOD: Nanos = 50 * MILLISECOND
SLOW_PERIOD: Nanos = 100 * MILLISECOND
"""Of looking for a change of the playback, and of beginning topics anew for who has subscribed."""
MAX_CHANNELS = 100
"""That a client may publish on."""


@dataclass(slots=True, eq=False)
class _Peer:
    """One client."""

    client: Client
    asking: Asking
    subscriptions: dict[int, str] = field(default_factory=dict)
    """Topics by the client's ids."""
    channels: dict[int, tuple[str, str]] = field(default_factory=dict)
    """Topics that it publishes, and their encodings, by its ids."""
    parameters: set[str] = field(default_factory=set)
    """Of which it is sent each change."""
    troubled: set[str] = field(default_factory=set)
    """Topics whose last message was refused."""

    def send_status(self, level: int, text: str, name: str = "") -> None:
        self.client.send(wire.status(level, text, name))


class Foxglove:
    """All clients. Building it prepares the message types, which takes some tenths of a second.

    Args:
        scene: what is shown.
        requests: what takes what they ask of the robot.
        acts: "play" controls a playback.
    """

    def __init__(self, scene: Scene, requests: Requests, acts: Mapping[str, Act]) -> None:
        self.scene, self._requests = scene, requests
        self._play = acts.get("play")
        self._peers: dict[Client, _Peer] = {}
        self._subscribers: dict[str, list[tuple[_Peer, int]]] = {}
        """By topic; topics without any are not in it."""
        self._wanted: set[str] = set()
        """Of these, those whose messages are made of each tick: all but the map, which is drawn in slices."""
        self._map = Drawing()
        self._store = typestore()
        every = topics(self._store).items()
        types = {topic: type_ for topic, type_ in every if scene.kind != "twin" or topic in TRUE}
        for bus in scene.robot.buses.values():
            if not bus.carries_bytes and scene.kind != "twin":
                types |= frame_topics(bus.name, fd=bus.kind == "canfd")
        self._topics = dict(enumerate(types, 1))
        self._advertised = self._advertise(types)
        self._views: Views | None = None
        self._gateway = scene.gateway
        self._stale = False
        """Whether topics begin anew."""
        live = scene.kind == "live"
        self._services = dict(enumerate(SERVICES if requests.steer else SERVICES[:1], 1)) if live else {}
        self._publish = live and requests.steer
        self._session = ""
        self._start: Nanos | None = None
        """Time of the beginning of a recording."""
        self._time_at = self._slow_at = self._ping_at = -SLOW_PERIOD
        self._playback: tuple[int, float] | None = None
        """State and rate, as clients know them."""
        self._values: dict[str, Json] | None = None
        """The parameters; None: they may have changed."""
        self._known: dict[str, Json] | None = None
        """As their subscribers know them; None: there are none."""
        self._waiting: list[tuple[_Peer, Sequence[str], Mapping[str, float], object]] = []
        """Who is answered after the next step: parameters, values that were accepted, the request's id."""

    # -- the speaker ------------------------------------------------------------------------------

    def receive(self, now: Nanos, client: Client, messages: Sequence[Message]) -> Sequence[Instruction]:
        """Return what a client asks of the robot; answer it."""
        peer = self._peers.get(client) or self._enter(now, client)
        instructions: list[Instruction] = []
        for message in messages:
            try:
                if isinstance(message, str):
                    instructions += self._text(now, peer, wire.read_text(message))
                elif message:
                    instructions += self._binary(now, peer, wire.read_binary(message))
            except WireError as error:
                peer.send_status(ERROR, f"Invalid message: {error}")
        return instructions

    def leave(self, clients: Sequence[Client]) -> list[Instruction]:
        """Forget clients that are not among these; return what ends what they held."""
        gone = [peer for client, peer in self._peers.items() if client not in clients]
        ended: list[Instruction] = []
        for peer in gone:
            del self._peers[peer.client]
            self._unsubscribe(peer, list(peer.subscriptions))
            self._waiting = [one for one in self._waiting if one[0] is not peer]
            ended += self._requests.leave(peer.asking)
        return ended

    def take(self, tick: Tick) -> None:
        """Send what a tick brought to who has subscribed to it."""
        if self._start is None and self._play is not None:
            self._start = tick.now - round(self._facts()["t"] * SECOND)
        if any(isinstance(one, msg.Set) for one in tick.inputs.instructions):
            self._values = None
        if not self._peers:
            return
        if not 0 <= tick.now - self._time_at < TIME_PERIOD:
            self._time_at = tick.now
            self._send_time()
        if self._views is not None and self._wanted and self.scene.gateway is self._gateway:
            self._send(self._views.messages(tick, self.scene.belief))

    def show(self, now: Nanos, clients: Sequence[Client]) -> None:
        """Greet who is new, and send what is due."""
        for client in clients:
            if client not in self._peers:
                self._enter(now, client)
        if not clients:
            return
        if self._publish and now - self._ping_at >= PING_PERIOD:
            self._ping_at = now
            for client in filter(lambda one: one.idle(now), clients):
                client.ping(now)
        self._send_parameters()
        jumped = self.scene.gateway is not self._gateway
        if jumped or now - self._slow_at >= SLOW_PERIOD:
            self._slow_at = now
            if self._stale or jumped:
                self._begin_anew()
            if self._play is not None:
                self._send_playback(sought=jumped)
        if MAP in self._subscribers and not self._stale:
            self._draw_map(now)

    def _enter(self, now: Nanos, client: Client) -> _Peer:
        """Greet a client."""
        peer = self._peers[client] = _Peer(client, self._requests.enter())
        client.ping(now)  # answered before whatever is published
        robot = self.scene.robot.name
        self._session = self._session or f"{robot}-{now}"
        playing = self._play is not None and client.subprotocol == wire.SDK
        capabilities = {
            "time": True,
            "parameters": True,
            "parametersSubscribe": True,
            "services": bool(self._services),
            "clientPublish": self._publish,
            "playbackControl": playing,
        }
        info = {
            "name": f"{robot} (motor-gateway)",
            "capabilities": [name for name, has in capabilities.items() if has],
            "supportedEncodings": list(wire.ENCODINGS),
            "metadata": {"ROS_DISTRO": "jazzy", "mode": self.scene.kind},
            "sessionId": self._session,
        }
        if playing:
            start = self._start or 0
            end = start + round(self._facts()["length"] * SECOND)
            info |= {"dataStartTime": wire.seconds(start), "dataEndTime": wire.seconds(end)}
        client.send(wire.text("serverInfo", info))
        client.send(self._advertised)
        if self._services:
            services = [one.advertised(number) for number, one in self._services.items()]
            client.send(wire.text("advertiseServices", {"services": services}))
        client.send(wire.time(self.scene.now))
        self._playback = None
        return peer

    def _advertise(self, types: Mapping[str, str]) -> str:
        views = Views(store=self._store)
        views.prepare()
        channels = [
            {
                "id": number,
                "topic": topic,
                "encoding": "cdr",
                "schemaName": types[topic],
                "schemaEncoding": "ros2msg",
                "schema": views.definition(types[topic]),
            }
            for number, topic in self._topics.items()
        ]
        return wire.text("advertise", {"channels": channels})

    def _text(self, now: Nanos, peer: _Peer, asked: Json) -> Sequence[Instruction]:
        match asked["op"]:
            case "subscribe":
                self._subscribe(peer, wire.rows(asked, "subscriptions"))
            case "unsubscribe":
                self._unsubscribe(peer, wire.ids(asked, "subscriptionIds"))
            case "advertise":
                self._advertised_by(peer, wire.rows(asked, "channels"))
            case "unadvertise":
                self._unadvertised_by(peer, wire.ids(asked, "channelIds"))
            case "getParameters" if why := self._requests.refused(now, peer.asking, reads=True):
                peer.send_status(ERROR, why)
            case "getParameters":
                names, values = wire.names(asked, "parameterNames"), self._parameters()
                _send_values(peer, values, names or list(values), asked.get("id"))
            case "setParameters":
                return self._set_parameters(now, peer, wire.rows(asked, "parameters"), asked.get("id"))
            case "subscribeParameterUpdates":
                self._subscribe_parameters(peer, wire.names(asked, "parameterNames"))
            case "unsubscribeParameterUpdates":
                names = wire.names(asked, "parameterNames")
                peer.parameters.difference_update(names or list(peer.parameters))
            case "subscribeConnectionGraph" | "unsubscribeConnectionGraph":
                peer.send_status(ERROR, "Server does not support connection graph capability")
            case "fetchAsset":
                peer.send_status(ERROR, "Server does not support assets capability")
            case op:
                raise WireError(f"there is no op {op[:40]!r}")
        return ()

    def _binary(self, now: Nanos, peer: _Peer, asked: wire.Binary) -> Sequence[Instruction]:
        match asked:
            case wire.Published():
                return self._published(now, peer, asked)
            case wire.Call():
                instruction = self._called(now, peer, asked)
                return () if instruction is None else (instruction,)
            case wire.Play():
                self._played(peer, asked)
        return ()

    # -- topics -----------------------------------------------------------------------------------

    def _begin_anew(self) -> None:
        """Send everything there is now, as after a jump, or to who has subscribed."""
        if self.scene.gateway is not self._gateway:
            self._gateway, self._values = self.scene.gateway, None
            self._send_time()
        self._stale = False
        mounts = {name: sensor.mount for name, sensor in self.scene.robot.sensors.items()}
        self._views = Views(mounts, self._store, self._wanted)
        self._map.anew()
        self._send(self._views.messages(self.scene.present(), self.scene.belief))

    def _send(self, views: Sequence[ViewMessage]) -> None:
        for view in views:
            for peer, subscription in self._subscribers.get(view.topic, ()):
                if view.topic in STATES:
                    peer.client.sample(view.topic, partial(wire.data, subscription, view.t, view.data))
                elif view.topic in EVENTS or peer.client.stuck_since is None:
                    peer.client.send(wire.data(subscription, view.t, view.data))

    def _draw_map(self, now: Nanos) -> None:
        """Draw some of the map, and send it once it is whole."""
        drawing, view = self._map, self.scene.belief.map
        if view is not None and drawing.draw(now, self.scene.now, view):
            layout = drawing.layout
            message = grid(self._store.types, drawing.t, layout.resolution, layout.origin, drawing.cells)
            self._send([to_view(self._store, MAP, drawing.t, message)])

    def _send_time(self) -> None:
        for client in self._peers:
            if client.stuck_since is None:
                client.send(wire.time(self.scene.now))

    def _subscribe(self, peer: _Peer, rows: Sequence[Json]) -> None:
        for one in rows:
            number, channel = wire.number(one, "id"), wire.number(one, "channelId")
            topic = self._topics.get(channel)
            if topic is None:
                peer.send_status(ERROR, f"Unknown channel ID: {channel}")
            elif topic in peer.subscriptions.values():
                peer.send_status(WARNING, f"Client is already subscribed to channel: {channel}")
            elif number in peer.subscriptions:
                peer.send_status(ERROR, f"Subscription ID was already used: {number}")
            else:
                peer.subscriptions[number] = topic
                self._subscribers.setdefault(topic, []).append((peer, number))
                if topic != MAP:
                    self._wanted.add(topic)
                self._stale = True

    def _unsubscribe(self, peer: _Peer, numbers: Sequence[int]) -> None:
        for number in numbers:
            topic = peer.subscriptions.pop(number, None)
            if topic is not None:
                peer.client.samples.pop(topic, None)
                self._subscribers[topic].remove((peer, number))
                if not self._subscribers[topic]:
                    del self._subscribers[topic]
                    self._wanted.discard(topic)

    # -- parameters -------------------------------------------------------------------------------

    def _parameters(self) -> dict[str, Json]:
        """Return the settings, by name."""
        if self._values is None:
            rows = self.scene.settings()
            self._values = {row["key"]: _parameter(row["key"], row["value"]) for row in rows}
        return self._values

    def _send_parameters(self) -> None:
        """Answer who has set some, and send subscribers what has changed."""
        if not self._waiting and (self._known is None or self._values is not None):
            return
        values, known = self._parameters(), self._known
        for peer, names, accepted, id_ in self._waiting:
            for name, value in accepted.items():
                if name not in values or values[name]["value"] != value:
                    peer.send_status(WARNING, f"{name[:100]} is not set: the reason is in /rosout")
            if id_ is not None:
                _send_values(peer, values, names, id_)
        self._waiting.clear()
        if known is not None and known is not values:
            self._known = values
            changed = [name for name, value in values.items() if known.get(name) != value]
            for peer in self._peers.values():
                if shown := [name for name in changed if name in peer.parameters]:
                    _send_values(peer, values, shown)

    def _set_parameters(
        self, now: Nanos, peer: _Peer, rows: Sequence[Json], id_: object
    ) -> Sequence[Instruction]:
        """Ask for new values, up to the first that is refused; what is no name or number spoils all."""
        wanted = {
            word(wire.string(one, "name"), "name"): wire.real(one.get("value"), "value") for one in rows
        }
        accepted = dict[str, Instruction]()
        for name, value in wanted.items():
            instruction, why = self._ask(now, peer, f"set {name} {value!r}")
            if instruction is None:
                peer.send_status(ERROR, f"{name[:100]} is not set: {why}")
                break
            accepted[name] = instruction
        self._waiting.append((peer, list(wanted), {name: wanted[name] for name in accepted}, id_))
        return list(accepted.values())

    def _subscribe_parameters(self, peer: _Peer, names: Sequence[str]) -> None:
        values = self._parameters()
        new = [name for name in names or values if name in values and name not in peer.parameters]
        peer.parameters.update(new)
        self._known = values if self._known is None else self._known
        if new:
            _send_values(peer, values, new)

    # -- what is asked of the robot ---------------------------------------------------------------

    def _ask(self, now: Nanos, peer: _Peer, line: str) -> tuple[Instruction | None, str]:
        """Return what a line asks, or None; and the answer."""
        instruction, answer = self._requests.line(now, peer.asking, line, peer.client.heard)
        return instruction, answer.text

    def _called(self, now: Nanos, peer: _Peer, asked: wire.Call) -> Instruction | None:
        """Call a service. What is refused is a failure of the call."""
        instruction: Instruction | None = None
        try:
            line = self._line_of(asked)
            instruction, text = self._ask(now, peer, line)
            failed = instruction is None and line.split() != ["help"]
        except WireError as error:
            text, failed = str(error), True
        if failed:
            failure = {"serviceId": asked.service, "callId": asked.call, "message": text[: wire.MAX_TEXT]}
            peer.client.send(wire.text("serviceCallFailure", failure))
        else:
            peer.client.send(wire.response(asked.service, asked.call, {"message": text}))
        return instruction

    def _line_of(self, asked: wire.Call) -> str:
        """Return what a call asks, in the operator's language; raises WireError."""
        service = self._services.get(asked.service)
        if service is None:
            raise WireError("Unknown service")
        if asked.encoding != b"json":
            raise WireError("Unsupported encoding: json is expected")
        given = wire.read_json(asked.payload or b"{}")
        if unknown := sorted(given.keys() - service.fields):
            raise WireError(f"there is no field {unknown[0][:100]!r}")
        return service.line(given)

    def _advertised_by(self, peer: _Peer, rows: Sequence[Json]) -> None:
        """Take what a client will publish on."""
        if not self._publish:
            peer.send_status(ERROR, "Server does not support clientPublish capability")
            return
        for one in rows:
            number, topic, encoding, name = (
                wire.number(one, "id"),
                *(wire.string(one, key) for key in ("topic", "encoding", "schemaName")),
            )
            expected, kind = RECEIVED.get(topic), name.rpartition("/")[2]
            if number in peer.channels:
                peer.send_status(WARNING, f"Client is already advertising channel: {number}")
            elif len(peer.channels) >= MAX_CHANNELS:
                peer.send_status(ERROR, f"there are {MAX_CHANNELS} channels already")
            elif expected is not None and (kind != expected or encoding not in wire.ENCODINGS):
                peer.send_status(ERROR, f"{topic}: {expected} in {' or '.join(wire.ENCODINGS)} is expected")
            else:
                peer.channels[number] = (topic, encoding)

    def _unadvertised_by(self, peer: _Peer, numbers: Sequence[int]) -> None:
        for number in numbers:
            if peer.channels.pop(number, None) is None:
                peer.send_status(WARNING, f"Client is not advertising channel: {number}")

    def _published(self, now: Nanos, peer: _Peer, asked: wire.Published) -> Sequence[Instruction]:
        """Do what a client publishes, and report to it what is refused, until it is not any more."""
        if asked.channel not in peer.channels:
            peer.send_status(ERROR, f"Unknown channel ID: {asked.channel}")
            return ()
        topic, encoding = peer.channels[asked.channel]
        instructions: Sequence[Instruction] = ()
        try:
            instructions, refused = self._asked_by(now, peer, topic, encoding, asked.payload)
        except WireError as error:
            refused = str(error)
        name = topic[:100]
        if refused:
            peer.troubled.add(name)
            peer.send_status(ERROR, f"{name}: {refused}", name)
        elif name in peer.troubled:
            peer.troubled.remove(name)
            peer.client.send(wire.text("removeStatus", {"statusIds": [name]}))
        return instructions

    def _asked_by(
        self, now: Nanos, peer: _Peer, topic: str, encoding: str, payload: bytes
    ) -> tuple[Sequence[Instruction], str]:
        """Return what a message asks, and why that is refused. A Twist of zeros lets go."""
        if topic not in RECEIVED:
            return (), f"nothing here receives this topic, but {', '.join(RECEIVED)}"
        if RECEIVED[topic] == "Twist":
            linear, lateral, angular = wire.twist(encoding, payload)
            sideways = f" {lateral!r}" if lateral else ""
            moves = linear or lateral or angular
            line = f"drive {linear!r} {angular!r}{sideways}" if moves else ""
            instructions, answer = self._requests.hold(now, peer.asking, line, peer.client.heard)
            return instructions, answer.text
        frame, x, y, yaw = wire.pose(encoding, payload)
        if frame.lstrip("/") not in ("", FRAME):
            return (), f"a goal is in the frame {FRAME!r}, not in {frame[:100]!r}"
        instruction, text = self._ask(now, peer, f"goal {x!r} {y!r} {yaw!r}rad")
        return ((), text) if instruction is None else ((instruction,), "")

    # -- a playback -------------------------------------------------------------------------------

    def _facts(self) -> Json:
        facts: Json = self.scene.facts()["playback"]
        return facts

    def _played(self, peer: _Peer, asked: wire.Play) -> None:
        if self._play is None:
            peer.send_status(ERROR, "Server does not support playback control capability")
            return
        wanted: dict[str, object] = {}
        if asked.seek is not None:
            wanted["seek"] = (asked.seek - (self._start or 0)) / SECOND
        if asked.rate > 0.0:
            wanted["rate"] = asked.rate
        answer = self._play(wanted | {"playing": asked.playing})
        if not answer.ok:
            peer.send_status(ERROR, answer.text)
        self._send_playback(sought=asked.seek is not None, request=asked.request)

    def _send_playback(self, *, sought: bool, request: bytes = b"") -> None:
        """Send where the playback is, if it has changed or on request."""
        facts = self._facts()
        ended = facts["due"] >= facts["length"] and not facts["playing"]
        state = wire.PLAYING if facts["playing"] else wire.ENDED if ended else wire.PAUSED
        known, self._playback = self._playback, (state, facts["rate"])
        if known == self._playback and not sought and not request:
            return
        t = (self._start or 0) + round(facts["due"] * SECOND)
        for client in self._peers:
            if client.subprotocol == wire.SDK:
                client.send(wire.playback(state, t, facts["rate"], sought=sought, request=request))


def _parameter(name: str, value: float) -> Json:
    kind = {"type": "float64"} if isinstance(value, float) else {}
    return {"name": name, "value": value} | kind


def _send_values(peer: _Peer, values: Mapping[str, Json], names: Sequence[str], id_: object = None) -> None:
    """Send parameters, of those that there are."""
    content: Json = {"parameters": [values[name] for name in names if name in values]}
    if id_ is not None:
        content["id"] = str(id_)[:200]
    peer.client.send(wire.text("parameterValues", content))
