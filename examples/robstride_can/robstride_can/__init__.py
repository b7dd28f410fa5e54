"""RobStride 01 joint motors over CAN, by impedance. Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.messages import COMMANDS, MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import can_motor, declared, decoder_of, driver_of
from protocols.toolkit.table import BINARY32

from . import table as rs
from .driver import Options, RobStride
from .twin import Memory, RobStrideTwin, Settings

MEASURED = {f"Feedback.{field.name}": field.range(inside=2) for field in rs.STATUS[1:]}
MEASURED["Feedback.position"] = Range(-1e4, 1e4, 1e-6, BINARY32)
"""Of a register, which counts turns."""


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    return can_motor(
        device,
        rs.TABLE,
        range(1, 0x80),
        commands=frozenset(COMMANDS),
        requests=frozenset({msg.ReadParameter, msg.WriteParameter, *rs.REQUESTS}),
        ranges=options.gains.ranges() | MEASURED,
        canonical=options.gains.canonical,
        watchdog=Watchdog(round(options.timeout_ms * MILLISECOND), enabled=True),
        feedback=FeedbackKind.REPLY,
        faults=rs.FAULTS,
        parameters=tuple(rs.REGISTERS.by_name),
        set_up=declared(RobStride().written(options)),
        stop=(rs.TABLE.encode("disable", device.address),),
    )


plugin = Plugin(
    name="robstride_can",
    title="RobStride 01 joint motors over CAN, by impedance",
    trust="bytes both ways: the vendor's robstride-dynamics 0.0.1, robstride 0.1.0. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(RobStride, spec),
    decoder=decoder_of(lambda options: rs.TABLE, Memory.of, spec),
    twin=RobStrideTwin,
    messages=rs.TABLE.names,
    vectors=(__name__, "vectors.json"),
)
