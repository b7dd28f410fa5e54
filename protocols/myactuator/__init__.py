"""MyActuator RMD motors over CAN, protocol V3 and V4: servo and motion mode (README.md). Exports `plugin`."""

from __future__ import annotations

import math

from protocols import messages as msg
from protocols.frames import EXTENDED_BIT, IdMask, exact
from protocols.messages import MILLISECOND, Command
from protocols.myactuator import table as rmd
from protocols.myactuator.driver import RmdAdapter
from protocols.myactuator.options import Options, Settings
from protocols.myactuator.twin import RmdTwin, memory_of
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec
from protocols.toolkit import mit
from protocols.toolkit.assembly import can_motor, decoder_of, driver_of, fed_by_any_frame, own_ramps

__all__ = ["plugin"]

COMMANDS: dict[str, frozenset[type[Command]]] = {
    "servo": mit.COMMANDS - {msg.Impedance},
    "motion": mit.COMMANDS,
}
SCALES = {"servo": ("torque_constant",), "motion": ("position_end", "velocity_end", "torque_end")}
"""Options that decide what the numbers of a mode mean."""
ANYBODY: IdMask = (0x140, EXTENDED_BIT | 0x7C0)
"""Ids of a scan."""
ANSWERS: IdMask = (0x240, EXTENDED_BIT | 0x7C0)
DEGREE = math.pi / 180.0


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry. What is measured may be cut off, not rounded."""
    constant, fine = options.torque_constant, 1.001 * 0.01 * DEGREE
    turns, fastest, strongest = rmd.TURNS * DEGREE, rmd.FASTEST * DEGREE, rmd.STRONGEST * constant
    common = {
        "Feedback.position": Range(-turns, turns, fine),
        "Feedback.temperature": rmd.ANY.range("status 2", "temperature"),
        "Feedback.voltage": rmd.ANY.range("status 1", "voltage"),
    }
    if options.mode == "motion":
        moved = {name: options.table.range("motion reply", name, inside=2) for name in ("velocity", "torque")}
        return common | options.gains.ranges() | {f"Feedback.{name}": each for name, each in moved.items()}
    return common | {
        "Position.position": Range(-turns, turns, 0.5 * fine),
        "Velocity.velocity": Range(-fastest, fastest, 0.5 * fine),
        "Torque.torque": Range(-strongest, strongest, 0.501 * 0.01 * constant),
        "Feedback.velocity": Range(-fastest, fastest, 1.001 * DEGREE),
        "Feedback.torque": Range(-strongest, strongest, 1.001 * 0.01 * constant),
        "Feedback.current": Range(-rmd.STRONGEST, rmd.STRONGEST, 1.001 * 0.01),
    }


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    timeout = (options.timeout_ms or device.settings.timeout_ms) * MILLISECOND
    own = math.radians(device.settings.acceleration)
    extra = options.gains.of_spec() if options.mode == "motion" else {}
    return can_motor(
        device,
        options.table,
        rmd.ADDRESSES,
        (ANYBODY,),
        sends=(*map(exact, rmd.own_ids(device.address)), *((ANYBODY,) if options.scan else ())),
        commands=COMMANDS[options.mode],
        requests=frozenset({msg.ClearFault, msg.SetAddress, msg.Zero}),
        writes={msg.Zero: {"zero here": (0.0,)}},
        ranges=ranges(options),
        feedback=FeedbackKind.REPLY,
        faults=rmd.FAULTS,
        stop=(rmd.ANY.encode("shutdown", device.address),),
        set_up={
            "set timeout": (float(options.timeout_ms),) if options.timeout_ms else (),
            "release brake": (1.0,) if options.brake else (),
        },
        receives_also=(ANSWERS,) if options.scan else (),
        obeys_also=(exact(rmd.ALL_MOTORS), exact(rmd.SET_ID)),
        ramps=own_ramps(0.0 if options.mode == "motion" else own, msg.Position, msg.Velocity),
        scales=dict.fromkeys(SCALES[options.mode], ""),
        **fed_by_any_frame(timeout),
        **extra,
    )


plugin = Plugin(
    name="myactuator",
    title="MyActuator RMD motors over CAN (protocol V3.8 to V4.2): servo and motion mode",
    trust="bytes both ways: the examples of the vendor's manual V4.2, 2b-t/myactuator_rmd@c43980c (V3.8); "
    "motorbridge 0.5.6 drove the twin. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(RmdAdapter, spec),
    decoder=decoder_of(lambda options: options.table, memory_of, spec),
    twin=RmdTwin,
    messages=rmd.ANY.names,
    vectors=("protocols.myactuator", "vectors.json"),
)
