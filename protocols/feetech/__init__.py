"""Feetech bus servos: STS, SMS and SCS on a half-duplex serial line (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.feetech import table as ft
from protocols.feetech.driver import FeetechAdapter
from protocols.feetech.options import Options, Settings
from protocols.feetech.twin import FeetechTwin, decoder
from protocols.messages import Command
from protocols.plugin import DRIVER_WRITES, Device, Plugin, Range, Setting, Spec, Watchdog
from protocols.toolkit.assembly import bus_servo, driver_of, own_ramps

__all__ = ["plugin"]

COMMANDS: dict[str, frozenset[type[Command]]] = {
    "position": frozenset({msg.Idle, msg.Hold, msg.Position}),
    "wheel": frozenset({msg.Idle, msg.Velocity}),
    "pwm": frozenset({msg.Idle, msg.Torque}),
}
NO_WATCHDOG = "it has no watchdog: without a host it holds its position, or turns on at its last velocity"


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry. Of wheels the position is counted on, not measured."""
    model, half = options.of, 0.501
    step = model.step
    fastest = 0x7FFE * step
    found = {
        "Feedback.velocity": Range(-fastest, fastest, half * step),
        "Feedback.voltage": Range(0.0, 25.5, 0.0501),
        "Feedback.temperature": Range(0.0, 255.0, half),
    }
    if "Present_Current" in model.table.by_name:
        found["Feedback.current"] = Range(-0x7FFF * ft.AMPERE, 0x7FFF * ft.AMPERE, half * ft.AMPERE)
    if options.mode == "wheel":
        return found | {"Velocity.velocity": Range(-fastest, fastest, half * step)}
    if options.mode == "pwm":
        strongest = options.stall_torque
        return found | {"Torque.torque": Range(-strongest, strongest, half * strongest / 1000.0)}
    first, last = -model.middle * step, (model.steps - 1 - model.middle) * step
    low, high = ((end - model.middle) * step for end in model.ends)
    return found | {
        "Position.position": Range(first, last, half * step),
        "Feedback.position": Range(low + step, high - step, half * step),
    }


def configured(options: Options) -> dict[str, Setting]:
    """Return the registers that are configuration: those that are stored."""
    written, table, found = options.set_up, options.table, dict[str, Setting]()
    for name, each in table.by_name.items():
        if each.writable and (table.is_stored(name) or name in written):
            protected = DRIVER_WRITES if name in written else ft.DATA["protected"].get(name, "")
            found[name] = Setting(None, *each.ends(), protected)
    return found


def spec(device: Device) -> Spec:
    """Return the contract of one servo. Raises ValueError for an id that it cannot have."""
    options: Options = device.options
    scales = {"model": "its Model_Number is read" if options.of.number else ""}
    modes = {"mode": "its Operating_Mode is read"} if len(options.of.modes) > 1 else {}
    zero = {msg.Zero} if "Homing_Offset" in options.table.by_name else set()
    return bus_servo(
        device,
        ft.PACKETS,
        commands=COMMANDS[options.mode],
        requests=frozenset({msg.ClearFault, msg.Scan, msg.ReadParameter, msg.WriteParameter} | zero),
        ranges=ranges(options),
        watchdog=Watchdog(None, enabled=False, note=NO_WATCHDOG),
        holds_unattended=True,
        faults=ft.FAULTS,
        configuration=configured(options),
        writes={msg.WriteParameter: {"Lock": (0.0, 1.0)}},
        ramps=own_ramps(options.acceleration, msg.Position, msg.Velocity),
        scales=scales | modes | ({"stall_torque": ""} if options.mode == "pwm" else {}),
    )


plugin = Plugin(
    name=ft.NAME,
    title="Feetech bus servos STS, SMS and SCS on a half-duplex serial line",
    trust="bytes both ways, and the twin driven: feetech-servo-sdk 1.0.0. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(FeetechAdapter, spec),
    decoder=decoder,
    twin=FeetechTwin,
    messages=ft.PACKETS.messages,
    vectors=("protocols.feetech", "vectors.json"),
)
