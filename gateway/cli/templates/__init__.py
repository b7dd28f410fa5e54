"""FILL IN: which devices, on which firmware.

This plugin is whole and keeps the contract, but for one thing: the device that it speaks to is invented.
It obeys a velocity and tells its state, velocity and position. Put the real device in its place, file by
file: `codec` and `framing` first, then `twin`, `ear`, `driver`, and the `spec` below. Each place to fill in
is marked, with the clause of `gateway protocols check` that tells whether it is right.
"""

from __future__ import annotations

from protocols.frames import Frame
from protocols.messages import MILLISECOND, ClearFault, Idle, Velocity
from protocols.plugin import Device, FeedbackKind, Plugin, Spec, Watchdog

from .codec import NAME, STATUS_PERIOD
from .driver import OFFLINE, RANGES, MotorDriver, Options
from .ear import MotorDecoder, messages
from .faults import FAULTS
from .framing import BUS, COMMAND, MAX_ADDRESS, STATUS, ids
from .twin import MotorTwin, Settings


def read_only(_frame: Frame) -> bool:
    """Whether a wire neither moves, arms, clears nor configures anything.

    FILL IN (clause "unclaimed"): what the driver may say before the first command, such as polling. This
    device talks by itself, so there is nothing."""
    return False


def spec(device: Device) -> Spec:
    """The contract of one device. Raises ValueError for an address that it cannot have."""
    if not 1 <= device.address <= MAX_ADDRESS:
        raise ValueError(f"a {NAME} has an address of 1 … {MAX_ADDRESS}, not {device.address}")
    settings: Settings = device.settings
    patience = round(settings.watchdog_ms * MILLISECOND)
    return Spec(
        bus=BUS,
        kind="motor",
        # FILL IN (clause "declared"): CAN ids, all of them; none on a serial line.
        sends=ids(COMMAND, device.address),
        expects=ids(STATUS, device.address),
        read_only=read_only,
        # FILL IN (clause "measurements"): polled or cyclic, and how often.
        feedback=FeedbackKind.CYCLIC,
        feedback_period=STATUS_PERIOD,
        # FILL IN (clause "blind"): well over the period, well under what would be dangerous.
        offline_after=OFFLINE,
        # FILL IN (clause "commands"): what it takes.
        commands=frozenset({Idle, Velocity}),
        requests=frozenset({ClearFault}),
        ranges=RANGES,
        # FILL IN (clause "watchdog"): what it does when its host falls silent, and after how long.
        watchdog=Watchdog(patience if patience else None, enabled=patience > 0),
        holds_unattended=False,
        stop_clears_faults=False,
        faults=FAULTS,
        # FILL IN (clauses "checksums", "obeyed"): `unsealed`, if it takes messages without a checksum.
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
    messages=messages,
    vectors=(__name__, "vectors.json"),
)
