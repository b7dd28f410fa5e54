"""What a command does: starting a device, arming it, its set-points, homing, disarming it.

Rules. Functions on a `DriveState`; they return frames, or queue jobs for its SDO client. Only uploads are
sent to a device before it is commanded, and no set-point before it is configured. Set-points are sent only in
response to a command of the same step. The first set-point of a sequence is the measured position. Disarming
and quick stops are repeated until the statusword shows them, commanded or not.

Homing is the device's own procedure, begun by bit 4 of the controlword while it is armed and holds. Its end
is taken from a statusword that came after the beginning. Then the device holds the newly measured position,
for its zero may have moved.

Source: CiA 402-2 "homing mode"; package canopen 2.4.1 `profiles/p402.py` for the bits.
"""

from __future__ import annotations

from protocols.cia402.old_client import Job, Purpose
from protocols.canopen.services import Nmt, NmtCommand, NmtState, encode
from protocols.cia402 import configuring, state_machine
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import DriveState, HomingRun
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.profile import Control, Demand, HomingStatus, Mode, PowerState, Status, homing_of
from protocols.cia402.setpoint import TARGET_OF, Values, mode_for, standstill, values_of
from protocols.cia402.startup import DeviceProfile, mode_name
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Hold, Idle, Nanos

START_AGAIN = 100 * MILLISECOND
"""Period at which NMT start is repeated until the device is operational."""
STARTS = 3
"""NMT starts to a device that sends no NMT state, before it is assumed to be operational."""
STOP_AGAIN = 50 * MILLISECOND
LATE = 500 * MILLISECOND
"""Time after which a device that has not disarmed is commanded DISABLE VOLTAGE, without a ramp."""
CONFIRMED = 2
"""Statuswords in a row that must show that a device is disarmed."""
PREPARED = 2
"""Set-points sent before a device is enabled."""
HANDSHAKE = 250 * MILLISECOND
"""Time after which a set-point of PP that was not acknowledged is replaced by the newest, by a new rise of
bit 4."""
LOWERED = 50 * MILLISECOND
"""Time for which bit 4 stays low before that: enough for a write by SDO."""
HOMED = 3
"""Statuswords after the start of homing before one is evaluated."""


def why_impossible(drive: DriveState, command: Command) -> str:
    """Return why a device cannot do a command at all; "" if it can, or is not known yet."""
    profile = drive.profile
    if profile is None or isinstance(command, Idle):
        return ""
    mode = mode_for(command, profile, drive.options.modes)
    if mode is None:
        return f"its object 6502 ({profile.modes:#x}) has no mode for {type(command).__name__}"
    try:
        values = values_of(command, mode, profile.units, 0)
    except ValueError as error:
        return str(error)
    lacking = next((key for key, value in values.items() if value and key in drive.absent), None)
    return f"it has no object {lacking[0]:04X} ({OBJECTS[lacking].name})" if lacking else ""


def apply(drive: DriveState, now: Nanos, command: Command, at_sync: bool) -> list[CanFrame]:
    """Return the frames of a command; none while the device cannot take it.

    `at_sync`: a SYNC follows, or another host produces it."""
    drive.commanded_at = now
    drive.holding = isinstance(command, Hold)
    if isinstance(command, Idle):
        _disarm(drive, now)
        return []
    if drive.stop_demand is Demand.SHUTDOWN:
        drive.stop_demand = None
    if drive.nmt is NmtState.STOPPED and not drive.offline:
        return _start(drive, now)
    if drive.profile is None or not drive.commandable:
        drive.setpoints = {}
        return []
    drive.owned = True
    if not configuring.configured(drive):
        return []
    frames = _start(drive, now) if not _operational(drive) else []
    if drive.writer.synchronous and not at_sync:
        return frames
    return frames + _setpoints(drive, now, drive.profile, command)


# -- starting ------------------------------------------------------------------------------------------------


def _operational(drive: DriveState) -> bool:
    """True if it is in NMT operational, as far as it reports that."""
    return drive.nmt is NmtState.OPERATIONAL or (drive.nmt is None and drive.nmt_starts >= STARTS)


