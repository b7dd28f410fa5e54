"""CubeMars (T-Motor) AK actuators over CAN: servo and MIT mode, firmware V3 (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.cubemars import table as cm
from protocols.cubemars.driver import CubeMarsAdapter
from protocols.cubemars.options import Options, Settings
from protocols.cubemars.twin import CubeMarsTwin, memory_of
from protocols.frames import exact
from protocols.messages import Command
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import can_motor, decoder_of, driver_of, own_ramps

__all__ = ["plugin"]

WHEEL: frozenset[type[Command]] = frozenset({msg.Idle, msg.Velocity, msg.Torque})
SERVO = WHEEL | {msg.Hold, msg.Position}
MIT = SERVO | {msg.Impedance}
NOTE = (
    "no timeout of its own is known: without its host the motor goes on with the last set-point. Write"
    ' watchdog = "acknowledged" under options'
)
SILENT = (
    "in MIT mode it reports nothing before its first command, and gets none before it has reported: it cannot"
    " start. If no other host drives it, write sole_host = true under options"
)


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry; of wheels the position is counted on, not measured."""
    if options.mode == "mit":
        table = options.table
        measured = {n: table.range("reply", n, inside=2) for n in ("position", "velocity", "torque")}
        measured["temperature"] = table.range("reply", "temperature")
        commanded = options.gains.ranges()
    else:
        table, unit, end = cm.SERVO, options.torque_constant, options.end
        most, fastest = options.max_current * unit, cm.MAX_ERPM * options.erpm
        measured = {
            "position": Range(-end + 2 * cm.DEGREE, end - 2 * cm.DEGREE, 0.051 * cm.DEGREE),
            "velocity": table.range("status", "velocity", options.erpm, inside=2),
            "torque": table.range("status", "current", unit),
            "current": table.range("status", "current"),
            "temperature": table.range("status", "temperature"),
        }
        if options.five:  # V3 gives its current another sign where it brakes
            del measured["torque"]
        commanded = (
            options.gains.ranges()
            if options.five
            else {
                "Position.position": Range(-end + 2 * cm.DEGREE, end - 2 * cm.DEGREE, 0.501e-4 * cm.DEGREE),
                "Velocity.velocity": Range(-fastest, fastest, 0.501 * options.erpm),
                "Torque.torque": Range(-most, most, 1.501e-3 * unit),
            }
        )
    if options.turns:
        del measured["position"]
        commanded = {n: each for n, each in commanded.items() if n.startswith(("Velocity", "Torque"))}
    return commanded | {f"Feedback.{name}": value for name, value in measured.items()}


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    mit, five = options.mode == "mit", options.five
    reads = ("model",) * five + ("pole_pairs", "gear") * (not mit) + ("torque_constant",) * (not five)
    release = cm.MIT.encode("exit", device.address) if mit else None
    release = release or cm.SERVO.encode("SET_CURRENT", device.address, value=0.0)
    status = exact(cm.STATUS | device.address, extended=True)
    return can_motor(
        device,
        options.table,
        cm.ADDRESSES,
        expects=tuple(map(exact, options.replies(device.address))) if mit else (status,),
        read_only=cm.asks if mit and options.sole_host else options.table.read_only,
        feedback=FeedbackKind.REPLY if mit else FeedbackKind.CYCLIC,
        commands=WHEEL if options.turns else MIT if five else SERVO,
        requests=frozenset({msg.ClearFault, msg.Zero}),
        ranges=ranges(options),
        watchdog=Watchdog(None, enabled=False, note="" if options.watchdog == "acknowledged" else NOTE),
        faults=cm.FAULTS,
        **options.gains.of_spec() if five else {},
        scales=dict.fromkeys(reads, ""),
        set_up={"exit": (1.0,)} if mit else {},
        stop=(release,),
        ramps=own_ramps(0.0 if mit else options.max_acceleration, msg.Position),
        caution=SILENT if mit and not options.sole_host else "",
    )


plugin = Plugin(
    name="cubemars",
    title="CubeMars (T-Motor) AK actuators over CAN (servo mode, MIT mode, firmware V3)",
    trust="bytes both ways: TMotorCANControl 1.2.6, which drove the twin too; of V3 epicallypowerful 1.0.7. "
    "No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(CubeMarsAdapter, spec),
    decoder=decoder_of(lambda options: options.table, memory_of, spec),
    twin=CubeMarsTwin,
    messages=cm.names,
    vectors=("protocols.cubemars", "vectors.json"),
)
