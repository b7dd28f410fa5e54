"""What is written to a device before it is armed: heartbeat, PDOs, the heartbeat consumer time.

Rules. Functions on a `DriveState`, which queue jobs for its SDO client. The setup is planned at the first
command and not before; what the device has is kept if it fits. Once all is written, the driver sends and
receives by it. A PDO that the device refuses to have written stays disabled, and its objects are transferred
by SDO; any other refusal keeps the device from being armed.
"""

from __future__ import annotations

from dataclasses import replace

from protocols.cia402.old_client import Job, Purpose
from protocols.cia402 import mapping
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import DriveState
from protocols.cia402.mapping import Pdo
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.profile import Mode
from protocols.cia402.setpoint import TARGET_OF
from protocols.cia402.startup import DeviceProfile
from protocols.messages import MILLISECOND


def configured(drive: DriveState) -> bool:
    """True if all is written that comes before arming; plan it first."""
    if drive.setup is None:
        drive.setup = _plan(drive)
    if drive.setup_pending:
        return False
    if not drive.configured:
        _adopt(drive)
        drive.configured = True
    return True


def _plan(drive: DriveState) -> list[Job]:
    options, jobs = drive.options, list[Job]()

    def write(key: Key, value: int) -> None:
        jobs.append(Job(Purpose.SETUP, key, to_bytes(OBJECTS[key].type, value)))

    if options.heartbeat_ms and not drive.read.get(o.PRODUCER_HEARTBEAT):
        write(o.PRODUCER_HEARTBEAT, options.heartbeat_ms)
    drive.pdos_to_write = _unfitting(drive) if options.mapping == "auto" else ()
    for pdo in drive.pdos_to_write:
        before = drive.read.get((mapping.parameters(pdo.kind, pdo.number)[0], o.COB_ID), 0)
        jobs += [Job(Purpose.SETUP, key, data) for key, data in mapping.writes(pdo, before)]
    if options.watchdog_ms:
        write(o.CONSUMER_HEARTBEAT, options.host_id << 16 | options.watchdog_ms)
    return jobs


def _unfitting(drive: DriveState) -> tuple[Pdo, ...]:
    """Return the PDOs that must be rewritten."""
    profile, options = drive.profile, drive.options
    if profile is None:
        return ()
    synced = options.feedback == "sync"
    sync = options.sync_ms * MILLISECOND
    wanted = mapping.wanted(drive.address, options, synced, drive.absent)
    if mapping.commands_fit(drive.usable("RPDO"), targets_of(profile, options.modes)):
        wanted = [pdo for pdo in wanted if pdo.kind == "TPDO"]
    # With another producer of SYNC its period is unknown here: one report in ten periods must do.
    most = 10 * max(sync, options.feedback_ms * MILLISECOND)
    if mapping.feedback_fits(drive.usable("TPDO"), sync or options.feedback_ms * MILLISECOND, most):
        wanted = [pdo for pdo in wanted if pdo.kind == "RPDO"]
    present = {(pdo.kind, pdo.number): pdo for pdo in profile.pdos}
    existing = [pdo for pdo in wanted if (pdo.kind, pdo.number) in present]
    return tuple(pdo for pdo in existing if not mapping.same(present[pdo.kind, pdo.number], pdo))


def targets_of(profile: DeviceProfile, prefer: str) -> set[Key]:
    """Return the set-points of the modes that would be used."""
    cyclic_modes = (Mode.CSP, Mode.CSV, Mode.CST)
    profile_modes = (Mode.PP, Mode.PV, Mode.PT)
    first, second = (cyclic_modes, profile_modes) if prefer == "cyclic" else (profile_modes, cyclic_modes)
    used = [profile.mode(*pair) for pair in zip(first, second, strict=True)]
    return {TARGET_OF[mode] for mode in used if mode is not None}


def _adopt(drive: DriveState) -> None:
    """Send and receive by the PDOs as they were written."""
    if drive.profile is None:
        return
    pdos = {(pdo.kind, pdo.number): pdo for pdo in (*drive.profile.pdos, *drive.pdos_to_write)}
    drive.profile = replace(drive.profile, pdos=tuple(pdos.values()))
    drive.pdos_to_write = ()
    drive.expect_tpdos(drive.profile.pdos)
    offsets = {key: drive.read[key] for key in (o.VELOCITY_OFFSET, o.TORQUE_OFFSET) if key in drive.read}
    drive.writer.configure(drive.usable("RPDO"))
    drive.writer.written |= offsets


def on_written(drive: DriveState, job: Job, abort: int | None) -> bool:
    """Handle the end of a setup job; return False if it must not fail.

    A PDO that the device refuses to have written stays disabled: its objects are transferred by SDO."""
    index, sub = job.key
    if abort is None:
        if job.key == o.CONSUMER_HEARTBEAT:
            drive.monitors_host = any(job.data or b"")
        return True
    if sub == o.INHIBIT and o.TPDO_COMMUNICATION <= index < o.TPDO_MAPPING:
        return True
    failed = [pdo for pdo in drive.pdos_to_write if index in mapping.parameters(pdo.kind, pdo.number)]
    if not failed:
        return job.key == o.PRODUCER_HEARTBEAT
    (pdo,) = failed
    drive.pdos_to_write = tuple(each for each in drive.pdos_to_write if each is not pdo)
    indices = mapping.parameters(pdo.kind, pdo.number)
    drive.setup = [each for each in drive.setup or [] if each.key[0] not in indices]
    if drive.profile is not None:
        identity = (pdo.kind, pdo.number)
        kept = tuple(each for each in drive.profile.pdos if (each.kind, each.number) != identity)
        drive.profile = replace(drive.profile, pdos=kept)
    return True
