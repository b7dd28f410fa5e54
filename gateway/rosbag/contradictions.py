"""What in a bag contradicts itself, in sentences: stamps of several clocks, sources of different motions.

Rules. What cannot be true makes a wrong figure out of a right filter, so it does not pass, whatever the error
is. Stamps come first: of what was not measured when it says so, nothing else can be compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Base
from brain.perception.mount import Mount
from gateway.rosbag import agreement, stamps
from gateway.rosbag.bag import Bag
from gateway.rosbag.motion import OdometryReading
from protocols.messages import SECOND, Imu, Nanos


def contradictions(bag: Bag, body: Base, mounts: Mapping[str, Mount], slip: float) -> tuple[str, ...]:
    """Return one sentence for each. `slip`: the standard deviation of a wheel's slip in turns, as a share."""
    if not bag.odometry:
        return ()
    names = {topic.role: f"{topic.name} ({topic.role})" for topic in bag.topics}
    with np.errstate(all="ignore"):  # of numbers as large as a damaged bag may have, sums are not finite
        found = list(_of_stamps(bag)) or list(_of_motion(bag, body, mounts, slip))
    return tuple(f"{names.get(role, role)}: {text}" for role, text in found)


def remarks(bag: Bag) -> tuple[str, ...]:
    """Return how it was read, if not as its writer meant; and what is odd about the stamps of a log that is
    written by several programs, each by its clock: it says little of the path."""
    return (bag.remark,) * bool(bag.remark) + tuple(
        f"{role}: {text}"
        for role in bag.several_clocks & bag.stamps.keys()
        for text in stamps.order(_stamps(bag.stamps[role], *bag.stamps[role][0]).stamps)
    )


def _of_stamps(bag: Bag) -> Iterator[tuple[str, str]]:
    if "odometry" not in bag.stamps:
        return
    began = bag.stamps["odometry"][0]
    times = {role: _stamps(messages, *began) for role, messages in bag.stamps.items()}
    for role, one in times.items():
        order = [] if role in bag.several_clocks else stamps.order(one.stamps)
        found = [*stamps.resolution(one.stamps), *order] or stamps.steps(one)
        if not found and role != "odometry":
            found = stamps.clock(one, times["odometry"])
        yield from ((role, text) for text in found)


def _of_motion(bag: Bag, body: Base, mounts: Mapping[str, Mount], slip: float) -> Iterator[tuple[str, str]]:
    start = bag.odometry[0].t
    own = _odometry(bag.odometry, start)
    if bag.own_path and bag.own_twists:  # else one was made of the other
        for text in agreement.odometry(own, sideways=body.moves_sideways):
            yield "odometry", text
    wheels = agreement.wheel_turns(own)
    for sensor, mount in mounts.items():
        if rates := [one for one in bag.events if isinstance(one, Imu) and one.sensor == sensor]:
            for text in agreement.gyro(_turns(rates, mount, start), wheels, max(slip, body.turn_slip)):
                yield f"sensors.{sensor}", text


def _stamps(messages: Sequence[tuple[Nanos, Nanos]], logged: Nanos, stamped: Nanos) -> stamps.Stamps:
    return stamps.Stamps(
        _times([one[0] for one in messages], logged), _times([one[1] for one in messages], stamped)
    )


def _odometry(readings: Sequence[OdometryReading], start: Nanos) -> agreement.Odometry:
    linear, lateral, rate, x, y, yaw = np.array(
        [(r.linear, r.lateral, r.angular, r.pose.x, r.pose.y, r.pose.yaw) for r in readings]
    ).T
    return agreement.Odometry(
        _times([one.t for one in readings], start), linear + 1j * lateral, rate, x + 1j * y, yaw
    )


def _turns(readings: Sequence[Imu], mount: Mount, start: Nanos) -> agreement.UnwrappedAngles:
    up = np.array(mount.rotation()[2])
    return agreement.turns_of(
        _times([one.t for one in readings], start), np.array([one.angular_velocity for one in readings]) @ up
    )


def _times(nanos: Sequence[Nanos], start: Nanos) -> Floats:
    """Return times as s since a start: as floating point, those of the epoch are good to 0.2 µs only."""
    return np.array([one - start for one in nanos], dtype=np.float64) / SECOND
