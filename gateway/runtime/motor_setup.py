"""What is done to a motor once, on the bench: its address, its zero, its calibration, and saving them.

Rules. The motor is alone in its session: no other is commanded, nor is it. A device that is armed, or shares
its address with another, is left as it is. What an action does is told before (`told`); afterwards it is read
back, and what can be put back is put back if it failed. Which requests a motor takes, what saves it and what
calibrates it is its protocol's (`Spec`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from gateway.config.errors import unknown
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.errors import UserError
from gateway.runtime import configuration
from gateway.runtime.configuration import (
    SHARED,
    Answer,
    Motors,
    Reading,
    is_same,
    motors_only,
    reason,
    shown,
)
from gateway.runtime.session import Session
from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.messages import MILLISECOND, SECOND, Nanos

Kind: TypeAlias = Literal["set-id", "zero", "calibrate", "save"]
Report: TypeAlias = Callable[[str], None]

CALIBRATING: Nanos = 150 * SECOND
"""Time in which a calibration or homing must end; drivers give up sooner (CANSimple: 120 s)."""
SETTLED: Nanos = 500 * MILLISECOND
"""After what is read back."""
NEAR_ZERO = 0.35
"""rad at the device's shaft within which it is zero: drivers take 0.05 turns, where a shaft is not still."""


@dataclass(frozen=True, slots=True)
class Action:
    """What one motor is to do."""

    kind: Kind
    motor: str
    address: int = -1
    """The new one; of set-id alone"""
    first: bool = False
    """Whether the device has no address yet; of set-id alone"""


def alone(robot: Robot, name: str, address: int | None = None) -> Robot:
    """Return the robot reduced to one motor, at another address if one is given. Raises UserError if there is
    no such motor, or it cannot have this address."""
    if name not in robot.motors:
        raise UserError(unknown("motor", name, robot.motors))
    motor = robot.motors[name]
    if address is not None:
        device = replace(motor.device, address=address)
        try:
            motor = replace(motor, device=device, spec=motor.plugin.spec(device))
        except (Invalid, ValueError) as error:
            raise UserError(f"{name}: {error}") from error
    reduced = motors_only(replace(robot, motors={name: motor}))
    bus = replace(reduced.buses[motor.bus], devices=(motor.spec,), receive_filter=())
    return replace(reduced, buses={motor.bus: bus})


def told(robot: Robot, action: Action) -> str:
    """Return what an action is going to do to the motor of a robot that has it alone. Raises UserError if its
    protocol cannot do it."""
    name = action.motor
    motor = robot.motors[name]
    spec, protocol = motor.spec, motor.plugin.name
    it = f"{name}: the {protocol} at address {motor.device.address} on {motor.bus}"
    cannot = f"{name}: {protocol} cannot do this over its bus: use the vendor's tool"
    match action.kind:
        case "set-id":
            if not spec.id_parameter and not {msg.SetAddress, msg.SetId} & spec.requests:
                raise UserError(cannot)
            alone(robot, name, action.address)
            if action.first:
                if not spec.first_address:
                    raise UserError(
                        f"{name}: a {protocol} has an address from the beginning: leave out --from none"
                    )
                one = f"{name}: the {protocol} on {motor.bus} that has no address yet"
                several = "of several the one with the lowest identity"
                return f"{one} gets the address {action.address}, and stores it; {several}"
            saved = f", and saves it ({spec.save})" if spec.save else ""
            return f"{it} gets the address {action.address}{saved}"
        case "zero":
            if msg.Zero not in spec.requests:
                raise UserError(cannot)
            kept = "; what is not saved is lost when it is switched off (gateway motor save)" * bool(
                spec.save
            )
            return f"{it} takes the place where its shaft stands as its zero{kept}"
        case "calibrate":
            by, value = spec.calibration
            if not by and msg.Home not in spec.requests:
                raise UserError(cannot)
            how = f"calibrates itself ({by} = {shown(value)})" if by else "runs its own homing"
            return (
                f"{it} {how}: ITS SHAFT TURNS BY ITSELF, and no limit of the robot file holds. Take its load "
                "off, and have a switch in its supply"
            )
        case "save":
            if not spec.save:
                raise UserError(f"{name}: {protocol} has nothing that saves its configuration over its bus")
            return f"{it} keeps what is configured on it now ({spec.save} = 1); some restart with that"


