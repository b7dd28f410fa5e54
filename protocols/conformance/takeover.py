"""Running devices: a new driver takes them over without dropping their load, and finds them without a touch.

Rules. A first host arms the device and leaves it under a constant load; if the device does not hold
unattended, that host stays on the bus until the new one takes over. Sagging is compared with how far the
shaft gave way when the load was applied: a controller without integral gives way as far again.
"""

from __future__ import annotations

from protocols.conformance.bench import ALPHA, ARMING, BETA, Messages, StepResult
from protocols.conformance.case import Case, Inapplicable
from protocols.conformance.fault_injection import (
    SLACK,
    STILL,
    Rig,
    make_rig,
    slack,
    takeover,
    torque_of,
)
from protocols.conformance.passivity import read_only
from protocols.messages import (
    Command,
    Done,
    Found,
    Hold,
    Idle,
    Impedance,
    Mode,
    Position,
    Reboot,
    Refused,
    Scan,
)
from protocols.plugin import FeedbackKind, Spec

PLACE = 0.7
"""rad where the shafts stand."""
LOAD = 0.05
"""N·m on a shaft."""
SETTLE = 500
"""Steps within which a loaded shaft has given way."""
SCANNED = 8000
"""Steps within which a scan must have ended."""


# -- attaching -------------------------------------------------------------------------------------------


def load_is_held(case: Case) -> None:
    """A new host attaches to a device under load, and takes it over with Hold: the load does not drop."""
    kinds = _holding(case.spec)
    if not kinds:
        raise Inapplicable("the spec lists neither Hold nor Position: the device holds no load")
    if case.spec.feedback is FeedbackKind.REPLY:
        raise Inapplicable("the spec's feedback is reply: without a command it is not known that it runs")
    _attach(case, case.random().choice(kinds), kinds[0])


def _holding(spec: Spec) -> list[type[Command]]:
    kinds: tuple[type[Command], ...] = (Hold, Position)
    return [kind for kind in kinds if kind in spec.commands]


def _loaded(case: Case, kind: type[Command], count: int = 1) -> tuple[Rig, list[Command], float]:
    """Arm devices by a first host, then load alpha.

    Returns the rig, what that host is given, and how far the shaft gave way at most [rad]."""
    rig = make_rig(case, count, position=PLACE)
    rig.get_ready()
    commands = rig.at_rest(kind, *rig.names)
    rig.must_arm(commands)
    shaft = rig.bench.shafts[ALPHA]
    place, shaft.load = shaft.position, LOAD
    gave_way = 0.0
    for _ in range(SETTLE):
        rig.step(commands)
        gave_way = max(gave_way, shaft.position - place)
    return rig, commands, gave_way


