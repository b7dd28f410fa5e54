"""VESC motor controllers over CAN: velocity, and torque by current (README.md). Exports `plugin`."""

from __future__ import annotations

from typing import Any

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.frames import exact
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import can_motor, decoder_of, driver_of
from protocols.vesc.driver import VescAdapter
from protocols.vesc.options import MotorOptions, Options, Settings
from protocols.vesc.table import ADDRESSES, EVERY, FAULTS, PONG, SHORT_BUFFER, STATUS, TABLE
from protocols.vesc.twin import VescTwin, motor_of

__all__ = ["plugin"]


def ranges(options: MotorOptions) -> dict[str, Range]:
    """Return what commands and measurements can carry. What is measured is cut off, not rounded."""
    fastest, strongest = options.max_erpm * options.erpm, options.max_current * options.torque_constant
    every = (1 << 31) - 2
    return {
        "Velocity.velocity": Range(-fastest, fastest, 0.501 * options.erpm),
        "Torque.torque": Range(-strongest, strongest, 1.501e-3 * options.torque_constant),
        "Feedback.velocity": Range(-every * options.erpm, every * options.erpm, 1.001 * options.erpm),
        "Feedback.position": Range(-every * options.step, every * options.step, 1.001 * options.step),
        "Feedback.torque": TABLE.range("STATUS_1", "current", options.torque_constant),
        "Feedback.current": TABLE.range("STATUS_1", "current"),
        "Feedback.voltage": TABLE.range("STATUS_5", "voltage"),
        "Feedback.temperature": TABLE.range("STATUS_4", "fet"),
    }


def caution(options: MotorOptions) -> str:
    """Return what it does not do below its least velocity; "": it has none."""
    if not options.min_erpm:
        return ""
    slowest = options.min_erpm * options.erpm
    return (
        f"at less than {slowest:.3g} rad/s (min_erpm) it lets go of its velocity and shorts its phases: that "
        "damps, and holds no load; at rest it does not start"
    )


def common(device: Device) -> dict[str, Any]:
    """Return what the spec has over any transport."""
    options, settings = device.options, device.settings
    timeout = (settings.timeout_ms or options.timeout_ms) * MILLISECOND
    return {
        "commands": frozenset({msg.Idle, msg.Velocity, msg.Torque}),
        "ranges": ranges(options),
        "watchdog": Watchdog(timeout, enabled=True),
        "faults": FAULTS,
        "scales": dict.fromkeys(("pole_pairs", "torque_constant", "min_erpm"), ""),
        "caution": caution(options),
    }


def spec(device: Device) -> Spec:
    """Return the contract of one controller. Raises ValueError if its address cannot be one."""
    options = device.options
    if device.address == options.host_id:
        text = f"address {device.address} of {device.name}: it is the host_id, to which all reply"
        raise Invalid(("address", text))
    replies = [(number << 8) | options.host_id for number in (SHORT_BUFFER, PONG)]
    status = [number << 8 | device.address for number, _ in STATUS.values()]
    return can_motor(
        device,
        TABLE,
        ADDRESSES,
        (TABLE.row("PING").id_mask(),),
        expects=tuple(exact(number, extended=True) for number in (*status, *replies)),
        feedback=FeedbackKind.CYCLIC,
        requests=frozenset({msg.ClearFault}),
        stop=(TABLE.encode("SET_CURRENT", device.address, value=0.0),),
        obeys_also=TABLE.ids("to_device", EVERY),
        **common(device),
    )


plugin = Plugin(
    name="vesc",
    title="VESC motor controllers over CAN (velocity, torque by current)",
    trust="bytes both ways: vedderb/bldc@b9d287b3, compiled; pybldc 1.1.0 drove the twin. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(VescAdapter, spec),
    decoder=decoder_of(lambda _: TABLE, motor_of, spec),
    twin=VescTwin,
    messages=TABLE.names,
    vectors=("protocols.vesc", "vectors.json"),
)
