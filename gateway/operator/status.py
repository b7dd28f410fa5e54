"""What the robot does, and why: for a person who asks while it runs."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING

from protocols.messages import MILLISECOND

if TYPE_CHECKING:
    from gateway.core.step import Gateway
    from gateway.runtime.session import Session


def status_text(made: Session) -> str:
    """Pose, goal, joints with their faults, counts of each bus, the recording: a line each."""
    gateway, now = made.gateway, made.clock.now()
    belief = gateway.belief()
    lines = [f"{made.robot.name}: {belief.state}{f' ({belief.reason})' if belief.reason else ''}"]
    if gateway.why_stopped():
        lines.append(f"stopped: {gateway.why_stopped()}")
    if belief.estimate is not None:
        pose = belief.estimate.pose
        lines.append(f"pose: {pose.x:.3f} m, {pose.y:.3f} m, {degrees(pose.yaw):.1f} degrees")
    if belief.goal is not None:
        lines.append(f"goal: {belief.goal.x:g}, {belief.goal.y:g} m ({belief.reached} reached so far)")
    for name, joint in gateway.joints.items():
        reported, age = joint.feedback, joint.feedback_age(now)
        received = "never heard" if age is None else f"heard {age / MILLISECOND:.0f} ms ago"
        parts = [
            f"{label} {value:.3f} {unit}"
            for label, value, unit in (
                ("at", reported.position, "rad"),
                ("turns", reported.velocity, "rad/s"),
                ("gives", reported.torque, "N·m"),
                ("supply", reported.voltage, "V"),
                ("temperature", reported.temperature, "degrees C"),
            )
            if value is not None
        ]
        lines.append(f"{name}: {joint.mode}, {received}{''.join(', ' + part for part in parts)}")
        lines += [f"  fault: {fault.name}; {fault.remedy}" for fault in joint.faults.values()]
    lines += _counted(gateway)
    lines.append(f"ticks: {made.stats.ticks}, {made.stats.missed} missed")
    if (recorder := made.recorder) is not None:
        lost = f", {recorder.lost} ticks lost: {recorder.trouble}" if recorder.trouble else ""
        lines.append(f"recording: {recorder.path}{lost}")
    return "\n".join(lines)


def _counted(gateway: Gateway) -> list[str]:
    """What each driver has counted, by bus; with its language where a bus has several."""
    rx_counters = gateway.rx_counters()
    buses = [bus for bus, _, _ in rx_counters]
    return [
        f"{f'{bus}, {language}' if buses.count(bus) > 1 else bus}: {counters.accepted} messages heard, "
        f"{counters.malformed} bad, {counters.ignored} foreign"
        for bus, language, counters in rx_counters
    ]
