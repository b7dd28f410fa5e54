"""The SDO server of a drive: request in, response out, and which objects were written.

Rules. Plain data. One transfer at a time: a new request of either kind replaces an unfinished one. A segment
without a beginning, a toggle bit that does not alternate and an unknown command are refused; a client's abort
ends the transfer without a response. A segmented download takes effect with its last segment.

Source: package canopen 2.4.1 `sdo/server.py` for the abort codes. (It answers a segment without a beginning
with a general error, and so does this.)
"""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols.canopen import sdo
from protocols.cia402.dictionary import Dictionary
from protocols.cia402.objects import Key

LONGEST = 256
"""Bytes that are accepted in segments; there is no longer object."""


@dataclass(slots=True)
class SdoServer:
    """One drive's SDO server."""

    key: Key = (0, 0)
    """Of the last transfer that was begun."""
    outgoing: bytes | None = None
    """What remains of a segmented upload."""
    incoming: bytes | None = None
    """What has been received of a segmented download."""
    size: int | None = None
    """Bytes of the download, as its request states."""
    toggle: bool = False
    written: list[Key] = field(default_factory=list)
    """The objects that the last request wrote."""

    def handle(self, dictionary: Dictionary, request: sdo.Request) -> sdo.Response | None:
        """Serve a request."""
        self.written.clear()
        match request:
            case sdo.Upload(index, sub):
                return self._upload(dictionary, (index, sub))
            case sdo.UploadSegment(toggle):
                return self._upload_segment(toggle)
            case sdo.Download(index, sub, data):
                self._begin((index, sub))
                return self._write(dictionary, data) or sdo.Downloaded(index, sub)
            case sdo.DownloadStart(index, sub, size):
                self._begin((index, sub))
                self.incoming, self.size = b"", size
                return sdo.Downloaded(index, sub)
            case sdo.DownloadSegment():
                return self._download_segment(dictionary, request)
            case sdo.Unsupported(_, index, sub):
                self._begin((index, sub))
                return self._abort(sdo.UNKNOWN_COMMAND)
            case sdo.Abort():
                self.outgoing = self.incoming = None
        return None

    def _begin(self, key: Key) -> None:
        self.key, self.outgoing, self.incoming, self.size, self.toggle = key, None, None, None, False

    def _abort(self, code: int) -> sdo.Abort:
        self.outgoing = self.incoming = None
        return sdo.Abort(*self.key, code)

    def _upload(self, dictionary: Dictionary, key: Key) -> sdo.Response:
        self._begin(key)
        code, data = dictionary.read(key)
        if code or not data:
            return self._abort(code or sdo.NO_DATA)
        if len(data) <= sdo.EXPEDITED:
            return sdo.Uploaded(*key, data)
        self.outgoing = data
        return sdo.UploadStart(*key, len(data))

    def _upload_segment(self, toggle: bool) -> sdo.Response:
        if self.outgoing is None:
            return self._abort(sdo.GENERAL)
        if toggle != self.toggle:
            return self._abort(sdo.TOGGLE)
        data, rest = self.outgoing[: sdo.SEGMENT], self.outgoing[sdo.SEGMENT :]
        self.outgoing = rest or None
        self.toggle = not toggle
        return sdo.UploadedSegment(toggle, data, not rest)

    def _download_segment(self, dictionary: Dictionary, segment: sdo.DownloadSegment) -> sdo.Response:
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
        return sdo.SegmentDownloaded(segment.toggle)

    def _write(self, dictionary: Dictionary, data: bytes) -> sdo.Abort | None:
        code = dictionary.write(self.key, data)
        if code:
            return self._abort(code)
        self.written.append(self.key)
        return None
