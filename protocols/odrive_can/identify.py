"""Which firmware line a device speaks, found out by asking only.

Rules. Answering Get_Version is 0.6.x. A device is 0.5.x if it sends heartbeats and answers another question
(one that both lines answer alike) time and again, but Get_Version and the roll call never: silence alone
proves nothing, it may be our frames that do not arrive. What the robot file says is an expectation; the
device decides, and where the two differ it is a fault. Until the line is known, and after a fault, nothing
moves. Who only listens (a dry run, a monitor) never knows; for reading, and for nothing else, the shape of a
heartbeat is enough where only one line can have sent it.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.odrive_can.faults import ERRORS
from protocols.odrive_can.faults05 import AXIS, AxisError
from protocols.odrive_can.messages import AxisState, Beacon, GetVersion
from protocols.plugin import FaultInfo

ATTEMPTS = 10
"""A device that sends heartbeats and answers nothing is a fault after so many questions."""
OTHERS = 5
"""So often another question must be answered, and Get_Version not, for a device to be 0.5.x."""
OTHERS_EXPECTED = 2
"""... and so often where the robot file says so too."""


@dataclass(slots=True)
class Identity:
    """What is known of one device's firmware. Plain data."""

    expected: str
    """ "0.5", "0.6" or "auto"."""
    line: str = ""
    """Not known yet if empty."""
    seems: str = ""
    """What its heartbeats look like: good for reading them."""
    version: GetVersion | None = None
    wrong: bool = False
    """It is not what was expected, or cannot be told: a fault until cleared."""
    _asked: int = 0
    _answered: int = 0
    _waiting: bool = False
    _answers_roll_call: bool = False

    def forget(self) -> None:
        """It may have restarted, or be another device: ask again. A fault stays."""
        self.line, self.seems, self.version = "", "", None
        self._asked = self._answered = 0
        self._waiting = self._answers_roll_call = False

    @property
    def reading(self) -> str:
        """The firmware line in which to read it."""
        return self.line or self.seems

    @property
    def expects(self) -> bool:
        """Whether it reads as the robot file says."""
        return self.expected in ("auto", self.reading)

    def on_beacon(self, beacon: Beacon) -> str:
        """A heartbeat of a line not known; the line in which to read it."""
        self.seems = shape_of(beacon)
        return self.reading

    def ask(self, beating: bool) -> FaultInfo | None:
        """Get_Version and the other question go out; what is wrong, if anything.

        `beating`: heartbeats were heard."""
        self._waiting = True
        self._asked += beating
        if self._asked <= ATTEMPTS or self.line:
            return None
        return self._fault(
            "firmware unknown",
            "it sends heartbeats but does not answer Get_Version, nor as 0.5.x would: do our frames arrive?",
            "look at cable and bit rate with a bus monitor, and for a second host",
        )

    def on_other(self) -> FaultInfo | None:
        """The other question was answered; what is wrong with it, if anything."""
        if not self._waiting or self.line:
            return None
        self._waiting = False
        self._answered += 1
        enough = OTHERS_EXPECTED if self.expected == "0.5" else OTHERS
        if self._answered < enough or self._answers_roll_call:
            return None
        self.line = "0.5"
        if self.expected != "0.6":
            return None
        cause = "it sends heartbeats and answers questions, but not Get_Version"
        return self._fault(
            "firmware 0.5.x", cause, 'say firmware = "0.5" in the robot file, or update the device'
        )

    def on_roll_call(self) -> None:
        """It answered on the broadcast node, as no 0.5.x does."""
        self._answers_roll_call = True

    def on_version(self, version: GetVersion) -> FaultInfo | None:
        """It answered Get_Version; what is wrong with it, if anything."""
        before, said = self.line, f"{version.fw_major}.{version.fw_minor}"
        self.version = version
        self.line = said if said == "0.6" else ""
        name = f"firmware {said}.{version.fw_revision}"
        if not self.line:
            return self._fault(
                name, "it says so by Get_Version", "this driver speaks 0.5.x and 0.6.x: update it"
            )
        if before == "0.5":
            return self._fault(
                name,
                "it was told apart as 0.5.x and now answers Get_Version: replaced, or two at one node id",
                "look for a second device, then clear",
            )
        if self.expected == "0.5":
            cause = "it says so by Get_Version, and the robot file says 0.5"
            return self._fault(name, cause, 'say firmware = "0.6" in the robot file')
        return None

    def cleared(self) -> None:
        """An operator clears the device's faults: it is asked again what it is."""
        if self.wrong:
            self.wrong = False
            self.forget()

    def title(self) -> str:
        """The firmware as far as known, for a sentence."""
        v = self.version
        if v is not None:
            return f"firmware {v.fw_major}.{v.fw_minor}.{v.fw_revision}"
        return f"firmware {self.line}.x" if self.line else "firmware not known yet"

    def _fault(self, name: str, cause: str, remedy: str) -> FaultInfo | None:
        """Told once until it is cleared."""
        if self.wrong:
            return None
        self.wrong = True
        return FaultInfo(name, cause, remedy)


ONLY05 = sum(AXIS.keys() - ERRORS.keys())
ONLY06 = sum(ERRORS.keys() - AXIS.keys())


def shape_of(beacon: Beacon) -> str:
    """The firmware line that alone can have sent a heartbeat, or "".

    0.5.x has three bytes of flags, of which only the first bit (and of the last byte the eighth) is used, and
    a part's flag never stands without its bit in the axis' errors, nor in closed loop. 0.6.x has a result, a
    flag and an empty byte. (Layouts: `codec`; ODrive@f9b5419 `can_simple.cpp` send_heartbeat.)"""
    error, result, flag = beacon.error, beacon.fifth, beacon.sixth
    if beacon.seventh or error & ONLY05:
        return "0.5" if not error & ONLY06 and result <= 1 and flag <= 1 else ""
    closed = beacon.state == AxisState.CLOSED_LOOP_CONTROL
    if error & ONLY06 or result > 1 or (closed and result == 1):
        return "0.6"
    return "0.6" if flag and not error & AxisError.ENCODER_FAILED else ""
