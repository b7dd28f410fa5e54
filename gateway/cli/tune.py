"""`gateway tune`: what one joint is (inertia, friction, load, backlash) and its gains, by steps and sines.

Of a recording, or of some motions within a declared travel. Exit status: 0 it was identified; 1 it was, but a
twin with these values is more than 5 % off; 2 it was not.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.bench import excite, tune
from gateway.bench.driven import is_recording
from gateway.bench.joint_trace import JointTrace, traced
from gateway.bench.tune import Identified, Value
from gateway.cli import arguments
from gateway.cli.terminal.consent import ask_consent
from gateway.config import load_robot, parse_robot, with_interfaces
from gateway.core.message_text import escaped
from gateway.core.robot import TWIN, Robot
from gateway.recording import read_recording
from gateway.runtime.session import open_session

SPEED, TRAVEL = 0.5, 3.0
"""Share of the velocity limit, and rad to either side, if none is given"""
WRONG = 0.05
"""Misfit of the twin from which on the answer is no"""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "source", metavar="FILE|ROBOT", help="a recording; or a robot, one joint of which moves"
    )
    parser.add_argument("joint", metavar="JOINT", help="its motor's name in the robot file")
    parser.add_argument("--yes", action="store_true", help="move without asking first")
    parser.add_argument(
        "--travel",
        type=arguments.number("rad"),
        default=TRAVEL,
        metavar="RAD",
        help="rad that it may move to either side of where it is (default: %(default)s)",
    )
    parser.add_argument(
        "--speed",
        type=arguments.number("rad/s"),
        metavar="RAD_PER_S",
        help="rad/s at most (default: half its limit)",
    )
    parser.add_argument(
        "--inertia",
        type=arguments.number("kg·m²"),
        metavar="KGM2",
        help="kg·m² at the output shaft, if it is known: then the factor on the reported torque follows",
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw what was measured and simulated")
    arguments.add_bus(parser, "where the motor's bus is: can0=socketcan:can0")
    arguments.add_seed(parser)


def run(options: Namespace) -> int:
    """Tune, and print what was found."""
    path = Path(options.source)
    if is_recording(path):
        recording = read_recording(path)
        robot = parse_robot(recording.robot_text, str(path))
        trace = traced(robot, options.joint, recording.ticks)
    else:
        robot = with_interfaces(load_robot(options.source), dict(options.bus))
        trace = _moved(robot, options)
    joint = robot.motors[options.joint]
    limit = joint.joint.limits.torque
    one = tune.identify(trace, limit)
    _print(one, options.inertia)
    if options.picture is not None:
        from gateway.cli.picture import draw_joint

        draw_joint(options.picture, one, trace, limit)
        print(f"picture: {options.picture}")
    return 1 if one.misfit > WRONG else 0


def _moved(robot: Robot, options: Namespace) -> JointTrace:
    """Move the joint, and return what it did."""
    trace = JointTrace(robot, options.joint)
    limits = robot.motors[options.joint].joint.limits
    speed = SPEED * limits.velocity if options.speed is None else options.speed
    single = excite.one_motor(robot, options.joint, speed)
    made = excite.Excitation(
        options.joint, excite.parts(limits, speed, options.travel), options.travel, trace
    )
    ask_consent(
        f"{options.joint} will move for {made.span:.0f} s at up to {speed:g} rad/s, within "
        f"{options.travel:g} rad to "
        "either side of where it stands; whatever it carries moves too. Its limits hold; Ctrl-C stops it.",
        options.yes,
    )
    simulated = all(bus.interface == TWIN for bus in single.buses.values())
    with open_session(single, simulated=simulated, seed=options.seed) as session:
        excite.excite(session, made)
    if made.ended:
        print(f"ended before its time: {escaped(made.ended)}", file=sys.stderr)
    return trace


def _print(one: Identified, inertia: float | None) -> None:
    print(f"{one.joint}, at its output shaft (± one standard deviation):")
    rows: list[tuple[str, Value | None, str]] = [
        ("inertia", one.inertia, "kg·m²"),
        ("friction", one.friction, "N·m, dry"),
        ("damping", one.damping, "N·m·s/rad"),
        ("load", one.load, "N·m, driving forward"),
        ("backlash", one.backlash, "rad"),
        ("velocity gain", one.gain, "N·m·s/rad"),
        ("its integral", one.integral, "N·m/rad"),
    ]
    for name, value, unit in rows:
        shown = "not to be seen" if value is None else f"{value.value:.4g} ± {value.sigma:.1g} {unit}"
        print(f"  {name:<14} {shown}")
    if inertia is not None:
        scale = inertia / one.inertia.value
        print(
            f"  torque scale   {scale:.3f}: reported torque × this is the true one; friction and "
            "gains likewise"
        )
    if one.gain is not None:
        print(f"  delay          {1e3 * one.delay:.1f} ms from a set-point to its torque")
        print(f"  lag            {1e3 * one.lag:.1f} ms of the velocity that its loop sees")
        print(
            f"a twin with these values follows the same set-points within {100 * one.misfit:.2f} % of "
            "the fastest"
        )
    bandwidth, gain, integral, position = tune.proposed(one)
    print(f"\nproposed, for a bandwidth of {bandwidth:.0f} rad/s:")
    for name, new, old in (("velocity gain", gain, one.gain), ("its integral", integral, one.integral)):
        now = f" (× {new / old.value:.2f} of what it has)" if old is not None and old.value > 0.0 else ""
        print(f"  {name:<14} {new:.4g}{now}")
    print(f"  position gain  {position:.3g} 1/s")
    if one.gain is not None and tune.bandwidth_of(one) > bandwidth:
        print(
            f"it has {tune.bandwidth_of(one):.0f} rad/s: keep its own where nothing swings; with these it "
            "follows more slowly, and bears more delay and load"
        )
    print("\nfor its twin, in the world file (a bench) or the plant file:")
    print(f"[shafts.{one.joint}]")
    shaft = one.shaft()
    for key in ("inertia", "damping", "friction", "load", "backlash"):
        value = getattr(shaft, key)
        if value or key != "backlash":
            print(f"{key} = {value:.5g}")
