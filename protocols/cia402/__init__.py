"""CANopen drives with the profile CiA 402 (servo drives), over CAN. See README.md beside this.

Rules. This file is the contract (`Spec`) and the entry point; nothing is decided here that the drive or the
robot file should decide. Ranges are what the wire can carry in sense, not what a joint may do; they follow
the drive's units as its settings have them, while the driver reads them from the drive itself.

What is read-only: requests to read an object by SDO, their segments, and a client's abort. SYNC is not: it
makes synchronous RPDOs of anybody take effect, and a second producer of it breaks the period of the first.
The host's heartbeat is not, since it feeds watchdogs; NMT is not, in any form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols import messages as msg
from protocols.cia402 import sdo
from protocols.cia402.codec import (
    HEARTBEAT_BASE,
    MAX_NODE,
    NMT_ID,
    NODE_MASK,
    SDO_RX_BASE,
    SDO_TX_BASE,
    SYNC_ID,
    Nmt,
    NmtCommand,
    decode,
    emcy_id,
    heartbeat_id,
    is_classic,
    rpdo_id,
    sdo_rx_id,
    sdo_tx_id,
    tpdo_id,
)
from protocols.cia402.decoder import Cia402Decoder
from protocols.cia402.driver import Cia402Driver
from protocols.cia402.faults import FAULTS
from protocols.cia402.objects import PDO_NUMBERS, Type
from protocols.cia402.options import Options, Settings, units_of_settings
from protocols.cia402.profile import Mode, supports
from protocols.cia402.twin import Cia402Twin
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command
from protocols.plugin import Device, Driver, FeedbackKind, Plugin, Range, Spec, Watchdog

WATCHDOG_NOTE = (
    "the drive is not told to watch this host's heartbeat, and its settings name none: if this host or its"
    " cable fails, the motor keeps its last set-point. Leave watchdog_ms above 0 under options, or set object"
    " 1016 with the maker's tool and heartbeat_consumer under settings"
)
ALMOST = 1.001
"""A resolution is half a step, and what rounding in binary64 adds."""
MODES: dict[type[Command], tuple[Mode, Mode]] = {
    msg.Position: (Mode.CSP, Mode.PP),
    msg.Velocity: (Mode.CSV, Mode.PV),
    msg.Torque: (Mode.CST, Mode.PT),
}
"""The modes that can do a command: the cyclic one, the profile one."""


def ranges(options: Options, settings: Settings) -> dict[str, Range]:
    """What a drive's objects can carry, in SI at its shaft."""
    units = units_of_settings(settings)
    step = math.pi / units.per_turn * ALMOST
    increment = math.pi / (settings.encoder_increments * units.gear) * ALMOST
    position = Range(units.position(Type.I32.low), units.position(Type.I32.high), step)
    velocity = Range(units.velocity(Type.I32.low), units.velocity(Type.I32.high), step)
    torque = Range(units.torque(Type.I16.low), units.torque(Type.I16.high), units.torque(1) / 2 * ALMOST)
    current = units.rated_current * 32.768
    found = {
        "Position.position": position,
        "Velocity.velocity": velocity,
        "Torque.torque": torque,
        "Feedback.position": Range(position.low, position.high, step + increment),
        "Feedback.velocity": velocity,
        "Feedback.torque": torque,
        "Feedback.current": Range(-current, current, units.current(1) / 2 * ALMOST),
        "Feedback.voltage": Range(0.0, Type.U32.high / 1000.0, 0.0005 * ALMOST),
    }
    if _is_cyclic(options, settings, msg.Position):
        found |= {"Position.velocity": velocity, "Position.torque": torque}
    if _is_cyclic(options, settings, msg.Velocity):
        found["Velocity.torque"] = torque
    return found


def _is_cyclic(options: Options, settings: Settings, kind: type[Command]) -> bool:
    """Whether a command goes by its cyclic mode, which alone has feed-forwards (60B1, 60B2)."""
    cyclic, profile = (supports(settings.supported_modes, mode) for mode in MODES[kind])
    return cyclic and (options.modes == "cyclic" or not profile)


def read_only(frame: Frame) -> bool:
    """Whether a wire only asks."""
    if not isinstance(frame, CanFrame) or not is_classic(frame) or frame.id & ~NODE_MASK != SDO_RX_BASE:
        return False
    return isinstance(sdo.decode_request(frame.data), sdo.Upload | sdo.UploadSegment | sdo.Abort)


