"""Which firmware line a device has, found out by requests only.

Rules. A reply to Get_Version means 0.6.x. A device is 0.5.x if it sends heartbeats and repeatedly answers
another request (one that both lines answer alike), but never Get_Version and the discovery: silence alone
proves nothing, since the host's frames may not arrive. The robot file states an expectation; the device
decides, and a difference is a fault. Until the line is known, and after a fault, nothing moves. A host that
only listens (a dry run, a monitor) never knows the line; for decoding, and for nothing else, the form of a
heartbeat is enough where only one line can have sent it.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.odrive_can.faults import ERRORS
from protocols.odrive_can.faults05 import AXIS_FAULTS, AxisError
from protocols.odrive_can.messages import AxisState, GetVersion, UnidentifiedHeartbeat
from protocols.plugin import FaultInfo

ATTEMPTS = 10
"""After this number of requests, a device that sends heartbeats and answers nothing is a fault."""
REPLIES = 5
"""Number of answers to the other request, with none to Get_Version, that identifies 0.5.x."""
REPLIES_EXPECTED = 2
"""The same where the robot file states 0.5."""


@dataclass(slots=True)
class Identity:
    """What is known of one device's firmware. Plain data."""

    expected: str
    """ "0.5", "0.6" or "auto"."""
    line: str = ""
    """Empty while not known."""
    apparent_line: str = ""
    """What the form of its heartbeats implies: good enough to decode them."""
    version: GetVersion | None = None
    wrong: bool = False
    """It is not what was expected, or cannot be identified: a fault until cleared."""
    _requests: int = 0
    _replies: int = 0
    _reply_pending: bool = False
    _answers_discovery: bool = False

    def forget(self) -> None:
        """Identify the device anew: it may have restarted, or been replaced. A fault stays."""
        self.line, self.apparent_line, self.version = "", "", None
        self._requests = self._replies = 0
        self._reply_pending = self._answers_discovery = False

    @property
    def decoded_as(self) -> str:
        """The firmware line to decode its frames with; "" if not known."""
        return self.line or self.apparent_line

    @property
    def as_expected(self) -> bool:
        """True if that line is the one in the robot file."""
        return self.expected in ("auto", self.decoded_as)

    def on_unidentified_heartbeat(self, heartbeat: UnidentifiedHeartbeat) -> str:
        """Handle a heartbeat of unknown line; return the line to decode it with."""
        self.apparent_line = line_by_form(heartbeat)
        return self.decoded_as

    def on_request(self, has_heartbeat: bool) -> FaultInfo | None:
        """Count a request of Get_Version and the other message; return a fault, if any."""
        self._reply_pending = True
        self._requests += has_heartbeat
        if self._requests <= ATTEMPTS or self.line:
            return None
        return self._fault(
            "firmware unknown",
            "it sends heartbeats but answers neither Get_Version nor as 0.5.x would: do our frames arrive?",
            "check cable and bit rate with a bus monitor, and look for a second host",
        )

    def on_reply(self) -> FaultInfo | None:
        """Handle an answer to the other request; return a fault, if any."""
        if not self._reply_pending or self.line:
            return None
        self._reply_pending = False
        self._replies += 1
        enough = REPLIES_EXPECTED if self.expected == "0.5" else REPLIES
        if self._replies < enough or self._answers_discovery:
            return None
        self.line = "0.5"
        if self.expected != "0.6":
            return None
        cause = "it sends heartbeats and answers requests, but not Get_Version"
        return self._fault(
            "firmware 0.5.x", cause, 'set firmware = "0.5" in the robot file, or update the device'
        )

    def on_discovery_reply(self) -> None:
        """Handle an answer on the broadcast node, which no 0.5.x gives."""
        self._answers_discovery = True

    def on_version(self, version: GetVersion) -> FaultInfo | None:
        """Handle a reply to Get_Version; return a fault, if any."""
        before, line = self.line, f"{version.fw_major}.{version.fw_minor}"
        self.version = version
        self.line = line if line == "0.6" else ""
        name = f"firmware {line}.{version.fw_revision}"
        if not self.line:
            return self._fault(
                name, "it reports that by Get_Version", "this driver supports 0.5.x and 0.6.x: update it"
            )
        if before == "0.5":
            return self._fault(
                name,
                "it was identified as 0.5.x and now answers Get_Version: replaced, or two at one node id",
                "look for a second device, then clear",
            )
        if self.expected == "0.5":
            cause = "it reports that by Get_Version, and the robot file states 0.5"
            return self._fault(name, cause, 'set firmware = "0.6" in the robot file')
        return None

    def on_clear(self) -> None:
        """Handle an operator's ClearFault: after a fault the device is identified anew."""
        if self.wrong:
            self.wrong = False
            self.forget()

    def text(self) -> str:
        """Return the firmware as far as known."""
        v = self.version
        if v is not None:
            return f"firmware {v.fw_major}.{v.fw_minor}.{v.fw_revision}"
        return f"firmware {self.line}.x" if self.line else "firmware not known yet"

    def _fault(self, name: str, cause: str, remedy: str) -> FaultInfo | None:
        """Return the fault once until it is cleared."""
        if self.wrong:
            return None
        self.wrong = True
        return FaultInfo(name, cause, remedy)


ONLY05 = sum(AXIS_FAULTS.keys() - ERRORS.keys())
ONLY06 = sum(ERRORS.keys() - AXIS_FAULTS.keys())


def line_by_form(heartbeat: UnidentifiedHeartbeat) -> str:
    """Return the firmware line that alone can have sent a heartbeat, or "".

    0.5.x has three bytes of flags, of which only the first bit (and of the last byte the eighth) is used, and
    a component's flag is never set without its bit in the axis' errors, nor in closed loop. 0.6.x has a
    result, a flag and an empty byte. (Layouts: `codec`; ODrive@f9b5419 `can_simple.cpp` send_heartbeat.)"""
    error, result, flag = heartbeat.error, heartbeat.fifth, heartbeat.sixth
    if heartbeat.seventh or error & ONLY05:
        return "0.5" if not error & ONLY06 and result <= 1 and flag <= 1 else ""
    closed_loop = heartbeat.state == AxisState.CLOSED_LOOP_CONTROL
    if error & ONLY06 or result > 1 or (closed_loop and result == 1):
        return "0.6"
    return "0.6" if flag and not error & AxisError.ENCODER_FAILED else ""