def perform(session: Session, action: Action, report: Report) -> bool:
    """Do it on the one motor of a session. Returns whether all is as it should be; what was seen and done is
    reported."""
    with closing(Motors(session)) as motors:
        before = motors.identify()[action.motor]
        if action.first:
            return _address_first(motors, action, report)
        if wrong := _unfit(motors, action.motor, before):
            report(f"{action.motor}: nothing was done: {wrong}")
            return False
        match action.kind:
            case "zero":
                return _zero(motors, action.motor, report)
            case "calibrate":
                return _calibrate(motors, action.motor, report)
            case "save":
                return _save(motors, action.motor, report)
    return _readdress(session, action, before, report)


def _unfit(motors: Motors, name: str, one: Reading) -> str:
    """Return why nothing is done to a motor, "" if it may be."""
    match motors.unfit(name):
        case "":
            return ""
        case configuration.SHARED:
            return f"{SHARED}: take all others of them off the bus"
        case msg.Mode.ARMED:
            return "it is armed, and another host has it: end that"
        case mode:
            return f"it is {mode}: nothing answers at address {one.address} (gateway scan, gateway doctor)"


# -- zero, calibration, saving ------------------------------------------------------------------------------


def _zero(motors: Motors, name: str, report: Report) -> bool:
    motor = motors.motors[name]
    before, held = _angle(motors, name), dict[str, float]()
    for parameter in motor.spec.writes.get(msg.Zero, ()):
        read = _ask(motors, msg.ReadParameter(name, parameter))
        if isinstance(read, msg.Parameter):
            held[parameter] = read.value
    answer = _ask(motors, msg.Zero(name))
    motors.wait(SETTLED)
    after = _angle(motors, name)
    done = isinstance(answer, msg.Done)
    good = done and after is not None and abs(after) * motor.joint.gear < NEAR_ZERO
    wrong = "" if done else f": {reason(answer)}"
    report(
        f"{name}: {'zero' if good else 'NOT zero'}{wrong}; it read {_rad(before)}, and reads {_rad(after)}"
    )
    return good or _put_back(motors, name, held, report)


def _put_back(motors: Motors, name: str, held: dict[str, float], report: Report) -> bool:
    """Write back what a request has changed; always returns False."""
    for parameter, value in held.items():
        now = _ask(motors, msg.ReadParameter(name, parameter))
        if isinstance(now, msg.Parameter) and not is_same(now.value, value):
            wrong = motors.write(name, parameter, value)
            report(f"{name}.{parameter}: {wrong or f'put back: {shown(value)}'}")
    return False


def _calibrate(motors: Motors, name: str, report: Report) -> bool:
    by, value = motors.motors[name].spec.calibration
    request: msg.Request = msg.WriteParameter(name, by, value) if by else msg.Home(name)
    answer = _ask(motors, request, CALIBRATING)
    if isinstance(answer, msg.Done):
        detail = f" ({answer.detail})" if answer.detail else ""
        report(f"{name}: done{detail}; it reads {_rad(_angle(motors, name))}")
        return True
    motors.session.submit(msg.Stop(f"{name} was not calibrated"))
    motors.wait(SETTLED)
    report(f"{name}: NOT calibrated, and told to stop: {reason(answer)}")
    return False


def _save(motors: Motors, name: str, report: Report) -> bool:
    wrong = motors.write(name, motors.motors[name].spec.save, 1.0)
    report(f"{name}: {f'NOT saved: {wrong}' if wrong else 'saved'}")
    return not wrong


# -- another address ----------------------------------------------------------------------------------------


def _readdress(session: Session, action: Action, before: Reading, report: Report) -> bool:
    """Give the motor its new address, look for it there, and save it."""
    name, by = action.motor, session.robot.motors[action.motor].spec.id_parameter
    if by and before.address != action.address and _is_taken(session, action):
        report(f"{name}: nothing was done: another device has address {action.address}")
        return False
    with closing(Motors(session)) as motors:
        motors.identify()
        given = _give(motors, action, before, report)
    return given and _moved(session, action, before, report)


