"""Foxglove's protocol on the view's port, by two real ends that one loop polls, with a simulated robot.

What is expected of answers to wrong requests is what foxglove-sdk 0.30.3 answered to the same ones: its
level, and its words where they tell a person anything. Where ours differs on purpose, it is said.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

import gateway
from gateway.core.step import Gateway
from gateway.core.tick import Note, Tick
from gateway.recording import read_recording
from gateway.recording.ros_views import TOPICS, Views, typestore
from gateway.replay.player import Player
from gateway.runtime.replay_view import ReplayView
from gateway.view import Access, Address, Scene, View, parse_address
from gateway.view.requests import HELD, NO_ROBOT, READ_ONLY, ViewAnswer
from gateway.view.scene import Json
from protocols.messages import ClearFault, Drive, Goal, Instruction, Nanos, Release, Set, Stop
from tests.gateway.view.clients import Browser

SDK, V1 = "foxglove.sdk.v1", "foxglove.websocket.v1"
INFO, WARNING, ERROR = 0, 1, 2
POSE, TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Twist"


class App(Browser):
    """A client: texts as they are parsed, binary messages as they are."""

    def __init__(self, address: Address, subprotocol: str = SDK) -> None:
        super().__init__(address, "/", subprotocols=(subprotocol,))
        self.binary: list[bytes] = []

    def op(self, op: str) -> list[Any]:
        return [one for one in self.messages if one["op"] == op]

    def data(self, subscription: int) -> list[tuple[Nanos, bytes]]:
        """Return times and contents of what came for a subscription."""
        head = struct.pack("<BI", 1, subscription)
        return [(Nanos.from_bytes(b[5:13], "little"), b[13:]) for b in self.binary if b.startswith(head)]

    def channels(self) -> dict[str, Json]:
        return {one["topic"]: one for one in self.op("advertise")[0]["channels"]}

    def subscribe(self, *topics: str) -> None:
        """Subscribe with the channels' own ids."""
        ids = [self.channels()[topic]["id"] for topic in topics]
        self.send({"op": "subscribe", "subscriptions": [{"id": id_, "channelId": id_} for id_ in ids]})

    def of(self, topic: str) -> list[tuple[Nanos, bytes]]:
        return self.data(self.channels()[topic]["id"])

    def statuses(self) -> list[tuple[int, str]]:
        return [(one["level"], one["message"]) for one in self.op("status")]

    def advertise(self, topic: str, type_: str, encoding: str, id_: int = 1) -> None:
        channel = {"id": id_, "topic": topic, "encoding": encoding, "schemaName": type_}
        self.send({"op": "advertise", "channels": [channel]})

    def publish(self, payload: bytes, id_: int = 1) -> None:
        self.send(struct.pack("<BI", 1, id_) + payload)

    def call(self, name: str, payload: bytes, call: int = 7, encoding: bytes = b"json") -> None:
        services = {one["name"]: one["id"] for one in self.op("advertiseServices")[0]["services"]}
        self.send(struct.pack("<BIII", 2, services[name], call, len(encoding)) + encoding + payload)

    def _events(self) -> None:
        for event in self.protocol.events_received():
            if isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                self.messages.append(json.loads(bytes(event.data)))
            elif isinstance(event, Frame) and event.opcode is Opcode.BINARY:
                self.binary.append(bytes(event.data))
            elif isinstance(event, Frame) and event.opcode is Opcode.CLOSE:
                self._closed()


@dataclass
class Bench:
    """A simulated robot, its view, and the clients; `ticks` drives all of them."""

    session: gateway.Session
    view: View
    apps: list[App] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    """For the next tick."""
    asked: list[tuple[Nanos, Instruction]] = field(default_factory=list)
    reading: bool = True

    def __post_init__(self) -> None:
        self.ticks = self.session.run(poll=self._poll)

    def _poll(self) -> list[Instruction]:
        asked = self.view.poll(self.session.clock.now())
        self.asked += [(self.session.clock.now(), one) for one in asked]
        return asked

    def app(self, subprotocol: str = SDK) -> App:
        """Return a client that has been greeted."""
        app = App(parse_address(self.view.url.partition("//")[2].partition("/")[0]), subprotocol)
        self.apps.append(app)
        self.until(lambda: len(app.binary) > 0)  # the time
        return app

    def tick(self) -> Tick:
        tick = next(self.ticks)
        notes, self.notes = (*tick.outputs.notes, *self.notes), []
        tick = replace(tick, outputs=replace(tick.outputs, notes=notes))
        self.view.take(tick, self.session.belief)
        self.view.show(tick.now)
        for app in self.apps:
            app.poll(self.reading)
        return tick

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.tick()

    def until(self, what: Callable[[], bool], ticks: int = 1000) -> None:
        for _ in range(ticks):
            if what():
                return
            self.tick()
        raise AssertionError(f"not within {ticks} ticks")

    def of(self, kind: type[Instruction]) -> list[Any]:
        return [one for _, one in self.asked if isinstance(one, kind)]


@contextmanager
def bench(
    *, steer: bool = True, kind: Any = "live", facts: Callable[[], Json] = dict, acts: Any = None
) -> Iterator[Bench]:
    with gateway.open_session("diffbot", simulated=True, seed=1) as session:
        scene = Scene(session.gateway, kind, facts)
        with View([scene], Address(port=0), Access(), steer=steer, acts=acts) as view:
            made = Bench(session, view)
            try:
                yield made
            finally:
                for app in made.apps:
                    app.close()


