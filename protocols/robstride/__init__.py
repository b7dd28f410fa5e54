"""RobStride joint motors and the Xiaomi CyberGear over CAN (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.frames import EXTENDED_BIT, IdMask
from protocols.messages import MILLISECOND, Command
from protocols.plugin import DRIVER_WRITES, Device, FeedbackKind, Plugin, Range, Setting, Spec
from protocols.robstride import table as rs
from protocols.robstride.driver import RobStrideAdapter
from protocols.robstride.options import STORED, Options, Settings
from protocols.robstride.twin import RobStrideTwin, memory_of
from protocols.toolkit import mit
from protocols.toolkit.assembly import can_motor, declared, decoder_of, driver_of, fed_by_any_frame, own_ramps
from protocols.toolkit.options import configuration
from protocols.toolkit.table import BINARY32

__all__ = ["plugin"]

COMMANDS: dict[str, frozenset[type[Command]]] = {
    "mit": mit.COMMANDS,
    "speed": frozenset({msg.Idle, msg.Velocity}),
    "position": frozenset({msg.Idle, msg.Hold, msg.Position}),
}
SET_POINTS = {"loc_ref": ("Position.position",), "spd_ref": ("Velocity.velocity",)}
REQUESTS = frozenset({msg.ClearFault, msg.SetAddress, msg.Zero, msg.ReadParameter, msg.WriteParameter})
TURNS = Range(-1e5, 1e5, 1e-6, BINARY32)
"""Position in a register, which counts turns."""
ANYBODY: IdMask = (EXTENDED_BIT | rs.HOST << 8, EXTENDED_BIT | 0x1FFFFF00)
"""Ids of a scan: who is at an address."""


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry."""
    table = options.table
    measured = {name: table.range("status", name, inside=2) for name in ("velocity", "torque")}
    measured |= {"temperature": table.range("status", "temperature"), "position": TURNS}
    end = table.row("control").field("velocity").high
    speed = {"Velocity.velocity": Range(-end, end, 1e-12, BINARY32)}
    own = {"speed": speed, "position": {"Position.position": TURNS}}
    commanded = own.get(options.mode) or options.gains.ranges()
    return commanded | {f"Feedback.{name}": value for name, value in measured.items()}


def configured(device: Device) -> dict[str, Setting]:
    """Return the registers that are configuration."""
    options: Options = device.options
    ends, has = rs.MODELS[options.model], rs.parameters_of(options.model)
    found = configuration(device.settings, {name: name for name in STORED if name in has})
    limits = ("limit_torque", ends.torque), ("limit_cur", ends.current), ("limit_spd", ends.velocity)
    for name, end in limits:  # 0 of the settings is the model's largest
        expected = getattr(device.settings, name) or None
        found[name] = Setting(expected, 0.0, end, limit="torque" if name == "limit_torque" else "")
    written = RobStrideAdapter().written(options).keys() - {*rs.SET_POINT.values()}
    return found | {name: Setting(protected=DRIVER_WRITES) for name in written}


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    has = rs.parameters_of(options.model)
    ramped = options.mode == "speed" and "acc_rad" in has
    return can_motor(
        device,
        options.table,
        RobStrideAdapter.addresses,
        (ANYBODY,),
        commands=COMMANDS[options.mode],
        requests=REQUESTS,
        tells_serial=True,
        ranges=ranges(options),
        feedback=FeedbackKind.REPLY,
        faults=rs.faults_of(options.model),
        parameters=tuple(name for name in has if name != rs.SAVE),
        configuration=configured(device),
        set_up={**declared(RobStrideAdapter().written(options)), **SET_POINTS},
        stop=(rs.ANY.encode("disable", device.address),),
        save=rs.SAVE if rs.SAVE in has else "",
        receives_also=((EXTENDED_BIT | 0xFE, EXTENDED_BIT | 0x1F0000FF),) if options.scan else (),
        **options.gains.of_spec() if options.mode == "mit" else {},
        ramps=own_ramps(options.max_acceleration if ramped else 0.0, msg.Velocity),
        scales={"model": ""},
        **fed_by_any_frame(
            round(options.timeout * MILLISECOND),
            "" if rs.MODELS[options.model].timeout else f"a {options.model} has no watchdog that works",
        ),
    )


plugin = Plugin(
    name="robstride",
    title="RobStride RS00 to RS06, EL05 and Xiaomi CyberGear joint motors over CAN",
    trust="bytes of every message both ways, and the twin driven: robstride-dynamics 0.0.1, robstride 0.1.0, "
    "pycybergear 1.0.0, motorbridge 0.5.6. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(RobStrideAdapter, spec),
    decoder=decoder_of(lambda options: options.table, memory_of, spec),
    twin=RobStrideTwin,
    messages=rs.ANY.names,
    vectors=("protocols.robstride", "vectors.json"),
)
