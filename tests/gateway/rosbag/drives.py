"""Recordings of a drive by a base with wheels, gyro and GPS, by seed; and the ways in which one contradicts
itself.

A drive varies in all that good recordings differ in: motion, rates, noise, delays, slip, twists that are
means over a second. A lie changes what one topic says, by a magnitude; where that is small, a good recording
may say it too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brain.belief import Floats, Pose
from gateway.rosbag import Bag, Topic
from gateway.rosbag.motion import OdometryReading
from protocols.messages import SECOND, Imu, Nanos
from tests.gateway.bag_helpers import METRES, METRES_NORTH, START, BagMessage, fix, imu, odometry

FINE = 0.005
"""s: the true motion is integrated in these steps."""


@dataclass(slots=True)
class Stream:
    """One topic: when its messages were logged, what they are stamped [s since START], and their columns."""

    logged: Floats
    stamps: Floats
    columns: dict[str, Floats]


@dataclass(slots=True)
class Drive:
    """What was recorded."""

    odom: Stream
    """v, lateral, w; x, y, yaw"""
    imu: Stream
    """w"""
    fix: Stream
    """x, y"""

    def streams(self) -> dict[str, Stream]:
        return {"odometry": self.odom, "sensors.imu": self.imu, "truth": self.fix}


def motion(rng: np.random.Generator, length: float, sideways: float) -> tuple[Floats, Floats, Floats]:
    """Return speed forward, to the left, and rate of turn: one slowly changing curve, or legs of
    random speed and turn, smoothly joined."""
    count = round(length / FINE)
    t = np.arange(count) * FINE
    top, sharp, shortest = rng.uniform(0.3, 1.5), rng.uniform(0.2, 1.2), rng.choice([0.0, 1.0, 4.0])
    speed: Floats = np.zeros(count)
    turn: Floats = np.zeros(count)
    at = 0
    if shortest:
        while at < count:
            leg = round(rng.uniform(1.0, 3.0) * shortest / FINE)
            rests = rng.random() < 0.1
            speed[at : at + leg] = 0.0 if rests else top * rng.uniform(0.5, 1.0)
            turn[at : at + leg] = 0.0 if rests else sharp * rng.choice([-1.0, -0.5, 0.0, 0.3, 1.0])
            at += leg
    else:
        driving = (t > 2.0) & (t < length - 3.0)
        speed += top * driving
        turn += 0.5 * sharp * driving * np.sin(t / rng.uniform(2.0, 6.0))
    wide = round(0.4 / FINE)
    kernel = np.ones(wide) / wide
    forward, turned = (np.convolve(one, kernel, mode="same") for one in (speed, turn))
    return forward, sideways * forward * np.sin(t / 7.0), turned


def drive(seed: int, length: float | None = None, sideways: float = 0.0) -> Drive:
    """Return a good recording."""
    rng = np.random.Generator(np.random.PCG64(seed))
    length = length or rng.uniform(40.0, 120.0)
    v, lateral, w = motion(rng, length, sideways)
    slip = rng.uniform(0.0, 0.1)  # the base turns less than its wheels
    fine = np.arange(len(v)) * FINE

    def path(turn: Floats) -> tuple[Floats, Floats, Floats]:
        yaw = np.concatenate(([0.0], np.cumsum(turn[:-1] * FINE)))
        step = (v + 1j * lateral) * np.exp(1j * (yaw + turn * FINE / 2.0)) * FINE
        place = np.concatenate(([0.0], np.cumsum(step[:-1])))
        return place.real, place.imag, yaw

    def stream(rate: float, delay: float, jitter: float) -> tuple[Floats, Floats]:
        t = np.arange(rng.uniform(0.0, 1.0 / rate), length - 0.1, 1.0 / rate)
        t = t + rng.uniform(-0.1, 0.1, len(t)) / rate
        t = t[(t > 0.0)]
        return t, t + delay + jitter * rng.random(len(t))

    t, logged = stream(float(rng.choice([10.0, 20.0, 50.0, 100.0])), 0.001, float(rng.choice([0.001, 0.03])))
    x, y, yaw = path(w)
    wide = round(rng.choice([0.0, 0.2, 1.0]) / FINE) + 1  # many controllers report a mean
    late = [np.convolve(one, np.ones(wide) / wide)[: len(one)] for one in (v, lateral, w)]
    odom = dict(zip(("v", "lateral", "w"), (np.interp(t, fine, one) for one in late), strict=True))
    odom |= {"x": np.interp(t, fine, x), "y": np.interp(t, fine, y), "yaw": np.interp(t, fine, yaw)}
    recorded = Stream(logged, t, odom)
    t, logged = stream(float(rng.choice([30.0, 50.0, 100.0, 200.0])), rng.uniform(0.001, 0.03), 0.005)
    noise = rng.choice([0.002, 0.01, 0.05])
    gyro = np.interp(t, fine, w * (1.0 - slip)) + rng.normal(rng.normal(0.0, 0.02), noise, len(t))
    turned = Stream(logged, t, {"w": gyro})
    t, logged = stream(float(rng.choice([1.0, 2.5, 5.0])), rng.uniform(0.0, 0.2), 0.05)
    x, y, _ = path(w * (1.0 - slip))
    sigma = rng.choice([0.02, 0.3])
    noisy = {n: np.interp(t, fine, one) + rng.normal(0.0, sigma, len(t)) for n, one in (("x", x), ("y", y))}
    return Drive(recorded, turned, Stream(logged, t, noisy))


# -- as a bag --------------------------------------------------------------------------------------


def bag(one: Drive) -> Bag:
    """Return a recording as what reading it gives."""
    one = Drive(*(_written(stream) for stream in one.streams().values()))
    o = one.odom
    poses = [Pose(*row) for row in zip(*(o.columns[n].tolist() for n in ("x", "y", "yaw")), strict=True)]
    twists = zip(*(o.columns[n].tolist() for n in ("v", "w", "lateral")), strict=True)
    readings = [
        OdometryReading(t, v, w, pose, lateral)
        for t, (v, w, lateral), pose in zip(_nanos(o.stamps), twists, poses, strict=True)
    ]
    rates = zip(_nanos(one.imu.stamps), one.imu.columns["w"].tolist(), strict=True)
    events = [Imu("imu", t, (0.0, 0.0, w), (0.0, 0.0, 9.81)) for t, w in rates]
    stamps = {
        role: list(zip(_nanos(s.logged), _nanos(s.stamps), strict=True)) for role, s in one.streams().items()
    }
    names = {"odometry": "/odom", "sensors.imu": "/imu/data", "truth": "/fix"}
    topics = tuple(Topic(names[role], "", len(s.stamps), role) for role, s in one.streams().items())
    in_order = tuple(sorted(events, key=lambda event: event.t))
    return Bag(Path("bag"), in_order, tuple(sorted(readings, key=lambda r: r.t)), (), topics, stamps)


def _written(stream: Stream) -> Stream:
    """Return a stream in the order in which a reader has it."""
    at = np.argsort(stream.logged, kind="stable")
    return Stream(stream.logged[at], stream.stamps[at], {n: c[at] for n, c in stream.columns.items()})


def messages(one: Drive) -> list[BagMessage]:
    """Return a recording as messages, to be written to a file."""
    o, columns = one.odom, one.odom.columns
    found = [
        odometry(t, v, w, Pose(x, y, yaw), logged=logged, lateral=lateral)
        for t, logged, v, lateral, w, x, y, yaw in zip(
            _nanos(o.stamps), _nanos(o.logged), *(column.tolist() for column in columns.values()), strict=True
        )
    ]
    found += [
        imu(t, (0.0, 0.0, w), logged=logged)
        for t, logged, w in zip(
            _nanos(one.imu.stamps), _nanos(one.imu.logged), one.imu.columns["w"].tolist(), strict=True
        )
    ]
    found += [
        fix(t, y / METRES_NORTH, x / METRES, logged=logged)
        for t, logged, x, y in zip(
            _nanos(one.fix.stamps),
            _nanos(one.fix.logged),
            *(column.tolist() for column in one.fix.columns.values()),
            strict=True,
        )
    ]
    return sorted(found, key=lambda message: message.logged)


def _nanos(times: Floats) -> list[Nanos]:
    return [START + round(t * SECOND) for t in times.tolist()]


# -- lies ------------------------------------------------------------------------------------------

Lie = Callable[[Drive, float], None]


def jump_back(one: Drive, by: float) -> None:
    """A bag played again, a simulation reset, a clock set back, half way."""
    half = float(one.odom.stamps[-1]) / 2.0
    for stream in one.streams().values():
        stream.stamps = np.where(stream.stamps > half, stream.stamps - by, stream.stamps)


def leap_ahead(one: Drive, by: float) -> None:
    """A clock set forward half way."""
    half = float(one.odom.stamps[-1]) / 2.0
    for stream in one.streams().values():
        stream.stamps = np.where(stream.stamps > half, stream.stamps + by, stream.stamps)


def gyro_jumps_back(one: Drive, by: float) -> None:
    half = float(one.odom.stamps[-1]) / 2.0
    one.imu.stamps = np.where(one.imu.stamps > half, one.imu.stamps - by, one.imu.stamps)


def two_clocks(one: Drive, by: float) -> None:
    """Two devices on one topic."""
    one.imu.stamps = one.imu.stamps - by * (np.arange(len(one.imu.stamps)) % 2)


def uptime(one: Drive, ago: float) -> None:
    """An IMU that counts since its power-up."""
    one.imu.stamps = one.imu.stamps - START / SECOND + ago


def gyro_offset(one: Drive, by: float) -> None:
    one.imu.stamps = one.imu.stamps + by


def gyro_offset_logged(one: Drive, by: float) -> None:
    """The same in a bag whose times of logging were made of the stamps."""
    for stream in one.streams().values():
        stream.logged = stream.stamps
    one.imu.stamps = one.imu.stamps + by
    one.imu.logged = one.imu.stamps


def truth_offset(one: Drive, by: float) -> None:
    """GPS time without its leap seconds, a time zone."""
    one.fix.stamps = one.fix.stamps + by


def gyro_drifts(one: Drive, share: float) -> None:
    one.imu.stamps = one.imu.stamps * (1.0 + share)


def gyro_factor(one: Drive, factor: float) -> None:
    one.imu.columns["w"] = one.imu.columns["w"] * factor


def gyro_axis(one: Drive, noise: float) -> None:
    """Another axis than that of the turn: its noise alone."""
    rng = np.random.Generator(np.random.PCG64(1))
    one.imu.columns["w"] = rng.normal(0.0, noise, len(one.imu.stamps))


def wheels_never_turn(one: Drive, _: float) -> None:
    one.odom.columns["w"] = 0.0 * one.odom.columns["w"]
    one.odom.columns["yaw"] = 0.0 * one.odom.columns["yaw"]


def coarse(role: str) -> Lie:
    def lie(one: Drive, seconds: float) -> None:
        stream = one.streams()[role]
        stream.stamps = np.floor(stream.stamps / seconds) * seconds + 1e-3

    return lie


def twist_factor(one: Drive, factor: float) -> None:
    one.odom.columns["v"] = one.odom.columns["v"] * factor


def turn_factor(one: Drive, factor: float) -> None:
    one.odom.columns["w"] = one.odom.columns["w"] * factor


def twist_in_odom(one: Drive, _: float) -> None:
    columns = one.odom.columns
    fixed = (columns["v"] + 1j * columns["lateral"]) * np.exp(1j * columns["yaw"])
    columns["v"], columns["lateral"] = fixed.real, fixed.imag


def twist_turned(one: Drive, angle: float) -> None:
    """A frame of the twist that is not the base's."""
    columns = one.odom.columns
    turned = (columns["v"] + 1j * columns["lateral"]) * np.exp(1j * angle)
    columns["v"], columns["lateral"] = turned.real, turned.imag


