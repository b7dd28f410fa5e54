"""FILL IN: which devices, on which firmware.

This plugin is complete and keeps the contract, except for one thing: its device is invented. It obeys a
velocity and sends its state, velocity and position. Replace it by the real device, file by file: `table`
first, then `line`, `twin`, `driver`, and the `spec` below. Each place to fill in is marked, with the clause
of `gateway protocols check` that checks it.
"""

from __future__ import annotations

from protocols.frames import Frame
from protocols.messages import MILLISECOND, ClearFault, Idle, Velocity
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Watchdog
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.table import BINARY32, Decoded

from .driver import OFFLINE, MotorAdapter, Options
from .line import BUS, Line, ids
from .table import ADDRESSES, FAULTS, NAME, PERIOD, TABLE
from .twin import MotorDecoder, MotorTwin, Settings


def messages(frame: Frame) -> tuple[str, ...]:
    """Return the names of the messages to a device in a frame."""
    found = Line().read(frame, "to_device")
    return tuple(each.name for each in found if isinstance(each, Decoded) and each.name)


def read_only(_frame: Frame) -> bool:
    """True if a frame neither moves, arms, clears nor configures anything.

    FILL IN (clause "passive"): what the driver may send before the first command, such as queries. This
    device sends its status unasked, so there is nothing."""
    return False


RANGES = {
    "Velocity.velocity": TABLE.range("run", "velocity"),
    "Feedback.velocity": TABLE.range("status", "velocity", inside=1),
    "Feedback.position": Range(-1e6, 1e6, 1e-6, BINARY32),
}
"""What commands and measurements can carry (clauses "commands" and "measurements")."""


def spec(device: Device) -> Spec:
    """Return the contract of one device. Raises ValueError for an address that it cannot have."""
    if device.address not in ADDRESSES:
        raise ValueError(f"a {NAME} has an address of 1 … {ADDRESSES.stop - 1}, not {device.address}")
    timeout = round(device.settings.watchdog_ms * MILLISECOND)
    return Spec(
        bus=BUS,
        kind="motor",
        sends=ids("to_device", device.address),
        expects=ids("from_device", device.address),
        read_only=read_only,
        # FILL IN (clause "measurements"): polled, cyclic or only in replies to commands, and the period.
        feedback=FeedbackKind.CYCLIC,
        feedback_period=PERIOD,
        # FILL IN (clause "offline"): well over the period, well under what would be dangerous.
        offline_after=OFFLINE,
        # FILL IN (clause "commands"): which commands and requests it takes.
        commands=frozenset({Idle, Velocity}),
        requests=frozenset({ClearFault}),
        ranges=RANGES,
        # FILL IN (clause "watchdog"): what it does when its host falls silent, and the timeout.
        watchdog=Watchdog(timeout or None, enabled=timeout > 0),
        holds_unattended=False,
        stop_clears_faults=False,
        faults=FAULTS,
        # FILL IN (clause "asked"): `set_up`, what the driver writes before it arms the device, with the
        # values; and `stop`, the frames that disarm it whatever it does.
        # FILL IN (clauses "checksums" and "obeyed"): `unprotected`, if it takes messages without a checksum.
    )


plugin = Plugin(
    name=NAME,
    title="FILL IN: one line, which devices and which firmware",
    trust="FILL IN: which bytes were checked against which package@version, repository@commit or manual",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(MotorAdapter, spec),
    decoder=MotorDecoder,
    twin=MotorTwin,
    messages=messages,
    vectors=(__name__, "vectors.json"),
)
