"""mjbots moteus over CAN FD: the multiplex protocol with registers (README.md). Exports `plugin`.

Rules. Driver and twin meet only in `codec` and `table`. Ranges are what the frames can carry in sense, not
what a joint may do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi, tau

from protocols import messages as msg
from protocols.frames import CanFrame, Frame, IdMask, exact
from protocols.messages import MILLISECOND
from protocols.moteus import codec
from protocols.moteus.codec import ADDRESS_MAX, BROADCAST, reply_id
from protocols.moteus.decoder import MoteusDecoder
from protocols.moteus.driver import SAVE, MoteusAdapter, Options
from protocols.moteus.loops import COUNTED, Settings
from protocols.moteus.messages import STOP, names
from protocols.moteus.table import FAULTS, UUID_MASK, beside, decoded
from protocols.moteus.twin import MoteusTwin
from protocols.plugin import Device, Plugin, Range, Setting, Spec, Watchdog
from protocols.toolkit.assembly import can_motor, driver_of, own_ramps
from protocols.toolkit.table import BINARY32, Table

__all__ = ["plugin"]

MOST = {"position": COUNTED * tau, "velocity": 1e3 * tau, "torque": 1e3}
"""What commands carry; the frames could carry more."""
MEASURED = {f"Feedback.{name}": 3.4e38 for name in ("position", "velocity", "torque", "current")}
CARRIED = {
    "Position": tuple(MOST),
    "Velocity": ("velocity", "torque"),
    "Torque": ("torque",),
    "Impedance": tuple(MOST),
}
COMMANDED = {f"{kind}.{name}": MOST[name] for kind, names in CARRIED.items() for name in names}
RANGES = {name: Range(-most, most, 1e-12, BINARY32) for name, most in {**COMMANDED, **MEASURED}.items()}
RANGES["Feedback.voltage"] = Range(0.0, 3276.7, 0.05001)
RANGES["Feedback.temperature"] = Range(-3276.7, 3276.7, 0.05001)
DESTINATION = 0x1FFF_00FF
"""Bits of an identifier that address a device: prefix and destination, of a frame of any format, CAN FD or
classic (mjbots/moteus@db1a762 `fw/fdcan_micro_server.h`)."""


IDENTITY = dict.fromkeys(
    ("model_number", "firmware_version", "register_map_version"), Setting(protected="it names the device")
)
"""What registers hold of its configuration; all else is in its console's `conf`, for the vendor's tool."""


@dataclass(frozen=True, slots=True)
class ReadOnly:
    """True of a frame that only queries registers. A value rather than a function, so that equal specs are
    equal."""

    ids: frozenset[int]

    def __call__(self, frame: Frame) -> bool:
        if not isinstance(frame, CanFrame) or frame.remote or frame.id not in self.ids:
            return False
        subframes, well_formed = codec.parse(frame.data)
        return well_formed and all(map(_only_reads, subframes))


def _only_reads(subframe: codec.Subframe) -> bool:
    """True for a query, and for the UUID of whom it is for."""
    masks = range(subframe.register, subframe.register + len(subframe.raw))
    return subframe.code == codec.READ or (
        subframe.code == codec.WRITE and bool(masks) and all(each in UUID_MASK for each in masks)
    )


def _exact(number: int) -> IdMask:
    """Return one id: of 29 bits if it needs more than 11."""
    return exact(number, number > codec.STANDARD_MAX)


def spec(device: Device) -> Spec:
    """Return the contract of one moteus. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    host, prefix = options.host_id, options.can_prefix
    sends = frozenset(codec.command_id(address, host, prefix) for address in (device.address, BROADCAST))
    # Feedback of a position is rounded to half a count of the encoder, and to binary32.
    position = replace(RANGES["Feedback.position"], resolution=pi / device.settings.encoder_cpr * 1.001)
    most = {"Impedance.stiffness": (0.0, options.gains[0]), "Impedance.damping": (0.0, options.gains[1])}
    if options.velocity_limit:  # the device would cut what is above it
        ends = (-options.velocity_limit, options.velocity_limit)
        most |= {"Position.velocity": ends, "Velocity.velocity": ends}
    ranges = {name: Range(low, high, 1e-12, 2.0 * BINARY32) for name, (low, high) in most.items()}
    return can_motor(
        device,
        Table(()),  # registers are no table of messages
        range(1, ADDRESS_MAX + 1),
        bus="canfd",
        sends=tuple(_exact(number) for number in sorted(sends)),
        expects=(_exact(reply_id(device.address, host, prefix)),),
        read_only=ReadOnly(sends),
        commands=frozenset(msg.COMMANDS if all(options.gains) else set(msg.COMMANDS) - {msg.Impedance}),
        tells_serial=True,
        requests=frozenset(
            {msg.ClearFault, msg.Scan, msg.SetId, msg.Zero, msg.ReadParameter, msg.WriteParameter}
        ),
        ranges=RANGES | ranges | {"Feedback.position": position},
        watchdog=Watchdog(options.timeout_ms * MILLISECOND, enabled=True),
        ramps=own_ramps(options.acceleration_limit, msg.Position, msg.Velocity),
        stop_clears_faults=True,
        faults=FAULTS,
        parameters=("mode", "voltage"),
        configuration=IDENTITY,
        save=SAVE,
        stop=(codec.make_frame(codec.command_id(device.address, host, prefix), STOP),),
        set_up={beside(name): ((0.0, most),) for name, most in options.most.items()},
        decoded=decoded,
        obeys_also=tuple((prefix << 16 | to, DESTINATION) for to in (device.address, BROADCAST)),
        receives_also=((reply_id(0, host, prefix), reply_id(0, 0x7F, 0x1FFF) | codec.REPLY_BIT | 0x80),),
    )


plugin = Plugin(
    name="moteus",
    title="mjbots moteus (r4, c1, n1, x1) over CAN FD",
    trust=(
        "bytes of every frame that moves a motor, replies, discovery: moteus 1.1.1 (the vendor's);"
        " worked examples: mjbots/moteus@db1a762; the twin driven by moteus 1.1.1's Controller and Transport"
    ),
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(MoteusAdapter, spec),
    decoder=MoteusDecoder,
    twin=MoteusTwin,
    messages=names,
    vectors=("protocols.moteus", "vectors.json"),
)