@pytest.fixture
def loop() -> Iterator[Bench]:
    with bench() as made:
        yield made


# -- greeting ------------------------------------------------------------------------------------------


def playback(**now: Any) -> Callable[[], Json]:
    fixed = {"playing": False, "rate": 1.0, "t": 0.0, "due": 0.0, "length": 8.5, "prepared": 1.0}
    return lambda: {"playback": fixed | now}


REPLAY = {
    "kind": "replay",
    "facts": playback(),
    "acts": {"play": lambda _: ViewAnswer(ok=True, text="")},
}
BASE = ["time", "parameters", "parametersSubscribe"]


@pytest.mark.parametrize(
    ("how", "subprotocol", "capabilities", "services"),
    [
        ({}, SDK, [*BASE, "services", "clientPublish"], ["/stop", "/release", "/clear", "/goal", "/ask"]),
        ({"steer": False}, V1, [*BASE, "services"], ["/stop"]),
        (REPLAY, SDK, [*BASE, "playbackControl"], []),
        (REPLAY, V1, BASE, []),
    ],
    ids=["live", "read-only", "replay", "replay-old"],
)
def test_a_client_is_greeted(
    how: Any, subprotocol: str, capabilities: list[str], services: list[str]
) -> None:
    with bench(**how) as loop:
        loop.run(3)
        app = loop.app(subprotocol)
        info = app.messages[0]
        assert app.protocol.subprotocol == subprotocol
        assert [one["op"] for one in app.messages[:2]] == ["serverInfo", "advertise"]
        assert info["capabilities"] == capabilities
        assert info["supportedEncodings"] == ["json", "cdr"]
        assert info["metadata"]["ROS_DISTRO"] == "jazzy"
        assert info["sessionId"] == loop.app(subprotocol).messages[0]["sessionId"]
        offered = app.op("advertiseServices")
        assert [one["name"] for message in offered for one in message["services"]] == services
        assert ("dataEndTime" in info) is ("playbackControl" in capabilities)


def test_two_servers_are_two_sessions() -> None:
    with bench() as one, bench() as other:
        one.run(1)
        assert one.app().messages[0]["sessionId"] != other.app().messages[0]["sessionId"]


def test_every_topic_is_advertised_with_its_definition(loop: Bench) -> None:
    channels = loop.app().channels()
    assert channels.keys() == TOPICS.keys() | {"/can0/from_can_bus", "/can0/to_can_bus"}
    views = Views()
    for topic, channel in channels.items():
        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
        assert channel["schema"] == views.definition(channel["schemaName"])
        assert channel["schemaName"] == TOPICS.get(topic, "can_msgs/msg/Frame")
    assert len({channel["id"] for channel in channels.values()}) == len(channels)


# -- topics --------------------------------------------------------------------------------------------


def test_all_that_is_subscribed_to_comes_and_can_be_read(loop: Bench) -> None:
    app = loop.app()
    app.subscribe(*app.channels())
    loop.notes.append(Note("warning", "bus", "a note"))
    loop.until(lambda: len(app.of("/map")) > 0)
    app.advertise("/goal_pose", POSE, "json")
    app.publish(b'{"pose": {"position": {"x": 1.0}}}')
    loop.run(150)
    store, absent = typestore(), {"/fix", "/pose"}
    for topic, channel in app.channels().items():
        got = app.of(topic)
        assert bool(got) is (topic not in absent), topic
        for _, content in got:
            store.deserialize_cdr(content, channel["schemaName"])
    times = [t for t, _ in app.of("/odom")]
    assert times == sorted(times)
    assert min(b - a for a, b in pairwise(times)) > 19_900_000  # at most 50 Hz
    assert [b for b in app.binary if b[0] == 2]


