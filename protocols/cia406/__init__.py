"""Absolute encoders by CiA 406, over CANopen (README.md). Exports `plugin`."""

from __future__ import annotations

import math

from protocols.bounds import Invalid
from protocols.canopen import names
from protocols.canopen.services import NODE_MASK, sdo_rx_id
from protocols.cia406 import table as enc
from protocols.cia406.driver import EXPECTED, EncoderAdapter, Options
from protocols.cia406.twin import EncoderDecoder, EncoderTwin, Settings
from protocols.frames import exact
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import driver_of

__all__ = ["plugin"]


def spec(device: Device) -> Spec:
    """Return the contract of an encoder. Raises ValueError if its address cannot be a node's."""
    options: Options = device.options
    if not 0 < device.address <= NODE_MASK:
        text = f"address {device.address} of {device.name}: it must be 1 to {NODE_MASK}"
        raise Invalid(("address", text))
    unit = math.tau / options.units
    return Spec(
        bus="can",
        kind="sensor",
        sends=(exact(sdo_rx_id(device.address)),),
        expects=tuple(exact(base + device.address) for base in EXPECTED),
        read_only=names.read_only,
        feedback=FeedbackKind.POLLED,
        feedback_period=round(options.feedback_ms * MILLISECOND),
        offline_after=round(options.offline_ms * MILLISECOND),
        commands=frozenset(),
        requests=frozenset(),
        ranges={
            "ShaftReading.position": Range(0.0, (options.units * options.turns - 1) * unit, 0.501 * unit)
        },
        watchdog=Watchdog(None, enabled=False),
        holds_unattended=False,
        stop_clears_faults=False,
        faults=enc.FAULTS,
        scales={"units": "it tells its units per turn"},
    )


plugin = Plugin(
    name=enc.NAME,
    title="Absolute encoders by CiA 406 over CANopen: the angle of a shaft",
    trust="bytes of SDO both ways, and the twin read: canopen 2.4.1. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(EncoderAdapter, spec),
    decoder=EncoderDecoder,
    twin=EncoderTwin,
    messages=names.messages,
    vectors=("protocols.cia406", "vectors.json"),
)