def _attach(case: Case, first: type[Command], second: type[Command]) -> None:
    before, commands, gave_way = _loaded(case, first)
    shaft = before.bench.shafts[ALPHA]
    if before.spec.holds_unattended:
        before.host.alive = False
        before.wait(SETTLE)
    rig, idle = takeover(case, before), [Idle(ALPHA)] if Idle in before.spec.commands else []
    if not before.spec.holds_unattended:
        rig.host.other, rig.host.others_messages = before.host.driver, commands
    place, room = shaft.position, 0.5 * SLACK

    def over(_: StepResult) -> bool:
        return _is_away(shaft.position - place, gave_way, room) or rig.mode() is Mode.ARMED

    if not rig.until(over, ARMING, idle):
        raise rig.failure(f"a new driver does not report in {ARMING} ms that the device is armed")
    rig.wait(SETTLE // 2, idle)
    moved = shaft.position - place
    if _is_away(moved, gave_way, room):
        raise rig.failure(f"a new driver sends only read-only frames, and the shaft moves by {moved:.3g} rad")
    _take_over(rig, second, gave_way)


def _take_over(rig: Rig, kind: type[Command], gave_way: float) -> None:
    """From now on the new host alone commands."""
    shaft = rig.bench.shafts[ALPHA]
    place = shaft.position
    room = 1.2 * gave_way + slack(rig.spec, place) + _pull_of_zero(rig.spec, place)
    (command,) = rig.at_rest(kind)
    rig.host.other = None
    rig.obeyed.clear()
    rig.faults.clear()  # a driver may well report two hosts on one bus
    limp = 0
    for at in range(2 * SETTLE):
        step = rig.step([command])
        limp = limp + 1 if abs(torque_of(step)) <= STILL else 0
        dropping = [m for m in step.received if isinstance(m, Idle | Reboot)]
        wrong = ""
        if dropping:
            wrong = f"the device is sent {dropping[0]}"
        elif limp > 3:
            wrong = "the device applies no torque"
        elif _is_away(shaft.position - place, gave_way, room):
            wrong = f"the shaft moves by {shaft.position - place:.3g} rad"
        elif rig.mode() is not Mode.ARMED or rig.faults:
            wrong = f"the driver reports {rig.faults[0].name if rig.faults else rig.mode()}"
        if wrong:
            raise rig.failure(f"a new driver takes over with {kind.__name__}; {at} ms later {wrong}")


def _is_away(moved: float, gave_way: float, room: float) -> bool:
    """True if a shaft gave way again, or has gone further back than it gave way."""
    return not -1.2 * gave_way - room <= moved <= room


def _pull_of_zero(spec: Spec, place: float) -> float:
    """Return how far [rad] a velocity and a torque that are zero but for their resolutions pull a device that
    holds as by an Impedance."""
    held = spec.canonical(Position(ALPHA, place))
    if not isinstance(held, Impedance) or not held.stiffness:
        return 0.0
    velocity, torque = (spec.ranges[f"Impedance.{name}"].resolution for name in ("velocity", "torque"))
    return (held.damping * velocity + torque) / held.stiffness


# -- scanning --------------------------------------------------------------------------------------------


def scan_is_read_only(case: Case) -> None:
    """Scan finds the devices by read-only frames; what runs goes on, what is in fault stays in fault."""
    if Scan not in case.spec.requests:
        raise Inapplicable("the spec lists no request Scan")
    known = _holding(case.spec) and case.spec.feedback is not FeedbackKind.REPLY
    for scan in case.sample([_scan_new, *([_scan_running] if known else [])]):
        scan(case)


def _scan_new(case: Case) -> None:
    """Scan devices as delivered, by a new driver."""
    rig = make_rig(case, 2)
    _scan(rig, case, "devices as delivered")
    if case.spec.kind == "motor":
        rig.get_ready()


def _scan_running(case: Case) -> None:
    """Scan while alpha holds a load for another host, and beta is in fault."""
    before, commands, gave_way = _loaded(case, _holding(case.spec)[0], 2)
    codes = sorted(code for code, fault in before.spec.faults.items() if fault.latching)
    code = case.random().choice(codes) if codes else None
    if code is not None:
        before.cables[BETA].provoke(code)
        before.wait(20, commands[:1])
    place = before.bench.shafts[ALPHA].position
    rig = takeover(case, before)
    if case.spec.line == "free":  # on a line where devices are asked there is one host
        rig.host.other, rig.host.others_messages = before.host.driver, commands[:1]
    _scan(rig, case, "a device that runs and one in fault")
    moved = before.bench.shafts[ALPHA].position - place
    if _is_away(moved, gave_way, 0.5 * SLACK) or rig.mode() is not Mode.ARMED:
        raise rig.failure(f"after a scan the device that ran moves by {moved:.3g} rad, and is {rig.mode()}")
    if code is not None and rig.mode(BETA) is not Mode.FAULT:
        raise rig.failure(f"after a scan the device that was in fault {code} is {rig.mode(BETA)}")


def _scan(rig: Rig, case: Case, what: str) -> None:
    """Scan until it has ended: read-only throughout, with every device found."""
    found, with_serial, ended = set[int](), set[int](), list[Done | Refused]()
    messages: Messages = [Scan("bus")]
    for _ in range(SCANNED):
        step = rig.step(messages)
        messages = ()
        for frame in rig.host.sent:
            if not read_only(rig.bench.specs, frame):
                received = case.plugin.decoder(rig.bench.devices).decode(step.now, frame)
                raise rig.failure(f"a scan of {what} sends what is not read-only", (frame,), received)
        founds = [event for event in step.events if isinstance(event, Found)]
        found |= {event.address for event in founds}
        with_serial |= {event.address for event in founds if event.serial is not None}
        ended += [e for e in step.events if isinstance(e, Done | Refused) and e.request == Scan.__name__]
        if ended:
            break
    if not ended or isinstance(ended[0], Refused):
        raise rig.failure(f"a scan of {what} ends with {ended or 'nothing'} in {SCANNED} ms")
    expected = set(case.addresses[: len(rig.names)])
    if missing := expected - found:
        raise rig.failure(f"a scan of {what} does not find address {min(missing)}")
    if case.spec.tells_serial is not (with_serial >= expected):
        raise rig.failure(
            f"a scan of {what} tells the serial numbers of {len(with_serial)} of {len(expected)} devices"
        )
