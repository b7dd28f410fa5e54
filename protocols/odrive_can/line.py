"""The firmware line of a device: how it is found out, and what the host does differently by it.

Rules. A reply to Get_Version means 0.6.x. A device is 0.5.x if it sends heartbeats and repeatedly answers
another request (one that both lines answer alike), but never Get_Version and the discovery: silence alone
proves nothing, since the host's frames may not arrive. The robot file states an expectation; the device
decides, and a difference is a fault. Until the line is known, and after a fault, nothing moves. A host that
only listens (a dry run, a monitor) never knows the line; for decoding, and for nothing else, the form of a
heartbeat is enough where only one line can have sent it. A `Dialect` is a constant, and no other code of the
driver tests for the line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from protocols.odrive_can import errors
from protocols.odrive_can.errors import Word
from protocols.odrive_can.table import REBOOT, SAVE, AxisState, table_of
from protocols.toolkit.table import Table, Values

Message = tuple[str, dict[str, Any]]
"""The name of a message, and its fields."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """One firmware line as the host uses it."""

    line: str
    polled: tuple[str, ...] = ()
    """Messages requested every `poll_ms`."""
    disarm_reasons: tuple[str, ...] = ()
    """Messages that report why an axis disarmed by itself."""
    word: Word | None = None
    """The heartbeat's error bits; None while their meaning is not known."""
    components: Mapping[str, Word] = field(default_factory=dict)
    """The error words of components, by message."""
    initializing: int = 0
    """Bits of the heartbeat's errors that mean "still starting"."""
    estop: int = -1
    """The bit that an emergency stop sets."""
    messages: Mapping[str, Message] = field(default_factory=dict)
    """What is sent to clear, reboot, save and zero; what is not here cannot be done over CAN."""
    boards: bool = False
    """Clearing and rebooting affect every axis of a board; a heartbeat cannot be requested."""

    def __deepcopy__(self, memo: object) -> Dialect:
        """A dialect is a constant."""
        return self

    def readable(self) -> dict[str, str]:
        """Return the messages by the vendor's names of the signals that they carry."""
        rows = [row for row in table_of(self.line).rows if row.direction == "from_device"]
        left_out = ("Address reply", "TxSdo", "Get_ADC_Voltage", "Get_Version" if self.boards else "")
        return {f.name: row.name for row in rows if row.name not in left_out for f in row.fields if f.name}


_05 = errors.AXIS.bits
DIALECTS = {
    "": Dialect(""),
    "0.6": Dialect(
        "0.6",
        polled=("Get_Iq", "Get_Bus_Voltage_Current", "Get_Temperature", "Get_Torques"),
        disarm_reasons=("Get_Error",),
        word=errors.ERRORS,
        initializing=errors.INITIALIZING,
        estop=errors.ERRORS.bits["ESTOP_REQUESTED"],
        messages={
            "clear": ("Clear_Errors", {"Identify": 0}),
            "reboot": ("Reboot", {"Action": REBOOT}),
            "save": ("Reboot", {"Action": SAVE}),
            "zero": ("Set_Absolute_Position", {"Position": 0.0}),
        },
    ),
    "0.5": Dialect(
        "0.5",
        polled=("Get_Iq", "Get_Bus_Voltage_Current"),
        word=errors.AXIS,
        components={
            "Get_Motor_Error": errors.MOTOR,
            "Get_Encoder_Error": errors.ENCODER,
            "Get_Controller_Error": errors.CONTROLLER,
            "Get_Sensorless_Error": errors.SENSORLESS,
        },
        estop=_05["ESTOP_REQUESTED"],
        messages={
            "clear": ("Clear_Errors (0.5.x)", {}),
            "reboot": ("Reboot (0.5.x)", {}),
            "zero": ("Set_Linear_Count", {"Position": 0}),
        },
        boards=True,
    ),
}


def flagged(heartbeat: Values) -> tuple[str, ...]:
    """Return the components whose errors a heartbeat of 0.5.x points to, by message. The sensorless estimator
    has no flag, but a bit of the axis' errors."""
    if "Motor_Error_Flag" not in heartbeat:
        return ()
    components = [name for name in ("Motor", "Encoder", "Controller") if heartbeat[f"{name}_Error_Flag"]]
    if heartbeat["Axis_Error"] & _05["SENSORLESS_ESTIMATOR_FAILED"]:
        components.append("Sensorless")
    return tuple(f"Get_{name}_Error" for name in components)


ONLY05 = sum(set(_05.values()) - set(errors.ERRORS.bits.values()))
ONLY06 = sum(set(errors.ERRORS.bits.values()) - set(_05.values()))


