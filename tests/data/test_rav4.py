"""A minute of a car's CAN by its DBC file, against what its recorder's own decoder made of the frames."""

from __future__ import annotations

import io
import re
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gateway.buses.log_file import logged
from gateway.cli.main import main
from gateway.monitor.dbc import DbcSignals

WHEELS = re.compile(r"WHEEL_SPEED_(FL|FR|RL|RR) ([\d.]+) km/h")
STEER = re.compile(r"STEER_ANGLE (-?[\d.]+) deg, STEER_FRACTION (-?[\d.]+) deg")
LOG, DBC = "rav4/raw_can_src0.candump.log.gz", "rav4/_toyota_2017.dbc"


@pytest.fixture(scope="module")
def texts(recording: Callable[[str], Path]) -> dict[str, list[str]]:
    """What the file says of each frame, by message."""
    signals, found = DbcSignals(recording(DBC)), dict[str, list[str]]()
    for packet, _ in logged(recording(LOG)):
        name, _, text = signals.take(packet).partition(": ")
        found.setdefault(name, []).append(text)
    assert signals.others == len(found.pop(""))
    return found


def decoded(recording: Callable[[str], Path], name: str) -> NDArray[np.float64]:
    with tarfile.open(recording("rav4/compact.tar.xz")) as archive:
        file = archive.extractfile(f"processed_log/CAN/{name}/value")
        assert file is not None
        values: NDArray[np.float64] = np.load(io.BytesIO(file.read()))
    return values


def test_wheel_speeds_are_those_of_its_recorders_decoder(
    texts: dict[str, list[str]], recording: Callable[[str], Path]
) -> None:
    theirs = decoded(recording, "wheel_speed")  # front left, front right, rear left, rear right: m/s
    speeds = [dict(WHEELS.findall(text)) for text in texts["WHEEL_SPEEDS"]]
    ours = np.array([[float(one[wheel]) / 3.6 for wheel in ("FL", "FR", "RL", "RR")] for one in speeds])
    assert abs(len(ours) - len(theirs)) <= 1
    assert np.abs(ours[: len(theirs)] - theirs[: len(ours)]).max() < 1e-3


def test_so_is_the_steering(texts: dict[str, list[str]], recording: Callable[[str], Path]) -> None:
    theirs = decoded(recording, "steering_angle")  # degrees
    found = [STEER.match(text) for text in texts["STEER_ANGLE_SENSOR"]]
    ours = np.array([float(one[1]) + float(one[2]) for one in found if one is not None])
    assert abs(len(ours) - len(theirs)) <= 1
    assert np.abs(ours[: len(theirs)] - theirs[: len(ours)].reshape(-1)).max() < 1e-3


def test_the_page_has_each_message_once(
    recording: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["watch", str(recording(LOG)), "--dbc", str(recording(DBC)), "--seconds", "2"]) == 0
    printed = capsys.readouterr().out
    assert re.search(
        r"^by _toyota_2017.dbc: 2\d of its 50 messages were seen; \d+ frames are of other ids$", printed, re.M
    )
    assert re.search(r"^  can0 1C4 ENGINE_RPM \d\d\.\d/s  RPM [\d.]+ rpm, ENGINE_RUNNING 1$", printed, re.M)
