"""RoboMaster C610, C620 and GM6020 over CAN: torque by current (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.frames import exact
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.robomaster.driver import RoboMasterAdapter
from protocols.robomaster.options import Options, Settings
from protocols.robomaster.table import FAULTS, GROUPS, RPM, SLOTS, TABLE
from protocols.robomaster.twin import RoboMasterTwin, motor_of
from protocols.toolkit.assembly import can_motor, decoder_of, driver_of

__all__ = ["plugin"]


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry. The position has no range: within a turn it is the
    rotor's, and turns are counted from where it was first reported."""
    strongest = options.of_model.full * options.torque
    return {
        "Torque.torque": Range(-strongest, strongest, 1.501 * options.torque),
        "Feedback.velocity": TABLE.range("feedback", "velocity", RPM, inside=2),
        "Feedback.torque": TABLE.range("feedback", "current", options.torque),
        "Feedback.current": TABLE.range("feedback", "current", options.ampere),
        "Feedback.temperature": TABLE.range("feedback", "temperature"),
    }


def spec(device: Device) -> Spec:
    """Return the contract of one controller. Raises ValueError if its address cannot be one."""
    options, settings = device.options, device.settings
    model = options.of_model
    addresses = range(1, model.last + 1)
    group = model.group_of(device.address)[0] if device.address in addresses else next(iter(GROUPS))
    still = TABLE.encode(group, **dict.fromkeys(SLOTS, 0))
    timeout = settings.timeout_ms or options.timeout_ms
    return can_motor(
        device,
        TABLE,
        addresses,
        sends=(exact(GROUPS[group]),),
        stop=(still,),
        feedback=FeedbackKind.CYCLIC,
        commands=frozenset({msg.Idle, msg.Torque}),
        requests=frozenset({msg.ClearFault}),
        ranges=ranges(options),
        watchdog=Watchdog(
            timeout * MILLISECOND,
            enabled=True,
            note=f"how long it drives on without a host is not documented; {timeout} ms is an assumption",
        ),
        expects=(exact(0x200 + device.address + model.feedback),),
        faults=FAULTS if options.error_byte else {},
        scales={"model": ""},
    )


plugin = Plugin(
    name="robomaster",
    title="RoboMaster C610, C620 (M2006, M3508) and GM6020 over CAN (torque by current)",
    trust="bytes both ways: RoboMaster/Development-Board-C-Examples@59d12b1, compiled; "
    "uw-advanced-robotics/taproot@5018c3c; GM6020 by hand: mjforan/rm_motors_can@16c97a0. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(RoboMasterAdapter, spec),
    decoder=decoder_of(lambda _: TABLE, motor_of, spec),
    twin=RoboMasterTwin,
    messages=TABLE.names,
    vectors=("protocols.robomaster", "vectors.json"),
)