def line_by_form(heartbeat: Values) -> str:
    """Return the firmware line that alone can have sent a heartbeat of the table "", or "".

    0.5.x has three bytes of flags, of which only the first bit (and of the last byte the eighth) is used, and
    a component's flag is never set without its bit in the axis' errors, nor in closed loop. 0.6.x has a
    result, a flag and an empty byte. (ODrive@f9b5419 `can_simple.cpp` send_heartbeat.)"""
    error, result, flag = heartbeat["Axis_Error"], heartbeat["Byte_5"], heartbeat["Byte_6"]
    if heartbeat["Byte_7"] or error & ONLY05:
        return "0.5" if not error & ONLY06 and result <= 1 and flag <= 1 else ""
    closed_loop = heartbeat["Axis_State"] == AxisState.CLOSED_LOOP_CONTROL
    if error & ONLY06 or result > 1 or (closed_loop and result == 1):
        return "0.6"
    return "0.6" if flag and not error & _05["ENCODER_FAILED"] else ""


ATTEMPTS = 10
"""After this number of requests, a device that sends heartbeats and answers nothing is a fault."""
REPLIES = 5
"""Number of answers to the other request, with none to Get_Version, that identifies 0.5.x."""
REPLIES_EXPECTED = 2
"""The same where the robot file states 0.5."""

NO_DISCOVERY = "sends heartbeats, but did not answer discovery: firmware 0.5.x?"


class Identity:
    """What is known of one device's firmware. Plain data."""

    def __init__(self, expected: str, extended: bool) -> None:
        self.expected = expected
        """ "0.5", "0.6" or "auto"."""
        self.extended = extended
        self.wrong = 0
        """The code of the fault if it is not what was expected, or cannot be identified; until cleared."""
        self.forget()

    def forget(self) -> None:
        """Identify the device anew: it may have restarted, or been replaced. A fault stays."""
        self.line = ""
        """Empty while not known."""
        self.version = ""
        """As it reported it."""
        self._requests = self._replies = 0
        self._reply_pending = self._answers_discovery = False
        self._decode_as("")

    def _decode_as(self, line: str) -> None:
        self.dialect = DIALECTS[line]
        self.table: Table = table_of(line, self.extended)

    @property
    def as_expected(self) -> bool:
        """True if the line that its frames are decoded as is the one in the robot file."""
        return self.expected in ("auto", self.dialect.line)

    @property
    def known(self) -> bool:
        """True if it may be commanded."""
        return bool(self.line) and not self.wrong

    def on_heartbeat(self, heartbeat: Values) -> None:
        """Handle a heartbeat of the table "": its form may be good enough to decode it."""
        self._decode_as(line_by_form(heartbeat))

    def on_request(self, has_heartbeat: bool) -> None:
        """Count a request of Get_Version and the other message."""
        self._reply_pending = True
        self._requests += has_heartbeat
        if self._requests > ATTEMPTS and not self.line:
            self._fault(errors.FIRMWARE_UNKNOWN)

    def on_reply(self) -> bool:
        """Handle an answer to the other request. True if it identifies the line."""
        if not self._reply_pending or self.line:
            return False
        self._reply_pending = False
        self._replies += 1
        enough = REPLIES_EXPECTED if self.expected == "0.5" else REPLIES
        if self._replies < enough or self._answers_discovery:
            return False
        self._identified("0.5")
        if self.expected == "0.6":
            self._fault(errors.FIRMWARE_05)
        return True

    def on_discovery_reply(self) -> None:
        """Handle an answer on the broadcast node, which no 0.5.x gives."""
        self._answers_discovery = True

    def on_version(self, values: Values) -> None:
        """Handle a reply to Get_Version."""
        before, line = self.line, f"{values['Fw_Version_Major']}.{values['Fw_Version_Minor']}"
        self.version = f"{line}.{values['Fw_Version_Revision']}"
        self._identified("0.6" if line == "0.6" else "")
        if line != "0.6":
            self._fault(errors.FIRMWARE_OTHER)
        elif before == "0.5":
            self._fault(errors.FIRMWARE_CHANGED)
        elif self.expected == "0.5":
            self._fault(errors.FIRMWARE_06)

    def _identified(self, line: str) -> None:
        self.line = line
        self._decode_as(line)

    def _fault(self, code: int) -> None:
        """Keep the first fault until it is cleared."""
        self.wrong = self.wrong or code

    def on_clear(self) -> bool:
        """Handle an operator's ClearFault. True if the device is to be identified anew."""
        wrong, self.wrong = self.wrong, 0
        return wrong != 0

    def text(self) -> str:
        """Return the firmware as far as known."""
        if self.version:
            return f"firmware {self.version}"
        return f"firmware {self.line}.x" if self.line else "firmware not known yet"

    def found(self) -> str:
        """Return what a scan reports of it if it did not answer discovery."""
        return self.text() if self.line else NO_DISCOVERY
