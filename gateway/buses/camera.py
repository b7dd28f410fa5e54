"""The bus on a camera: V4L2, or a video file in its place. What it sees comes as bytes, pixels never do:
the newest picture is there for who looks on.

Rules. Opening raises a BusError with what is missing; afterwards nothing is raised. A picture is waited for
and looked at by a thread, and nothing here waits: a step takes what was seen since the last one. A camera
that gives no pictures any more is gone, and is tried again once a second; a video is played once, at its own
pace.
Pictures that come faster than they are looked at are left out.
"""

from __future__ import annotations

import logging
import os
import stat
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from gateway.buses.serial.opening import forbidden, in_use
from gateway.core.clock import stopwatch
from gateway.core.robot import BusSettings
from gateway.errors import BusError, UserError
from gateway.vision.camera import Image, Seen
from gateway.vision.live import Capture, LiveCamera, Look, Watch
from protocols.camera import table
from protocols.frames import BusState, Frame, Packet
from protocols.messages import SECOND, Nanos

log = logging.getLogger("gateway")

REOPEN = 1.0
"""s between the attempts to open a camera that is gone"""
MOST_WAITING = 64
"""Pictures that were looked at and not yet taken"""
MOST_OLD: Nanos = SECOND
"""Age up to which the stamp of a picture is believed"""
MOST_STALE = 4
"""Pictures that may have waited in the kernel, one after the other"""
DEVICES = Path("/dev")

Open = Callable[[], Capture]


class CameraBus:
    """One camera. `reopen` opens it again; None: it is a file."""

    def __init__(self, settings: BusSettings, capture: Capture, reopen: Open | None) -> None:
        assert settings.camera is not None
        self.name = settings.name
        self._watch = Watch(settings.camera)
        self._capture, self._reopen = capture, reopen
        self._period = capture.period
        self._lens = settings.camera.projection
        self.seen: Seen | None = None
        """The newest picture, when it was taken by the clock of `read`, and how it was projected"""
        self._newest: tuple[Nanos, Image] | None = None
        """The same, as the thread has it"""
        self._found: deque[Look | BusState] = deque(maxlen=MOST_WAITING)
        self._ends = threading.Event()
        self._readable, self._written = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._began = False
        """From the first time that it is read: what it saw before is nobody's."""

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the state changes, and what was seen since it was read last."""
        if not self._began:
            self._began = True
            self._thread.start()
        with suppress(BlockingIOError):
            os.read(self._readable, 4096)
        changes: list[BusState] = []
        packets: list[Packet] = []
        while self._found:
            found = self._found.popleft()
            if isinstance(found, BusState):
                changes.append(found)
            else:
                packets += [Packet(now, self.name, frame) for frame in frames_of(found, stopwatch())]
        if (newest := self._newest) is not None:
            self._newest = None
            self.seen = Seen(now - (stopwatch() - newest[0]), newest[1], self._lens)
        return changes, packets

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:  # noqa: ARG002 -- a real bus has no plan
        """Return the file that can be read when a picture was looked at."""
        return (self._readable,), None

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Send nothing: a camera takes nothing."""

    def close(self) -> None:
        """Release the camera. One that does not give a picture, nor up, keeps its files."""
        self._ends.set()
        if self._began:
            self._thread.join(0.5)
        else:
            self._capture.close()
        if not self._thread.is_alive():
            os.close(self._readable)
            os.close(self._written)

    # -- the thread -----------------------------------------------------------------------------------

    def _work(self) -> None:
        due = stopwatch()
        while not self._ends.is_set():
            try:
                look = self._look()
            except Exception as error:  # noqa: BLE001 -- whatever OpenCV raises
                log.warning("%s: a picture cannot be looked at: %s", self.name, error)
                look = None
            if look is not None:
                self._tell(look)
                due += self._period
                self._ends.wait(max(0, due - stopwatch()) / SECOND if self._period else 0.0)
            elif not self._again():
                break
        self._capture.close()

    def _tell(self, found: Look | BusState) -> None:
        self._found.append(found)
        with suppress(OSError):  # nobody has read for long, which is enough
            os.write(self._written, b"\0")

    def _look(self) -> Look | None:
        """Wait for the newest picture and look at it; None: none comes any more."""
        for _ in range(MOST_STALE):
            found = self._capture.next()
            if found is None:
                return None
            image, stamp = found
            now = stopwatch()
            taken = stamp if stamp is not None and 0 <= now - stamp <= MOST_OLD else now
            if now - taken <= max(self._watch.interval, SECOND / 30):
                break
        self._newest = taken, image
        return self._watch.look(image, taken)

    def _again(self) -> bool:
        """Say that it is gone, and open it again; False: it is over."""
        self._capture.close()
        ended = "its video has ended" if self._reopen is None else "it gives no pictures any more"
        log.warning("%s: %s", self.name, ended)
        self._tell(BusState.GONE)
        while self._reopen is not None and not self._ends.wait(REOPEN):
            with suppress(UserError):
                self._capture = self._reopen()
                self._tell(BusState.BACK)
                log.warning("%s: it is back", self.name)
                return True
        return False


