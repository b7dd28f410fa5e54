"""The bus on a camera: a video file as the device, drawn here; cameras that fail are made up, since no test
machine has one. What a camera sees is in the recording, and replays to the same bytes."""

from __future__ import annotations

import logging
import os
import select
import stat
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway import config, open_session
from gateway.buses import camera as bus_of_a_camera
from gateway.buses import open_bus
from gateway.buses.camera import CameraBus, frames_of
from gateway.cli.main import main
from gateway.core.clock import SimulatedClock, stopwatch
from gateway.core.robot import BusSettings
from gateway.errors import BusError, ConfigError, UserError
from gateway.vision.camera import Image, Intrinsics, opencv
from gateway.vision.detectors import Detectors
from gateway.vision.live import LiveCamera, Watch
from gateway.vision.tags import CELLS, Tags, pattern
from protocols.camera import plugin, table
from protocols.frames import BusState
from protocols.messages import MILLISECOND, SECOND, Marker, Nanos
from protocols.plugin import Device

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
LENS = Intrinsics(FOCAL, FOCAL, WIDTH / 2.0 - 0.5, HEIGHT / 2.0 - 0.5)
CAMERA = LiveCamera(Detectors(Tags(0.16)), WIDTH, HEIGHT, lens=LENS)
PATIENCE = 60.0
"""s"""
RATE = 25.0


def drawn(number: int, cell: int, left: int, top: int) -> Image:
    """A picture of a tag seen straight: each of its cells has so many pixels."""
    image = np.full((HEIGHT, WIDTH, 3), 220, np.uint8)
    black = np.kron(np.array(pattern(number)), np.ones((cell, cell), bool))
    image[top : top + cell * CELLS, left : left + cell * CELLS][black] = 15
    return image


