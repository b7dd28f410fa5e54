"""The graph of rmw_zenoh: how its keys are made, and a robot in it, judged by a peer with real messages."""

from __future__ import annotations

import socket
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import gateway
from gateway.errors import UserError
from gateway.ros import actions, definitions, graph, types
from gateway.ros import zenoh_keys as keys
from gateway.ros.link import Setup, dds_type
from gateway.ros.network import ROUTER, parse_network, zenoh_endpoint
from gateway.ros.process import open_carrier
from gateway.ros.zenoh_keys import Endpoint, Node
from protocols import messages as msg
from tests.gateway.processes import PATIENCE
from tests.gateway.ros.judged import Judge, domain, python
from tests.gateway.ros.test_judges import Server

NODE = Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", "", "listener")
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
STRING = "std_msgs::msg::dds_::String_"


def test_networks_of_zenoh() -> None:
    assert zenoh_endpoint(parse_network("zenoh")) == (ROUTER, True)
    assert zenoh_endpoint(parse_network("zenoh:tcp/192.0.2.1:7447")) == ("tcp/192.0.2.1:7447", False)
    for wrong in ("zenoh:", "zenoh:192.0.2.1", "zenoh:tcp/here"):
        with pytest.raises(UserError, match="expected zenoh, or zenoh:tcp/HOST:PORT"):
            parse_network(wrong)


@pytest.mark.parametrize(
    ("one", "text"),
    [
        (Endpoint("MS", "/chatter", STRING, HASH), "MS/%/%/listener/%chatter/TYPE/HASH/::,10:,:,:,,"),
        (
            Endpoint("MP", "/map", STRING, HASH, transient=True, depth=1),
            "MP/%/%/listener/%map/TYPE/HASH/:1:,1:,:,:,,",
        ),
        (
            Endpoint("MS", "/a/cmd_vel", STRING, HASH, reliable=False, depth=1),
            "MS/%/%/listener/%a%cmd_vel/TYPE/HASH/2::,1:,:,:,,",
        ),
    ],
)
def test_tokens(one: Endpoint, text: str) -> None:
    """The first is the example of rmw_zenoh's design."""
    made = keys.token(NODE, 10, one)
    wanted = text.replace("TYPE", STRING).replace("HASH", HASH)
    assert made == f"@ros2_lv/2/{NODE.session}/0/10/{wanted}"
    assert keys.subscribed(made) == ((one.name, STRING) if one.kind == "MS" else None)


def test_nodes_data_and_attachments() -> None:
    assert keys.node_token(NODE) == f"@ros2_lv/2/{NODE.session}/0/0/NN/%/%/listener"
    inner = NODE._replace(namespace="/left/arm")
    assert keys.node_token(inner).endswith("/NN/%/%left%arm/listener")
    assert keys.data_key(0, Endpoint("MP", "/chatter", STRING, HASH)) == f"0/chatter/{STRING}/{HASH}"
    goal = Endpoint(
        "SS", "/left/navigate_to_pose/_action/send_goal", dds_type(f"{graph.NAVIGATE}_SendGoal"), HASH
    )
    assert keys.data_key(7, goal) == (  # by pamoja-ros2 0.2.0
        f"7/left/navigate_to_pose/_action/send_goal/nav2_msgs::action::dds_::NavigateToPose_SendGoal_/{HASH}"
    )
    assert keys.subscribed(keys.node_token(NODE)) is None
    whose = bytes(range(16))
    packed = keys.attachment(7, 1_000_000_007, whose)
    assert packed.hex() == "070000000000000007ca9a3b0000000010" + whose.hex()
    assert keys.read_attachment(packed) == (7, whose)
    assert keys.read_attachment(packed[:16] + whose) == (7, whose)
    for wrong in (b"", packed[:-2], packed + b"\0", packed[:16] + b"\x0f" + packed[17:]):
        assert keys.read_attachment(wrong) is None


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the process with the network says it."""
    monkeypatch.setitem(sys.modules, "gateway.ros.zenoh_carrier", None)
    with pytest.raises(UserError, match=r"pip install 'motor-gateway\[ros\]'"):
        open_carrier(Setup("zenoh", 0, "n", "", ()), None)  # type: ignore[arg-type]


def endpoint() -> str:
    """Return an endpoint that is free."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{one.getsockname()[1]}"


def judge(folder: Path, number: int, where: str, part: str) -> Judge:
    python()
    return Judge(folder, "zenoh_client", number, str(number), where, part)


def test_a_robot_in_the_graph_of_zenoh(tmp_path: Path) -> None:
    number, where, asked = domain(), endpoint(), list[Any]()
    with gateway.open_session("diffbot", seed=1) as session:
        session.watch(lambda tick, _: asked.extend(tick.inputs.instructions))
        assert session.ros(f"zenoh:{where}", domain=number).endswith(f"{where}, as its router")
        peer = judge(tmp_path, number, where, "robot")
        for _ in session.run(seconds=PATIENCE):
            if peer.done():
                break
        found = peer.end()
    assert found["node"]["tokens"] == ["NN/%/%/diffbot"]
    row = next(one for one in graph.rows(session.robot, steers=True) if one.name == "/map")
    assert found["map_token"] == {
        "kind": "map_token",
        "type": "nav_msgs::msg::dds_::OccupancyGrid_",
        "hash": row.hash,
        "qos": ":1:,1:,:,:,,",
    }
    assert (found["odom"]["frame"], found["odom"]["child"]) == ("odom", "base_link")
    assert keys.read_attachment(bytes.fromhex(found["odom"]["attachment"])) is not None
    assert found["map"]["cells"] == found["map"]["size"] > 0
    assert found["driven"]["speed"] == pytest.approx(0.1, abs=0.05)
    assert (found["stop"]["success"], found["stop"]["message"]) == (True, "accepted")
    assert {msg.Drive, msg.Stop} <= {type(one) for one in asked}


def test_a_goal_by_zenoh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fibonacci = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence"
    monkeypatch.setitem(definitions.ACTIONS, "test_msgs/action/Fibonacci", fibonacci)
    types.store.cache_clear()
    number, where = domain(), endpoint()
    server = Server(number, f"zenoh:{where}")
    peer = judge(tmp_path, number, where, "action")
    try:
        while not peer.done():
            server.turn()
            time.sleep(0.02)
    finally:
        found = peer.end()
        server.close()
    assert found["sent"]["accepted"]
    assert (found["result"]["status"], found["result"]["sequence"]) == (actions.SUCCEEDED, [0, 1, 1, 2, 3])
    assert found["feedback"]["sequence"] == [0, 1, 1, 2, 3]
