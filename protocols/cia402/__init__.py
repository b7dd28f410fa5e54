"""CANopen drives with the profile CiA 402 (servo drives), over CAN. See README.md beside this.

Exports the plugin, its `Options` and `Settings`. Imports nothing of gateway and brain, owns no bus and no
clock.

Rules. This file is the contract (`Spec`) and the entry point. Ranges are what a drive's objects can
represent, not what a joint may do; they follow the drive's units as its settings have them, while the driver
reads them from the drive itself.

Read-only are: SDO uploads, their segments, and a client's abort. SYNC is not: it makes every host's
synchronous RPDOs take effect, and a second producer of it disturbs the period of the first. The host's
heartbeat is not, since it feeds watchdogs; NMT is not, in any form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols import messages as msg
from protocols.canopen import sdo
from protocols.canopen import services as codec
from protocols.canopen.services import (
    HEARTBEAT_BASE,
    MAX_NODE,
    NMT_ID,
    NODE_MASK,
    SDO_RX_BASE,
    SDO_TX_BASE,
    SYNC_ID,
)
from protocols.cia402.driver import Cia402Adapter
from protocols.cia402.faults import FAULTS
from protocols.cia402.memory import Cia402Decoder
from protocols.cia402.objects import PDO_NUMBERS, Type
from protocols.cia402.options import Options, Settings, units_of_settings
from protocols.cia402.profile import supports
from protocols.cia402.setpoints import FAMILIES
from protocols.cia402.twin import Cia402Twin
from protocols.frames import EXTENDED_BIT, CanFrame, Frame, IdMask, exact
from protocols.messages import MILLISECOND, Command
from protocols.plugin import Device, Driver, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.motor_driver import MotorDriver

__all__ = ["Options", "Settings", "plugin"]

WATCHDOG_NOTE = (
    "the drive does not monitor this host's heartbeat: neither options nor settings enable that. If this host"
    " or its cable fails, the motor keeps its last set-point. Leave watchdog_ms above 0 under options, or set"
    " object 1016 with the maker's tool and heartbeat_consumer under settings"
)
MARGIN = 1.001
"""For rounding in binary64: a resolution is half a step, and this margin."""


def ranges(options: Options, settings: Settings) -> dict[str, Range]:
    """Return what a drive's objects can represent, in SI at its shaft."""
    units = units_of_settings(settings)
    step = math.pi / units.per_turn * MARGIN
    increment = math.pi / (settings.encoder_increments * units.gear) * MARGIN
    position = Range(units.position(Type.I32.low), units.position(Type.I32.high), step)
    speed = math.pi / units.velocity_per_turn * MARGIN
    velocity = Range(units.velocity(Type.I32.low), units.velocity(Type.I32.high), speed)
    torque = Range(units.torque(Type.I16.low), units.torque(Type.I16.high), units.torque(1) / 2 * MARGIN)
    current = units.rated_current * 32.768
    found = {
        "Position.position": position,
        "Velocity.velocity": velocity,
        "Torque.torque": torque,
        "Feedback.position": Range(position.low, position.high, step + increment),
        "Feedback.velocity": velocity,
        "Feedback.torque": torque,
        "Feedback.current": Range(-current, current, units.current(1) / 2 * MARGIN),
        "Feedback.voltage": Range(0.0, Type.U32.high / 1000.0, 0.0005 * MARGIN),
    }
    if _is_cyclic(options, settings, msg.Position):
        found |= {"Position.velocity": velocity, "Position.torque": torque}
    if _is_cyclic(options, settings, msg.Velocity):
        found["Velocity.torque"] = torque
    return found


def _is_cyclic(options: Options, settings: Settings, kind: type[Command]) -> bool:
    """True if a command uses its cyclic mode; only these have feed-forwards (60B1, 60B2)."""
    cyclic, profile = (supports(settings.supported_modes, mode) for mode in FAMILIES[kind][0][1:])
    return cyclic and (options.modes == "cyclic" or not profile)


def read_only(frame: Frame) -> bool:
    """True if a frame only reads."""
    if not isinstance(frame, CanFrame) or not codec.is_classic(frame):
        return False
    request = sdo.decode_request(frame.data) if frame.id & ~NODE_MASK == SDO_RX_BASE else None
    return isinstance(request, sdo.Upload | sdo.UploadSegment | sdo.Abort)


