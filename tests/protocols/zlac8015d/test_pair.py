"""Two motors of one drive: one node, one power state, one transfer at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from protocols import messages as msg
from protocols.canopen import pdo, sdo, services
from protocols.conformance.bench import Bench, StepResult, make_bench
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Mode
from protocols.plugin import Device
from protocols.zlac8015d import plugin
from protocols.zlac8015d import table as z
from protocols.zlac8015d.options import Options, Settings
from protocols.zlac8015d.twin import ZlacTwin
from tests.sampled import sampled

NAMES = ("left", "right")


def pair(sdo_ms: int = 0, **options: int) -> Bench:
    """Return both motors of node 5; the drive takes `sdo_ms` for each transfer."""
    bench = make_bench(plugin, Options(**options), (5, 5 + z.RIGHT_OFFSET), NAMES)
    for twin in bench.twins:
        assert isinstance(twin, ZlacTwin)
        twin.sender.sdo_delay = sdo_ms * MILLISECOND
    return bench


def turn(left: float, right: float) -> list[Command]:
    return [msg.Velocity("left", left), msg.Velocity("right", right)]


def until(bench: Bench, holds: Callable[[], bool], commands: Sequence[Command] = (), most: int = 5000) -> int:
    """Step until it holds; return after how many steps."""
    for count in range(most):
        if holds():
            return count
        bench.step(commands)
    raise AssertionError(f"not within {most} ms: {bench.modes}")


def armed(bench: Bench) -> bool:
    return all(bench.modes.get(name) is Mode.ARMED for name in NAMES)


def energised(bench: Bench) -> bool:
    return any(isinstance(twin, ZlacTwin) and twin.mode is Mode.ARMED for twin in bench.twins)


def details(steps: Sequence[StepResult], motor: str) -> list[str]:
    states = [event for step in steps for event in step.events if isinstance(event, msg.State)]
    return [state.detail for state in states if state.motor == motor]


def faults(steps: Sequence[StepResult], motor: str) -> list[str]:
    found = [event for step in steps for event in step.events if isinstance(event, msg.Fault)]
    return [fault.name for fault in found if fault.motor == motor]


def test_both_turn_each_by_its_own_command() -> None:
    bench = pair()
    until(bench, lambda: armed(bench), turn(2.0, -3.0))
    steps = bench.steps(1000, turn(2.0, -3.0))
    assert bench.shafts["left"].velocity == pytest.approx(2.0, abs=z.RPM)
    assert bench.shafts["right"].velocity == pytest.approx(-3.0, abs=z.RPM)
    measured = {
        e.motor: e for step in steps for e in step.events if isinstance(e, msg.Feedback) and e.velocity
    }
    assert measured["left"].velocity == pytest.approx(2.0, abs=z.RPM)
    assert measured["right"].velocity == pytest.approx(-3.0, abs=z.RPM)


def test_one_set_point_is_one_frame_for_both() -> None:
    bench, commands = pair(), turn(10 * z.RPM, -1 * z.RPM)
    until(bench, lambda: armed(bench), commands)
    bench.steps(20, commands)
    down = [frame for step in bench.steps(50, commands) for frame in step.down]
    assert {frame.id for frame in down if isinstance(frame, CanFrame)} == {0x305}
    assert set(down[1::2]) == {CanFrame(0x305, bytes.fromhex("0a00ffff"))}


def test_a_drive_gets_one_request_at_a_time() -> None:
    bench, asked, answered, open_ = pair(sdo_ms=3), 0, 0, set[int]()
    bench.steps(2)
    for step in bench.steps(2000, turn(1.0, 1.0)):
        answered += sum(isinstance(frame, CanFrame) and frame.id == 0x585 for frame in step.up)
        asked += sum(isinstance(frame, CanFrame) and frame.id == 0x605 for frame in step.down)
        open_.add(asked - answered)
    assert max(open_) - min(open_) <= 1
    assert asked > 100


def test_one_motor_waits_for_the_other_without_a_fault() -> None:
    bench = pair()
    steps = bench.steps(16_000, [msg.Velocity("left", 1.0)])
    assert not energised(bench)
    assert details(steps, "left")[-1] == "switch on disabled, waits for the other motor"
    assert not faults(steps, "left")
    until(bench, lambda: armed(bench), turn(1.0, 0.0))


@pytest.mark.parametrize("idle", NAMES)
def test_idle_for_either_disarms_both(idle: str) -> None:
    bench = pair()
    until(bench, lambda: armed(bench), turn(1.0, 1.0))
    commands = [msg.Idle(name) if name == idle else msg.Velocity(name, 1.0) for name in NAMES]
    until(bench, lambda: not energised(bench), commands, 50)
    bench.steps(1000, commands)
    assert not energised(bench)
    assert bench.modes == dict.fromkeys(NAMES, Mode.READY)
    until(bench, lambda: armed(bench), turn(1.0, 1.0))


@pytest.mark.parametrize("at", sampled(range(0, 9000, 611), 4))
def test_idle_at_any_moment_disarms_a_slow_drive(at: int) -> None:
    bench = pair(sdo_ms=60, sdo_timeout_ms=500, offline_ms=5000, timeout_ms=2000)
    bench.steps(at, turn(1.0, 1.0))
    idle = [msg.Idle(name) for name in NAMES]
    bench.steps(400, idle)
    assert not energised(bench)
    bench.steps(500, idle)
    assert not energised(bench)


def test_a_slow_drive_is_enabled_and_stops_at_zero() -> None:
    bench = pair(sdo_ms=60, sdo_timeout_ms=500, offline_ms=5000, timeout_ms=2000)
    until(bench, lambda: armed(bench), turn(2.0, 2.0), 12_000)
    bench.steps(1500, turn(2.0, 2.0))
    assert bench.shafts["left"].velocity == pytest.approx(2.0, abs=z.RPM)
    bench.steps(1000, turn(0.0, 0.0))
    assert [shaft.velocity for shaft in bench.shafts.values()] == pytest.approx([0.0, 0.0], abs=0.02)


def test_a_fault_of_one_motor_stops_both_until_cleared() -> None:
    bench = pair()
    until(bench, lambda: armed(bench), turn(1.0, 1.0))
    bench.twins[1].provoke(0x8)
    steps = bench.steps(200, turn(1.0, 1.0))
    assert (faults(steps, "left"), faults(steps, "right")) == (["the other motor is in fault"], ["overload"])
    assert not energised(bench)
    answers = bench.step([msg.ClearFault("left")]).events, *(step.events for step in bench.steps(200))
    assert [each.request for events in answers for each in events if isinstance(each, msg.Done)] == [
        "ClearFault"
    ]
    assert bench.modes == dict.fromkeys(NAMES, Mode.READY)
    until(bench, lambda: armed(bench), turn(1.0, 1.0))


@pytest.mark.parametrize("half", [0, 1])
def test_a_fault_of_the_drive_is_that_of_both(half: int) -> None:
    bench = pair()
    bench.steps(200)
    bench.twins[half].provoke(0x2)
    steps = bench.steps(200)
    assert faults(steps, "left") == faults(steps, "right") == ["under-voltage"]


@pytest.mark.parametrize("side", [z.LEFT, z.RIGHT])
def test_every_fault_is_in_the_half_of_its_side(side: int) -> None:
    for code in z.FAULTS.keys() - {z.OTHER_MOTOR}:
        value = code << 16 if side == z.RIGHT and not code & z.OF_DRIVE else code
        assert z.faults_of(value, side) == {code}
        other = z.LEFT + z.RIGHT - side
        assert z.faults_of(value, other) == ({code} if code & z.OF_DRIVE else {z.OTHER_MOTOR})
    assert z.faults_of(0x4000 << 16 * (side - 1), side) == {z.UNKNOWN}


def test_a_drive_that_restarts_is_set_up_again() -> None:
    bench = pair(timeout_ms=300)
    until(bench, lambda: armed(bench), turn(1.0, 1.0))
    reset = services.encode(services.Nmt(services.NmtCommand.RESET_NODE, 5))
    bench.step(turn(1.0, 1.0), extra_down=[reset])
    frames = [frame for step in bench.steps(500, turn(1.0, 1.0)) for frame in step.down]
    written = [frame.data[:5].hex() for frame in frames if isinstance(frame, CanFrame)]
    assert armed(bench)
    assert written.index("2b0020002c") < written.index("2b4060000f")  # 300 ms before it is enabled


def test_the_right_motor_alone() -> None:
    bench = make_bench(plugin, Options(), (5 + z.RIGHT_OFFSET,), ("right",))
    command = [msg.Velocity("right", 2.0)]
    until(bench, lambda: bench.modes.get("right") is Mode.ARMED, command)
    bench.steps(500, command)
    assert bench.shafts["right"].velocity == pytest.approx(2.0, abs=z.RPM)


def test_motors_of_a_drive_have_the_same_options() -> None:
    devices = [
        Device(name, at, Options(timeout_ms=at), Settings())
        for name, at in zip(NAMES, (50, 178), strict=True)
    ]
    with pytest.raises(ValueError, match="left: both motors of a drive must have the same options"):
        plugin.driver(devices)
    for address in (0, 128, 256):
        with pytest.raises(ValueError, match="must be 1 to 127, or 129 to 255"):
            plugin.spec(Device("left", address, Options(), Settings()))


@pytest.mark.sample(1)
@pytest.mark.parametrize("index", [0x1401, 0x1800, 0x1802])
def test_a_pdo_that_a_late_copy_of_a_write_has_disabled_is_set_up_again(index: int) -> None:
    """Without set-points or reports no drive stays enabled; commanded on, it is armed and obeys again."""
    bench, cob = pair(), {0x1401: 0x305, 0x1800: 0x185, 0x1802: 0x385}[index]
    until(bench, lambda: armed(bench), turn(2.0, -2.0))
    write = sdo.encode(sdo.Download(index, 1, (cob | pdo.DISABLED).to_bytes(4, "little")))
    for twin in bench.twins:
        twin.receive(bench.now, CanFrame(services.sdo_rx_id(5), write))
    bench.steps(4000, turn(0.0, 3.0))
    until(bench, lambda: armed(bench), turn(0.0, 3.0))
    bench.steps(500, turn(0.0, 3.0))
    assert bench.shafts["left"].velocity == pytest.approx(0.0, abs=z.RPM)
    assert bench.shafts["right"].velocity == pytest.approx(3.0, abs=z.RPM)