def frames_of(look: Look, now: Nanos) -> list[bytes]:
    """Return what is told of a picture, at this time of the same clock."""
    faults = not look.fits and table.SIZE
    faults |= (look.dark and table.DARK) | (look.slow and table.SLOW)
    size, rate = (look.width, look.height), round(100.0 * look.rate)
    picture = table.Picture(look.number, now - look.taken, *size, rate, round(look.grey), faults)
    frames = []
    for seen in look.seen:
        with suppress(ValueError):  # beyond what a camera measures
            frames.append(table.encode(picture, seen))
    return frames


def open_camera(settings: BusSettings) -> CameraBus:
    """Open the camera, or the video file, of a bus. Raises BusError with what is missing and what helps."""
    path = settings.interface.partition(":")[2]
    head = f"bus {settings.name!r} cannot be opened as {settings.interface!r}"
    if settings.camera is None:
        text = "nothing says what its pictures are like, and what is looked for"
        raise BusError(f"{head}: {text}: [buses.{settings.name}.camera]")
    camera, is_file = settings.camera, Path(path).is_file()

    def attempt() -> Capture:
        return _opened(path, camera, is_file=is_file)

    try:
        capture = attempt()
    except UserError as error:
        raise BusError(f"{head}: {error}") from error
    return CameraBus(settings, capture, None if is_file else attempt)


def _opened(path: str, camera: LiveCamera, *, is_file: bool) -> Capture:
    """Return an open camera or file. Raises UserError with what is missing."""
    if why := _missing(path):
        raise UserError(why)
    capture = Capture(path, camera, is_file=is_file)
    if not capture.is_open:
        capture.close()
        raise UserError(_refused(path, is_file=is_file))
    return capture


def _missing(path: str, devices: Path = DEVICES) -> str:
    """Return why a path is no camera or file that we can read; "" if it may be one."""
    try:
        mode = Path(path).stat().st_mode
    except OSError as error:
        there = sorted(str(each) for each in devices.glob("video*"))
        text = f"there is no {path}" if isinstance(error, FileNotFoundError) else str(error)
        return f"{text}. Cameras of this machine: {', '.join(there) or 'none'}"
    if not (stat.S_ISCHR(mode) or stat.S_ISREG(mode)):
        return f"{path} is neither a camera nor a video file"
    if not os.access(path, os.R_OK):
        return forbidden(path, "video4linux", "video")
    return ""


def _refused(path: str, *, is_file: bool) -> str:
    if is_file:
        return f"{path} is no video that OpenCV reads"
    text = "it gives no pictures: it is no camera, or its second node, which has none (try the other numbers)"
    return f"{text}; or {in_use(path)}"
