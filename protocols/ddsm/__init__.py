"""Waveshare DDSM115 (RS-485) and DDSM210 (UART) hub motors: velocity, of a DDSM115 also torque (README.md).
Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.ddsm import table as ds
from protocols.ddsm.driver import DdsmAdapter, answered
from protocols.ddsm.options import Options, Settings
from protocols.ddsm.twin import DdsmDecoder, DdsmTwin
from protocols.line import Rank
from protocols.messages import MILLISECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import driver_of

__all__ = ["plugin"]

NOTE = (
    "no watchdog of a DDSM motor is documented: without a host, its last command goes on. This side disarms "
    "it on every way out; beside that it needs a switch in its supply. Acknowledge it with "
    'watchdog = "acknowledged" under options'
)


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry. The position has no range: within a turn it is the
    motor's, and turns are counted from where it was first reported."""
    model, torque = options.of_model, options.torque
    count, strongest = model.rpm, model.strongest * (options.torque_constant or model.torque_constant)
    speeds, full = (ds.FULL - 1) * count, (ds.FULL - 1) * ds.AMPERE
    found = {
        "Velocity.velocity": Range(-model.fastest, model.fastest, 0.501 * count),
        "Feedback.current": Range(-full, full, 0.501 * ds.AMPERE),
        "Feedback.temperature": Range(0.0, 255.0, 0.5),
    }
    if torque:
        found["Feedback.torque"] = Range(
            -full * torque / ds.AMPERE, full * torque / ds.AMPERE, 0.501 * torque
        )
    if model.tells_mode:  # of the other one only answers to `drive` have it
        found["Feedback.velocity"] = Range(-speeds, speeds, 0.501 * count)
    if strongest:
        found["Torque.torque"] = Range(-strongest, strongest, 1.501 * torque)
    return found


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError for an address that it cannot have."""
    options: Options = device.options
    model, at = options.of_model, device.address
    if at not in ds.ADDRESSES:
        last = ds.ADDRESSES.stop - 1
        raise ValueError(f"address {at} of {device.name}: it must be {ds.ADDRESSES.start} to {last}")
    return Spec(
        bus="serial",
        line="half-duplex" if model.tells_mode else "asked",
        kind="motor",
        sends=(),
        expects=(),
        read_only=ds.read_only,
        feedback=FeedbackKind.POLLED,
        feedback_period=round(options.feedback_ms * MILLISECOND),
        offline_after=round(options.offline_ms * MILLISECOND),
        commands=frozenset({msg.Idle, msg.Velocity} | ({msg.Torque} if model.strongest else set())),
        requests=frozenset({msg.ClearFault, msg.Scan, msg.WriteParameter}),
        ranges=ranges(options),
        watchdog=Watchdog(None, enabled=False, note="" if options.watchdog == "acknowledged" else NOTE),
        holds_unattended=False,
        stop_clears_faults=False,
        faults=ds.FAULTS,
        set_up={"mode": (float(model.rest), float(ds.SPEED))},
        stop=(
            ds.encode(f"set mode {model.name[4:]}", at, mode=model.rest),
            answered(options, ds.encode("drive", at, value=0, brake=0), Rank.RELEASE, f"{at} drive"),
        ),
        scales={"model": "answers of the other model are none to it: it is offline then"},
        unprotected=frozenset({"set mode 115"}),
    )


plugin = Plugin(
    name="ddsm",
    title="Waveshare DDSM115 (RS-485) and DDSM210 (UART) hub motors (velocity; DDSM115: torque, too)",
    trust="bytes: waveshareteam/ddsm_example@79bfd6f, rasheeddo/ddsm115_python@d3668b0; CRC: crccheck 1.3.1. "
    "No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(DdsmAdapter, spec),
    decoder=DdsmDecoder,
    twin=DdsmTwin,
    messages=ds.names,
    vectors=("gateway.fixtures", "vectors/ddsm.json"),
)
