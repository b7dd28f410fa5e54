"""ZLAC8015D: drives for two hub motors, over CANopen, in velocity mode (README.md). Exports `plugin`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.canopen import names, services
from protocols.canopen.services import NODE_MASK
from protocols.frames import exact
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
    Watchdog,
)
from protocols.toolkit.assembly import driver_of, own_ramps
from protocols.zlac8015d import table as z
from protocols.zlac8015d.driver import EXPECTED, RPDO, ZlacAdapter, set_up
from protocols.zlac8015d.options import Options, Settings
from protocols.zlac8015d.twin import ZlacDecoder, ZlacTwin

__all__ = ["plugin"]

MARGIN = 1.001
"""For rounding in binary64: a resolution is half a step, and this margin."""


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options, node = device.options, device.address & NODE_MASK
    if not node or not 0 < device.address <= 0xFF:
        text = f"address {device.address} of {device.name}: it must be 1 to 127, or 129 to 255"
        raise Invalid(("address", text))
    side = z.side_of(device.address)
    keys = z.OFFLINE_TIME, z.SYNCHRONOUS, (z.ACCELERATION, side), (z.DECELERATION, side)
    configured = {z.OBJECTS[key].name: Setting(protected=DRIVER_WRITES) for key in keys}
    fastest, turns = options.max_rpm * z.RPM, 2**31 / options.counts * math.tau
    slowest = max(options.acceleration_ms, options.deceleration_ms)
    return Spec(
        bus="can",
        kind="motor",
        sends=tuple(map(exact, (services.NMT_ID, services.rpdo_id(RPDO, node), services.sdo_rx_id(node)))),
        expects=tuple(exact(base + node) for base in EXPECTED),
        read_only=names.read_only,
        feedback=FeedbackKind.POLLED,
        feedback_period=options.feedback_ms * MILLISECOND,
        offline_after=options.offline_ms * MILLISECOND,
        commands=frozenset({msg.Idle, msg.Velocity}),
        requests=frozenset({msg.ClearFault, msg.ReadParameter}),
        ranges={
            "Velocity.velocity": Range(-fastest, fastest, z.RPM / options.steps_per_rpm / 2 * MARGIN),
            "Feedback.position": Range(-turns, turns, math.pi / options.counts * MARGIN),
            "Feedback.velocity": Range(-1e6, 1e6, z.RPM / 20 * MARGIN),
        },
        watchdog=Watchdog(options.timeout_ms * MILLISECOND, enabled=True, fed_by="any frame"),
        ramps=own_ramps(1000.0 * fastest / slowest if slowest else 0.0, msg.Velocity),
        holds_unattended=False,
        stop_clears_faults=False,
        faults=z.FAULTS,
        parameters=tuple(configured),
        configuration=configured,
        scales=dict.fromkeys(("steps_per_rpm", "counts"), ""),
        set_up=set_up(node, options),
        stop=(services.disable(node),),
    )


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver for all motors of one bus. ValueError if those of a drive differ in their options."""
    options = {device.address & NODE_MASK: device.options for device in devices}
    for device in devices:
        if device.options != options[device.address & NODE_MASK]:
            raise ValueError(f"{device.name}: both motors of a drive must have the same options")
    return driver_of(lambda: ZlacAdapter(devices), spec)(devices)


plugin = Plugin(
    name="zlac8015d",
    title="ZLAC8015D, a drive for two hub motors, over CANopen (velocity)",
    trust="bytes of SDO both ways, and the twin driven: canopen 2.4.1; objects: public code. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=ZlacDecoder,
    twin=ZlacTwin,
    messages=names.messages,
    vectors=("protocols.zlac8015d", "vectors.json"),
)
