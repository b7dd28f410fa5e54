"""`--only PART` of `replay` and `judge`: one part of a robot alone, on what it was given in a recording."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from gateway.buses.log_file import is_log, logged, summary
from gateway.cli import arguments
from gateway.config import load_robot, parse_robot
from gateway.config.one_setting import with_settings
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.monitor.allowed import GuardOnly
from gateway.monitor.heard import places
from gateway.recording import Recording, read_recording
from gateway.replay.one_part import PARTS, run_alone
from gateway.rosbag import is_bag


def add_only(parser: ArgumentParser) -> None:
    """Add --only and --set."""
    text = (
        "run this part alone, with the settings of --robot and --set, on what it was given in the recording; "
    )
    text += "guard: of a recording or a log of CAN, what would it have allowed?"
    parser.add_argument("--only", choices=[*PARTS, "guard"], help=text)
    arguments.add_settings(parser, "with --only: another value of a setting of the robot file")


def check_only(options: Namespace, others: Sequence[str]) -> None:
    """Refuse what does not go with --only, and --set without it."""
    if options.only is None:
        if options.set:
            raise UserError("--set is for one part alone: give --only PART (or use `gateway again --set`)")
        return
    for name in others:
        if getattr(options, name):
            option = name.replace("_", "-")
            raise UserError(f"--only {options.only} runs one part alone: leave --{option} away")
    if getattr(options, "against", None) is not None:
        if options.robot is not None or options.set:
            text = "has its own settings: leave --robot and --set away"
            raise UserError(
                f"--only {options.only} --against REV runs both versions with what each recording {text}"
            )
        return
    if options.only != "guard" and options.robot is None and not options.set:
        text = "--robot ROBOT, or --set KEY=VALUE"
        raise UserError(f"--only {options.only} runs it with other settings than the recorded: give {text}")


def only(file: Path, options: Namespace) -> tuple[list[str], bool]:
    """Return what a part makes of a recording, in words, and whether that is as it was recorded (of the
    guard: whether all would have been allowed)."""
    if is_bag(file):
        raise UserError(f"{file}: a bag has no frames; --only is for recordings, and of the guard for logs")
    if is_log(file):
        if options.only != "guard":
            text = "nothing in it tells what its program perceived, planned and commanded"
            raise UserError(f"{file} is a log of CAN: {text}; of a log there is --only guard")
        return _log(file, options)
    recording = read_recording(file)
    robot = _robot(options, recording)
    if options.only != "guard":
        found = run_alone(recording, robot, options.only)
        return found.lines(), found.same
    guard = GuardOnly(robot, next((tick.now for tick in recording.ticks), 0))
    for tick in recording.ticks:
        for packet in (*tick.inputs.packets, *tick.outputs.packets):
            guard.take(packet)
    return guard.lines(), guard.sound


def _robot(options: Namespace, recording: Recording | None) -> Robot:
    """Return the robot of --robot, or the recorded one, with the settings of --set."""
    if options.robot is None:
        assert recording is not None, "a log has a robot file"
        text, name = recording.robot_text, f"{recording.path}: robot.toml"
        return parse_robot(with_settings(text, options.set), name)
    robot = load_robot(options.robot, recorded=True)
    return parse_robot(with_settings(robot.text, options.set), options.robot) if options.set else robot


def _log(file: Path, options: Namespace) -> tuple[list[str], bool]:
    if options.robot is None:
        raise UserError(f"{file} is a log of CAN: --robot ROBOT says whose devices were on its buses")
    robot, log = _robot(options, None), summary(file)
    buses, guard = places(robot, log, file), GuardOnly(robot, log.began)
    with suppress(UserError):  # it was told by the summary
        for packet, _ in logged(file):
            if packet.bus in buses:
                guard.take(replace(packet, bus=buses[packet.bus]))
    cut = [f"cut short: {log.error}"] if log.error else []
    return [*guard.lines(), *cut], guard.sound and not log.error
