"""Sabertooth boards for two motors, over packet serial: open loop, they report nothing (README.md).

Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.sabertooth import table as st
from protocols.sabertooth.driver import NOTED, SabertoothAdapter
from protocols.sabertooth.options import Options, Settings
from protocols.sabertooth.twin import SabertoothDecoder, SabertoothTwin
from protocols.toolkit.assembly import declared, driver_of

__all__ = ["plugin"]

CAUTION = (
    "open loop: it reports nothing, neither its speed nor a fault, nor whether it hears; full power is taken "
    "to be full_scale, and what it turns is not measured"
)


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    if device.address not in st.ADDRESSES:
        low, middle, high = st.ADDRESSES.start, st.BOARDS.stop, st.ADDRESSES.stop - 1
        raise ValueError(
            f"address {device.address} of {device.name}: it must be its board's, {low} to {middle - 1}, "
            f"or for the board's second motor that and {st.SECOND}, {middle} to {high}"
        )
    idle = st.PACKETS.encode(f"M{st.side_of(device.address)}FORWARD", st.board_of(device.address), value=0)
    step = options.full_scale / st.FULL
    return Spec(
        bus="serial",
        kind="motor",
        sends=(),
        expects=(),
        read_only=st.PACKETS.read_only,
        feedback=FeedbackKind.NONE,
        feedback_period=NOTED,
        offline_after=NOTED,
        commands=frozenset({msg.Idle, msg.Velocity}),
        requests=frozenset(),
        ranges={"Velocity.velocity": Range(-options.full_scale, options.full_scale, 0.501 * step)},
        watchdog=Watchdog(options.timeout_ms * MILLISECOND, enabled=True),
        holds_unattended=False,
        stop_clears_faults=False,
        set_up=declared({"SERIALTIMEOUT": float(options.timeout_ms // st.TIMEOUT_UNIT_MS)}),
        stop=(Exchange(idle, None, Rank.RELEASE),),
        scales={"full_scale": ""},
        line="asked",
        caution=CAUTION,
    )


plugin = Plugin(
    name="sabertooth",
    title="Sabertooth boards for two motors, over packet serial (power, open loop)",
    trust="bytes, and the twin driven: pysabertooth 0.4.0. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(SabertoothAdapter, spec),
    decoder=SabertoothDecoder,
    twin=SabertoothTwin,
    messages=st.PACKETS.names,
    vectors=("gateway.fixtures", "vectors/sabertooth.json"),
)