def test_nothing_is_made_without_a_subscriber(loop: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    messages = Views.messages

    def seen(self: Views, *args: Any) -> Any:
        views = messages(self, *args)
        made.extend(view.topic for view in views)
        return views

    monkeypatch.setattr(Views, "messages", seen)
    app = loop.app()
    loop.run(200)
    assert not made
    app.subscribe("/odom")
    loop.run(100)
    assert set(made) == {"/odom"}
    app.send({"op": "unsubscribe", "subscriptionIds": [app.channels()["/odom"]["id"]]})
    loop.run(2)
    made.clear()
    count = len(app.of("/odom"))
    loop.run(50)
    assert not made
    assert len(app.of("/odom")) == count > 20


def test_who_comes_later_gets_what_stays(loop: Bench) -> None:
    first = loop.app()
    first.subscribe("/map", "/tf_static", "/goal_pose", "/plan", "/diagnostics", "/joint_states")
    first.advertise("/goal_pose", POSE, "json")
    goal = loop.session.tour()[0]
    first.publish(pose("map", goal.x, goal.y, 0.0)[0])
    loop.until(lambda: bool(first.of("/map")) and bool(loop.session.belief.path))
    second = loop.app()
    second.subscribe("/map", "/tf_static", "/goal_pose", "/plan", "/diagnostics", "/joint_states")
    loop.run(13)  # a tenth of a second, and the ways
    for topic in ("/map", "/tf_static", "/goal_pose", "/plan", "/diagnostics", "/joint_states"):
        assert second.of(topic), topic
    store = typestore()
    status: Any = store.deserialize_cdr(
        second.of("/diagnostics")[0][1], "diagnostic_msgs/msg/DiagnosticArray"
    )
    assert {one.name for one in status.status} >= {"/gateway/motors/left", "/gateway/motors/right"}
    plan: Any = store.deserialize_cdr(second.of("/plan")[0][1], "nav_msgs/msg/Path")
    assert len(plan.poses) == len(loop.session.belief.path)


def test_a_paused_scene_shows_what_stays(loop: Bench) -> None:
    """No tick comes, as in a replay that stands."""
    loop.run(100)
    app = loop.app()
    app.subscribe("/odom", "/scan", "/map")
    now = loop.session.clock.now()
    for number in range(50):
        loop.view.poll(now)
        loop.view.show(now + number * 10_000_000)
        app.poll()
    assert [len(app.of(topic)) for topic in ("/odom", "/scan", "/map")] == [1, 1, 1]


def test_a_slow_client_gets_every_note_and_the_newest_of_the_rest(loop: Bench) -> None:
    app = loop.app()
    app.subscribe("/rosout", "/odom", "/can0/from_can_bus")
    loop.run(20)
    loop.reading = False
    slow, frames = 0, 0
    while slow < 200:  # ticks in which there was no room
        loop.notes.append(Note("info", "test", f"{len(loop.asked)} " + "x" * 8000))
        tick = loop.tick()
        frames += len(tick.inputs.packets)
        client = loop.view._server.clients[0]
        slow += client.stuck_since is not None
        sent = sum(b"x" * 8000 in content for _, content in app.of("/rosout"))
    assert sent == 0
    loop.reading = True
    loop.run(100)
    notes = [content for _, content in app.of("/rosout") if b"x" * 8000 in content]
    assert len(notes) >= 200
    times = [t for t, _ in app.of("/odom")]
    estimate = loop.session.belief.estimate
    assert estimate is not None
    assert 0 <= estimate.t - times[-1] <= 20_000_000  # what was sent in the last tick is not read yet
    assert max(b - a for a, b in pairwise(times)) > 10**9
    assert len(app.of("/can0/from_can_bus")) < frames


# -- wrong requests ------------------------------------------------------------------------------------

CHANNEL = '{"id":1,"topic":"/x","encoding":"json","schemaName":"X"}'
WRONG: list[tuple[Any, tuple[int, str] | None]] = [
    ("{", (ERROR, "Invalid message: JSON is expected: an object")),
    ("[]", (ERROR, "Invalid message: JSON is expected: an object")),
    ("[" * 60000, (ERROR, "Invalid message: JSON is expected: an object")),
    ('{"op": 1}', (ERROR, "Invalid message: an op is expected")),
    ('{"op":"fly"}', (ERROR, "Invalid message: there is no op 'fly'")),
    ("{}", (ERROR, "Invalid message: an op is expected")),
    (
        '{"op":"subscribe","subscriptions":[{"id":1,"channelId":999}]}',
        (ERROR, "Unknown channel ID: 999"),
    ),
    (
        '{"op":"subscribe","subscriptions":[{"id":9,"channelId":1},{"id":8,"channelId":1}]}',
        (WARNING, "Client is already subscribed to channel: 1"),
    ),
    (
        '{"op":"subscribe","subscriptions":[{"id":9,"channelId":1},{"id":9,"channelId":2}]}',
        (ERROR, "Subscription ID was already used: 9"),
    ),
    ('{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}', (ERROR, "id must be an integer")),
    ('{"op":"subscribe","subscriptions":[{"id":true,"channelId":1}]}', (ERROR, "id must be an integer")),
    ('{"op":"subscribe","subscriptions":[7]}', (ERROR, "subscriptions must be a list of objects")),
    ('{"op":"unsubscribe","subscriptionIds":[77]}', None),
    ('{"op":"unsubscribe","subscriptionIds":7}', (ERROR, "subscriptionIds must be a list of ids")),
    ('{"op":"unadvertise","channelIds":[9]}', (WARNING, "Client is not advertising channel: 9")),
    (
        f'{{"op":"advertise","channels":[{CHANNEL},{CHANNEL}]}}',
        (WARNING, "Client is already advertising channel: 1"),
    ),
    ('{"op":"advertise","channels":[{"id":1,"topic":5}]}', (ERROR, "topic must be a text")),
    (  # the reference takes any encoding
        '{"op":"advertise","channels":[{"id":2,"topic":"/cmd_vel","encoding":"xml","schemaName":"Twist"}]}',
        (ERROR, "/cmd_vel: Twist in json or cdr is expected"),
    ),
    (
        '{"op":"advertise","channels":[{"id":2,"topic":"/goal_pose","encoding":"cdr","schemaName":"a/Twist"}]}',
        (ERROR, "/goal_pose: PoseStamped in json or cdr is expected"),
    ),
    (struct.pack("<BI", 1, 9) + b"{}", (ERROR, "Unknown channel ID: 9")),
    (b"\1\0", (ERROR, "Invalid message: it is too short")),
    (b"", None),
    (b"\x63abc", (ERROR, "Invalid message: there is no opcode 99")),
    (b"\2\0\0", (ERROR, "Invalid message: it is too short")),
    (struct.pack("<BIII", 2, 1, 3, 400) + b"json{}", (ERROR, "Invalid message: it is too short")),
    (
        struct.pack("<BBfBQI", 3, 0, 1.0, 0, 0, 1) + b"r",
        (ERROR, "Server does not support playback control capability"),
    ),
    (
        struct.pack("<BBfBQI", 3, 7, 1.0, 0, 0, 1) + b"r",
        (ERROR, "Invalid message: there is no playback command 7"),
    ),
    (b"\3\0", (ERROR, "Invalid message: it is too short")),
    ('{"op":"setParameters","parameters":7,"id":"s2"}', (ERROR, "parameters must be a list of objects")),
    ('{"op":"setParameters","parameters":[{"name":"a b","value":1}]}', (ERROR, "'a b' is no name")),
    ('{"op":"setParameters","parameters":[{"name":"a","value":"1"}]}', (ERROR, "value must be a finite")),
    ('{"op":"setParameters","parameters":[{"name":"a","value":NaN}]}', (ERROR, "value must be a finite")),
    (
        '{"op":"setParameters","parameters":[{"name":"a","value":1' + "0" * 400 + "}]}",
        (ERROR, "value must be a finite"),
    ),
    ('{"op":"setParameters","parameters":[{"name":"a","value":1}]}', (ERROR, "a is not set: no owner")),
    (
        '{"op":"setParameters","parameters":[{"name":"a","value":1},{"name":"b","value":1}]}',
        (ERROR, "a is not set: no owner"),
    ),
    (
        json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 999}] * 101}),
        (ERROR, "subscriptions: at most 100 are expected"),
    ),
    (
        '{"op":"subscribeConnectionGraph"}',
        (ERROR, "Server does not support connection graph capability"),
    ),
    (
        '{"op":"fetchAsset","uri":"package://x","requestId":3}',
        (ERROR, "Server does not support assets capability"),
    ),
]


