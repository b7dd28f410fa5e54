"""Sabertooth boards for two motors, over packet serial: open loop, they report nothing (README.md).

Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.sabertooth import table as st
from protocols.sabertooth.driver import SabertoothAdapter
from protocols.sabertooth.options import Options, Settings
from protocols.sabertooth.twin import SabertoothTwin, motor_of
from protocols.toolkit.assembly import declared, driver_of, serial_motor
from protocols.toolkit.packets import packet_decoder

__all__ = ["plugin"]

CAUTION = (
    "open loop: it reports nothing, neither its speed nor a fault, nor what arrives; full power is taken "
    "to be full_scale, and what it turns is not measured"
)


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    st.BOARDS.check(device)
    idle = st.PACKETS.encode(
        f"M{st.BOARDS.side(device.address)}FORWARD", st.BOARDS.board(device.address), value=0
    )
    step = options.full_scale / st.FULL
    return serial_motor(
        device,
        st.PACKETS.read_only,
        st.BOARDS.motors,
        feedback=FeedbackKind.NONE,
        commands=frozenset({msg.Idle, msg.Velocity}),
        requests=frozenset(),
        ranges={"Velocity.velocity": Range(-options.full_scale, options.full_scale, 0.501 * step)},
        watchdog=Watchdog(options.timeout_ms * MILLISECOND, enabled=True),
        set_up=declared({"SERIALTIMEOUT": float(options.timeout_ms // st.TIMEOUT_UNIT_MS)}),
        stop=(Exchange(idle, None, Rank.RELEASE),),
        scales={"full_scale": ""},
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
    decoder=packet_decoder(lambda _: st.PACKETS, motor_of),
    twin=SabertoothTwin,
    messages=st.PACKETS.names,
    vectors=("protocols.sabertooth", "vectors.json"),
)