def _start(drive: DriveState, now: Nanos) -> list[CanFrame]:
    if now < drive.nmt_start_next:
        return []
    drive.owned = True
    drive.nmt_start_next, drive.nmt_starts = now + START_AGAIN, drive.nmt_starts + 1
    return [encode(Nmt(NmtCommand.START, drive.address))]


# -- set-points ------------------------------------------------------------------------------------------


def _setpoints(drive: DriveState, now: Nanos, profile: DeviceProfile, command: Command) -> list[CanFrame]:
    if drive.homing is not None:
        return _send(drive, now, _homing_setpoints(drive, drive.homing), o.CONTROLWORD)
    mode = mode_for(command, profile, drive.options.modes)
    power, position = drive.power, drive.position
    if mode is None or position is None or power is None:
        return []
    if not isinstance(command, Hold):
        drive.hold = None
    elif drive.hold is None:
        drive.hold = position
    drive.target = TARGET_OF[mode]
    in_mode = drive.mode_display == mode
    if power is PowerState.OPERATION_ENABLED:
        resting = drive.setpoints.get(o.TARGET_POSITION, position) if drive.hold is None else drive.hold
        values = values_of(command, mode, profile.units, resting)
        control = int(Demand.ENABLE_OPERATION)
        if mode is Mode.PP and in_mode:
            control = _pp_handshake(drive, now, values)
        if in_mode:
            drive.arming_since = None
        else:
            _note_progress(drive, now, (power, mode))
    else:
        values = standstill(position)
        _note_progress(drive, now, (power, in_mode))
        drive.pp_target, drive.pp_new_setpoint = None, False
        # By SDO, one transfer after the other: each is confirmed before the next begins.
        prepared = in_mode and drive.rounds >= PREPARED
        option = drive.read.get(o.QUICK_STOP_OPTION, 2)
        demand = state_machine.arming_demand(power, option, prepared=prepared)
        if demand is None:
            return []
        control = demand
    values |= {o.CONTROLWORD: control, o.MODE: int(mode)}
    drive.rounds += 1
    return _send(drive, now, values, drive.target)


def _note_progress(drive: DriveState, now: Nanos, progress: object) -> None:
    """Note that it is not armed yet; arming fails without progress for too long."""
    if drive.arming_since is None or drive.arming_progress != progress:
        drive.arming_since, drive.arming_progress = now, progress


def arming_timeout(drive: DriveState, now: Nanos) -> str:
    """Return why arming has failed by now; "" if it has not."""
    since = drive.arming_since
    timeout = drive.options.state_timeout_ms * MILLISECOND
    if since is None or drive.arming_failed or now < since + timeout:
        return ""
    power = "an unknown state" if drive.power is None else drive.power.value
    shown = "no mode" if drive.mode_display is None else mode_name(drive.mode_display)
    return f"it stayed in {power} with {shown} displayed"


def _pp_handshake(drive: DriveState, now: Nanos, values: Values) -> int:
    """Return the controlword of PP's handshake; put its target into the values."""
    acknowledged = bool((drive.statusword or 0) & Status.SETPOINT_ACKNOWLEDGED)
    before = drive.pp_new_setpoint
    if before and not acknowledged and now > drive.pp_raised_at + HANDSHAKE:
        before = drive.pp_new_setpoint = False
        drive.pp_target, drive.pp_low_until = None, now + LOWERED
    if now < drive.pp_low_until:
        return int(Demand.ENABLE_OPERATION | Control.CHANGE_IMMEDIATELY)
    control, given, drive.pp_new_setpoint = state_machine.pp_handshake(
        acknowledged, before, values[o.TARGET_POSITION], drive.pp_target
    )
    if drive.pp_new_setpoint:
        values[o.TARGET_POSITION] = drive.pp_target = given
        drive.pp_raised_at = drive.pp_raised_at if before else now
    return control


def _send(drive: DriveState, now: Nanos, values: Values, moving: Key) -> list[CanFrame]:
    drive.setpoints = {key: value for key, value in values.items() if key not in drive.absent}
    return drive.writer.frames(now, drive.setpoints, moving)


# -- homing ----------------------------------------------------------------------------------------------


