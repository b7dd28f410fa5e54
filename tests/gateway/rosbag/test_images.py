"""Recorded images: a tag and a ball drawn flat, at known distances, in every encoding and kind of bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.errors import BagError, ConfigError
from gateway.rosbag import Bag, read
from gateway.vision.camera import opencv
from gateway.vision.tags import pattern
from protocols.messages import SECOND, Marker, Nanos
from tests.gateway.bag_helpers import (
    KINDS,
    ROBOT,
    START,
    BagMessage,
    Kind,
    header,
    odometry,
    rover,
    write,
)

CAMERA = """\

[bag.cameras.eye]
image = "/eye/image_raw"
info = "/eye/camera_info"

[bag.cameras.eye.detectors]
tags = { size = 0.16 }
targets = [{ marker = 1000, diameter = 0.1, hue = 240.0 }]
"""
SENSOR = """
[sensors.eye]
protocol = "plain"
bus = "line"
address = 4

[brain]
"""
TEXT = (
    ROBOT.replace("\n[brain]\n", SENSOR, 1)
    .replace('truth = "/fix"\n', "")
    .replace('sensors = { imu = "/imu/data" }\n', "")
    + CAMERA
)
FOCAL = 400.0


def picture() -> np.ndarray[Any, Any]:
    """Tag 42, 20 pixels a cell, its middle 20 right of and 30 below the image's; a blue ball of radius 40."""
    image = np.full((480, 640, 3), 200, dtype=np.uint8)
    cells = np.kron(np.array(pattern(42)), np.ones((20, 20), dtype=int)).astype(bool)
    image[190:350, 260:420][cells] = 10
    rows, columns = np.ogrid[:480, :640]
    image[(rows - 100.5) ** 2 + (columns - 369.5) ** 2 < 40.0**2] = (20, 20, 200)
    return image


def image(t: Nanos, encoding: str = "rgb8", pad: int = 0, topic: str = "/eye/image_raw") -> BagMessage:
    drawn = picture()
    grey = drawn.mean(axis=2).astype(np.uint8)[..., None]
    whole = {
        "rgb8": drawn,
        "bgr8": drawn[..., ::-1],
        "bgra8": np.dstack((drawn[..., ::-1], drawn[..., :1])),
        "mono8": grey,
        "mono16": np.dstack((grey, grey)),
    }[encoding]
    rows = whole.reshape(480, -1)
    data = np.hstack((rows, np.zeros((480, pad), dtype=np.uint8)))

    def make(types: Any) -> Any:
        return types["sensor_msgs/msg/Image"](
            header=header(types, t, "eye"),
            height=480,
            width=640,
            encoding=encoding,
            is_bigendian=0,
            step=data.shape[1],
            data=data.ravel(),
        )

    return BagMessage(topic, "sensor_msgs/msg/Image", t, make)


def packed(t: Nanos, data: bytes, form: str) -> BagMessage:
    def make(types: Any) -> Any:
        kind = types["sensor_msgs/msg/CompressedImage"]
        return kind(header=header(types, t, "eye"), format=form, data=np.frombuffer(data, dtype=np.uint8))

    return BagMessage("/eye/image_raw", "sensor_msgs/msg/CompressedImage", t, make)


def info(t: Nanos, focal: float = FOCAL, model: str = "plumb_bob") -> BagMessage:
    def make(types: Any) -> Any:
        kind = types["sensor_msgs/msg/CameraInfo"]
        one = [focal, 0.0, 319.5, 0.0, focal, 239.5, 0.0, 0.0, 1.0]
        names = {name.lower(): name for name in kind.__dataclass_fields__ if len(name) == 1}
        numbers = {"d": np.zeros(5), "k": np.array(one), "r": np.eye(3).ravel(), "p": np.zeros(12)}
        window = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        rest = {"binning_x": 0, "binning_y": 0, "roi": window, "height": 480, "width": 640}
        lettered = {names[key]: value for key, value in numbers.items()}
        return kind(header=header(types, t, "eye"), distortion_model=model, **lettered, **rest)

    return BagMessage("/eye/camera_info", "sensor_msgs/msg/CameraInfo", t, make)


def made(path: Path, messages: list[BagMessage], kind: Kind = "ros1") -> Bag:
    robot = rover(TEXT)
    drive = [odometry(START + i * SECOND, 0.0, 0.0) for i in range(3)]
    return read(write(path / "bag", [*drive, *messages], kind), robot.bag, robot.brain.body)  # type: ignore[arg-type]


def markers(bag: Bag) -> list[Marker]:
    return [event for event in bag.events if isinstance(event, Marker)]


@pytest.mark.parametrize("form", ["jpeg", "png"])
def test_a_packed_image_is_one(tmp_path: Path, form: str) -> None:
    data = opencv().imencode(f".{form}", picture()[..., ::-1])[1].tobytes()
    messages = [info(START), packed(START + 1, data, form), packed(START + 2, data[:50], form)]
    bag = made(tmp_path, [*messages, packed(START + 3, b"", form)], "mcap")
    assert [one.marker for one in markers(bag)] == [42, 1000]
    (topic,) = (one for one in bag.topics if one.name == "/eye/image_raw")
    assert topic.unused == {f"not an image of format '{form}'": 2}


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_in_an_image_is_an_event_at_its_time(tmp_path: Path, kind: Kind) -> None:
    t = START + SECOND // 2
    tag, ball = markers(made(tmp_path, [info(START), image(t)], kind))
    assert (tag.sensor, tag.t, tag.marker, ball.marker) == ("eye", t, 42, 1000)
    assert tag.position == pytest.approx((FOCAL * 0.16 / 160.0, -20.0 * 0.001, -30.0 * 0.001), abs=2e-3)
    assert ball.position is not None
    assert ball.position[0] == pytest.approx(FOCAL * 0.1 / 80.0, rel=0.05)
    assert ball.position[1] / ball.position[0] == pytest.approx(-50.0 / FOCAL, rel=0.02)


@pytest.mark.parametrize(("encoding", "pad", "found"), [("bgr8", 7, 2), ("bgra8", 0, 2), ("mono8", 3, 1)])
def test_every_encoding_shows_the_same(tmp_path: Path, encoding: str, pad: int, found: int) -> None:
    seen = markers(made(tmp_path, [info(START), image(START + SECOND, encoding, pad)]))
    assert [one.marker for one in seen] == [42, 1000][:found]


def test_what_cannot_be_used_is_counted(tmp_path: Path) -> None:
    late = [START + i * SECOND // 10 for i in range(1, 6)]
    bag = made(
        tmp_path,
        [
            image(late[0]),
            info(late[1], 0.0),
            info(late[2], model="fisheye"),
            info(late[3]),
            image(late[4], "mono16"),
        ],
    )
    unused = {topic.name: topic.unused for topic in bag.topics if topic.role.startswith("cameras")}
    assert unused == {
        "/eye/image_raw": {"before the camera's description": 1, "encoding 'mono16'": 1},
        "/eye/camera_info": {"not calibrated": 1, "distortion model 'fisheye'": 1},
    }
    assert markers(bag) == []


def test_a_camera_has_both_topics_and_a_sensor(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"cameras\.eye\.info: no topic '/eye/camera_info'"):
        made(tmp_path, [image(START)])
    with pytest.raises(ConfigError, match=r"bag\.cameras\.eye"):
        rover(TEXT.replace("[sensors.eye]", "[sensors.other]"))