def spec(device: Device) -> Spec:
    """The contract of one drive. ValueError if its address cannot be one."""
    options, settings, node = device.options, device.settings, device.address
    if not isinstance(options, Options) or not isinstance(settings, Settings):
        raise TypeError("a cia402 device takes cia402's Options and Settings")
    if not 1 <= node <= MAX_NODE:
        raise ValueError(f"address {node} of {device.name}: a node id is 1 to {MAX_NODE}")
    if node == options.host_id:
        raise ValueError(f"address {node} of {device.name} is the host's own node id: set host_id to another")
    able = {
        kind
        for kind, modes in MODES.items()
        if any(supports(settings.supported_modes, mode) for mode in modes)
    }
    enabled = bool(options.watchdog_ms or settings.heartbeat_consumer & 0xFFFF)
    timeout = (options.watchdog_ms or settings.heartbeat_consumer & 0xFFFF) * MILLISECOND
    # Any node may be asked who it is (Scan), so SDO requests may go to all of them.
    sends = {NMT_ID, SYNC_ID, heartbeat_id(options.host_id)} | {sdo_rx_id(n) for n in range(1, MAX_NODE + 1)}
    reported = {emcy_id(node), sdo_tx_id(node), heartbeat_id(node)}
    return Spec(
        bus="can",
        kind="motor",
        sends=frozenset(sends | {rpdo_id(number, node) for number in PDO_NUMBERS}),
        expects=frozenset(reported | {tpdo_id(number, node) for number in PDO_NUMBERS}),
        read_only=read_only,
        feedback=FeedbackKind.POLLED if options.feedback == "sdo" else FeedbackKind.CYCLIC,
        feedback_period=_feedback_ms(options) * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset(
            {msg.Idle} | able | ({msg.Hold} if able & {msg.Position, msg.Velocity} else set())
        ),
        requests=frozenset(
            {
                msg.ClearFault,
                msg.Estop,
                msg.Scan,
                msg.Home,
                msg.Zero,
                msg.ReadParameter,
                msg.WriteParameter,
                msg.Reboot,
            }
        ),
        ranges=ranges(options, settings),
        watchdog=Watchdog(timeout or None, enabled, "" if enabled else WATCHDOG_NOTE, "any command"),
        holds_unattended=not enabled,
        stop_clears_faults=False,
        faults=FAULTS,
        receives_also=_receives_also(options),
    )


def _receives_also(options: Options) -> tuple[tuple[int, int], ...]:
    """Answers to a scan, heartbeats; and, where this host says SYNC, that of another producer."""
    own_sync = options.feedback == "sync" and options.sync_ms
    return ((SDO_TX_BASE, 0x780), (HEARTBEAT_BASE, 0x780), *([(SYNC_ID, 0x1FFF_FFFF)] if own_sync else []))


def _feedback_ms(options: Options) -> int:
    return options.sync_ms or options.feedback_ms if options.feedback == "sync" else options.feedback_ms


NMT_NAMES = {
    NmtCommand.START: "NMT start",
    NmtCommand.STOP: "NMT stop",
    NmtCommand.ENTER_PRE_OPERATIONAL: "NMT enter pre-operational",
    NmtCommand.RESET_NODE: "NMT reset node",
    NmtCommand.RESET_COMMUNICATION: "NMT reset communication",
}
RPDO_NAMES = {rpdo_id(number, 0): f"RPDO{number}" for number in PDO_NUMBERS}


def messages(frame: Frame) -> Sequence[str]:
    """The name of the message to a device that a wire holds: "NMT start", "SDO download 6040", "RPDO1" …"""
    if not isinstance(frame, CanFrame) or not is_classic(frame):
        return ()
    function = frame.id & ~NODE_MASK
    if function == SDO_RX_BASE:
        return _sdo_name(sdo.decode_request(frame.data))
    if function in RPDO_NAMES and frame.id & NODE_MASK:
        return (RPDO_NAMES[function],)
    match decode(frame):
        case Nmt(command, _):
            return (NMT_NAMES[command],)
        case None:
            return ()
    if frame.id == SYNC_ID:
        return ("SYNC",)
    return ("heartbeat",) if function == HEARTBEAT_BASE else ()


def _sdo_name(request: sdo.Request | None) -> Sequence[str]:
    match request:
        case sdo.Download(index, _, _):
            return (f"SDO download {index:04X}",)
        case sdo.DownloadStart(index, _, _):
            return (f"SDO segmented download {index:04X}",)
        case sdo.DownloadSegment():
            return ("SDO download segment",)
        case sdo.Upload():
            return ("SDO upload",)
        case sdo.UploadSegment():
            return ("SDO upload segment",)
        case sdo.Abort():
            return ("SDO abort",)
    return ()


def driver(devices: Sequence[Device]) -> Driver:
    """Our end, for all drives of one bus. ValueError if addresses collide, or SYNC is not agreed on."""
    addresses = [device.address for device in devices]
    for device in devices:
        if addresses.count(device.address) > 1:
            raise ValueError(f"address {device.address} of {device.name} is given twice on this bus")
        if device.address in {other.options.host_id for other in devices}:
            raise ValueError(f"address {device.address} of {device.name} is a host's own node id on this bus")
    return Cia402Driver(devices, {device.name: spec(device).ranges for device in devices})


plugin = Plugin(
    name="cia402",
    title="servo drives with CANopen and the profile CiA 402 (DS402)",
    trust=(
        "bytes of NMT, SYNC, heartbeat, EMCY, SDO and PDO both ways: canopen 2.4.1; error codes, units and"
        " modes of CiA 402: from memory of its text, checked against no drive; twin driven by canopen 2.4.1's"
        " BaseNode402 (arming, modes, fault, homing, PdoMap.save, scanner)"
    ),
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=Cia402Decoder,
    twin=Cia402Twin,
    messages=messages,
    vectors=("gateway.fixtures", "vectors/cia402.json"),
)
