"""RoboClaw boards for two motors with encoders, over packet serial (README.md). Exports `plugin`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols import messages as msg
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND
from protocols.plugin import DRIVER_WRITES, Device, Driver, Plugin, Range, Setting, Spec, Written
from protocols.roboclaw import table as rt
from protocols.roboclaw.driver import RoboclawAdapter
from protocols.roboclaw.options import MOST, Options, Settings
from protocols.roboclaw.twin import RoboclawTwin, motor_of
from protocols.toolkit.assembly import declared, driver_of, fed_by_any_frame, own_ramps, serial_motor
from protocols.toolkit.options import configuration
from protocols.toolkit.packets import packet_decoder

__all__ = ["plugin"]

MARGIN = 1.001
"""Of rounding in between."""
UNENDING = 1e30
"""rad: counts are continued beyond 32 bits."""


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry."""
    unit, half = options.unit, 0.5 * options.unit * MARGIN
    fastest = options.max_qpps * unit
    whole = (1 << 31) * unit
    return {
        "Velocity.velocity": Range(-fastest, fastest, half),
        "Position.position": Range(-0.25 * whole, 0.25 * whole, half),
        "Feedback.position": Range(-UNENDING, UNENDING, half),
        "Feedback.velocity": Range(-(MOST - 1) * unit, (MOST - 1) * unit, half),
        "Feedback.current": rt.ANSWERS.range("GETCURRENTS", "current1"),
        "Feedback.voltage": rt.ANSWERS.range("GETMBATT", "voltage"),
        "Feedback.temperature": rt.ANSWERS.range("GETTEMP", "temperature"),
    }


def configured(settings: Settings, options: Options) -> dict[str, Setting]:
    """Return what is configured on a board."""
    names = [name for name in rt.PARAMETERS if name not in ("timeout", rt.CONFIG)]
    found = configuration(settings, dict(zip(names, names, strict=True)))
    found |= {"timeout": Setting(float(options.timeout), 0.0, 255.0, DRIVER_WRITES)}
    return found | {rt.CONFIG: Setting(protected="it would answer at another address or rate, or not at all")}


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    rt.BOARDS.check(device)
    idle = rt.PACKETS.encode(rt.name_of("M#DUTY", device.address), rt.BOARDS.board(device.address), duty=0)
    parameters = configured(device.settings, options)
    beside: Written = {name: (each.ends(),) for name, each in rt.REGISTERS.by_name.items()}
    return serial_motor(
        device,
        rt.PACKETS.read_only,
        rt.BOARDS.motors,
        commands=frozenset({msg.Idle, msg.Hold, msg.Position, msg.Velocity}),
        requests=frozenset({msg.ClearFault, msg.Zero, msg.ReadParameter, msg.WriteParameter})
        | (frozenset({msg.Scan}) if options.scan else frozenset()),
        ranges=ranges(options),
        faults=rt.FAULTS,
        parameters=tuple(parameters),
        configuration=parameters,
        set_up=declared({"timeout": float(options.timeout)}),
        writes={msg.WriteParameter: beside},
        save=rt.SAVE,
        stop=(Exchange(idle, options.answer(idle), Rank.RELEASE),),
        ramps=own_ramps(math.tau * options.acceleration / options.counts, msg.Position),
        scales={"counts": ""},
        unprotected=rt.QUESTIONS,
        **fed_by_any_frame(options.timeout_ms * MILLISECOND),
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver for all motors of one line. ValueError if those of a board differ in timeout."""
    return driver_of(lambda: RoboclawAdapter(devices), spec)(devices)


plugin = Plugin(
    name="roboclaw",
    title="RoboClaw boards for two motors with encoders, over packet serial (velocity, position)",
    trust="bytes both ways, and the twin driven: basicmicro 2.0.10. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=packet_decoder(lambda _: rt.PACKETS, motor_of, rt.GAP),
    twin=RoboclawTwin,
    messages=rt.PACKETS.names,
    vectors=("protocols.roboclaw", "vectors.json"),
)
