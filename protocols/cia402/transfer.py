"""The client's side of one SDO transfer: it says what to send, and takes what comes.

Rules. Plain data, one at a time per device. What is not the answer that is waited for changes nothing: of
another object, of another kind, a segment that came twice. A value of another length than was told counts as
aborted.

Source: package canopen 2.4.1 (`sdo/client.py`); CiA 301 "SDO protocols".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from protocols.cia402.sdo import (
    EXPEDITED,
    LENGTH_MISMATCH,
    SEGMENT,
    Abort,
    Answer,
    Download,
    Downloaded,
    DownloadSegment,
    DownloadStart,
    Request,
    SegmentDownloaded,
    Upload,
    Uploaded,
    UploadedSegment,
    UploadSegment,
    UploadStart,
)


@dataclass(slots=True)
class Transfer:
    """Reading one object (`data` None), or writing it. Plain data; one at a time per device."""

    index: int
    sub: int
    data: bytes | None = None
    done: bool = False
    """It has ended, one way or the other."""
    value: bytes = b""
    """What was read so far; whole when `done` and no `abort`."""
    abort: int | None = None
    """The abort code with which it ended, if it did."""
    toggle: bool = False
    sent: int = 0
    """Bytes written so far."""
    expecting: type[Answer] | None = None
    """The kind of answer that comes next in the middle of a segmented transfer."""
    size: int | None = None
    """Bytes to be read, as the device told."""

    def first(self) -> Request:
        """The message that begins it, also when it is begun anew."""
        self.done, self.value, self.abort = False, b"", None
        self.toggle, self.sent, self.expecting, self.size = False, 0, None, None
        if self.data is None:
            return Upload(self.index, self.sub)
        if 1 <= len(self.data) <= EXPEDITED:
            return Download(self.index, self.sub, self.data)
        return DownloadStart(self.index, self.sub, len(self.data))

    def handle(self, answer: Answer) -> Request | None:
        """Take an answer; the next request, or None if it ended, or if the answer was not for it."""
        kind = type(answer)
        if kind is Uploaded or kind is Downloaded:
            return self._on_expedited(answer)
        return self._on_other(answer)

    def _on_expedited(self, answer: Any) -> Request | None:  # noqa: ANN401 -- Uploaded or Downloaded
        """One of the two answers that are the bulk of all traffic."""
        reading = type(answer) is Uploaded
        if not self._begins(answer.index, answer.sub, reading):
            return None
        if reading:
            self.done, self.value = True, answer.data
            return None
        return self._written()

    def _on_other(self, answer: Answer) -> Request | None:
        match answer:
            case Abort(index, sub, code):
                if (index, sub) == (self.index, self.sub):
                    self.done, self.abort = True, code
            case UploadStart(index, sub, size) if self._begins(index, sub, reading=True):
                self.expecting, self.size = UploadedSegment, size
                return UploadSegment(self.toggle)
            case UploadedSegment(toggle, data, last) if self.expecting is UploadedSegment:
                return self._take(toggle, data, last)
            case SegmentDownloaded(toggle) if self.expecting is SegmentDownloaded and toggle == self.toggle:
                self.toggle = not self.toggle
                return self._next()
        return None

    def _begins(self, index: int, sub: int, reading: bool) -> bool:
        right = index == self.index and sub == self.sub and reading == (self.data is None)
        return right and self.expecting is None and not self.done

    def _take(self, toggle: bool, data: bytes, last: bool) -> Request | None:
        if toggle != self.toggle:  # a piece that came twice
            return None
        self.value += data
        self.toggle = not self.toggle
        if not last:
            return UploadSegment(self.toggle)
        self.done, self.expecting = True, None
        if self.size is not None and self.size != len(self.value):
            self.abort = LENGTH_MISMATCH
        return None

    def _written(self) -> Request | None:
        if self.data is not None and 1 <= len(self.data) <= EXPEDITED:
            self.done = True
            return None
        self.expecting = SegmentDownloaded
        return self._next()

    def _next(self) -> Request | None:
        data = self.data or b""
        if self.sent and self.sent >= len(data):
            self.done, self.expecting = True, None
            return None
        piece = data[self.sent : self.sent + SEGMENT]
        self.sent += max(len(piece), 1)
        return DownloadSegment(self.toggle, piece, self.sent >= len(data))
