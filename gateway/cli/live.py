"""`--view`: the options of the live view, and its address as it is printed."""

from __future__ import annotations

import os
import secrets
from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from gateway.errors import UserError

if TYPE_CHECKING:
    from gateway.core.robot import Robot
    from gateway.runtime.session import Session

TOKEN = "MOTOR_GATEWAY_TOKEN"  # noqa: S105 -- the name of a variable
"""Environment variable with the token of the view; without it a new one is made where one is needed."""
DOMAIN, MOST_DOMAIN = "ROS_DOMAIN_ID", 232
"""Environment variable of ROS 2."""


def add_view(parser: ArgumentParser, *, steer: bool = True) -> None:
    """Add --view and what belongs to it."""
    parser.add_argument(
        "--view",
        nargs="?",
        const="",
        metavar="HOST:PORT",
        help="open a live view for a browser and Foxglove (default: 127.0.0.1:8765, or a port that is free)",
    )
    add_origin(parser)
    if steer:
        parser.add_argument(
            "--steer", action="store_true", help="let who looks at the view steer the robot, too"
        )


def add_origin(parser: ArgumentParser) -> None:
    """Add --origin."""
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="URL",
        help="let pages of another site connect to the view, such as https://app.foxglove.dev",
    )


def check_view(options: Namespace) -> None:
    """Raise UserError for options that do not go with --view, or without it."""
    given = ["--origin"] * bool(options.origin) + ["--steer"] * getattr(options, "steer", False)
    if options.view is None and given:
        raise UserError(f"{given[0]} belongs to --view, which is absent")
    if options.view is not None and getattr(options, "fast", False):
        raise UserError("--view shows a run in real time: leave --fast away")


def token_for(address: str) -> str:
    """Return the token that a view at this address needs; "" if it needs none and none is set."""
    from gateway.view import Address, parse_address

    loopback = (parse_address(address) if address else Address()).loopback
    return os.environ.get(TOKEN) or ("" if loopback else secrets.token_urlsafe(16))


def add_ros(parser: ArgumentParser) -> None:
    """Add --ros."""
    parser.add_argument(
        "--ros",
        nargs="?",
        const="",
        metavar="INTERFACE|zenoh",
        help="put it into ROS 2's graph: on this machine alone, or on the network of an interface or address "
        "or (zenoh, zenoh:ENDPOINT) where rmw_zenoh is used",
    )


def domain_of(robot: Robot) -> int:
    """Return the DDS domain: ROS_DOMAIN_ID, else the robot file's. Raises UserError if it is none."""
    text = os.environ.get(DOMAIN, "")
    if not text:
        return robot.ros.domain
    if not text.isdecimal() or not int(text) <= MOST_DOMAIN:
        raise UserError(f"{DOMAIN} is {text!r}, expected a number from 0 to {MOST_DOMAIN}")
    return int(text)


def open_ros(session: Session, options: Namespace) -> None:
    """Enter the graph that is asked for, and print under which name."""
    if options.ros is not None:
        if getattr(options, "fast", False):
            raise UserError("--ros shows a run in real time: leave --fast away")
        print(f"ROS 2: {session.ros(options.ros, domain=domain_of(session.robot))}", flush=True)


def open_view(session: Session, options: Namespace) -> None:
    """Open the view that is asked for, and print its address."""
    if options.view is not None:
        steer = getattr(options, "steer", False)
        url = session.view(options.view, steer=steer, token=token_for(options.view), origins=options.origin)
        print(f"live view{'' if steer else ' (read-only)'}: {url}", flush=True)


def view_on_demand(session: Session, words: str) -> str:
    """Open the view of a session that runs, as an operator's `view [HOST:PORT] [steer]` asks, unless one is
    open and nothing else is asked for; return its address, or why not."""
    asked = words.split()
    if session.view_url and not asked:
        return session.view_url  # as it was opened
    steer = asked[-1:] == ["steer"]
    address = " ".join(asked[:-1] if steer else asked)
    if any(joint.armed for joint in session.joints.values()):
        return "a motor is armed: the view takes too long to open; stop first, or begin with --view"
    try:
        return session.view(address, steer=steer, token=token_for(address))
    except UserError as error:
        return str(error)