def slides(one: Drive, share: float) -> None:
    """Twist and pose move sideways alike."""
    columns = one.odom.columns
    across = share * columns["v"]
    columns["lateral"] = across
    dt = np.diff(one.odom.stamps, prepend=one.odom.stamps[0])
    step = 1j * across * np.exp(1j * columns["yaw"]) * dt
    columns["x"], columns["y"] = columns["x"] + np.cumsum(step.real), columns["y"] + np.cumsum(step.imag)


@dataclass(frozen=True, slots=True)
class Case:
    """A lie, magnitudes of it that must be named, and what names it."""

    lie: Lie
    magnitudes: tuple[float, ...]
    named: str
    topic: str = "/imu/data (sensors.imu)"


CASES = {
    "time jumps back": Case(jump_back, (0.7, 3.0, 15.0), "its stamps jump back by", "/odom (odometry)"),
    "the gyro's time jumps back": Case(gyro_jumps_back, (0.7, 3.0, 15.0), "its stamps jump back by"),
    "time leaps ahead": Case(leap_ahead, (2.0, 30.0, 3600.0), "its stamps leap by", "/odom (odometry)"),
    "two clocks on a topic": Case(two_clocks, (0.7, 100.0), "there are two clocks on it"),
    "since power-up": Case(uptime, (5.0, 123.0), "another clock than the odometry's"),
    "gyro early": Case(gyro_offset, (-0.25, -0.35, -0.7), "before the wheels do"),
    "gyro late": Case(gyro_offset, (0.35, 0.7), "after the wheels do"),
    "gyro far off": Case(gyro_offset, (-5.0, 1.2, 18.0, 3600.0), "another clock than the odometry's"),
    "gyro early, as logged": Case(gyro_offset_logged, (-0.25, -0.35, -1.5), "before the wheels do"),
    "truth off": Case(truth_offset, (-3600.0, -2.0, 18.0), "another clock", "/fix (truth)"),
    "a clock drifts": Case(gyro_drifts, (-0.02, 0.02, 0.05), "another clock than the odometry's"),
    "degrees": Case(gyro_factor, (math.degrees(1.0),), "degrees for radians?"),
    "a factor": Case(gyro_factor, (0.1, 0.5, 2.0, 4.0, 10.0), "times as much as the wheels"),
    "reversed": Case(gyro_factor, (-1.0,), "the gyro turns the other way than the wheels"),
    "another axis": Case(gyro_axis, (0.001, 0.05), "of it"),
    "wheels that never turn": Case(wheels_never_turn, (0.0,), "of it"),
    "whole seconds of the gyro": Case(coarse("sensors.imu"), (0.2, 0.5, 1.0), "when each was measured"),
    "whole seconds": Case(coarse("odometry"), (0.25, 0.5, 1.0), "when each was measured", "/odom (odometry)"),
    "the twist's size": Case(twist_factor, (0.5, 0.7, 1.4, 2.0, 3.6), "its twists move", "/odom (odometry)"),
    "backwards": Case(twist_factor, (-1.0,), "its twists point 1", "/odom (odometry)"),
    "no twist": Case(twist_factor, (0.0,), "and its twists at 0", "/odom (odometry)"),
    "the twist's turn": Case(turn_factor, (0.5, 0.7, 1.4, 2.0), "its twists turn", "/odom (odometry)"),
    "turn in degrees": Case(turn_factor, (math.degrees(1.0),), "degrees for radians?", "/odom (odometry)"),
    "turn reversed": Case(turn_factor, (-1.0,), "its twists turn the other way", "/odom (odometry)"),
    "no turn": Case(turn_factor, (0.0,), "and its twists by 0", "/odom (odometry)"),
    "in the odometry's frame": Case(
        twist_in_odom, (0.0,), "in the frame of the odometry", "/odom (odometry)"
    ),
    "in another frame": Case(twist_turned, (-1.5, 0.4, 1.5), "its twists point", "/odom (odometry)"),
    "a base that slides": Case(slides, (-0.6, 0.15, 0.3), "it moves sideways", "/odom (odometry)"),
}