@pytest.fixture(scope="module")
def shared() -> Iterator[Bench]:
    with bench() as made:
        yield made


@pytest.mark.parametrize(("message", "expected"), WRONG, ids=[str(one[0])[:60] for one in WRONG])
def test_what_is_wrong_is_told(
    shared: Bench, app: App, message: Any, expected: tuple[int, str] | None
) -> None:
    app.send(message)
    shared.run(60 if len(message) > 1000 else 4)
    if expected is None:
        assert not app.statuses()
    else:
        assert len(app.statuses()) == 1
        level, words = app.statuses()[0]
        assert level == expected[0]
        assert expected[1] in words
    assert app.open
    app.send({"op": "getParameters", "parameterNames": ["left.limits.torque"], "id": "still there"})
    shared.until(lambda: bool(app.op("parameterValues")))


@pytest.fixture
def app(shared: Bench) -> Iterator[App]:
    """A client of the shared robot, which is asked nothing yet."""
    app = shared.app()
    shared.asked.clear()
    yield app
    shared.apps.remove(app)
    app.close()
    shared.run(2)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
OPS = [
    "subscribe",
    "unsubscribe",
    "advertise",
    "unadvertise",
    "getParameters",
    "setParameters",
    "subscribeParameterUpdates",
    "unsubscribeParameterUpdates",
    "fetchAsset",
]
FIELDS = [
    "subscriptions",
    "subscriptionIds",
    "channels",
    "channelIds",
    "parameters",
    "parameterNames",
    "id",
    "channelId",
    "topic",
    "name",
    "value",
    "encoding",
    "schemaName",
]
rows = st.lists(st.dictionaries(st.sampled_from(FIELDS), json_values, max_size=4), max_size=3)
texts = st.builds(
    lambda op, more: json.dumps({"op": op} | more),
    st.sampled_from(OPS),
    st.dictionaries(st.sampled_from(FIELDS), json_values | rows, max_size=4),
)
binaries = st.builds(
    lambda op, rest: bytes([op]) + rest, st.integers(0, 5), st.binary(max_size=60)
) | st.builds(
    lambda service, encoding, rest: struct.pack("<BIII", 2, service, 1, len(encoding)) + encoding + rest,
    st.integers(0, 6),
    st.sampled_from([b"json", b"cdr"]),
    st.binary(max_size=40) | json_values.map(lambda value: json.dumps(value).encode()),
)


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(messages=st.lists(texts | binaries | st.text(max_size=40), max_size=6))
def test_no_message_does_any_harm(shared: Bench, messages: list[str | bytes]) -> None:
    app = shared.app()
    for topic, type_ in (("/goal_pose", POSE), ("/cmd_vel", TWIST)):
        for encoding in ("json", "cdr"):
            app.advertise(topic, type_, encoding, id_=len(topic) + len(encoding))
    for message in messages:
        app.send(message)
        if isinstance(message, bytes):
            app.publish(message, id_=len("/cmd_vel") + 3)
            app.publish(b"\0\1\0\0" + message, id_=len("/goal_pose") + 3)
    app.send({"op": "getParameters", "parameterNames": ["left.limits.torque"], "id": "at the end"})
    shared.until(lambda: any(one.get("id") == "at the end" for one in app.op("parameterValues")))
    shared.apps.remove(app)
    app.close()
    shared.run(3)


# -- parameters ----------------------------------------------------------------------------------------


