"""RoboClaw boards for two motors with encoders, over packet serial (README.md). Exports `plugin`."""

from __future__ import annotations

from collections.abc import Sequence

from protocols import messages as msg
from protocols.line import Answer, Exchange, Rank
from protocols.messages import MILLISECOND
from protocols.plugin import (
    DRIVER_WRITES,
    Device,
    Driver,
    FeedbackKind,
    Plugin,
    Range,
    Setting,
    Spec,
    Written,
)
from protocols.roboclaw import table as rt
from protocols.roboclaw.driver import SAVE, RoboclawAdapter
from protocols.roboclaw.options import MOST, Options, Settings
from protocols.roboclaw.twin import RoboclawDecoder, RoboclawTwin
from protocols.toolkit.assembly import declared, driver_of, fed_by_any_frame
from protocols.toolkit.options import configuration

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
    found = configuration(settings, {name: name for name in rt.PID})
    timeout = float(options.timeout_ms // rt.TIMEOUT_UNIT_MS)
    return found | {"timeout": Setting(timeout, 0.0, 255.0, DRIVER_WRITES)}


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    if device.address not in rt.ADDRESSES:
        low, middle, high = rt.ADDRESSES.start, rt.BOARDS.stop, rt.ADDRESSES.stop - 1
        raise ValueError(
            f"address {device.address} of {device.name}: it must be its board's, {low} to {middle - 1}, "
            f"or for the board's second motor that and {rt.SECOND}, {middle} to {high}"
        )
    idle = rt.PACKETS.encode(f"M{rt.side_of(device.address)}DUTY", rt.board_of(device.address), duty=0)
    answer = Answer(len(rt.ACK), rt.find_answer, round(options.answer_ms * MILLISECOND))
    parameters = configured(device.settings, options)
    any_gains: Written = {name: ((0.0, float(MOST * 2 + 1)),) for name in rt.PID}
    return Spec(
        bus="serial",
        kind="motor",
        sends=(),
        expects=(),
        read_only=rt.PACKETS.read_only,
        feedback=FeedbackKind.POLLED,
        feedback_period=options.feedback_ms * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset({msg.Idle, msg.Hold, msg.Position, msg.Velocity}),
        requests=frozenset({msg.ClearFault, msg.Zero, msg.ReadParameter, msg.WriteParameter})
        | (frozenset({msg.Scan}) if options.scan else frozenset()),
        ranges=ranges(options),
        faults=rt.FAULTS,
        stop_clears_faults=False,
        parameters=tuple(parameters),
        configuration=parameters,
        set_up=declared({"timeout": float(options.timeout_ms // rt.TIMEOUT_UNIT_MS)}),
        writes={msg.WriteParameter: any_gains},
        save=SAVE,
        stop=(Exchange(idle, answer, Rank.RELEASE),),
        scales={"counts": ""},
        unprotected=rt.QUESTIONS,
        line="asked",
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
    decoder=RoboclawDecoder,
    twin=RoboclawTwin,
    messages=rt.PACKETS.names,
    vectors=("gateway.fixtures", "vectors/roboclaw.json"),
)
