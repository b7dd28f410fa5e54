"""Requests under way: which transfers each makes, when it is done, when it is given up.

Rules. Every request ends in Done or Refused within its deadline, whatever the device does. What is impossible
is refused at once with the reason. Aborts are reported in text. Faults are cleared here and nowhere else, by
a rising edge of bit 7 of the controlword.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols import messages as msg
from protocols.cia402.old_client import Job, Outcome, Purpose
from protocols.canopen.sdo import NO_OBJECT, abort_text
from protocols.canopen.services import Nmt, NmtCommand, encode
from protocols.cia402 import motion, startup
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import FAULTY, DriveState, HomingRun
from protocols.cia402.faults import HOMING_FAILED
from protocols.cia402.objects import OBJECTS, Key, Type, to_bytes
from protocols.cia402.profile import Demand, Mode, PowerState, supports
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Event, Nanos, Request
from protocols.toolkit.requests import PendingRequest, refusal

TIMEOUT = 2000 * MILLISECOND
CLEAR_TIMEOUT = 3000 * MILLISECOND
CLEAR_AGAIN = 500 * MILLISECOND
REBOOT_TIMEOUT = 8000 * MILLISECOND
REBOOT_AGAIN = 2000 * MILLISECOND
ZERO_METHODS = (37, 35)
"""Homing methods that take the present position (35 is the older number)."""
DRIVER_OBJECTS = frozenset({o.CONTROLWORD, o.MODE, *o.TARGETS, o.CONSUMER_HEARTBEAT})
"""Objects that only the driver itself writes, like the PDO parameters."""
NO_RESPONSE = "no response from the device"


@dataclass(slots=True)
class Pending(PendingRequest):
    """A request to one device."""

    token: int
    """Of its SDO jobs."""
    drive: DriveState
    stage: int = 0
    """Resets sent (ClearFault, Reboot); index of the homing method (Zero), -1 once homing began."""

    def transfer(self, key: Key, data: bytes | None = None) -> None:
        """Queue an upload (`data` None) or a download for this request."""
        self.drive.request_jobs.append(Job(Purpose.REQUEST, key, data, self.token))


def begin(now: Nanos, request: Request, drive: DriveState, token: int) -> Pending | msg.Refused:
    """Begin a request."""
    pending = Pending(request, drive.name, now, now + TIMEOUT, now, token, drive)
    running = drive.owned or drive.power in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP)
    match request:
        case msg.ClearFault():
            drive.arming_failed, drive.clearing, drive.duplicate_reported = False, True, False
            drive.arming_since = None
            pending.deadline = now + CLEAR_TIMEOUT
        case msg.Estop():
            drive.estopped = True
            motion.stop(drive, now, Demand.QUICK_STOP)
        case msg.ReadParameter(_, parameter):
            return _read(now, pending, parameter)
        case msg.WriteParameter(_, parameter, value):
            return _write(now, pending, parameter, value)
        case msg.Reboot() if running:
            return refusal(now, request, "it is armed, and would drop its load: command idle first")
        case msg.Reboot():
            pending.deadline = now + REBOOT_TIMEOUT
        case msg.Home() | msg.Zero():
            return _home(now, pending)
        case _:
            return refusal(now, request, f"cia402 has no {type(request).__name__}")
    return pending


def _home(now: Nanos, pending: Pending) -> Pending | msg.Refused:
    drive, request = pending.drive, pending.request
    if drive.profile is None or not supports(drive.profile.modes, Mode.HM):
        return refusal(now, request, "it has no homing mode (object 6502), or is not known yet")
    if not drive.armed or not drive.holding:
        return refusal(now, request, "it must be armed and hold: command hold first")
    if drive.homing is not None:
        return refusal(now, request, "homing is under way")
    pending.deadline = now + drive.options.home_timeout_ms * MILLISECOND + TIMEOUT
    if isinstance(request, msg.Zero):
        pending.transfer(o.HOMING_METHOD)
    else:
        drive.homing = HomingRun(pending.token, now, zero=False)
    return pending


def _read(now: Nanos, pending: Pending, parameter: str) -> Pending | msg.Refused:
    key = _key(parameter)
    if key is None:
        return refusal(now, pending.request, _unknown(parameter))
    pending.transfer(key)
    return pending


def _write(now: Nanos, pending: Pending, parameter: str, value: float) -> Pending | msg.Refused:
    key = _key(parameter)
    if key is None:
        return refusal(now, pending.request, _unknown(parameter))
    known = OBJECTS.get(key)
    if known is None or known.type is Type.TEXT:
        return refusal(now, pending.request, f"the type of {o.title(key)} is not known: not written")
    if key in DRIVER_OBJECTS or key[0] in o.PDO_PARAMETERS:
        return refusal(now, pending.request, f"{known.name} is the driver's own: commands set it")
    if value != int(value):
        return refusal(now, pending.request, f"{value} is not a whole number")
    try:
        pending.transfer(key, to_bytes(known.type, int(value)))
    except ValueError as error:
        return refusal(now, pending.request, str(error))
    return pending


def _key(parameter: str) -> Key | None:
    """Return the object of a name or an address; None if it is neither."""
    return OBJECTS.find(parameter)


def _unknown(parameter: str) -> str:
    return f'{parameter!r} is no object: give its name, or its address like "6081" or "608F:01"'


# -- progress --------------------------------------------------------------------------------------------


def on_outcome(pending: Pending, t: Nanos, outcome: Outcome) -> list[Event]:
    """Handle the end of a transfer of this request; return the events that end the request, or none."""
    drive, request = pending.drive, pending.request
    if outcome.timed_out:
        return [pending.refuse(t, NO_RESPONSE)]
    if isinstance(request, msg.Zero):
        return _on_zero(pending, t, outcome)
    if outcome.abort is not None:
        return [pending.refuse(t, abort_text(outcome.abort))]
    if isinstance(request, msg.ReadParameter):
        return _parameter(pending, t, request, outcome)
    if isinstance(request, msg.WriteParameter):
        known_at_startup = outcome.job.key in (*startup.FIRST, *startup.THEN)
        if known_at_startup and not drive.owned:
            drive.forget()  # what is known of it has changed: read it anew
            drive.received(t)
        return [pending.done(t)]
    return []


def _parameter(pending: Pending, t: Nanos, request: msg.ReadParameter, outcome: Outcome) -> list[Event]:
    key = outcome.job.key
    known = OBJECTS.get(key)
    if known is not None and known.type is Type.TEXT:
        return [pending.done(t, outcome.value.decode("ascii", "replace"))]
    value = startup.value_of(key, outcome.value)
    if value is None:
        return [pending.refuse(t, f"{outcome.value.hex()} is no number of its type")]
    return [msg.Parameter(pending.drive.name, t, request.parameter, float(value))]


def _on_zero(pending: Pending, t: Nanos, outcome: Outcome) -> list[Event]:
    """Read the homing method, then write one; try the next one if the device does not support it."""
    drive, job = pending.drive, outcome.job
    if job.data is None:
        drive.homing_method = startup.value_of(job.key, outcome.value) if outcome.abort is None else None
        pending.stage = 0
    elif outcome.abort is None:
        drive.homing = HomingRun(pending.token, t, zero=True)
        return []
    else:
        pending.stage += 1
    if outcome.abort == NO_OBJECT or pending.stage >= len(ZERO_METHODS):
        why = abort_text(outcome.abort or 0)
        return [pending.refuse(t, f"it cannot take its present position as zero: {why}")]
    pending.transfer(o.HOMING_METHOD, to_bytes(Type.I8, ZERO_METHODS[pending.stage]))
    return []


def poll(pending: Pending, now: Nanos) -> tuple[list[Event], list[CanFrame]]:
    """Do what is due of a request; return (events, frames). Events end it."""
    drive, request = pending.drive, pending.request
    ended: list[Event] = []
    frames: list[CanFrame] = []
    match request:
        case msg.ClearFault():
            ended = _clear(pending, now)
        case msg.Estop() if drive.stop_demand is None and drive.power is not None:
            ended = [pending.done(now, "it stays in fault until cleared")]
        case msg.Reboot() if (
            drive.booted_at is not None and drive.booted_at > pending.began and pending.stage
        ):
            ended = [pending.done(now, "it has restarted")]
        case msg.Reboot() if now >= pending.next:
            pending.next, pending.stage = now + REBOOT_AGAIN, 1
            frames = [encode(Nmt(NmtCommand.RESET_NODE, drive.address))]
        case msg.Home() | msg.Zero():
            ended = _poll_homing(pending, now)
    if not ended and now >= pending.deadline:
        ended = _give_up(pending, now)
    return ended, frames


def _clear(pending: Pending, now: Nanos) -> list[Event]:
    drive = pending.drive
    if drive.power is None or drive.offline:
        return []
    if drive.power not in FAULTY:
        # An EMCY may be a fault or a warning: the statusword decides, and nothing is dropped before.
        if drive.emcy_unconfirmed or (pending.stage and drive.urgent_jobs):
            return []
        drive.clearing, drive.estopped = False, False
        drive.reported_faults.clear()
        if drive.stop_demand is Demand.QUICK_STOP:
            drive.stop_demand = None
        return [*drive.report(now), pending.done(now)]
    if pending.next <= now < pending.deadline:
        pending.next, pending.stage = now + CLEAR_AGAIN, pending.stage + 1
        demands = (Demand.DISABLE_VOLTAGE, Demand.FAULT_RESET)
        drive.urgent_jobs = [
            Job(Purpose.URGENT, o.CONTROLWORD, to_bytes(Type.U16, demand)) for demand in demands
        ]
        drive.writer.forget()
    return []


def _poll_homing(pending: Pending, now: Nanos) -> list[Event]:
    drive, homing = pending.drive, pending.drive.homing
    if homing is None:
        begun = isinstance(pending.request, msg.Home) or pending.stage < 0
        return [pending.refuse(now, "it was disarmed, or commanded otherwise")] if begun else []
    if homing.token != pending.token:
        return []
    if isinstance(pending.request, msg.Zero):
        pending.stage = -1
    result = motion.homing_result(drive, homing, now)
    if result is None:
        return []
    success, detail = result
    late = not success and now >= homing.since + drive.options.home_timeout_ms * MILLISECOND
    motion.end_homing(drive)
    if isinstance(pending.request, msg.Zero) and drive.homing_method is not None:
        restored = to_bytes(Type.I8, drive.homing_method)
        drive.request_jobs.append(Job(Purpose.REQUEST, o.HOMING_METHOD, restored))
    if success:
        return [pending.done(now, detail)]
    faults = drive.report_fault(now, HOMING_FAILED) if late else []
    return [*faults, pending.refuse(now, detail)]


def _give_up(pending: Pending, now: Nanos) -> list[Event]:
    drive = pending.drive
    if drive.received_at is None or drive.received_at < pending.began:
        reason = NO_RESPONSE
    elif isinstance(pending.request, msg.ClearFault):
        code, drive.reported_faults = drive.error_code, set()
        again = drive.report_fault(now, code or 0x1000)
        drive.clearing = False
        return [*again, pending.refuse(now, f"still in fault: error code {code:#06x}")]
    elif isinstance(pending.request, msg.Reboot):
        reason = "no boot-up message after the reset"
    else:
        reason = "the device did not react"
    return [pending.refuse(now, reason)]