def test_parameters_are_the_settings(loop: Bench) -> None:
    app = loop.app()
    app.send({"op": "getParameters", "parameterNames": [], "id": "all"})
    app.send({"op": "getParameters", "parameterNames": ["left.limits.torque", "nothing"]})
    loop.until(lambda: len(app.op("parameterValues")) == 2)
    everything, two = app.op("parameterValues")
    rows = Scene(loop.session.gateway, "live", dict).settings()
    assert everything["id"] == "all"
    assert {p["name"]: p["value"] for p in everything["parameters"]} == {r["key"]: r["value"] for r in rows}
    assert two == {
        "op": "parameterValues",
        "parameters": [{"name": "left.limits.torque", "value": 2.0, "type": "float64"}],
    }


def test_a_parameter_is_set_answered_and_told_to_who_has_subscribed(loop: Bench) -> None:
    app, other, third = loop.app(), loop.app(V1), loop.app()
    other.send({"op": "subscribeParameterUpdates", "parameterNames": []})
    third.send({"op": "subscribeParameterUpdates", "parameterNames": ["right.limits.torque"]})
    loop.until(lambda: bool(other.op("parameterValues")) and bool(third.op("parameterValues")))
    values = [
        {"name": "left.limits.torque", "value": 1.5, "type": "float64"},
        {"name": "brain.planner.margin", "value": 0.2},
    ]
    app.send({"op": "setParameters", "parameters": values, "id": "mine"})
    loop.until(lambda: bool(app.op("parameterValues")))
    loop.run(3)
    answer = app.op("parameterValues")[0]
    assert answer["id"] == "mine"
    assert {p["name"]: p["value"] for p in answer["parameters"]} == {
        "left.limits.torque": 1.5,
        "brain.planner.margin": 0.2,
    }
    assert loop.session.joints["left"].settings.limits.torque == 1.5
    told = other.op("parameterValues")[1]
    assert "id" not in told
    assert {p["name"] for p in told["parameters"]} == {"left.limits.torque", "brain.planner.margin"}
    assert len(third.op("parameterValues")) == 1  # its values, on subscribing
    loop.session.submit(Set("right.limits.torque", 1.0))  # somebody else
    loop.run(3)
    assert third.op("parameterValues")[1]["parameters"][0]["value"] == 1.0
    third.send({"op": "unsubscribeParameterUpdates", "parameterNames": []})
    loop.run(3)
    loop.session.submit(Set("right.limits.torque", 0.9))
    loop.run(3)
    assert len(third.op("parameterValues")) == 2
    assert not app.statuses()


def test_a_parameter_out_of_its_bounds_stays(loop: Bench) -> None:
    app = loop.app()
    app.send({"op": "setParameters", "parameters": [{"name": "left.limits.torque", "value": 9}], "id": "x"})
    loop.until(lambda: bool(app.op("parameterValues")))
    assert app.op("parameterValues")[0]["parameters"][0]["value"] == 2.0
    assert app.statuses() == [(WARNING, "left.limits.torque is not set: the reason is in /rosout")]


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"steer": False}, READ_ONLY),
        (REPLAY, NO_ROBOT),
    ],
    ids=["read-only", "replay"],
)
def test_who_only_looks_changes_nothing(how: Any, why: str) -> None:
    with bench(**how) as loop:
        app = loop.app()
        app.send({"op": "setParameters", "parameters": [{"name": "left.limits.torque", "value": 1}]})
        app.advertise("/cmd_vel", TWIST, "json")
        app.publish(b'{"linear": {"x": 0.1}}')
        loop.run(5)
        assert app.statuses() == [
            (ERROR, f"left.limits.torque is not set: {why}"),
            (ERROR, "Server does not support clientPublish capability"),
            (ERROR, "Unknown channel ID: 1"),
        ]
        assert not loop.asked


def test_who_only_looks_can_stop() -> None:
    with bench(steer=False) as loop:
        app = loop.app()
        app.call("/stop", b"{}")
        loop.until(lambda: bool(loop.of(Stop)))
        app.send(struct.pack("<BIII", 2, 2, 1, 4) + b"json{}")
        loop.until(lambda: bool(app.op("serviceCallFailure")))
        assert app.op("serviceCallFailure")[0]["message"] == "Unknown service"


# -- services ------------------------------------------------------------------------------------------

CALLS: list[tuple[str, bytes, type[Instruction] | None, str]] = [
    ("/stop", b"", Stop, "stopped"),
    ("/stop", b'{"reason": "a dog"}', Stop, "stopped"),
    ("/release", b"{}", Release, "accepted"),
    ("/clear", b"{}", ClearFault, "accepted"),
    ("/clear", b'{"motor": "left"}', ClearFault, "accepted: clear left"),
    ("/clear", b'{"motor": "#"}', None, "'#' is no motor"),
    ("/clear", b'{"motor": "nobody"}', None, "no motor 'nobody'"),
    ("/goal", b'{"x": 1, "y": -0.5, "yaw": 1.5707963267948966}', Goal, "accepted"),
    ("/goal", b'{"x": 1}', None, "y must be a finite number"),
    ("/goal", b'{"x": 1, "y": 2, "z": 3}', None, "there is no field 'z'"),
    ("/goal", b'{"x": 1, "y": NaN}', None, "y must be a finite number"),
    ("/goal", b"[1, 2]", None, "JSON is expected: an object"),
    ("/goal", b"\xff", None, "JSON is expected"),
    ("/ask", b'{"line": "goal 2 1 90"}', Goal, "accepted: goal 2 1 90"),
    ("/ask", b'{"line": "fly"}', None, "no command 'fly'"),
    ("/ask", b'{"line": "help"}', None, ""),
    ("/ask", b"{}", None, "line must be a text"),
]


