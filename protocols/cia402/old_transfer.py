"""The client's side of one SDO transfer: it returns the requests to send, and handles the responses.

Rules. Plain data, one at a time per device. A response that is not the expected one (of another object, of
another kind, a repeated segment) changes nothing. A value whose length is not the announced one counts as
aborted.

Source: package canopen 2.4.1 (`sdo/client.py`); CiA 301 "SDO protocols".
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.canopen import sdo


@dataclass(slots=True)
class Transfer:
    """An upload of one object (`data` None), or a download."""

    index: int
    sub: int
    data: bytes | None = None
    done: bool = False
    """It has ended, successfully or not."""
    value: bytes = b""
    """What has been read; complete when `done` and no `abort`."""
    abort: int | None = None
    """The abort code with which it ended, if it did."""
    toggle: bool = False
    sent: int = 0
    """Bytes written so far."""
    expecting: type[sdo.Response] | None = None
    """The kind of response expected in the middle of a segmented transfer."""
    size: int | None = None
    """Bytes to be read, as the device announced."""

    def first(self) -> sdo.Request:
        """Begin the transfer, or begin it anew; return its first request."""
        self.done, self.value, self.abort = False, b"", None
        self.toggle, self.sent, self.expecting, self.size = False, 0, None, None
        if self.data is None:
            return sdo.Upload(self.index, self.sub)
        if 1 <= len(self.data) <= sdo.EXPEDITED:
            return sdo.Download(self.index, self.sub, self.data)
        return sdo.DownloadStart(self.index, self.sub, len(self.data))

    def handle(self, response: sdo.Response) -> sdo.Request | None:
        """Handle a response; return the next request, or None if the transfer ended or ignores the
        response."""
        if isinstance(response, sdo.Uploaded):  # the bulk of all traffic, without the cost of a match
            if self._begins(response.index, response.sub, reading=True):
                self.done, self.value = True, response.data
            return None
        if isinstance(response, sdo.Downloaded):
            begins = self._begins(response.index, response.sub, reading=False)
            return self._on_downloaded() if begins else None
        match response:
            case sdo.Abort(index, sub, code):
                if (index, sub) == (self.index, self.sub):
                    self.done, self.abort = True, code
            case sdo.UploadStart(index, sub, size) if self._begins(index, sub, reading=True):
                self.expecting, self.size = sdo.UploadedSegment, size
                return sdo.UploadSegment(self.toggle)
            case sdo.UploadedSegment(toggle, data, last) if self.expecting is sdo.UploadedSegment:
                return self._on_segment(toggle, data, last)
            case sdo.SegmentDownloaded(toggle):
                if self.expecting is sdo.SegmentDownloaded and toggle == self.toggle:
                    self.toggle = not self.toggle
                    return self._next_segment()
        return None

    def _begins(self, index: int, sub: int, reading: bool) -> bool:
        right = index == self.index and sub == self.sub and reading == (self.data is None)
        return right and self.expecting is None and not self.done

    def _on_segment(self, toggle: bool, data: bytes, last: bool) -> sdo.Request | None:
        if toggle != self.toggle:  # a repeated segment
            return None
        self.value += data
        self.toggle = not self.toggle
        if not last:
            return sdo.UploadSegment(self.toggle)
        self.done, self.expecting = True, None
        if self.size is not None and self.size != len(self.value):
            self.abort = sdo.LENGTH_MISMATCH
        return None

    def _on_downloaded(self) -> sdo.Request | None:
        if self.data is not None and 1 <= len(self.data) <= sdo.EXPEDITED:
            self.done = True
            return None
        self.expecting = sdo.SegmentDownloaded
        return self._next_segment()

    def _next_segment(self) -> sdo.Request | None:
        data = self.data or b""
        if self.sent and self.sent >= len(data):
            self.done, self.expecting = True, None
            return None
        segment = data[self.sent : self.sent + sdo.SEGMENT]
        self.sent += max(len(segment), 1)
        return sdo.DownloadSegment(self.toggle, segment, self.sent >= len(data))