def _address_first(motors: Motors, action: Action, report: Report) -> bool:
    """Give the one device without an address that of the motor in the file, and look for it there."""
    name, address = action.motor, action.address
    answer = _ask(motors, msg.SetAddress(name, address))
    if not isinstance(answer, msg.Done):
        report(f"{name}: NOT given the address {address}: {reason(answer)}")
        return False
    report(f"{name}: has the address {address}{f', {answer.detail}' if answer.detail else ''}")
    motors.wait(SETTLED)
    now = motors.identify()[name]
    wrong = _unfit(motors, name, now)
    serial = "" if now.serial is None else f", serial number {now.serial:X}"
    report(f"{name}: NOT read back: {wrong}" if wrong else f"{name}: read back at {address}{serial}")
    return not wrong


def _give(motors: Motors, action: Action, before: Reading, report: Report) -> bool:
    """Give the motor its new address. Returns whether its driver says that it has it."""
    name, motor = action.motor, motors.motors[action.motor]
    if before.address == action.address:
        report(f"{name}: it has that address")
        return True
    request: msg.Request = msg.SetAddress(name, action.address)
    if motor.spec.id_parameter:
        request = msg.WriteParameter(name, motor.spec.id_parameter, float(action.address))
    elif msg.SetAddress not in motor.spec.requests:
        if before.serial is None:
            report(
                f"{name}: nothing was done: it tells no serial number, by which it would be given an address"
            )
            return False
        request = msg.SetId(motor.bus, before.serial, action.address)
    answer = _ask(motors, request)
    if isinstance(answer, msg.Done):
        report(f"{name}: has the address {action.address}{f', {answer.detail}' if answer.detail else ''}")
        return True
    report(f"{name}: NOT given the address {action.address}: {reason(answer)}")
    return False


def _is_taken(session: Session, action: Action) -> bool:
    """Return whether anything answers at the new address: its driver would take it for the motor."""
    robot = alone(session.robot, action.motor, action.address)
    with closing(Motors(_as_if(session, robot))) as motors:
        one = motors.identify()[action.motor]
        return one.shared or not motors.session.joints[action.motor].feedback_lost(session.clock.now())


def _moved(session: Session, action: Action, before: Reading, report: Report) -> bool:
    """Look for the motor at its new address with a driver that knows no other, and save it; else give it the
    one of before again."""
    name = action.motor
    robot = alone(session.robot, name, action.address)
    with closing(Motors(_as_if(session, robot))) as motors:
        now = motors.identify()[name]
        wrong = _unfit(motors, name, now)
        if not wrong and None not in (before.serial, now.serial) and before.serial != now.serial:
            wrong = f"serial number {now.serial:X} answers there, and {before.serial:X} was given the address"
        serial = "" if now.serial is None else f", serial number {now.serial:X}"
        report(
            f"{name}: NOT read back: {wrong}" if wrong else f"{name}: read back at {action.address}{serial}"
        )
        if not wrong and (not robot.motors[name].spec.save or _save(motors, name, report)):
            return True
        if action.address != before.address:
            _give(motors, replace(action, address=before.address), now, report)
    return False


def _as_if(session: Session, robot: Robot) -> Session:
    """Return a session of another robot on the open buses of one."""
    return Session(
        robot, Gateway(robot), session.clock, session.buses, session.twins, reasons=session.reasons
    )


# -- what is asked and read --------------------------------------------------------------------------------


def _ask(motors: Motors, request: msg.Request, timeout: Nanos = 15 * SECOND) -> Answer | None:
    return next(iter(motors.ask([request], timeout).values()), None)


def _angle(motors: Motors, name: str) -> float | None:
    """Return the position of a joint [rad]; None: it was not reported."""
    return motors.session.joints[name].feedback.position


def _rad(angle: float | None) -> str:
    return "no position" if angle is None else f"{angle:.4g} rad"
