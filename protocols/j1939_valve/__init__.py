"""Proportional hydraulic valves on SAE J1939, commanded as auxiliary valves of ISO 11783-7 (README.md).

Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.j1939_valve import table as jt
from protocols.j1939_valve.driver import ValveAdapter
from protocols.j1939_valve.options import Options, Settings
from protocols.j1939_valve.twin import ValveTwin, valve_of
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import both_ways, can_motor, declared, decoder_of, driver_of

__all__ = ["plugin"]


def spec(device: Device) -> Spec:
    """Return the contract of one valve. Raises ValueError if its address is no valve's number."""
    options: Options = device.options
    valve = device.address if device.address in jt.VALVES else 0
    step = options.full_flow / jt.MOST / (1.0 - options.dead_band)
    position = jt.STROKE * options.stroke
    return can_motor(
        device,
        jt.TABLE,
        jt.VALVES,
        sends=(jt.command_id(valve, options.host), jt.claim_id(options.host)),
        expects=jt.report_ids(valve, options.ecu),
        receives_also=(jt.claim_id(options.host),),
        feedback=FeedbackKind.CYCLIC,
        commands=frozenset({msg.Idle, msg.Velocity}),
        requests=frozenset({msg.ClearFault}),
        ranges={
            "Velocity.velocity": both_ways(options.full_flow, 0.501 * step),
            "Feedback.position": Range(
                options.retracted, options.retracted + jt.MOST_POSITION * position, 0.501 * position
            ),
        },
        watchdog=Watchdog(options.timeout_ms * MILLISECOND, enabled=True),
        holds_idle=options.tight,
        faults=jt.FAULTS,
        set_up=declared({"ADDRESS_CLAIM": float(options.host)}),
        stop=(
            jt.TABLE.encode(
                "command", valve, host=options.host, flow=0, state=jt.BLOCK, fail_safe=jt.FAIL_SAFE_BLOCK
            ),
        ),
        scales=dict.fromkeys(("full_flow", "dead_band", "stroke", "retracted"), ""),
    )


plugin = Plugin(
    name="j1939_valve",
    title="proportional hydraulic valves on SAE J1939 (ISO 11783-7 auxiliary valves: velocity by flow)",
    trust="bytes: DanielMartensson/Open-SAE-J1939@315a955, compiled; can-j1939 2.0.12 drove "
    "the twin. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(ValveAdapter, spec),
    decoder=decoder_of(lambda _: jt.TABLE, valve_of, spec),
    twin=ValveTwin,
    messages=jt.TABLE.names,
    vectors=("protocols.j1939_valve", "vectors.json"),
)
