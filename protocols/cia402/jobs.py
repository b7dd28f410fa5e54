"""Which object of a device is next to be read or written by SDO, and when.

Rules. One transfer at a time per device, in order of urgency. Set-points take turns with feedback (`feedback`
schedules it), and so does what is read at startup, or written before arming. Nothing is written to a device
that was not commanded, except on request.
"""

from __future__ import annotations

from protocols.cia402.old_client import Job, Purpose
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import DriveState
from protocols.cia402.feedback import NEVER, Conditions
from protocols.cia402.objects import OBJECTS, to_bytes
from protocols.messages import MILLISECOND, SECOND, Nanos

IDENTITY_CHECK = SECOND
"""Period at which a device's serial number is read, to notice another device, or two."""
IDENTITY_RECHECK = 100 * MILLISECOND
"""The same after a response that came twice."""


def next_job(drive: DriveState, now: Nanos) -> Job | None:
    """Return the job to begin now; None if nothing is due, or the client is busy."""
    client = drive.client
    if drive.urgent_jobs and client.free(Purpose.URGENT):
        return drive.urgent_jobs.pop(0)
    if not client.free(Purpose.POLL):
        return None
    poll = drive.polls.next(now, _conditions(drive), drive.absent)
    has_turn, drive.poll_has_turn = drive.poll_has_turn and poll is not None, True
    if not has_turn:
        if drive.setup and (drive.owned or drive.commanded_at == now):
            return drive.setup.pop(0)
        setpoint = _setpoint(drive, now)
        if setpoint is not None:
            return setpoint
    if drive.request_jobs:
        drive.poll_has_turn = False
        return drive.request_jobs.pop(0)
    key = drive.next_key()
    if key is not None and not has_turn:
        return Job(Purpose.STARTUP, key)
    drive.poll_has_turn = False
    if poll is not None:
        drive.polls.begin(now, poll, drive.absent)
        return Job(Purpose.POLL, poll)
    if now >= drive.identity_check_at and drive.received_at is not None:
        suspect = client.duplicates or client.repeated
        drive.identity_check_at = now + (IDENTITY_RECHECK if suspect else IDENTITY_CHECK)
        serial = o.SERIAL_NUMBER not in drive.absent
        return Job(Purpose.IDENTITY_CHECK, o.SERIAL_NUMBER if serial else o.DEVICE_TYPE)
    return None


def _setpoint(drive: DriveState, now: Nanos) -> Job | None:
    """Return the download of a set-point that is in no PDO, while the device is commanded."""
    commanded = drive.commanded_at == now or drive.homing
    if not drive.setpoints or drive.stop_demand is not None or not commanded:
        return None
    download = drive.writer.next_download(now, drive.setpoints, drive.target)
    if download is None:
        return None
    key, value = download
    return Job(Purpose.SETPOINT, key, to_bytes(OBJECTS[key].type, value))


def _conditions(drive: DriveState) -> Conditions:
    transient = drive.arming_since is not None or drive.stop_demand is not None or drive.clearing
    return Conditions(transient, drive.error_code_wanted, drive.units is not None)


def due(drive: DriveState) -> Nanos:
    """Return when `next_job` next has something for a free client."""
    if drive.urgent_jobs or drive.setup or drive.request_jobs or drive.next_key() is not None:
        return 0
    check = drive.identity_check_at if drive.received_at is not None else NEVER
    return min(drive.polls.due(_conditions(drive)), check)
