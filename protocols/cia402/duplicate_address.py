"""Duplicate node ids: another device than before, or two at once.

Rules. Functions on a `DriveState`. One response that came twice proves nothing; several requests in a row
that were answered twice, or heartbeats that alternate between contradictory states, prove two devices (or two
hosts that poll the same one). It is reported once until it is cleared.
"""

from __future__ import annotations

from protocols.cia402.old_client import DUPLICATES, Outcome
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import DriveState
from protocols.cia402.faults import DUPLICATE_NODE
from protocols.messages import Event, Found, Nanos


def on_identity(t: Nanos, drive: DriveState, outcome: Outcome) -> list[Event]:
    """Handle the identity check: with another serial number it is another device, of which nothing is
    known."""
    known = drive.profile.serial if drive.profile is not None else None
    serial = int.from_bytes(outcome.value, "little")
    if outcome.job.key == o.SERIAL_NUMBER and known is not None and serial != known:
        drive.forget()
        drive.received(t)
        return drive.report(t, "another device responds")
    return []


def check_responses(t: Nanos, drive: DriveState) -> list[Event]:
    """Report a duplicate after too many repeated responses. After one, the identity is checked soon."""
    if drive.client.repeated or drive.client.duplicates:
        drive.identity_check_at = min(drive.identity_check_at, t)
    if drive.client.duplicates < DUPLICATES:
        return []
    return _report(t, drive, "every request is answered twice (by two devices, or to two hosts)")


def check_heartbeats(t: Nanos, drive: DriveState) -> list[Event]:
    """Report a duplicate after heartbeats with the states A B A B."""
    states = drive.heartbeats
    if len(states) < 4 or states[:2] != states[2:] or states[0] == states[1]:
        return []
    return _report(t, drive, "its heartbeats alternate between contradictory states")


def _report(t: Nanos, drive: DriveState, cause: str) -> list[Event]:
    if drive.duplicate_reported:
        return []
    drive.duplicate_reported = True
    serial = drive.profile.serial if drive.profile is not None else None
    detail = f"duplicate node id {drive.address}: {cause}"
    found = Found(t, "cia402", drive.address, serial, detail, duplicate_address=True)
    return [found, *drive.report_fault(t, DUPLICATE_NODE, cause)]
