"""FILL IN: which devices, on which firmware.

This plugin is complete and keeps the contract, except for one thing: its device is invented. It obeys a
velocity and sends its state, velocity and position. Replace it by the real device, file by file: `codec` and
`framing` first, then `twin`, `decoder`, `driver`, and the `spec` below. Each place to fill in is marked, with
the clause of `gateway protocols check` that checks it.
"""

from __future__ import annotations

from protocols.frames import Frame
from protocols.messages import MILLISECOND, ClearFault, Idle, Velocity
from protocols.plugin import Device, FeedbackKind, Plugin, Spec, Watchdog

from .codec import NAME, STATUS_PERIOD
from .decoder import MotorDecoder, message_names
from .driver import OFFLINE, RANGES, MotorDriver, Options
from .faults import FAULTS
from .framing import BUS, COMMAND, MAX_ADDRESS, STATUS, ids
from .twin import MotorTwin, Settings


def read_only(_frame: Frame) -> bool:
    """True if a frame neither moves, arms, clears nor configures anything.

    FILL IN (clause "passive"): what the driver may send before the first command, such as queries. This
    device sends its status unasked, so there is nothing."""
    return False


def spec(device: Device) -> Spec:
    """Return the contract of one device. Raises ValueError for an address that it cannot have."""
    if not 1 <= device.address <= MAX_ADDRESS:
        raise ValueError(f"a {NAME} has an address of 1 … {MAX_ADDRESS}, not {device.address}")
    settings: Settings = device.settings
    timeout = round(settings.watchdog_ms * MILLISECOND)
    return Spec(
        bus=BUS,
        kind="motor",
        # FILL IN (clause "declared"): CAN ids, all of them; none on a serial line.
        sends=ids(COMMAND, device.address),
        expects=ids(STATUS, device.address),
        read_only=read_only,
        # FILL IN (clause "measurements"): polled or cyclic, and the period.
        feedback=FeedbackKind.CYCLIC,
        feedback_period=STATUS_PERIOD,
        # FILL IN (clause "offline"): well over the period, well under what would be dangerous.
        offline_after=OFFLINE,
        # FILL IN (clause "commands"): which commands and requests it takes.
        commands=frozenset({Idle, Velocity}),
        requests=frozenset({ClearFault}),
        ranges=RANGES,
        # FILL IN (clause "watchdog"): what it does when its host falls silent, and the timeout.
        watchdog=Watchdog(timeout if timeout else None, enabled=timeout > 0),
        holds_unattended=False,
        stop_clears_faults=False,
        faults=FAULTS,
        # FILL IN (clauses "checksums", "obeyed"): `unprotected`, if it takes messages without a checksum.
    )


plugin = Plugin(
    name=NAME,
    title="FILL IN: one line, which devices and which firmware",
    trust="FILL IN: which bytes were checked against which package@version, repository@commit or manual",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=MotorDriver,
    decoder=MotorDecoder,
    twin=MotorTwin,
    messages=message_names,
    vectors=(__name__, "vectors.json"),
)
