"""The host's end: what a valve is sent, and what its controller reports.

Rules. Before the first command our address is claimed; to a claim of another with a higher NAME ours is said
again, and one with a lower NAME has the address: nothing is sent from it any more, and the valves close by
their time-out. A flow arms a valve, a flow of 0 too; Idle closes its ports. The state that its controller
reports is believed; the flow that it estimates is not, since that follows from the command.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.j1939_valve import table as jt
from protocols.j1939_valve.options import Options
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.duplicates import ShaftCheck
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import NEVER, Adapter, MotorDriver, Pending, Rx

APART = 0.1
"""Share of the stroke by which the positions of two cylinders differ at least, to be noticed as two"""
WAITS: Nanos = 250 * MILLISECOND
"""From a claim to the first other message, but of addresses that may send at once (J1939-81)"""
AT_ONCE = frozenset({*range(128), *range(248, 254)})
MODES = {
    jt.BLOCK: (Mode.READY, "ports closed"),
    jt.EXTEND: (Mode.ARMED, "extends"),
    jt.RETRACT: (Mode.ARMED, "retracts"),
    jt.FLOAT: (Mode.ARMED, "floats"),
    jt.ERROR: (Mode.FAULT, "error"),
}


@dataclass(slots=True)
class Valve:
    """What is known of one valve beyond its phase. Plain data."""

    shaft: ShaftCheck


@dataclass(slots=True)
class Claim:
    """Our claim to an address. Plain data."""

    at: Nanos = -NEVER
    """When it was last sent"""
    again: bool = True
    """It is to be sent"""
    lost: bool = False

    def send(self, now: Nanos) -> None:
        """Note that it is sent."""
        self.at, self.again = now, False

    def hear(self, name: int, own: int) -> None:
        """Note another's claim."""
        self.lost |= name < own
        self.again |= name > own

    def claim_anew(self) -> None:
        """Claim it once more, if another had it."""
        self.again |= self.lost
        self.lost = False

    def may_send(self, now: Nanos, node: int) -> bool:
        """True if other messages may be sent."""
        return not self.lost and not self.again and (node in AT_ONCE or now - self.at >= WAITS)


class ValveAdapter(Adapter[Valve]):
    """What valves are sent, and what they report."""

    name = "j1939_valve"
    faults, latch = jt.ALL_FAULTS, True

    def __init__(self) -> None:
        self.claims: dict[int, Claim] = {}
        """By our address"""

    def own(self, device: Device) -> Valve:
        self.claims.setdefault(device.options.host, Claim())
        return Valve(ShaftCheck(APART * device.options.stroke))

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Valve]) -> Sequence[Report[Valve] | Rx]:
        decoded = jt.TABLE.decode(frame, "from_device")
        if decoded is None or not isinstance(frame, CanFrame):
            return (Rx.IGNORED,)
        node = frame.id & 0xFF
        if frame.id >> 8 == 0x18EEFF:
            return self._on_claim(node, decoded.values, driver)
        host = driver.at.get(decoded.address)
        if host is None or host.options.ecu != node:
            return (Rx.IGNORED,)
        if not decoded.name:
            return (Rx.MALFORMED,)
        values, options = decoded.values, host.options
        if decoded.name == "measured position":
            raw = values["position"]
            known = options.retracted + raw * jt.STROKE * options.stroke if raw <= jt.MOST_POSITION else None
            two = known is not None and host.own.shaft.add(t, known, 0.0)
            duplicate = "positions of two cylinders" if two else ""
            feedback = Feedback(host.name, t, known)
            return (Report(host, host.address, feedback=feedback, duplicate=duplicate),)
        mode, detail = MODES.get(values["state"], (None, ""))
        faults = [jt.VALVE_ERROR] if mode is Mode.FAULT else []
        return (Report(host, host.address, mode, detail, faults),)

    def _on_claim(
        self, node: int, values: dict[str, int], driver: MotorDriver[Valve]
    ) -> Sequence[Report[Valve] | Rx]:
        ours = next((each for each in driver.hosts.values() if each.options.host == node), None)
        if ours is None or "name" not in values:
            return (Rx.IGNORED,)
        self.claims[node].hear(values["name"], ours.options.name)
        return (Rx.EXPECTED,)

    def notice(self, now: Nanos, host: Host[Valve]) -> Sequence[Event]:
        lost = self.claims[host.options.host].lost
        return host.trip(now, jt.ADDRESS_LOST) if lost and not host.tripped else ()

    # -- sent -----------------------------------------------------------------------------------------

    def _claim(self, now: Nanos, host: Host[Valve]) -> Sequence[Frame]:
        """Return our claim, if it is to be sent."""
        options: Options = host.options
        claim = self.claims[options.host]
        if not claim.again or claim.lost:
            return ()
        claim.send(now)
        return (jt.TABLE.encode("address claimed", host=options.host, name=options.name),)

    def _message(self, now: Nanos, host: Host[Valve], state: int, flow: int) -> Sequence[Frame]:
        claims = self._claim(now, host)
        if not self.claims[host.options.host].may_send(now, host.options.host):
            return claims
        values = {"flow": flow, "state": state, "fail_safe": jt.FAIL_SAFE_BLOCK}
        return *claims, jt.TABLE.encode("command", host.address, host=host.options.host, **values)

    def arm(self, now: Nanos, host: Host[Valve], command: Command) -> Sequence[Frame]:
        return self._message(now, host, jt.EXTEND, 0)

    def command(self, now: Nanos, host: Host[Valve], command: Command) -> Sequence[Frame]:
        velocity = getattr(command, "velocity", 0.0)
        flow = host.options.flow(velocity)
        return self._message(now, host, jt.RETRACT if velocity < 0.0 and flow else jt.EXTEND, flow)

    def release(self, now: Nanos, host: Host[Valve]) -> Sequence[Frame]:
        return self._message(now, host, jt.BLOCK, 0)

    def begin(
        self, now: Nanos, request: Request, host: Host[Valve] | None, driver: MotorDriver[Valve]
    ) -> Pending[Valve] | str:
        if isinstance(request, msg.ClearFault) and host is not None:  # its errors pass by themselves
            self.claims[host.options.host].claim_anew()
            return Pending(request, host.name, now, now + SECOND, now, host, sent=1)
        return "the device cannot do that on this bus"

    def poll(self, now: Nanos, host: Host[Valve]) -> Sequence[Frame]:
        """Defend our address, once it was claimed."""
        claim = self.claims[host.options.host]
        return self._claim(now, host) if claim.at > -NEVER else ()

    def poll_due(self, host: Host[Valve]) -> Nanos:
        claim = self.claims[host.options.host]
        return 0 if claim.again and claim.at > -NEVER and not claim.lost else NEVER
