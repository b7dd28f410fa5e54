"""Dynamixel servos over protocol 2.0 on a half-duplex line (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.dynamixel import packets as dx
from protocols.dynamixel import table as dt
from protocols.dynamixel.driver import DynamixelAdapter
from protocols.dynamixel.memory import decoder
from protocols.dynamixel.options import STORED, Options, Settings
from protocols.dynamixel.twin import DynamixelTwin
from protocols.messages import MILLISECOND, Command
from protocols.plugin import DRIVER_WRITES, Device, Plugin, Range, Setting, Spec
from protocols.toolkit.assembly import bus_servo, declared, driver_of, fed_by_any_frame
from protocols.toolkit.options import configuration

__all__ = ["plugin"]

COMMANDS: dict[str, frozenset[type[Command]]] = {
    "velocity": frozenset({msg.Idle, msg.Velocity}),
    "current": frozenset({msg.Idle, msg.Torque}),
}
PLACED: frozenset[type[Command]] = frozenset({msg.Idle, msg.Hold, msg.Position})
REQUESTS = frozenset({msg.ClearFault, msg.Zero, msg.ReadParameter, msg.WriteParameter})
SET_POINT = {"velocity": "Velocity.velocity", "current": "Torque.torque"}
LIMITS = {"Velocity_Limit": "velocity", "Current_Limit": "torque"}


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry."""
    model = options.of
    half = 0.501 * model.count
    low = -(model.counts // 2) * model.count
    turn = Range(low, low + (model.counts - 1) * model.count, half)
    measured = turn if options.mode == "position" else _places(model, (1 << 31) - 2)
    most = ((1 << 31) - 2) * model.step
    found = {
        "Feedback.position": measured,
        "Feedback.velocity": Range(-most, most, 0.501 * model.step),
        "Feedback.voltage": Range(0.0, 6553.5, 0.0501),
        "Feedback.temperature": Range(0.0, 255.0, 0.501),
    }
    if model.current:
        for name, unit in (("current", model.ampere), ("torque", options.newton_metre)):
            found[f"Feedback.{name}"] = Range(-32768 * unit, 32767 * unit, 0.501 * unit)
    match options.mode:
        case "velocity":
            end = options.velocity * model.step
            return found | {"Velocity.velocity": Range(-end, end, 0.501 * model.step)}
        case "current":
            end = options.current * options.newton_metre
            return found | {"Torque.torque": Range(-end, end, 0.501 * options.newton_metre)}
        case "position":
            return found | {"Position.position": turn}
    return found | {"Position.position": _places(model, model.far)}


def _places(model: dt.Model, counts: int) -> Range:
    """Return the range of positions that end at so many counts, either way."""
    low, high = (-counts - model.zero) * model.count, (counts - model.zero) * model.count
    return Range(low, high, 0.501 * model.count)


def configured(device: Device) -> dict[str, Setting]:
    """Return the registers that are configuration."""
    options: Options = device.options
    has = options.table.by_name
    protected = dt.DEVICE["protected"] | {"operating_mode": DRIVER_WRITES}
    found = configuration(
        device.settings, {name: setting for name, setting in STORED.items() if name in has}, (), protected
    )
    for name, most, unit in (
        ("Velocity_Limit", max(options.of.velocity, options.velocity), options.of.step),
        ("Current_Limit", max(options.of.current, options.current), options.newton_metre),
    ):
        if name in found:
            expected = getattr(device.settings, STORED[name]) or None
            limit = LIMITS[name]
            found[name] = Setting(expected, 0.0, most, limit=limit, unit=unit)  # type: ignore[arg-type]
    return found | {"ID": Setting(protected="it would be another device")}


def spec(device: Device) -> Spec:
    """Return the contract of one device. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    scales = {"model": "Model_Number is read before it is armed"}
    goal = SET_POINT.get(options.mode, "Position.position")
    offset = {"Homing_Offset": ((-float(1 << 31), float(1 << 31)),)}
    return bus_servo(
        device,
        dx.PACKETS,
        commands=COMMANDS.get(options.mode, PLACED),
        requests=REQUESTS | ({msg.Scan} if options.scan else set()),
        ranges=ranges(options),
        faults=dt.FAULTS,
        parameters=tuple(each for each in options.table.by_name if not each.startswith("Indirect_Address")),
        configuration=configured(device),
        set_up={**declared(options.set_up), goal: (goal,)},
        writes={msg.Zero: offset},
        scales=scales | ({"torque_constant": ""} if options.mode == "current" else {}),
        **fed_by_any_frame(options.watchdog * dt.WATCHDOG_UNIT_MS * MILLISECOND),
    )


plugin = Plugin(
    name=dt.NAME,
    title="Dynamixel X, XL330, XC330 and P servos over protocol 2.0 (TTL, RS-485)",
    trust="bytes both ways, control tables, and the twin driven: dynamixel-sdk 4.1.0. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(DynamixelAdapter, spec),
    decoder=decoder,
    twin=DynamixelTwin,
    messages=dx.PACKETS.messages,
    vectors=("protocols.dynamixel", "vectors.json"),
)
