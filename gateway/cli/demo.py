"""`gateway demo`: a tour or a mission in a simulated world; its figures, its recording, and a picture of
it."""

from __future__ import annotations

import resource
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from itertools import pairwise
from math import degrees, dist
from pathlib import Path

from brain.belief import Belief, MissionView
from gateway.cli import arguments
from gateway.cli.live import add_ros, add_view, check_view, open_ros, open_view
from gateway.cli.picture import draw
from gateway.cli.reports import add_report, reported
from gateway.cli.run import goals_of, print_recording
from gateway.cli.terminal.progress import Progress, progress
from gateway.cli.tour import Tour
from gateway.config import load_robot
from gateway.config.mission import load_mission
from gateway.core.clock import stopwatch
from gateway.errors import UserError
from gateway.runtime.realtime import realtime, wanted_of
from gateway.runtime.session import Session, open_session
from gateway.runtime.timing import SLOW
from protocols.messages import SECOND, Goal, Mission, Nanos

GOAL_TIMEOUT: Nanos = 240 * SECOND
"""How long the demo waits for one goal, in the robot's time."""
MISSION_TIMEOUT: Nanos = 1200 * SECOND
"""And for a mission."""
PROGRESS_PERIOD: Nanos = SECOND
"""Between two lines of progress, in wall time."""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--fast", action="store_true", help="as fast as the machine can, not in real time")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out"),
        metavar="DIR",
        help="folder for recording and picture (default: out)",
    )
    parser.add_argument("--robot", default="diffbot", metavar="ROBOT", help="another robot file")
    add_report(parser)
    arguments.add_seed(parser)
    arguments.add_realtime(parser)
    arguments.add_goal(parser, "drive here, instead of the world's tour")
    parser.add_argument("--mission", metavar="FILE", help="do this mission, instead of the world's tour")
    add_view(parser)
    add_ros(parser)


def run(options: Namespace) -> int:
    """Return 1 unless the true pose was near every goal, or the mission is done, and every motor is disarmed
    or holds."""
    check_view(options)
    wanted = wanted_of(options.realtime)
    robot = load_robot(options.robot)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {options.out}: {error.strerror}") from error
    asked = goals_of(options, robot)
    recording, picture = options.out / "demo.mcap", options.out / "demo.png"
    recording.unlink(missing_ok=True)
    with (
        open_session(robot, simulated=options.fast, record=recording, seed=options.seed) as session,
        reported(session, options.report, "demo") as ending,
    ):
        open_view(session, options)
        open_ros(session, options)
        mission, goals = _choice(options, session, asked)
        tour = Tour(session, goals)
        began = stopwatch()
        metres = round(sum(_straight(goals)), 1)
        what, total = ("tour, metres", metres) if mission is None else ("mission, steps", len(mission.steps))
        with progress(what, total) as shown, realtime(wanted, robot):
            (_follow if mission is None else partial(_do, mission))(session, tour, shown)
        took = stopwatch() - began
        done = tour.done if mission else tour.near == len(goals)
        ending.ok = done and not session.gateway.still_armed()
        ending.figures = tuple(tour.figures())
        ending.walls = tuple(map(tuple, tour.outlines))
    print("\n".join(ending.figures))
    _print_costs(session, tour.seconds * SECOND, took)
    draw(tour, picture)
    print_recording(session)
    if options.report is not None:
        print(f"report: {options.report}")
    print(f"picture: {picture}\nreplay it: gateway replay {recording}")
    return 0 if ending.ok else 1


def _choice(options: Namespace, session: Session, goals: list[Goal]) -> tuple[Mission | None, list[Goal]]:
    """Return the mission, or the goals: those asked for, else the world's own."""
    assert session.twins is not None
    world = session.twins.world
    if options.mission or (world.mission and not goals):
        return load_mission(options.mission or world.mission, session.robot), []
    if not goals and not world.tour:
        raise UserError(f"the world of {session.robot.name!r} has no tour: name goals with --goal X,Y")
    return None, goals or session.tour()


