"""basicmicro 2.0.10, the vendor's SDK, on our twins of both motors of a board, over a pty."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from protocols.messages import Idle, Mode, Position, Velocity
from protocols.plugin import Device, join
from protocols.roboclaw import plugin
from protocols.roboclaw.options import Options, Settings
from protocols.roboclaw.twin import RoboclawTwin
from tests.protocols.on_pty import put, run_client

CLIENT = """
import json, sys
from basicmicro import Basicmicro
rc = Basicmicro(sys.argv[1], 38400); assert rc.Open(); a = 0x80
rc._port.timeout = 60.0  # else it asks again after a second, and takes one answer for the next
said = []
for name, *arguments in json.loads(%r):
    said.append(getattr(rc, name)(a, *arguments))
print(json.dumps(said))
"""
OPTIONS = Options(counts=8192)
CALLS: tuple[tuple[list[Any], Any], ...] = (
    (["ReadVersion"], [True, "USB Roboclaw 2x15a v4.2.3\n"]),
    (["SetTimeout", 1.0], True),
    (["GetTimeout"], [True, 1.0]),
    (["ReadEncM1"], [1, 2048, 0]),
    (["ReadEncM2"], [1, (1 << 32) - 4096, 2]),
    (["GetEncoders"], [1, 2048, (1 << 32) - 4096]),
    (["ReadSpeedM1"], [1, 819, 0]),
    (["GetSpeeds"], [1, 819, (1 << 32) - 1638]),
    (["ReadISpeedM1"], [1, 819, 0]),
    (["ReadISpeedM2"], [1, (1 << 32) - 1638, 1]),
    (["GetISpeeds"], [1, 819, (1 << 32) - 1638]),
    (["ReadMainBatteryVoltage"], [1, 240]),
    (["ReadLogicBatteryVoltage"], [1, 240]),
    (["ReadTemp"], [1, 300]),
    (["ReadTemp2"], [1, 300]),
    (["GetVolts"], [True, 240, 240]),
    (["GetTemps"], [1, 300, 300]),
    (["ReadError"], [1, 0x2000]),
    (["ReadPWMs"], [True, 0, 0]),
    (["ReadCurrents"], [True, 0, 0]),
    (["ReadBuffers"], [1, 128, 128]),
    (["ReadM1VelocityPID"], [True, 1.0, 0.5, 0.25, 44000]),
    (["SetM2VelocityPID", 2.0, 1.0, 0.5, 30000], True),
    (["ReadM2VelocityPID"], [True, 2.0, 1.0, 0.5, 30000]),
    (["SetM1MaxCurrent", 2500, 0], True),
    (["ReadM1MaxCurrent"], [True, 2500, 0]),
    (["ReadM2MaxCurrent"], [True, 1500, 0]),
    (["GetConfig"], [True, 3]),
    (["SetConfig", 0x63], True),
    (["GetConfig"], [True, 0x63]),
    (["DutyM1", -16384], True),
    (["ReadPWMs"], [True, -16384, 0]),
    (["DutyM1M2", 0, 0], True),
    (["SpeedM1", -2500], True),
    (["SpeedM1M2", 1000, -1000], True),
    (["SpeedAccelM1", 12000, 3000], True),
    (["SpeedAccelM1M2", 12000, 3000, -3000], True),
    (["DutyAccelM1", 1000, 8192], True),
    (["DutyAccelM1M2", 1000, 8192, 1000, -8192], True),
    (["PositionM1", 8192, 0], True),
    (["SpeedAccelDeccelPositionM1M2", 1000, 2000, 1000, 4096, 1000, 2000, 1000, 8192, 1], True),
    (["SpeedAccelDeccelPositionM1", 1000, 2000, 1000, -4096, 1], True),
    (["SetEncM2", 77], True),
    (["ReadEncM2"], [1, 77, 2]),
    (["ResetEncoders"], True),
    (["GetEncoders"], [1, 0, 0]),
    (["WriteNVM"], True),
    (["ResetEStop"], True),
)
"""Each call, and what it returns."""
ENDS: tuple[tuple[list[Any], Mode, Any], ...] = (
    (["SpeedM1", -2500], Mode.ARMED, Velocity("left", -2500 * OPTIONS.unit)),
    (["SpeedM1M2", 1000, -1000], Mode.ARMED, Velocity("left", 1000 * OPTIONS.unit)),
    (["SpeedAccelM1", 12000, 3000], Mode.ARMED, Velocity("left", 3000 * OPTIONS.unit)),
    (["PositionM1", 8192, 1], Mode.ARMED, Position("left", math.tau)),
    (["SpeedAccelDeccelPositionM1", 1000, 2000, 1000, -4096, 1], Mode.ARMED, Position("left", -math.pi)),
    (["DutyM1", 0], Mode.READY, Idle("left")),
)


def board(settings: Settings | None = None) -> list[RoboclawTwin]:
    """Both motors of a board."""
    made = [
        plugin.twin(Device(name, at, OPTIONS, settings or Settings()), at)
        for name, at in (("left", 128), ("right", 136))
    ]
    return [twin for twin in made if isinstance(twin, RoboclawTwin)]


def test_each_call_returns_what_the_board_is() -> None:
    left, right = board()
    for twin, name, position, velocity in (
        (left, "left", math.pi / 2, 0.6283185),
        (right, "right", -math.pi, -1.2566371),
    ):
        put(twin, name, position, velocity)
    right.provoke(0x1000)
    left.passing = right.passing = 0
    said = json.loads(run_client(CLIENT % json.dumps([call for call, _ in CALLS]), [left, right]))
    for (call, wanted), one in zip(CALLS, said, strict=True):
        assert one == pytest.approx(wanted) if call[0] == "GetTimeout" else one == wanted, call


@pytest.mark.parametrize(("call", "mode", "goal"), ENDS, ids=lambda each: str(each))
def test_what_it_commands_is_obeyed(call: list[Any], mode: Mode, goal: Any) -> None:
    left, right = board()
    run_client(CLIENT % json.dumps([call]), [left, right])
    assert left.mode is mode
    assert left.goal == goal


def test_older_firmware_has_a_status_of_16_bits() -> None:
    left, right = board(Settings(older_status=True))
    join([left, right])
    for twin in (left, right):
        twin.step(0, [])
    right.provoke(0x40)
    left.receive(1_000_000, b"\x80\x5a")
    (answer,) = left.step(2_000_000, [])[1]
    assert isinstance(answer, bytes)
    assert answer[:2] == b"\x02\x00"
