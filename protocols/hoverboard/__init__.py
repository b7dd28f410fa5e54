"""Hoverboard mainboards with the FOC firmware, over a serial line: two motors by duty, speed or torque
(README.md). Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.hoverboard import table as hb
from protocols.hoverboard.driver import HoverboardAdapter
from protocols.hoverboard.options import Options, Settings
from protocols.hoverboard.twin import HoverboardTwin, memory_of
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import driver_of, serial_motor
from protocols.toolkit.packets import packet_decoder

__all__ = ["plugin"]

HOLDS = (
    "in SPD_MODE nothing lets go of a wheel while its board is sent anything: Idle holds it at 0 rpm, and it "
    "coasts 0.8 s after both motors are idle"
)


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry. The position, an integral, has no range."""
    name = "Torque.torque" if options.control == "torque" else "Velocity.velocity"
    end = options.most * options.unit
    return {
        name: Range(-end, end, 1.501 * options.unit),
        "Feedback.velocity": hb.FEEDBACK.range("feedback", "left", hb.RPM, inside=2),
        "Feedback.voltage": hb.FEEDBACK.range("feedback", "voltage"),
        "Feedback.temperature": hb.FEEDBACK.range("feedback", "temperature"),
    }


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError for an address that it cannot have."""
    options: Options = device.options
    if device.address not in hb.ADDRESSES:
        text = (
            f"address {device.address} of {device.name}: the left motor of a board has 1, the right one 2, "
        )
        raise Invalid(("address", f"{text}and one board is on a line"))
    moves = msg.Torque if options.control == "torque" else msg.Velocity
    decides = {"duty": ("full_scale",), "speed": (), "torque": ("torque_full",)}
    return serial_motor(
        device,
        hb.COMMANDS.read_only,
        hb.ADDRESSES,
        "free",
        feedback=FeedbackKind.CYCLIC,
        commands=frozenset({moves} if options.control == "speed" else {msg.Idle, moves}),
        requests=frozenset(),
        ranges=ranges(options),
        watchdog=Watchdog(hb.TIMEOUT_MS * MILLISECOND, enabled=True, fed_by="any command"),
        stop=(hb.COMMANDS.encode("command", steer=0, speed=0),),
        scales=dict.fromkeys(("control", "tank", *decides[options.control]), ""),
        caution=HOLDS if options.control == "speed" else "",
    )


plugin = Plugin(
    name="hoverboard",
    title="hoverboard mainboards with the FOC firmware, by USART: two motors (duty, speed or torque)",
    trust="bytes both ways: EFeru/hoverboard-firmware-hack-FOC@a0751d5, its sketch compiled. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(HoverboardAdapter, spec),
    decoder=packet_decoder(lambda _: hb.COMMANDS, memory_of),
    twin=HoverboardTwin,
    messages=hb.COMMANDS.names,
    vectors=("protocols.hoverboard", "vectors.json"),
)