@pytest.mark.parametrize(("name", "payload", "asked", "answer"), CALLS, ids=[str(one[:2]) for one in CALLS])
def test_a_service_is_called(
    shared: Bench, app: App, name: str, payload: bytes, asked: type[Instruction] | None, answer: str
) -> None:
    app.call(name, payload)
    shared.until(lambda: any(b[0] == 3 for b in app.binary) or bool(app.op("serviceCallFailure")))
    if asked is None and answer:
        failure = app.op("serviceCallFailure")[0]
        assert failure["callId"] == 7
        assert answer in failure["message"]
        assert not shared.asked
    else:
        (got,) = (b for b in app.binary if b[0] == 3)
        _, service, call, length = struct.unpack_from("<BIII", got)
        assert (service, call, got[13 : 13 + length]) == (app_service(app, name), 7, b"json")
        assert answer in json.loads(got[17:])["message"]
        assert [type(one) for _, one in shared.asked] == ([] if asked is None else [asked])


def app_service(app: App, name: str) -> int:
    return next(int(one["id"]) for one in app.op("advertiseServices")[0]["services"] if one["name"] == name)


def test_a_call_has_a_service_and_an_encoding(shared: Bench, app: App) -> None:
    app.send(struct.pack("<BIII", 2, 99, 1, 4) + b"json{}")
    app.call("/stop", b"{}", call=2, encoding=b"cdr")
    shared.until(lambda: len(app.op("serviceCallFailure")) == 2)
    unknown, encoding = app.op("serviceCallFailure")
    assert unknown == {
        "op": "serviceCallFailure",
        "serviceId": 99,
        "callId": 1,
        "message": "Unknown service",
    }
    assert (encoding["callId"], encoding["message"]) == (2, "Unsupported encoding: json is expected")


# -- what clients publish ------------------------------------------------------------------------------


def pose(frame: str, x: float, y: float, yaw: float) -> tuple[bytes, bytes]:
    """Return a PoseStamped in JSON, and in CDR by another program."""
    types, store = typestore().types, typestore()
    z, w = math.sin(yaw / 2), math.cos(yaw / 2)
    point = types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0)
    turned = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=z, w=w)
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    message = types[POSE](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame),
        pose=types["geometry_msgs/msg/Pose"](position=point, orientation=turned),
    )
    text = {
        "header": {"frame_id": frame, "stamp": {"sec": 1, "nsec": 2}},
        "pose": {"position": {"x": x, "y": y, "z": 0}, "orientation": {"x": 0, "y": 0, "z": z, "w": w}},
    }
    return json.dumps(text).encode(), bytes(store.serialize_cdr(message, POSE))


def twist(x: float, y: float, yaw: float, *, little: bool = True) -> tuple[bytes, bytes]:
    types, store = typestore().types, typestore()
    vector = types["geometry_msgs/msg/Vector3"]
    message = types[TWIST](linear=vector(x=x, y=y, z=0.0), angular=vector(x=0.0, y=0.0, z=yaw))
    text = {"linear": {"x": x, "y": y}, "angular": {"z": yaw}}
    return json.dumps(text).encode(), bytes(store.serialize_cdr(message, TWIST, little_endian=little))


@pytest.mark.parametrize("encoding", ["json", "cdr"])
@pytest.mark.parametrize("topic", ["/goal_pose", "/move_base_simple/goal"])
@pytest.mark.parametrize("frame", ["map", "/map", ""])
def test_a_pose_is_a_goal(shared: Bench, app: App, topic: str, encoding: str, frame: str) -> None:
    app.advertise(topic, POSE if encoding == "cdr" else "geometry_msgs/PoseStamped", encoding)
    app.publish(pose(frame, 1.25, -0.5, 2.0)[encoding == "cdr"])
    shared.until(lambda: bool(shared.of(Goal)))
    goal = shared.of(Goal)[0]
    assert (goal.x, goal.y, goal.yaw) == (1.25, -0.5, pytest.approx(2.0, abs=1e-12))
    assert not app.statuses()


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (pose("base_link", 1.0, 0.0, 0.0)[0], "a goal is in the frame 'map', not in 'base_link'"),
        (pose("odom", 1.0, 0.0, 0.0)[0], "a goal is in the frame 'map', not in 'odom'"),
        (b"{", "JSON is expected: an object"),
        (b'{"pose": 7}', "pose must be an object"),
        (b'{"pose": {"position": {"x": "1"}}}', "x must be a finite number"),
        (b'{"pose": {"position": {"x": Infinity}}}', "x must be a finite number"),
    ],
)
def test_what_is_no_goal_is_told_and_that_it_is_over(
    shared: Bench, app: App, payload: bytes, why: str
) -> None:
    app.advertise("/goal_pose", POSE, "json")
    app.publish(payload)
    shared.until(lambda: bool(app.op("status")))
    assert app.op("status") == [
        {"op": "status", "level": ERROR, "message": f"/goal_pose: {why}", "id": "/goal_pose"}
    ]
    assert not shared.asked
    app.publish(pose("map", 1.0, 0.0, 0.0)[0])
    shared.until(lambda: bool(app.op("removeStatus")))
    assert app.op("removeStatus") == [{"op": "removeStatus", "statusIds": ["/goal_pose"]}]


