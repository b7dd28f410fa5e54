"""Types of ROS 2: hashes of real ROS 2, bytes that it wrote, and what is no message."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load_robot
from gateway.ros import definitions, graph, types
from tests.gateway.ros.judged import Judge, domain

REAL = json.loads((Path(__file__).parent / "kilted.json").read_text())
HASHES: dict[str, str] = REAL["hashes"]
"""RIHS01 of ROS 2 Kilted (rosidl 4.9.5), of the files that its packages install; of the map, tf2, nav2 and
control packages there are none to be installed without a build:"""
MADE: dict[str, str] = REAL["made"]
"""what its generator makes of the text of their definitions, and"""
SHOWN: dict[str, str] = REAL["shown"]
"""what real ones have shown (`ros2 topic info -v`, bags) in what others have published"""
CDR: list[tuple[str, str]] = REAL["cdr"]
"""What rclpy 9.1.2 wrote: between a message's fields, and (cut off) after it, is what was in its memory."""


@pytest.mark.parametrize("type_", [*HASHES, *SHOWN, *MADE])
def test_hashes_are_those_of_ros(type_: str) -> None:
    assert types.type_hash(type_) == f"RIHS01_{(HASHES | SHOWN | MADE)[type_]}"


def test_every_type_of_the_graph_has_a_hash_of_ros() -> None:
    robots = [load_robot(name) for name in ("diffbot", "bench", "arm")]
    rows = [row for one in robots for row in graph.rows(one, steers=True, cameras=["eye"])]
    assert [row.type for row in rows if row.type not in HASHES | SHOWN | MADE] == []


def test_the_generator_of_ros_makes_the_same_hashes_of_our_definitions(tmp_path: Path) -> None:
    texts = tmp_path / "texts.json"
    texts.write_text(json.dumps(definitions.MESSAGES | definitions.ACTIONS))
    judge = Judge(tmp_path, "rosidl_hashes", domain(), str(texts))
    while not judge.done():
        time.sleep(0.05)
    found = judge.end()["hashes"]["of"]
    named = [one for one in (*MADE, *SHOWN, *definitions.MESSAGES) if one in found]
    assert {*MADE, *definitions.MESSAGES} <= {*named}
    for one in named:
        assert types.type_hash(one) == found[one], one


def test_requests_of_actions_are_made_as_rosidl_makes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """By an action of which ROS installs the hashes."""
    monkeypatch.setitem(
        definitions.ACTIONS, FIBONACCI, "int32 order\n---\nint32[] sequence\n---\nint32[] sequence"
    )
    types.store.cache_clear()
    types.store()
    assert (
        types.type_hash(f"{FIBONACCI}_SendGoal")
        == "RIHS01_d807633803e38e164276573cd97e9fbd71e109c290bbf4cc312a0a1c9da7bbd9"
    )
    assert (
        types.type_hash(f"{FIBONACCI}_GetResult")
        == "RIHS01_5d30fdeb21d20e117aa5f36c7b4f0b6874f1a8cf7a9c038d58f1156c5737b209"
    )
    assert (
        types.type_hash(f"{FIBONACCI}_FeedbackMessage")
        == "RIHS01_37487bae8cea358366b97003c1ef1ca7ce7c08df36f9e8cca496624226aee64e"
    )
    for type_, text in CDR:
        if type_.startswith(FIBONACCI):
            assert len(types.encode(types.decode(type_, bytes.fromhex(text)))) == len(bytes.fromhex(text))


FIBONACCI = "test_msgs/action/Fibonacci"


def plain(message: Any) -> Any:
    """Return a message as something that can be compared."""
    if hasattr(message, "__dataclass_fields__"):
        return {
            name: plain(getattr(message, name)) for name in message.__dataclass_fields__ if name[0] != "_"
        }
    return (
        [plain(one) for one in message]
        if hasattr(message, "__len__") and not isinstance(message, str)
        else message
    )


@pytest.mark.parametrize(("type_", "text"), [one for one in CDR if not one[0].startswith("test_msgs")])
def test_bytes_of_ros_are_read_and_written_again(type_: str, text: str) -> None:
    real = bytes.fromhex(text)
    message = types.decode(type_, real)
    written = types.encode(message)
    assert plain(types.decode(type_, written)) == plain(message)
    differing = [(a, b) for a, b in zip(written, real, strict=True) if a != b]
    assert not any(a for a, _ in differing), "but for what lies between fields, where ours are zeros"


def test_values_that_ros_wrote() -> None:
    read = {
        type_: types.decode(type_, bytes.fromhex(text)) for type_, text in CDR if "Fibonacci" not in type_
    }
    assert read["geometry_msgs/msg/TwistStamped"].twist.angular.z == -1.0
    assert list(read["trajectory_msgs/msg/JointTrajectory"].points[0].velocities) == [2.0]
    assert read["rcl_interfaces/srv/SetParameters_Request"].parameters[0].value.double_value == 2.0
    assert read["action_msgs/srv/CancelGoal_Request"].goal_info.goal_id.uuid.tolist() == list(range(16))


@pytest.mark.parametrize(
    "data",
    [b"", b"\x00\x01\x00\x00", b"\x00\x06\x00\x00" + bytes(48), bytes(30), b"\x00\x01\x00\x00" + bytes(60)],
)
def test_what_is_no_message_is_said(data: bytes) -> None:
    with pytest.raises(types.Malformed, match=r"geometry_msgs/msg/Twist|encapsulation"):
        types.decode("geometry_msgs/msg/Twist", data)


def test_a_message_without_values_is_empty() -> None:
    for type_ in ("sensor_msgs/msg/BatteryState", "control_msgs/action/FollowJointTrajectory_Feedback"):
        made = types.make(type_)
        assert plain(types.decode(type_, types.encode(made))) == plain(made)
