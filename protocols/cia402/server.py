"""The drive's side of SDO: a request in, an answer out, and what was written.

Rules. Plain data. One transfer at a time: a new request of either kind takes the place of one that is not
finished. A segment that nobody began, a toggle bit that does not alternate and an unknown command are
refused; a client's abort ends the transfer without an answer. What is written in segments takes effect with
the last one.

Source: package canopen 2.4.1 `sdo/server.py`: which abort code for what. (It answers a segment that nobody
began with a general error, and so does this.)
"""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols.cia402 import sdo
from protocols.cia402.dictionary import Dictionary
from protocols.cia402.objects import Key
from protocols.cia402.sdo import (
    Abort,
    Answer,
    Download,
    Downloaded,
    DownloadSegment,
    DownloadStart,
    Request,
    SegmentDownloaded,
    Unsupported,
    Upload,
    Uploaded,
    UploadedSegment,
    UploadSegment,
    UploadStart,
)

LONGEST = 256
"""Bytes that are taken in segments; there is no longer object."""


@dataclass(slots=True)
class Server:
    """One drive's SDO server."""

    key: Key = (0, 0)
    """Of the last transfer that was begun."""
    outgoing: bytes | None = None
    """What is still to be read of an object, in segments."""
    incoming: bytes | None = None
    """What was written so far, in segments."""
    size: int | None = None
    """Bytes that the client said it would write."""
    toggle: bool = False
    written: list[Key] = field(default_factory=list)
    """What the last request wrote."""

    def handle(self, dictionary: Dictionary, request: Request) -> Answer | None:
        """Serve a request."""
        self.written.clear()
        match request:
            case Upload(index, sub):
                return self._upload(dictionary, (index, sub))
            case UploadSegment(toggle):
                return self._next_piece(toggle)
            case Download(index, sub, data):
                self._begin((index, sub))
                return self._write(dictionary, data) or Downloaded(index, sub)
            case DownloadStart(index, sub, size):
                self._begin((index, sub))
                self.incoming, self.size = b"", size
                return Downloaded(index, sub)
            case DownloadSegment():
                return self._take_piece(dictionary, request)
            case Unsupported(_, index, sub):
                self._begin((index, sub))
                return self._abort(sdo.UNKNOWN_COMMAND)
            case Abort():
                self.outgoing = self.incoming = None
        return None

    def _begin(self, key: Key) -> None:
        self.key, self.outgoing, self.incoming, self.size, self.toggle = key, None, None, None, False

    def _abort(self, code: int) -> Abort:
        self.outgoing = self.incoming = None
        return Abort(*self.key, code)

    def _upload(self, dictionary: Dictionary, key: Key) -> Answer:
        self._begin(key)
        code, data = dictionary.read(key)
        if code or not data:
            return self._abort(code or sdo.NO_DATA)
        if len(data) <= sdo.EXPEDITED:
            return Uploaded(*key, data)
        self.outgoing = data
        return UploadStart(*key, len(data))

    def _next_piece(self, toggle: bool) -> Answer:
        if self.outgoing is None:
            return self._abort(sdo.GENERAL)
        if toggle != self.toggle:
            return self._abort(sdo.TOGGLE)
        piece, rest = self.outgoing[: sdo.SEGMENT], self.outgoing[sdo.SEGMENT :]
        self.outgoing = rest or None
        self.toggle = not toggle
        return UploadedSegment(toggle, piece, not rest)

    def _take_piece(self, dictionary: Dictionary, segment: DownloadSegment) -> Answer:
        if self.incoming is None:
            return self._abort(sdo.GENERAL)
        if segment.toggle != self.toggle:
            return self._abort(sdo.TOGGLE)
        self.incoming += segment.data
        self.toggle = not segment.toggle
        if len(self.incoming) > LONGEST:
            return self._abort(sdo.LENGTH_MISMATCH)
        if segment.last:
            data, self.incoming = self.incoming, None
            if self.size is not None and self.size != len(data):
                return self._abort(sdo.LENGTH_MISMATCH)
            refused = self._write(dictionary, data)
            if refused:
                return refused
        return SegmentDownloaded(segment.toggle)

    def _write(self, dictionary: Dictionary, data: bytes) -> Abort | None:
        code = dictionary.write(self.key, data)
        if code:
            return self._abort(code)
        self.written.append(self.key)
        return None
