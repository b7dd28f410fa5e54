"""Pololu Maestro servo controllers over serial or USB: hobby servos, without feedback (README.md).

Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.line import Exchange, Rank
from protocols.maestro import table as mt
from protocols.maestro.driver import MaestroAdapter
from protocols.maestro.options import Options, Settings
from protocols.maestro.twin import MaestroTwin, channel_of
from protocols.messages import MILLISECOND
from protocols.plugin import Device, Plugin, Spec
from protocols.toolkit.assembly import declared, driver_of, fed_by_any_frame, own_ramps, serial_motor
from protocols.toolkit.packets import packet_decoder

__all__ = ["plugin"]

ADDRESSES = range(128 * mt.BOARD)


def spec(device: Device) -> Spec:
    """Return the contract of one channel. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    if mt.channel(device.address) not in mt.CHANNELS or device.address not in ADDRESSES:
        text = (
            f"address {device.address} of {device.name}: a channel, 0 to {mt.CHANNELS.stop - 1}, of a board "
        )
        text += f"alone on its line; or {mt.BOARD} times a board's device number, 1 to 127, and a channel"
        raise Invalid(("address", text))
    packets = mt.PACKETS[options.crc]
    off = packets.encode("SETTARGET", device.address, value=0)
    return serial_motor(
        device,
        packets.read_only,
        ADDRESSES,
        **options.spec(mt.QUARTER),
        **fed_by_any_frame(options.timeout_ms * MILLISECOND, "its board has no serial timeout"),
        set_up=declared({**options.set_up, "GETERRORS": 1.0}),
        stop=(Exchange(off, None, Rank.RELEASE),),
        ramps=own_ramps(options.acceleration, msg.Position),
        unprotected=frozenset()
        if options.crc
        else frozenset(packets.row(each.name).name for each in mt.ROWS),
    )


plugin = Plugin(
    name="maestro",
    title="Pololu Maestro servo controllers, serial or USB (hobby servos, open loop)",
    trust="bytes: the examples in Pololu's user's guide (0J40), chapters 5.c to 5.e. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(MaestroAdapter, spec),
    decoder=packet_decoder(lambda options: mt.PACKETS[options.crc], channel_of),
    twin=MaestroTwin,
    messages=lambda frame: mt.PACKETS[False].names(frame) or mt.PACKETS[True].names(frame),
    vectors=("protocols.maestro", "vectors.json"),
)