def _do(mission: Mission, session: Session, tour: Tour, shown: Progress) -> None:
    """Do a mission, until it ends."""
    session.submit(mission)
    printed = stopwatch()
    with closing(session.run()) as ticks:
        for tick in ticks:
            tour.on_tick(tick)
            view = tour.belief.mission
            if view is not None and view.phase not in ("running", "paused"):
                shown.clear()
                print(f"mission {view.name} {view.phase}{view.reason and ': '}{view.reason}")
                break
            if stopwatch() - printed > PROGRESS_PERIOD:
                printed = stopwatch()
                doing = f"step {view.step} of {view.steps}: {view.text}" if view else ""
                shown.clear()
                print(f"{_progress(session, tour.belief, tick.now)}  {doing}", flush=True)
            if view is not None:
                shown.update(_steps_done(view))
            stopped = session.gateway.why_stopped()
            if stopped or tick.now > MISSION_TIMEOUT:
                why = stopped or f"not done after {MISSION_TIMEOUT / SECOND:.0f} s"
                shown.clear()
                print(f"mission {mission.name} abandoned: {why}", file=sys.stderr)
                break


def _follow(session: Session, tour: Tour, shown: Progress) -> None:
    """Send one goal after the other, the next when the brain reports the last as reached."""
    goals, arrivals = tour.goals, tour.arrivals
    sent: Nanos = session.clock.now()
    printed = stopwatch()
    session.submit(goals[0])
    with closing(session.run()) as ticks:
        for tick in ticks:
            reached = len(arrivals)
            tour.on_tick(tick)
            if len(arrivals) == len(goals):
                break
            if len(arrivals) > reached:
                session.submit(goals[len(arrivals)])
                sent = tick.now
            if stopwatch() - printed > PROGRESS_PERIOD:
                printed = stopwatch()
                where = _progress(session, tour.belief, tick.now)
                shown.clear()
                print(f"{where}  goals {tour.belief.reached}/{len(goals)}", flush=True)
            shown.update(_way_done(tour))
            stopped = session.gateway.why_stopped()
            if stopped or tick.now - sent > GOAL_TIMEOUT:
                why = stopped or f"not reached after {GOAL_TIMEOUT / SECOND:.0f} s"
                shown.clear()
                print(f"goal {len(arrivals) + 1} abandoned: {why}", file=sys.stderr)
                break


def _straight(goals: Sequence[Goal]) -> list[float]:
    """Return the straight ways [m] from the start to the first goal, and from each to the next."""
    places = [(0.0, 0.0), *((goal.x, goal.y) for goal in goals)]
    return [dist(a, b) for a, b in pairwise(places)]


def _way_done(tour: Tour) -> float:
    """Return how much [m] of the straight ways is done."""
    ways, reached, estimate = _straight(tour.goals), len(tour.arrivals), tour.belief.estimate
    if estimate is None or reached == len(ways):
        return sum(ways[:reached])
    goal = tour.goals[reached]
    left = dist((estimate.pose.x, estimate.pose.y), (goal.x, goal.y))
    return sum(ways[:reached]) + max(0.0, ways[reached] - left)


def _steps_done(view: MissionView) -> int:
    """Return how many steps of a mission are behind it."""
    return int(view.step.partition(".")[0]) - 1 if view.step else view.steps


def _print_costs(session: Session, simulated: float, took: Nanos) -> None:
    stats = session.stats
    print(f"{stats.ticks} ticks in {took / SECOND:.1f} s: {simulated / took:.1f} times real time")
    if stats.missed:
        print(f"ticks missed: {stats.missed}")
    print(f"memory: at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def _progress(session: Session, belief: Belief, now: Nanos) -> str:
    """Return where it is and how it goes, in one line."""
    estimate = belief.estimate
    where = ""
    if estimate is not None:
        x, y, yaw = estimate.pose.x, estimate.pose.y, degrees(estimate.pose.yaw)
        where = f"at {x:6.2f}, {y:6.2f} m, {yaw:4.0f}°, {estimate.linear:5.2f} m/s"
    why = f" ({belief.reason})" if belief.reason else ""
    pace = session.stats.pace
    slow = f"  slow motion: {pace:.2f} of real time" if pace < SLOW else ""
    return f"{now / SECOND:6.1f} s  {belief.state:<12} {where}{why}{slow}"