def test_every_part_of_a_pose_is_too_little_and_none_is_taken(shared: Bench, app: App) -> None:
    app.advertise("/goal_pose", POSE, "cdr")
    whole = pose("map", 1.0, 0.0, 0.0)[1]
    for end in range(len(whole)):
        app.publish(whole[:end])
    for head in (b"\0\2\0\0", b"\1\0\0\0", b"\0\7\0\0"):
        app.publish(head + whole[4:])
    app.publish(whole[:12] + b"\xff\xff\xff\xff" + whole[16:])
    shared.until(lambda: len(app.op("status")) == len(whole) + 4)
    assert not shared.asked


def test_a_client_has_so_many_channels(shared: Bench, app: App) -> None:
    for first in (0, 60):
        channels = [
            {"id": first + number, "topic": "/x", "encoding": "json", "schemaName": "X"}
            for number in range(60)
        ]
        app.send({"op": "advertise", "channels": channels})
    shared.until(lambda: len(app.statuses()) == 20)
    assert set(app.statuses()) == {(ERROR, "there are 100 channels already")}


def test_numbers_that_are_not_finite_are_no_motion(shared: Bench, app: App) -> None:
    app.advertise("/cmd_vel", TWIST, "cdr")
    app.publish(twist(math.nan, 0.0, 0.0)[1])
    shared.until(lambda: bool(app.statuses()))
    assert app.statuses() == [(ERROR, "/cmd_vel: finite numbers are expected")]
    assert not shared.asked


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    "payload",
    [
        twist(0.1, 0.0, 0.3)[0],
        twist(0.1, 0.0, 0.3)[1],
        twist(0.1, 0.0, 0.3, little=False)[1],
    ],
    ids=["json", "cdr", "cdr-big-endian"],
)
def test_a_twist_drives_for_as_long_as_it_is_repeated(payload: bytes) -> None:
    with bench() as loop:
        app = loop.app()
        app.advertise("/cmd_vel", TWIST, "json" if payload.startswith(b"{") else "cdr")
        for _ in range(100):
            app.publish(payload)
            loop.tick()
        last = loop.session.clock.now()
        loop.until(lambda: loop.of(Drive)[-1] == Drive(0.0, 0.0) if loop.of(Drive) else False)
        moved, ended = [(t, one) for t, one in loop.asked if one == Drive(0.1, 0.3)], loop.asked[-1]
        assert 90 <= len(moved) <= 100
        assert HELD < ended[0] - moved[-1][0] <= HELD + 2 * loop.session.robot.period
        assert moved[-1][0] <= last + 2 * loop.session.robot.period
        assert not app.statuses()


def test_a_twist_of_zeros_lets_go_and_drops_no_goal(loop: Bench) -> None:
    app = loop.app()
    app.advertise("/cmd_vel", TWIST, "json")
    app.publish(twist(0.0, 0.0, 0.0)[0])
    loop.run(50)
    assert not loop.asked
    app.publish(twist(0.1, 0.0, 0.0)[0])
    loop.until(lambda: bool(loop.asked))
    app.publish(twist(0.0, 0.0, 0.0)[0])
    loop.run(5)
    assert [one for _, one in loop.asked] == [Drive(0.1, 0.0), Drive(0.0, 0.0)]


def test_what_a_client_holds_ends_with_it(loop: Bench) -> None:
    app = loop.app()
    app.advertise("/cmd_vel", TWIST, "json")
    app.publish(twist(0.1, 0.0, 0.0)[0])
    loop.until(lambda: bool(loop.asked))
    app.close()
    loop.apps.remove(app)
    loop.run(3)
    assert [one for _, one in loop.asked] == [Drive(0.1, 0.0), Drive(0.0, 0.0)]


def test_a_twist_that_the_base_cannot_do_is_told(loop: Bench) -> None:
    app = loop.app()
    app.advertise("/cmd_vel", TWIST, "json")
    app.publish(twist(0.1, 0.2, 0.0)[0])
    loop.until(lambda: bool(app.op("status")))
    assert "sideways" in app.op("status")[0]["message"]
    assert not loop.asked


def test_a_topic_that_nobody_receives_may_be_advertised(loop: Bench) -> None:
    app = loop.app()
    app.advertise("/clicked_point", "geometry_msgs/PointStamped", "json")
    loop.run(5)
    assert not app.statuses()
    app.publish(b"{}")
    loop.until(lambda: bool(app.statuses()))
    assert "nothing here receives this topic, but /goal_pose" in app.statuses()[0][1]
    app.send({"op": "unadvertise", "channelIds": [1]})
    app.publish(b"{}")
    loop.until(lambda: len(app.statuses()) == 2)
    assert app.statuses()[1] == (ERROR, "Unknown channel ID: 1")


# -- a replay ------------------------------------------------------------------------------------------