def _homing_setpoints(drive: DriveState, homing: HomingRun) -> Values:
    """Return the set-points during homing; bit 4 begins it once the device displays the mode."""
    control = int(Demand.ENABLE_OPERATION)
    if drive.mode_display == Mode.HM:
        if not homing.started:
            homing.started, homing.statusword_count = True, drive.statusword_count
        control |= Control.START_HOMING
    return standstill(drive.position or 0) | {o.CONTROLWORD: control, o.MODE: int(Mode.HM)}


def homing_result(drive: DriveState, homing: HomingRun, now: Nanos) -> tuple[bool, str] | None:
    """Return the end of homing as (success, detail); None while it goes on."""
    if drive.power is not PowerState.OPERATION_ENABLED:
        return False, "it was disarmed meanwhile"
    if now >= homing.since + drive.options.home_timeout_ms * MILLISECOND:
        return False, "it did not end in time"
    received = drive.statusword_count - homing.statusword_count
    if not homing.started or received < HOMED or drive.statusword is None:
        return None
    match homing_of(drive.statusword):
        case HomingStatus.DONE:
            return True, "home is found" if not homing.zero else "the present position is zero"
        case HomingStatus.ERROR_MOVING | HomingStatus.ERROR_STOPPED:
            return False, "it reports a homing error (bit 13 of its statusword)"
    return None


def end_homing(drive: DriveState) -> None:
    """Go back to holding, at the position measured from now on."""
    drive.homing, drive.hold, drive.position, drive.rounds = None, None, None, 0
    drive.polls.invalidate(o.POSITION)


# -- stopping --------------------------------------------------------------------------------------------


def _disarm(drive: DriveState, now: Nanos) -> None:
    """Disarm on Idle: only what this host has commanded, or after an operator's stop."""
    if drive.owned and drive.stop_demand is None:
        stop(drive, now, Demand.SHUTDOWN)
        drive.arming_failed = False


def stop(drive: DriveState, now: Nanos, demand: Demand) -> None:
    """Begin to disarm (SHUTDOWN), or a quick stop."""
    drive.stop_demand, drive.stop_since, drive.stop_next = demand, now, now
    drive.disarmed_statuswords = 0
    drive.unarm()
    drive.setpoints = {}


def repeat_stop(drive: DriveState, now: Nanos) -> list[CanFrame]:
    """Return the controlword of a stop that the statusword does not confirm yet."""
    if drive.stop_demand is None:
        return []
    gone = drive.power is PowerState.FAULT
    if drive.disarmed_statuswords >= CONFIRMED or (gone and drive.disarmed_statuswords):
        _on_stopped(drive)
        return []
    if now < drive.stop_next:
        return []
    drive.stop_next = now + STOP_AGAIN
    late = drive.stop_demand is Demand.SHUTDOWN and now - drive.stop_since >= LATE
    demand = Demand.DISABLE_VOLTAGE if late else drive.stop_demand
    return _send_demand(drive, now, demand, by_sdo=now > drive.stop_since)


def _send_demand(drive: DriveState, now: Nanos, demand: Demand, by_sdo: bool) -> list[CanFrame]:
    """Send a controlword by RPDO, and by SDO if it is in none, or that did not help (`by_sdo`)."""
    frames = []
    if o.CONTROLWORD in drive.writer.mapped and _operational(drive):
        values = dict.fromkeys(drive.writer.mapped, 0)
        values |= {o.TARGET_POSITION: drive.position or 0, o.MODE: drive.mode_display or 0}
        frames = drive.writer.frames(now, values | {o.CONTROLWORD: int(demand)}, o.CONTROLWORD)
    if by_sdo or not frames:
        data = to_bytes(OBJECTS[o.CONTROLWORD].type, demand)
        drive.urgent_jobs = [Job(Purpose.URGENT, o.CONTROLWORD, data)]
    drive.writer.written.pop(o.CONTROLWORD, None)
    return frames


def _on_stopped(drive: DriveState) -> None:
    if drive.stop_demand is Demand.SHUTDOWN:
        if drive.monitors_host:  # a host that disarms and leaves must not trip the watchdog
            drive.setup = [Job(Purpose.SETUP, o.CONSUMER_HEARTBEAT, bytes(4))]
            drive.monitors_host = False
            return
        if drive.setup_pending:
            return
        drive.owned, drive.setup, drive.configured = False, None, False
    drive.stop_demand = None