TAG = drawn(11, 9, 200, 60)
"""Of 72 pixels: 0.16 m × 300 / 72 away"""
AWAY = 0.16 * FOCAL / 72.0


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve pictures of a tag, then eight of none."""
    cv2: Any = opencv()
    path = tmp_path_factory.mktemp("clips") / "clip.avi"
    file = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE, (WIDTH, HEIGHT))
    for image in [TAG] * 12 + [np.full_like(TAG, 220)] * 8:
        file.write(image)
    file.release()
    return path


def settings(path: Path | str, camera: LiveCamera | None = CAMERA) -> BusSettings:
    return BusSettings("eye", "camera", f"camera:{path}", camera=camera)


def all_of(bus: Any, enough: Callable[[list[BusState], list[bytes]], bool]) -> list[Any]:
    """Read until it is enough; return the markers that the driver makes of it, and what the bus said."""
    states: list[BusState] = []
    frames: list[bytes] = []
    while True:
        changes, packets = bus.read(SECOND)
        states, frames = [*states, *changes], [*frames, *(each.frame for each in packets)]
        if enough(states, frames):
            break
        files, _ = bus.wakes(SECOND)
        assert select.select(files, [], [], PATIENCE)[0], "nothing came"
    driver = plugin.driver([Device("eye", 1, plugin.options(), plugin.settings())])
    events = [event for frame in frames for event in driver.receive(SECOND, frame)]
    assert driver.counters.malformed == 0
    return [*states, *(event for event in events if isinstance(event, Marker))]


def ended(states: list[BusState], _: list[bytes]) -> bool:
    return BusState.GONE in states


def test_a_video_is_played_once_and_its_markers_are_where_they_were_drawn(
    clip: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bus = open_bus(settings(clip), SimulatedClock())
    gone, *seen = all_of(bus, ended)
    assert bus.read(2 * SECOND) == ([], [])
    bus.close()
    assert (gone, len(seen)) == (BusState.GONE, 20)
    assert [one.marker for one in seen] == [11] * 12 + [None] * 8
    for one in seen[:12]:
        across = -(200 + 36 - WIDTH / 2.0) / FOCAL * AWAY, (HEIGHT / 2.0 - 60 - 36) / FOCAL * AWAY
        assert one.position == pytest.approx((AWAY, *across), abs=0.02)
    assert [record.getMessage() for record in caplog.records] == ["eye: its video has ended"]


def test_a_video_has_its_own_pace() -> None:
    """By the times of its pictures, which are counted from when they came: none comes before its time."""

    class Tape:
        period = SECOND // 50

        def __init__(self) -> None:
            self.left = 6

        def next(self) -> tuple[Image, None] | None:
            self.left -= 1
            return (TAG, None) if self.left >= 0 else None

        def close(self) -> None:
            pass

    began = stopwatch()
    bus = CameraBus(settings("x"), Tape(), None)  # type: ignore[arg-type]
    all_of(bus, ended)
    bus.close()
    assert stopwatch() - began >= 5 * Tape.period


class Made:
    """A camera that does as it is told: pictures, or None for one that is pulled out."""

    period = 0

    def __init__(self, *pictures: Image | None, age: Nanos | None = None) -> None:
        self._pictures, self._age = list(pictures), age
        self.closed = threading.Event()
        self.goes_on = threading.Event()
        """When nothing is left"""

    def next(self) -> tuple[Image, Nanos | None] | None:
        if not self._pictures:
            self.goes_on.wait(PATIENCE)
            return None
        image = self._pictures.pop(0)
        if image is None:
            return None
        return image, None if self._age is None else stopwatch() - self._age

    def close(self) -> None:
        self.closed.set()


def test_a_camera_that_is_pulled_out_is_gone_and_back_when_it_is_there_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(bus_of_a_camera, "REOPEN", 0.001)
    first, second = Made(TAG, None), Made(TAG)
    tries: list[int] = []

    def again() -> Any:
        tries.append(len(tries))
        if len(tries) < 3:
            raise UserError("there is no /dev/video0")
        return second

    bus = CameraBus(settings("/dev/video0"), first, again)  # type: ignore[arg-type]
    found = all_of(bus, lambda states, frames: BusState.BACK in states and len(frames) >= 2)
    assert found[:2] == [BusState.GONE, BusState.BACK]
    assert [one.marker for one in found[2:]] == [11, 11]
    assert (len(tries), first.closed.is_set()) == (3, True)
    said = [record.getMessage() for record in caplog.records]
    assert said == ["eye: it gives no pictures any more", "eye: it is back"]
    second.goes_on.set()
    bus.close()


def test_a_picture_that_cannot_be_looked_at_is_told(caplog: pytest.LogCaptureFixture) -> None:
    flat: Any = np.zeros((0, 0), np.uint8)
    bus = CameraBus(settings("x"), Made(TAG, flat), None)  # type: ignore[arg-type]
    found = all_of(bus, ended)
    bus.close()
    assert found[0] is BusState.GONE
    assert [one.marker for one in found[1:]] == [11]
    assert caplog.messages[0].startswith("eye: a picture cannot be looked at: ")


def test_a_camera_that_hangs_delays_nobody_and_keeps_its_files_at_the_end() -> None:
    made = Made()
    bus = CameraBus(settings("/dev/video0"), made, lambda: made)  # type: ignore[arg-type,return-value]
    for now in range(1000):
        assert bus.read(now) == ([], [])
        bus.write(now, [b"anything"])
    bus.close()
    assert not made.closed.is_set()
    assert select.select(bus.wakes(0)[0], [], [], 0.0) == ([], [], [])  # its files are open
    made.goes_on.set()
    assert made.closed.wait(PATIENCE)


def test_a_picture_has_the_stamp_of_its_camera_and_what_waited_is_left_out() -> None:
    stale = Made(*[TAG] * 4, age=200 * MILLISECOND)
    bus = CameraBus(settings("/dev/video0"), stale, None)  # type: ignore[arg-type]
    (seen,) = all_of(bus, lambda _, frames: len(frames) >= 1)
    assert SECOND - seen.t >= 200 * MILLISECOND
    stale.goes_on.set()
    bus.close()


# -- what is wrong with pictures ---------------------------------------------------------------------------


def told(pictures: list[tuple[Image, Nanos]], camera: LiveCamera = CAMERA) -> list[tuple[Nanos, int]]:
    """Return when which faults were told."""
    watch, found = Watch(camera), []
    for image, t in pictures:
        (frame, *_) = frames_of(watch.look(image, t), t)
        decoded = table.decode(frame[:-4], t, "eye")
        assert decoded is not None
        found.append((t, decoded[0].faults))
    return found


BLACK = np.full((HEIGHT, WIDTH, 3), 1, np.uint8)
PERIOD = 40 * MILLISECOND


@pytest.mark.parametrize(
    ("bit", "pictures", "latest"),
    [
        (table.SIZE, [(np.full((480, 640, 3), 200, np.uint8), PERIOD)], PERIOD),
        (table.DARK, [(BLACK, n * PERIOD) for n in range(1, 40)], SECOND + 2 * PERIOD),
        (table.SLOW, [(TAG, n * SECOND) for n in range(1, 6)], 3 * SECOND),
    ],
    ids=["size", "black", "slow"],
)
def test_bad_pictures_are_told_within_their_time_and_good_ones_end_it(
    bit: int, pictures: list[tuple[Image, Nanos]], latest: Nanos
) -> None:
    good = [(TAG, n * PERIOD) for n in range(1, 60)]
    assert {faults for _, faults in told(good)} == {0}
    found = told(pictures)
    assert min(t for t, faults in found if faults & bit) <= latest
    after = [(TAG, pictures[-1][1] + t) for _, t in good]
    assert told([*pictures, *after])[-1][1] == 0


def test_a_few_dark_pictures_are_none_and_darkest_0_allows_the_night() -> None:
    flicker = [(BLACK if n % 10 < 5 else TAG, n * PERIOD) for n in range(1, 100)]
    assert {faults for _, faults in told(flicker)} == {0}
    night = [(BLACK, n * PERIOD) for n in range(1, 60)]
    assert {faults for _, faults in told(night, replace(CAMERA, darkest=0.0))} == {0}


def test_another_size_is_not_looked_at() -> None:
    """Where the lens was described for another one, a marker would be elsewhere."""
    large = np.kron(TAG, np.ones((2, 2, 1), np.uint8))
    look = Watch(CAMERA).look(large, SECOND)
    assert [one.marker for one in look.seen] == [None]
    assert (look.width, look.height, look.fits) == (640, 480, False)


# -- opening, and the robot file ---------------------------------------------------------------------------


def test_what_cannot_be_opened_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("video0", "video2"):
        (tmp_path / name).touch()
    text = tmp_path / "text"
    text.write_text("no video")
    monkeypatch.setattr(bus_of_a_camera, "DEVICES", tmp_path)
    assert bus_of_a_camera._missing("/dev/video9", tmp_path) == (
        f"there is no /dev/video9. Cameras of this machine: {tmp_path}/video0, {tmp_path}/video2"
    )
    for path, wrong in (
        ("/dev/video9", "there is no /dev/video9. Cameras of this machine: "),
        (text, f"{text} is no video that OpenCV reads"),
        (tmp_path, f"{tmp_path} is neither a camera nor a video file"),
        ("/dev/null", "it gives no pictures: it is no camera, or its second node"),
    ):
        with pytest.raises(BusError, match=f"bus 'eye' cannot be opened as 'camera:{path}': ") as caught:
            open_bus(settings(path), SimulatedClock())
        assert wrong in str(caught.value)
    with pytest.raises(BusError, match=r"nothing says what its pictures are like.*\[buses.eye.camera\]"):
        open_bus(settings(text, None), SimulatedClock())


def test_a_camera_of_another_group_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "video0"
    device.touch()
    device.chmod(stat.S_IRUSR)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may all
    assert 'SUBSYSTEM=="video4linux"' in bus_of_a_camera._missing(str(device))


EYE = """
[buses.eye.camera]
width = 320
height = 240
lens = { fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5 }
[buses.eye.camera.detectors]
tags = { size = 0.16 }
"""


def with_eye(text: str = EYE, interface: str = "camera:/dev/video0") -> str:
    given = config.load_robot("diffbot_camera").text
    return (
        given.replace('kind = "camera"\ninterface = "twin" ', f'kind = "camera"\ninterface = "{interface}" ')
        + text
    )


@pytest.mark.parametrize(
    ("part", "instead", "wrong"),
    [
        ("width = 320", "width = 3", "buses.eye.camera.width"),
        ("tags = { size = 0.16 }", "", "tags or targets must say what to look for"),
        ("cy = 119.5 }", "cy = 119.5, distortion = [0.1] }", "4, 5 or 8 numbers"),
        (EYE, "", "buses.eye.camera: missing; expected a table"),
        ('kind = "camera"\n', 'kind = "camera"\nbaudrate = 9600\n', "has no baudrate; expected none"),
        ("camera:/dev/video0", "serial:/dev/ttyUSB0", 'expected "camera:PATH", such as "camera:/dev/video0"'),
        ('kind = "camera"', 'kind = "serial"\nbaudrate = 9600', "is no camera; expected no key 'camera'"),
        (
            'protocol = "camera"',
            'protocol = "plain"',
            "plain needs a bus of kind serial, and 'eye' is camera",
        ),
    ],
)
def test_what_is_wrong_with_one_is_said(part: str, instead: str, wrong: str) -> None:
    text = with_eye()
    assert part in text
    with pytest.raises(ConfigError) as caught:
        config.parse_robot(text.replace(part, instead))
    assert wrong in str(caught.value)


def test_a_real_camera_on_a_simulated_body_is_recorded_and_replayed(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """On the wall clock: nothing that is judged depends on it."""
    caplog.set_level(logging.CRITICAL, "gateway")  # a busy machine misses ticks, and says so
    robot = config.parse_robot(with_eye(interface=f"camera:{clip}"), real=["camera"])
    file = tmp_path / "run.mcap"
    seen: list[int | None] = []
    gone = False
    with open_session(robot, record=file) as session:
        for tick in session.run(seconds=PATIENCE):
            seen += [event.marker for event in tick.outputs.events if isinstance(event, Marker)]
            gone = gone or BusState.GONE in [state for _, state in tick.inputs.states]
            if gone:
                break
    assert (gone, seen) == (True, [11] * 12 + [None] * 8)
    assert session.latencies.found["camera"].count == 20
    assert main(["replay", str(file)]) == 0
    assert "the same, byte for byte" in capsys.readouterr().out
