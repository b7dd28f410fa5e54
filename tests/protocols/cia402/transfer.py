"""One SDO transfer of the host's client, request by request, for tests of servers."""

from __future__ import annotations

from protocols.canopen import sdo
from protocols.canopen.client import Job, Purpose, SdoClient
from protocols.messages import SECOND


class Transfer:
    """An upload of one object (`data` None), or a download."""

    def __init__(self, index: int, sub: int, data: bytes | None = None) -> None:
        self._client = SdoClient(SECOND)
        self._client.put(Job(Purpose.REQUEST, (index, sub), data))
        self.done = False
        self.value = b""
        self.abort: int | None = None

    def first(self) -> sdo.Request:
        """Return the first request."""
        request, _ = self._client.poll(0)
        assert request is not None
        return request

    def handle(self, response: sdo.Response) -> sdo.Request | None:
        """Handle a response; return the next request."""
        outcome = self._client.handle(0, response)
        if outcome is not None:
            self.done, self.value, self.abort = True, outcome.value, outcome.abort
        return self._client.poll(0)[0]
