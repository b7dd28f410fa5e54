"""Damiao DM-J joint motors over CAN: modes MIT, POS_VEL, VEL and FORCE_POS (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.damiao.driver import DamiaoAdapter
from protocols.damiao.options import REGISTERS as STORED
from protocols.damiao.options import Options, Settings
from protocols.damiao.table import ADDRESSES, ALL_MOTORS, ANY, FAULTS, REGISTERS, REPLY_BASE, SAVE
from protocols.damiao.twin import DamiaoTwin, motor_of
from protocols.frames import EXTENDED_BIT, exact
from protocols.messages import MILLISECOND, Command
from protocols.plugin import DRIVER_WRITES, Device, Plugin, Range, Setting, Spec, Watchdog
from protocols.toolkit import mit
from protocols.toolkit.assembly import can_motor, declared, decoder_of, driver_of
from protocols.toolkit.options import configuration
from protocols.toolkit.table import BINARY32

__all__ = ["plugin"]

COMMANDS: dict[str, frozenset[type[Command]]] = {
    "mit": mit.COMMANDS,
    "pos_vel": frozenset({msg.Idle, msg.Hold, msg.Position}),
    "vel": frozenset({msg.Idle, msg.Velocity}),
    "force_pos": frozenset({msg.Idle, msg.Hold, msg.Position}),
}

REQUESTS = frozenset(
    {msg.ClearFault, msg.SetAddress, msg.Zero, msg.ReadParameter, msg.WriteParameter, msg.Scan}
)
REPLIES = {msg.SetAddress: {"MST_ID": tuple(float(REPLY_BASE + at) for at in ADDRESSES)}}


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry."""
    p, v, _ = options.ends.values()
    table, numbers = options.table, ("position", "velocity", "torque")
    measured = {name: table.range("feedback", name, inside=2) for name in numbers}
    measured["temperature"] = Range(0.0, 255.0, 0.501)
    if options.position == "xout":
        measured["position"] = Range(-1e5, 1e5, 1e-6, BINARY32)
    commanded = {"Position.position": Range(-p, p, 1e-12, BINARY32)}
    if options.mode == "mit":
        commanded = options.gains.ranges()
    elif options.mode == "vel":
        commanded = {"Velocity.velocity": Range(-v, v, 1e-12, BINARY32)}
    return commanded | {f"Feedback.{name}": value for name, value in measured.items()}


PROTECTED: dict[str, str] = {
    **dict.fromkeys(("ESC_ID", "MST_ID"), "it is an address: a mistake ends all communication"),
    "can_br": "it is the bit rate: a mistake ends all communication",
    **dict.fromkeys(("SN", "hw_ver", "sw_ver", "sub_ver"), "it names the motor"),
    **dict.fromkeys(("NPP", "Rs", "Ls", "Flux", "Gr", "Damp", "Inertia"), "it was measured of the motor"),
    **dict.fromkeys(("TIMEOUT", "CTRL_MODE"), DRIVER_WRITES),
}


def configured(device: Device) -> dict[str, Setting]:
    """Return the registers that are configuration; those of the ranges are the model's."""
    p, v, t = device.options.ends.values()
    found = configuration(device.settings, {name: name for name in STORED})
    found |= {"PMAX": Setting(p, 0.0), "VMAX": Setting(v, 0.0, limit="velocity")}
    found |= {"TMAX": Setting(t, 0.0, limit="torque")}
    return found | {name: Setting(protected=why) for name, why in PROTECTED.items()}


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address, or the id of its answers, cannot be
    one."""
    options: Options = device.options
    address, reply = device.address, options.reply(device.address)
    if reply & 0xFF == address:
        text = f"reply_id {options.reply_id:#05x} of {device.name}: the motor itself obeys that id"
        raise Invalid(("options.reply_id", text))
    return can_motor(
        device,
        options.table,
        ADDRESSES,
        sends=(*(exact(page << 8 | address) for page in range(4)), exact(ALL_MOTORS)),
        obeys_also=((address, EXTENDED_BIT | 0xFF),),
        expects=(exact(reply),),
        commands=COMMANDS[options.mode],
        requests=REQUESTS,
        tells_serial=True,
        ranges=ranges(options),
        watchdog=Watchdog(round(options.timeout_ms * MILLISECOND), enabled=True),
        faults=FAULTS,
        parameters=tuple(REGISTERS.by_name),
        configuration=configured(device),
        set_up=declared(DamiaoAdapter().written(options)),
        stop=(ANY.encode("disable", device.address),),
        save=SAVE,
        writes={} if options.reply_id else REPLIES,
        receives_also=((REPLY_BASE, EXTENDED_BIT | 0x7F0), exact(0), exact(ALL_MOTORS)),
        **options.gains.of_spec() if options.mode == "mit" else {},
        scales={"model": "the motor is asked for its ranges before it is enabled"},
    )


plugin = Plugin(
    name="damiao",
    title="Damiao DM-J joint motors over CAN (MIT, POS_VEL, VEL, FORCE_POS)",
    trust="bytes of every message both ways, and the twin driven: damiao-motor 1.0.6. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(DamiaoAdapter, spec),
    decoder=decoder_of(lambda options: options.table, motor_of, spec),
    twin=DamiaoTwin,
    messages=ANY.names,
    vectors=("protocols.damiao", "vectors.json"),
)