def spec(device: Device) -> Spec:
    """Return the contract of one drive. ValueError if its address is not possible."""
    options, settings, node = device.options, device.settings, device.address
    if not isinstance(options, Options) or not isinstance(settings, Settings):
        raise TypeError("a cia402 device takes cia402's Options and Settings")
    if not 1 <= node <= MAX_NODE:
        raise ValueError(f"address {node} of {device.name}: a node id is 1 to {MAX_NODE}")
    if node == options.host_id:
        raise ValueError(f"address {node} of {device.name} is the host's own node id: set host_id to another")
    able = {
        kind
        for kind, families in FAMILIES.items()
        if any(supports(settings.supported_modes, mode) for family in families for mode in family[1:])
    }
    timeout = (options.watchdog_ms or settings.heartbeat_consumer & 0xFFFF) * MILLISECOND
    # A scan uploads from every node, so SDO requests may be sent to all of them.
    sends = {NMT_ID, SYNC_ID, codec.heartbeat_id(options.host_id)}
    sends |= {codec.sdo_rx_id(n) for n in range(1, MAX_NODE + 1)}
    sends |= {codec.rpdo_id(number, node) for number in PDO_NUMBERS}
    expects = {codec.emcy_id(node), codec.sdo_tx_id(node), codec.heartbeat_id(node)}
    expects |= {codec.tpdo_id(number, node) for number in PDO_NUMBERS}
    return Spec(
        bus="can",
        kind="motor",
        sends=tuple(exact(number) for number in sorted(sends)),
        expects=tuple(exact(number) for number in sorted(expects)),
        read_only=read_only,
        feedback=FeedbackKind.POLLED if options.feedback == "sdo" else FeedbackKind.CYCLIC,
        feedback_period=_feedback_ms(options) * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset({msg.Idle} | able),
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
        watchdog=Watchdog(timeout or None, bool(timeout), "" if timeout else WATCHDOG_NOTE, "any command"),
        holds_unattended=not timeout,
        stop_clears_faults=False,
        faults=FAULTS,
        parameters=("6041", "6064"),
        receives_also=_receives_also(options),
    )


def _receives_also(options: Options) -> tuple[IdMask, ...]:
    """Responses to a scan, heartbeats; and, if this host produces SYNC, that of another producer."""
    own_sync = options.feedback == "sync" and options.sync_ms
    any_node = 0x780 | EXTENDED_BIT
    scanned = ((SDO_TX_BASE, any_node), (HEARTBEAT_BASE, any_node))
    return (*scanned, exact(SYNC_ID)) if own_sync else scanned


def _feedback_ms(options: Options) -> int:
    return options.sync_ms or options.feedback_ms if options.feedback == "sync" else options.feedback_ms


NMT_NAMES = {
    codec.NmtCommand.START: "NMT start",
    codec.NmtCommand.STOP: "NMT stop",
    codec.NmtCommand.ENTER_PRE_OPERATIONAL: "NMT enter pre-operational",
    codec.NmtCommand.RESET_NODE: "NMT reset node",
    codec.NmtCommand.RESET_COMMUNICATION: "NMT reset communication",
}
RPDO_NAMES = {codec.rpdo_id(number, 0): f"RPDO{number}" for number in PDO_NUMBERS}


def messages(frame: Frame) -> Sequence[str]:
    """Return the name of the message to a device in a frame: "NMT start", "SDO download 6040", "RPDO1" …"""
    if not isinstance(frame, CanFrame) or not codec.is_classic(frame):
        return ()
    function = frame.id & ~NODE_MASK
    if function == SDO_RX_BASE:
        name = _sdo_name(sdo.decode_request(frame.data))
        return (name,) if name else ()
    if function in RPDO_NAMES and frame.id & NODE_MASK:
        return (RPDO_NAMES[function],)
    match codec.decode(frame):
        case codec.Nmt(command, _):
            return (NMT_NAMES[command],)
        case codec.Sync():
            return ("SYNC",)
        case codec.Heartbeat():
            return ("heartbeat",)
    return ()


def _sdo_name(request: sdo.Request | None) -> str:
    match request:
        case sdo.Download(index, _, _):
            return f"SDO download {index:04X}"
        case sdo.DownloadStart(index, _, _):
            return f"SDO segmented download {index:04X}"
        case sdo.DownloadSegment():
            return "SDO download segment"
        case sdo.Upload():
            return "SDO upload"
        case sdo.UploadSegment():
            return "SDO upload segment"
        case sdo.Abort():
            return "SDO abort"
    return ""


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver for all drives of one bus. ValueError if addresses collide, or they need a host that
    does two things at once."""
    addresses = [device.address for device in devices]
    errors = [
        f"address {device.address} of {device.name} is given twice on this bus"
        for device in devices
        if addresses.count(device.address) > 1
    ]
    errors += [
        f"address {device.address} of {device.name} is a host's own node id on this bus"
        for device in devices
        if device.address in {other.options.host_id for other in devices}
    ]
    synced = [device for device in devices if device.options.feedback == "sync"]
    errors += _differ("sync_ms", synced) + _differ("host_id", devices)
    if errors:
        raise ValueError("; ".join(errors))
    ranges_of = {device.name: spec(device).ranges for device in devices}
    return MotorDriver(Cia402Adapter(devices), devices, ranges_of)


def _differ(option: str, devices: Sequence[Device]) -> list[str]:
    """Return why the devices of a bus do not agree on an option; [] if they do."""
    values = {getattr(device.options, option): device.name for device in reversed(devices)}
    found = " and ".join(f"{value} for {name}" for value, name in reversed(values.items()))
    return [f"{option} must be the same for all drives of one bus: it is {found}"] if len(values) > 1 else []


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
