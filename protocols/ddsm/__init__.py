"""Waveshare DDSM115 (RS-485) and DDSM210 (UART) hub motors: velocity, of a DDSM115 also torque (README.md).
Exports `plugin`."""

from __future__ import annotations

from protocols import messages as msg
from protocols.ddsm import table as ds
from protocols.ddsm.driver import DdsmAdapter
from protocols.ddsm.options import Options, Settings
from protocols.ddsm.twin import DdsmTwin, memory_of
from protocols.line import Exchange, Rank
from protocols.plugin import Device, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import both_ways, driver_of, serial_motor
from protocols.toolkit.packets import packet_decoder

__all__ = ["plugin"]

NOTE = (
    "no watchdog of a DDSM motor is documented: without a host, its last command goes on. This side disarms "
    "it on every way out; beside that it needs a switch in its supply. Acknowledge it with "
    'watchdog = "acknowledged" under options'
)


def ranges(options: Options) -> dict[str, Range]:
    """Return what commands and measurements can carry. The position has no range: within a turn it is the
    motor's, and turns are counted from where it was first reported."""
    model, torque, strongest = options.of_model, options.torque, options.strongest
    most, count = ds.FULL - 1, model.rpm
    found = {
        "Velocity.velocity": both_ways(model.fastest, 0.501 * count),
        "Feedback.current": both_ways(most * ds.AMPERE, 0.501 * ds.AMPERE),
        "Feedback.temperature": Range(0.0, 255.0, 0.5),
    }
    if torque:
        found["Feedback.torque"] = both_ways(most * torque, 0.501 * torque)
    if model.names_mode:  # of the other one only answers to `drive` have it
        found["Feedback.velocity"] = both_ways(most * count, 0.501 * count)
    if strongest:
        found["Torque.torque"] = both_ways(strongest, 1.501 * torque)
    return found


def spec(device: Device) -> Spec:
    """Return the contract of one motor. Raises ValueError for an address that it cannot have."""
    options: Options = device.options
    model, at = options.of_model, device.address
    return serial_motor(
        device,
        ds.ALL.read_only,
        ds.ADDRESSES,
        "half-duplex" if model.names_mode else "asked",
        commands=frozenset({msg.Idle, msg.Velocity} | ({msg.Torque} if model.strongest else set())),
        requests=frozenset({msg.ClearFault, msg.Scan, msg.WriteParameter}),
        ranges=ranges(options),
        watchdog=Watchdog(None, enabled=False, note="" if options.watchdog == "acknowledged" else NOTE),
        faults=ds.FAULTS,
        set_up={"mode": (float(model.rest), float(ds.SPEED))},
        stop=(
            ds.encode(f"set mode {model.name[4:]}", at, mode=model.rest),
            Exchange(
                ds.encode("drive", at, value=0, brake=0), options.answer(at), Rank.RELEASE, f"{at} drive"
            ),
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
    decoder=packet_decoder(lambda options: ds.PACKETS[options.model], memory_of),
    twin=DdsmTwin,
    messages=ds.ALL.names,
    vectors=("protocols.ddsm", "vectors.json"),
)
