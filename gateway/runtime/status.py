"""The status of a running robot as text, for an operator."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING

from gateway.core.message_text import escaped
from protocols.messages import MILLISECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gateway.buses import Bus
    from gateway.core.joint import Joint
    from gateway.core.step import Gateway
    from gateway.runtime.doctor import Finding
    from gateway.runtime.session import Session
    from protocols.messages import Nanos


def doctor_text(session: Session) -> str:
    """Return what hinders the robot, and what to do about it: a line each."""
    if session.driving is None:
        return "it is no longer looked for: that has failed, and the log says how"
    return "\n".join(finding_lines(session.driving.findings(), explain=True))


def finding_lines(findings: Sequence[Finding], *, explain: bool) -> list[str]:
    """Return findings as lines, and how many they are."""
    lines = []
    for one in findings:
        lines.append(f"{'!!' if one.grave else ' !'} {one.about}: {escaped(one.seen)}")
        lines += [f"     why it matters: {escaped(one.matters)}"] if explain else []
        lines.append(f"     what to do: {escaped(one.todo)}")
    grave = sum(one.grave for one in findings)
    return [*lines, f"{len(findings)} findings, {grave} of them grave" if findings else NOTHING]


NOTHING = "nothing was found"


def unready(session: Session) -> str:
    """Return which motors cannot be commanded yet; "" if all can, or are in fault."""
    now = session.clock.now()
    silent = [name for name, joint in session.joints.items() if not (joint.open_loop or joint.is_heard(now))]
    return f"{', '.join(silent)} not heard yet" if silent else ""


def status_text(session: Session) -> str:
    """Return state, pose, goal, joints and their faults, counters, ticks and recording: a line each."""
    gateway, now = session.gateway, session.clock.now()
    belief = gateway.belief()
    lines = [f"{session.robot.name}: {belief.state}{f' ({belief.reason})' if belief.reason else ''}"]
    if gateway.why_stopped():
        lines.append(f"stopped: {gateway.why_stopped()}")
    if belief.estimate is not None:
        pose = belief.estimate.pose
        lines.append(f"pose: {pose.x:.3f} m, {pose.y:.3f} m, {degrees(pose.yaw):.1f} degrees")
    if belief.goal is not None:
        lines.append(f"goal: {belief.goal.x:g}, {belief.goal.y:g} m ({belief.reached} reached so far)")
    if (mission := belief.mission) is not None:
        at = f", step {mission.step} of {mission.steps}: {mission.text}" if mission.step else ""
        why = f" ({mission.reason})" if mission.reason else ""
        lines.append(f"mission: {mission.name}: {mission.phase}{why}{at}")
    lines += [
        f"{system.name}: {system.state}{f' ({system.reason})' if system.reason else ''}"
        for system in belief.systems
    ]
    for joint in gateway.joints.values():
        lines += _joint(joint, now)
    lines += _counters(gateway)
    lines += [line for bus in session.buses.values() for line in _lost(bus)]
    lines.append(f"ticks: {session.stats.ticks}, {session.stats.missed} missed")
    if session.stats.trouble:
        lines.append(f"timing: {session.stats.trouble}")
    if (recorder := session.recorder) is not None:
        lost = f", {recorder.lost} ticks lost: {recorder.trouble}" if recorder.trouble else ""
        lines.append(f"recording: {recorder.path}{lost}")
    return "\n".join(map(escaped, lines))


def _joint(joint: Joint, now: Nanos) -> list[str]:
    feedback, age = joint.feedback, joint.feedback_age(now)
    values = (
        ("position", feedback.position, "rad"),
        ("velocity", feedback.velocity, "rad/s"),
        ("torque", feedback.torque, "N·m"),
        ("supply", feedback.voltage, "V"),
        ("temperature", feedback.temperature, "degrees C"),
    )
    cells = ["no feedback yet" if age is None else f"feedback {age / MILLISECOND:.0f} ms old"]
    if joint.open_loop:
        cells = ["open loop: nothing is measured"]
    cells += [f"{label} {value:.3f} {unit}" for label, value, unit in values if value is not None]
    faults = [f"  fault: {fault.name}; {fault.remedy}" for fault in joint.faults.values()]
    return [f"{joint.name}: {joint.mode}, {', '.join(cells)}", *faults]


_LOST = {
    "dropped": "frames never sent",
    "bad": "pieces that were no frames",
    "refused": "frames refused by the adapter",
    "turned_off": "times it was taken off the bus for that",
}
"""What a bus counts, where it can."""


def _lost(bus: Bus) -> list[str]:
    """Return what was lost on a bus; nothing if nothing was."""
    counts = [f"{count} {text}" for name, text in _LOST.items() if (count := getattr(bus, name, 0))]
    return [f"{bus.name}: {', '.join(counts)}"] if counts else []


def _counters(gateway: Gateway) -> list[str]:
    """Return what each driver has counted, by bus; with its protocol where a bus has several."""
    counted = gateway.rx_counters()
    buses = [bus for bus, _, _ in counted]
    return [
        f"{f'{bus}, {protocol}' if buses.count(bus) > 1 else bus}: {counters.accepted} messages accepted, "
        f"{counters.malformed} malformed, {counters.ignored} ignored"
        for bus, protocol, counters in counted
    ]
