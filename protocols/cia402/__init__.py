"""CANopen drives with the profile CiA 402 (servo drives), over CAN (README.md). Exports `plugin`, its
`Options` and `Settings`.

Ranges are what a drive's objects can represent, not what a joint may do; they follow the drive's units as its
settings have them, while the driver reads them from the drive itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.canopen import lss, names
from protocols.canopen import objects as co
from protocols.canopen import services as cs
from protocols.canopen.objects import PDO_NUMBERS, Key, Type
from protocols.canopen.services import NMT_STATE, NmtState
from protocols.cia402 import objects as o
from protocols.cia402.data_sheet import DataSheet, check, read
from protocols.cia402.driver import Cia402Adapter
from protocols.cia402.faults import FAULTS
from protocols.cia402.memory import HEARTBEAT, LSS, RESET, SYNC, Cia402Decoder
from protocols.cia402.objects import OBJECTS, decoded
from protocols.cia402.options import Options
from protocols.cia402.profile import Mode, supports
from protocols.cia402.setpoints import FAMILIES
from protocols.cia402.settings import SETTING_OBJECTS, Settings, units_of_settings
from protocols.cia402.setup import Known
from protocols.cia402.twin import Cia402Twin
from protocols.cia402.units import READ
from protocols.frames import EXTENDED_BIT, exact
from protocols.messages import MILLISECOND, Command, Request
from protocols.plugin import (
    ANY,
    DRIVER_WRITES,
    Declared,
    Device,
    Driver,
    FeedbackKind,
    Plugin,
    Range,
    Setting,
    Spec,
    Watchdog,
    Written,
)
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.options import configuration

__all__ = ["Options", "Settings", "plugin"]

WATCHDOG_NOTE = (
    "the drive does not monitor this host's heartbeat: neither options nor settings enable that. If this host"
    " or its cable fails, the motor keeps its last set-point. Leave watchdog_ms above 0 under options, or set"
    " object 1016 with the maker's tool and heartbeat_consumer under settings"
)
_ACTIONS = (msg.ClearFault, msg.Estop, msg.Scan, msg.SetAddress, msg.Home, msg.Zero, msg.Reboot)
REQUESTS: frozenset[type[Request]] = frozenset((*_ACTIONS, msg.ReadParameter, msg.WriteParameter))
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


PROTECTED: dict[Key, str] = {
    **dict.fromkeys((co.VENDOR_ID, co.PRODUCT_CODE, co.REVISION, co.SERIAL_NUMBER), "it names the drive"),
    o.SUPPORTED_MODES: "the drive is made so",
    o.ENCODER_INCREMENTS: "it belongs to the encoder that is mounted",
    o.HOME_OFFSET: "it is where the zero was found",
    co.PRODUCER_HEARTBEAT: DRIVER_WRITES,
    co.CONSUMER_HEARTBEAT: DRIVER_WRITES,
}


def configured(options: Options, settings: Settings) -> dict[str, Setting]:
    """Return the objects that are configuration; stated are those of units and watchdog."""
    units, lacks = units_of_settings(settings), {int(index, 16) for index in settings.lacks.split()}
    keys = {n: k for n, k in SETTING_OBJECTS.items() if k != o.DIGITAL_INPUTS and k[0] not in lacks}
    why = {name: PROTECTED[key] for name, key in keys.items() if key in PROTECTED}
    if not options.watchdog_ms:
        why["heartbeat_consumer"] = "the driver alone configures heartbeats"
    watched = (co.CONSUMER_HEARTBEAT, o.ABORT_CONNECTION)
    stated = [name for name, key in keys.items() if key in (*READ, *watched)]
    found = configuration(settings, {OBJECTS[key].name: name for name, key in keys.items()}, stated, why)
    limits: dict[Key, tuple[Literal["velocity", "torque"], float]] = {
        o.MAX_MOTOR_SPEED: ("velocity", math.tau / 60.0 / units.gear),
        o.MAX_PROFILE_VELOCITY: ("velocity", units.velocity(1)),
        o.MAX_TORQUE: ("torque", units.torque(1)),
    }
    for key, (limit, unit) in limits.items():
        if (name := OBJECTS[key].name) in found:
            found[name] = replace(found[name], limit=limit, unit=unit)
    return found


MODES = tuple(
    (float(mode), kind) for kind, families in FAMILIES.items() for family in families for mode in family[1:]
)
HOMING: Written = {co.title(o.MODE): (float(Mode.HM),), co.title(o.HOMING_METHOD): ((-128.0, 127.0),)}
"""What homing writes: Zero its own method, then that of before."""


READDRESSED: Written = {LSS: ANY, NMT_STATE: (float(NmtState.PRE_OPERATIONAL),), RESET: (1.0,)}
"""What gives a drive another node id: LSS, and a reset of its communication."""


def set_up(device: Device) -> Written:
    """Return what is written to a drive unasked. What a controlword makes it do is decoded beside."""
    found = co.declared(
        (write.key, write.value) for write in Known(device.options, device.address).all_writes()
    )
    found[co.title(co.CONSUMER_HEARTBEAT)] = (0.0, *found.get(co.title(co.CONSUMER_HEARTBEAT), ()))
    states = (float(NmtState.OPERATIONAL), float(NmtState.PRE_OPERATIONAL))
    sent: dict[str, tuple[Declared, ...]] = {
        SYNC: (0.0,),
        HEARTBEAT: states,
        NMT_STATE: states[:1],
        co.title(o.MODE): MODES,
    }
    sent[co.title(o.TARGET_POSITION)] = ((-(2.0**31), 2.0**31),)
    for key in o.TARGETS - {o.TARGET_POSITION}:
        sent[co.title(key)] = (0.0,)
    return {**found, **sent, co.title(o.CONTROLWORD): ((0.0, 65535.0),)}


def _sheet(options: Options) -> DataSheet | None:
    """Return the data sheet that a robot file names. Raises Invalid if it cannot be read."""
    try:
        return read(options.eds) if options.eds else None
    except ValueError as error:
        raise Invalid(("options.eds", str(error))) from error


def spec(device: Device) -> Spec:
    """Return the contract of one drive. ValueError if its address is not possible."""
    options, settings, node = device.options, device.settings, device.address
    if not isinstance(options, Options) or not isinstance(settings, Settings):
        raise TypeError("a cia402 device takes cia402's Options and Settings")
    if not 1 <= node <= cs.MAX_NODE:
        raise Invalid(("address", f"address {node} of {device.name}: a node id is 1 to {cs.MAX_NODE}"))
    if node == options.host_id:
        text = f"address {node} of {device.name} is the host's own node id: set host_id to another"
        raise Invalid(("address", text))
    configuration, supported = configured(options, settings), settings.supported_modes
    sheet = _sheet(options)
    if sheet is not None:
        configuration = {**check(sheet, options, configuration, configured(options, Settings()))}
        supported = supported if sheet.modes is None else sheet.modes
    able = {
        kind
        for kind, families in FAMILIES.items()
        if any(supports(supported, mode) for family in families for mode in family[1:])
    }
    if sheet is not None:
        able = sheet.commands(able, options)
    timeout = (options.watchdog_ms or settings.heartbeat_consumer & 0xFFFF) * MILLISECOND
    synced = options.feedback == "sync"
    # A scan uploads from every node, so SDO requests may be sent to all of them.
    sends = [lss.MASTER, cs.NMT_ID, cs.SYNC_ID, cs.HEARTBEAT_BASE + options.host_id]
    sends += [cs.rpdo_id(number, node) for number in PDO_NUMBERS]
    sends += [cs.sdo_rx_id(each) for each in range(1, cs.MAX_NODE + 1)]
    expects = [base + node for base in (cs.EMCY_BASE, cs.SDO_TX_BASE, cs.HEARTBEAT_BASE)]
    expects += [cs.tpdo_id(number, node) for number in PDO_NUMBERS]
    any_node = 0x780 | EXTENDED_BIT
    other_producer = (exact(cs.SYNC_ID),) if synced and options.sync_ms else ()
    return Spec(
        bus="can",
        kind="motor",
        sends=tuple(map(exact, sends)),
        expects=tuple(map(exact, expects)),
        read_only=names.read_only,
        feedback=FeedbackKind.POLLED if options.feedback == "sdo" else FeedbackKind.CYCLIC,
        feedback_period=(options.sync_ms * synced or options.feedback_ms) * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset({msg.Idle} | able),
        requests=REQUESTS,
        tells_serial=True,
        first_address=True,
        ranges=ranges(options, settings),
        watchdog=Watchdog(timeout or None, bool(timeout), "" if timeout else WATCHDOG_NOTE, "any command"),
        holds_unattended=not timeout,
        stop_clears_faults=False,
        faults=FAULTS,
        parameters=("6041", "6064"),
        configuration=configuration,
        set_up=set_up(device),
        unread=tuple(exact(cs.rpdo_id(number, node)) for number in PDO_NUMBERS),
        stop=(cs.disable(node),),
        writes={msg.Home: HOMING, msg.Zero: HOMING, msg.SetAddress: READDRESSED},
        decoded=decoded,
        save="save",
        receives_also=(
            (cs.SDO_TX_BASE, any_node),
            (cs.HEARTBEAT_BASE, any_node),
            exact(lss.SLAVE),
            *other_producer,
        ),
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver for all drives of one bus. ValueError if addresses collide, or the drives need a host
    that does two things at once."""
    synced = [device for device in devices if device.options.feedback == "sync"]
    for option, concerned in (("sync_ms", synced), ("host_id", devices)):
        values = {getattr(device.options, option): device.name for device in concerned}
        if len(values) > 1:
            found = " and ".join(f"{value} for {name}" for value, name in values.items())
            raise ValueError(f"{option} must be the same for all drives of one bus: it is {found}")
    return driver_of(lambda: Cia402Adapter(devices), spec)(devices)


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
    messages=names.messages,
    vectors=("protocols.cia402", "vectors.json"),
)