@dataclass
class Playing:
    """A playback that does what it is told."""

    facts: Json = field(default_factory=lambda: playback()()["playback"])
    asked: list[Any] = field(default_factory=list)

    def act(self, asked: Any) -> ViewAnswer:
        self.asked.append(asked)
        self.facts |= {"playing": asked["playing"], "rate": asked.get("rate", 1.0)}
        self.facts["due"] = asked.get("seek", self.facts["due"])
        return ViewAnswer(ok=True, text="")


def state_of(message: bytes) -> tuple[int, int, float, bool, bytes]:
    """Return status, time, rate, whether it was sought, and the id of the request."""
    _, status, t, rate, sought, length = struct.unpack_from("<BBQfBI", message)
    assert len(message) == 19 + length
    return status, t, rate, bool(sought), message[19:]


def test_a_playback_is_controlled() -> None:
    playing = Playing()
    with bench(kind="replay", facts=lambda: {"playback": playing.facts}, acts={"play": playing.act}) as loop:
        start = loop.tick().now
        app, old = loop.app(), loop.app(V1)
        info = app.messages[0]
        assert info["dataStartTime"] == {"sec": start // 10**9, "nsec": start % 10**9}
        end = start + 8_500_000_000
        assert info["dataEndTime"] == {"sec": end // 10**9, "nsec": end % 10**9}
        loop.run(20)
        app.binary.clear()
        app.send(struct.pack("<BBfBQI", 3, 0, 2.0, 0, 0, 2) + b"r1")
        loop.run(3)
        app.send(struct.pack("<BBfBQI", 3, 1, 1.0, 1, start + 3_000_000_000, 2) + b"r2")
        loop.run(3)
        playing.facts["due"] = 8.5
        loop.run(20)
        states = [state_of(b) for b in app.binary if b[0] == 5]
        assert playing.asked == [
            {"rate": 2.0, "playing": True},
            {"seek": 3.0, "rate": 1.0, "playing": False},
        ]
        assert states == [
            (0, start, 2.0, False, b"r1"),
            (1, start + 3_000_000_000, 1.0, True, b"r2"),
            (3, end, 1.0, False, b""),
        ]
        assert not [b for b in old.binary if b[0] == 5]


def test_what_a_playback_refuses_is_told() -> None:
    refuses = {"play": lambda _: ViewAnswer(ok=False, text="not now")}
    with bench(kind="replay", facts=playback(), acts=refuses) as loop:
        app = loop.app()
        app.send(struct.pack("<BBfBQI", 3, 0, 2.0, 0, 0, 2) + b"r1")
        loop.until(lambda: bool(app.statuses()))
        assert app.statuses() == [(ERROR, "not now")]


def test_after_a_jump_everything_is_sent_anew() -> None:
    playing = Playing()
    with bench(kind="replay", facts=lambda: {"playback": playing.facts}, acts={"play": playing.act}) as loop:
        scene = loop.view._scenes[0]
        app = loop.app()
        app.subscribe("/tf_static", "/joint_states")
        loop.run(50)
        app.binary.clear()
        scene.adopt(Gateway(loop.session.robot))  # as a player does
        loop.run(2)
        assert len(app.of("/tf_static")) == 1
        assert [state_of(b)[3] for b in app.binary if b[0] == 5] == [True]


def test_a_recording_is_played_sought_and_ends(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    with gateway.open_session("diffbot", simulated=True, seed=1, record=file) as session:
        session.submit(session.tour()[0])
        for _ in session.run(seconds=3.0):
            pass
    with Player(read_recording(file), cache=tmp_path) as player:
        view = ReplayView([player], Address(port=0), Access())
        with closing(view), closing(App(parse_address(view.url.partition("//")[2][:-1]))) as app:
            now = 0

            def slices(count: int) -> None:
                nonlocal now
                for _ in range(count):
                    now += 10_000_000
                    view.slice(now)
                    app.poll()

            def play(command: int, seek: Nanos | None, request: bytes) -> None:
                head = struct.pack("<BBfBQI", 3, command, 1.0, seek is not None, seek or 0, len(request))
                app.send(head + request)

            slices(10)
            info, start = app.messages[0], player.start
            assert info["dataStartTime"] == {"sec": start // 10**9, "nsec": start % 10**9}
            assert info["dataEndTime"] == {"sec": player.end // 10**9, "nsec": player.end % 10**9}
            app.subscribe("/odom", "/tf_static")
            slices(20)
            assert len(app.of("/odom")) <= 1  # it stands
            assert len(app.of("/tf_static")) == 1
            play(0, None, b"a")
            slices(100)
            times = [t for t, _ in app.of("/odom")]
            assert len(times) > 40
            assert times == sorted(times)
            app.binary.clear()
            back = start + 200_000_000
            play(0, back, b"b")
            slices(20)
            clock = [Nanos.from_bytes(b[1:], "little") for b in app.binary if b[0] == 2]
            assert start < min(clock) < back + 100_000_000
            assert min(t for t, _ in app.of("/odom")) < back + 100_000_000
            assert app.of("/tf_static")
            slices(330)
            states = [state_of(b) for b in app.binary if b[0] == 5]
            assert states[0] == (0, back, 1.0, True, b"b")
            assert states[-1] == (3, player.end, 1.0, False, b"")
            play(1, back, b"c")
            slices(30)
            assert (1, back, 1.0, True, b"c") in [state_of(b) for b in app.binary if b[0] == 5]
            assert player.now <= back
            assert not app.statuses()
