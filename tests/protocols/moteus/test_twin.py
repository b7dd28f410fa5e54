"""The twin alone: what it obeys, reports and refuses, mode by mode (README, "the twin")."""

from __future__ import annotations

from math import isnan, nan, tau

import pytest

from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Feedback
from protocols.moteus.codec import (
    F32,
    INT8,
    INT16,
    INT32,
    REPLY,
    Error,
    Query,
    Raw,
    Values,
    command_id,
    encode,
    make_frame,
    reply_id,
    write,
)
from protocols.moteus.faults import FAULTS, TIMEOUT
from protocols.moteus.messages import (
    DISCOVER,
    STOP,
    Limits,
    console,
    masked,
    position_command,
    torque_command,
)
from protocols.moteus.options import Options, Settings
from protocols.moteus.registers import Mode, Register
from protocols.moteus.reply import FAST, decode
from protocols.moteus.twin import MoteusTwin
from tests.protocols.moteus.helpers import device, free_shaft, rev, subframes

LIMITS = Limits(10.0)


def mode(value: Mode, *rest: bytes) -> bytes:
    return write(Register.MODE, float(value), resolution=INT8) + b"".join(rest)


class Rig:
    """One twin, its shaft, and a host that sends bytes."""

    def __init__(self, settings: Settings | None = None, address: int = 1, seed: int = 0) -> None:
        self.device = device("left", address, settings)
        self.twin = MoteusTwin(self.device, seed)
        self.shaft = free_shaft()
        self.now = 1_000_000 * MILLISECOND
        self.run(1)

    def run(self, milliseconds: int) -> list[CanFrame]:
        """What it sent meanwhile."""
        out: list[CanFrame] = []
        for _ in range(milliseconds):
            truth = Feedback("left", self.now, self.shaft.position, self.shaft.velocity)
            torques, frames = self.twin.step(self.now, [truth])
            self.shaft.turn(torques[0].torque, MILLISECOND)
            out += [w for w in frames if isinstance(w, CanFrame)]
            self.now += MILLISECOND
        return out

    def send(self, data: bytes, to: int = 1, milliseconds: int = 1) -> list[CanFrame]:
        """Send it, and run on. Returns the replies."""
        self.twin.receive(self.now, make_frame(command_id(to), data))
        return self.run(milliseconds)

    def report(self, register: int, resolution: int = F32) -> Raw | None:
        """The encoded value of one register; None for an error."""
        (answer,) = self.send(encode(Query(register, resolution, 1)))
        (reported,) = subframes(answer)
        return reported.raw[0] if isinstance(reported, Values) else None

    def value(self, register: int) -> float | None:
        """One register, as a quantity."""
        (answer,) = self.send(encode(Query(register, F32, 1)))
        reported = decode(answer.data)
        return reported.values[register] if reported else None

    @property
    def mode(self) -> int:
        return self.twin.servo.mode


# -- modes ---------------------------------------------------------------------------------------------


def test_from_stopped_it_enables_first() -> None:
    rig = Rig(Settings(enable_ms=10))
    seen = [rig.mode]
    for _ in range(14):
        rig.send(position_command(0.0, 0.0, 0.0, LIMITS))
        seen.append(rig.mode)
    assert list(dict.fromkeys(seen)) == [Mode.STOPPED, Mode.ENABLING, Mode.CALIBRATING, Mode.POSITION]
    assert rig.twin.servo.torque() == 0.0


def test_a_query_gets_the_state_before_the_command_of_its_frame() -> None:
    rig = Rig()
    rig.send(position_command(0.0, 0.0, 0.0, LIMITS), milliseconds=20)
    (answer,) = rig.send(STOP + FAST)
    reported = decode(answer.data)
    assert reported is not None
    assert reported.values[Register.MODE] == Mode.POSITION
    assert rig.mode == Mode.STOPPED


@pytest.mark.parametrize("latched", [Mode.FAULT, Mode.TIMEOUT])
def test_only_a_stop_leaves_fault_and_timeout(latched: Mode) -> None:
    rig = Rig()
    rig.send(position_command(0.0, 0.0, 0.0, LIMITS), milliseconds=20)
    rig.twin.provoke(38 if latched == Mode.FAULT else TIMEOUT)
    for value in (Mode.POSITION, Mode.CURRENT, Mode.BRAKE, Mode.ZERO_VELOCITY):
        rig.send(mode(value), milliseconds=20)
        assert rig.mode == latched
    rig.send(STOP)
    assert (rig.mode, rig.report(Register.FAULT, INT8)) == (Mode.STOPPED, 0)
    rig.send(position_command(0.0, 0.0, 0.0, LIMITS), milliseconds=20)
    assert rig.mode == Mode.POSITION


@pytest.mark.parametrize("code", FAULTS)
@pytest.mark.parametrize("running", [False, True])
def test_every_fault_can_be_provoked_and_gives_no_torque(code: int, running: bool) -> None:
    rig = Rig()
    if running:
        rig.send(position_command(None, 2.0, 0.0, LIMITS), milliseconds=100)
    rig.twin.provoke(code)
    rig.run(5)
    if code == TIMEOUT:
        assert rig.mode == Mode.TIMEOUT
        return
    assert (rig.mode, rig.report(Register.FAULT, INT8)) == (Mode.FAULT, code)
    assert rig.twin.servo.torque() == 0.0


def test_a_fault_that_it_does_not_have() -> None:
    with pytest.raises(ValueError, match="no fault 96"):
        Rig().twin.provoke(96)


def test_what_a_frame_does_not_name_falls_back_to_its_default() -> None:
    rig = Rig()
    rig.shaft.position = rev(0.75)
    rig.run(5)
    rig.send(position_command(0.75, 0.0, 0.0, Limits(10.0, 0.5)), milliseconds=20)
    assert rig.value(Register.COMMAND_POSITION_MAX_TORQUE) == 0.5
    rig.send(mode(Mode.POSITION), milliseconds=60)  # no position: 0, and the motor turns there
    assert rig.value(Register.COMMAND_POSITION) == 0.0
    assert rig.value(Register.COMMAND_POSITION_MAX_TORQUE) is None
    assert rig.value(Register.COMMAND_KP_SCALE) == 1.0
    assert rig.shaft.position < rev(0.7)


def test_registers_without_a_mode_change_nothing() -> None:
    rig = Rig()
    rig.send(position_command(0.0, 0.0, 0.0, LIMITS), milliseconds=20)
    rig.send(write(Register.COMMAND_POSITION, 5.0), milliseconds=100)
    assert rig.shaft.position == pytest.approx(0.0, abs=0.01)


def test_a_repeated_position_command_begins_again() -> None:
    rig = Rig()
    for _ in range(10):
        rig.send(position_command(0.25, 1.0, 0.0, LIMITS), milliseconds=10)
    assert rig.value(Register.CONTROL_POSITION) == pytest.approx(0.26, abs=0.002)


def test_without_a_position_it_goes_on_from_its_set_point() -> None:
    rig = Rig()
    rig.send(position_command(3.0, 0.0, 0.0, LIMITS), milliseconds=30)
    rig.send(position_command(None, 0.0, 0.0, LIMITS), milliseconds=30)
    assert rig.value(Register.CONTROL_POSITION) == pytest.approx(3.0)


def test_kd_is_scaled_no_higher_than_kp() -> None:
    rig = Rig()
    rig.shaft.locked, rig.shaft.velocity = True, 0.0
    rig.send(mode(Mode.POSITION, write(Register.COMMAND_POSITION, None, 1.0, 0.0, 0.0, 1.0)), milliseconds=30)
    assert rig.value(Register.POSITION_KD) == 0.0


CURRENT_2A = mode(Mode.CURRENT, write(Register.COMMAND_Q_CURRENT, 2.0))
KT = 8.27 / 304
"""N·m/A"""


@pytest.mark.parametrize(
    ("data", "then", "torque", "current", "limit"),
    [
        # a command to a shaft that is held → N·m, A, and the limit that the fault register reports
        (torque_command(0.0, 0.25, LIMITS), Mode.POSITION, 0.25, 0.25 / KT, 0),
        (position_command(5.0, 0.0, 0.0, Limits(10.0, 0.125)), Mode.POSITION, 0.125, 0.125 / KT, 102),
        (torque_command(0.0, 9.0, LIMITS), Mode.POSITION, 40.0 * KT, 40.0, 99),
        (CURRENT_2A, Mode.CURRENT, 2.0 * KT, 2.0, 0),
        (mode(Mode.VOLTAGE_DQ, write(Register.VOLTAGEDQ_Q, 0.25)), Mode.VOLTAGE_DQ, 5.0 * KT, 5.0, 0),
        *(
            (mode(field, write(Register.VFOC_VOLTAGE, 1.0)), field, 0.0, 0.0, 0)  # it turns the field only
            for field in (Mode.PWM, Mode.VOLTAGE, Mode.VOLTAGE_FOC, Mode.MEASURE_IND)
        ),
    ],
)
def test_torque_and_current_of_a_command(
    data: bytes, then: Mode, torque: float, current: float, limit: int
) -> None:
    rig = Rig()
    rig.shaft.locked = True
    rig.send(data, milliseconds=50)
    assert rig.mode == then
    assert rig.twin.servo.torque() == pytest.approx(torque, rel=1e-3)
    assert rig.value(Register.TORQUE) == pytest.approx(torque, rel=1e-3)
    assert rig.value(Register.Q_CURRENT) == pytest.approx(current, rel=1e-3)
    assert rig.report(Register.FAULT, INT8) == limit


@pytest.mark.parametrize("value", [Mode.BRAKE, Mode.ZERO_VELOCITY])
def test_brake_and_zero_velocity_slow_down(value: Mode) -> None:
    rig = Rig()
    rig.send(position_command(None, 3.0, 0.0, LIMITS), milliseconds=300)
    rig.send(mode(value), milliseconds=300)
    assert abs(rig.shaft.velocity) < 0.05


def test_stay_within_pushes_back_at_its_bounds_only() -> None:
    rig = Rig()
    bounds = write(Register.COMMAND_WITHIN_LOWER_BOUND, -0.1, 0.1)
    rig.send(mode(Mode.STAY_WITHIN, bounds, write(Register.COMMAND_WITHIN_TIMEOUT, 10.0)), milliseconds=50)
    assert (rig.mode, rig.twin.servo.torque()) == (Mode.STAY_WITHIN, 0.0)
    rig.shaft.locked, rig.shaft.position = True, rev(0.3)
    rig.run(10)
    assert rig.twin.servo.torque() < -0.1
    rig.shaft.position = rev(-0.3)
    rig.run(10)
    assert rig.twin.servo.torque() > 0.1
    assert rig.value(Register.COMMAND_TIMEOUT) == 10.0  # a shadow of it


def test_a_trajectory_reports_completion() -> None:
    rig = Rig()
    rig.send(position_command(1.0, 0.0, 0.0, Limits(10.0, None, 1.0, 4.0)), milliseconds=400)
    assert rig.report(Register.TRAJECTORY_COMPLETE, INT8) == 0
    rig.run(2200)
    assert rig.report(Register.TRAJECTORY_COMPLETE, INT8) == 1
    assert rig.value(Register.CONTROL_POSITION) == pytest.approx(1.0, abs=1e-3)


def test_configured_limits_hold_unless_a_command_switches_them_off() -> None:
    rig = Rig(Settings(default_velocity_limit=0.5))
    rig.send(position_command(5.0, 0.0, 0.0, LIMITS), milliseconds=200)
    assert rig.twin.servo.setpoint.velocity == pytest.approx(0.5)
    rig.send(mode(Mode.POSITION, write(0x20, 5.0), write(0x27, 10.0, -1.0)), milliseconds=5)
    assert rig.value(Register.CONTROL_POSITION) == pytest.approx(5.0)


def test_a_trajectory_to_a_velocity() -> None:
    rig = Rig()
    rig.send(position_command(None, 1.0, 0.0, Limits(10.0, None, None, 2.0)), milliseconds=250)
    assert 0.4 < rig.twin.servo.setpoint.velocity < 0.6
    rig.run(1000)
    assert rig.twin.servo.setpoint.velocity == pytest.approx(1.0)


def test_a_stop_position_ends_a_velocity_and_does_not_go_with_limits() -> None:
    rig = Rig()
    stop = write(Register.COMMAND_STOP_POSITION, 0.25, 10.0)
    rig.send(mode(Mode.POSITION, write(0x20, None, 2.0), stop), milliseconds=600)
    assert rig.value(Register.CONTROL_POSITION) == pytest.approx(0.25)
    rig.send(mode(Mode.POSITION, write(0x20, None, 2.0), write(0x26, 0.25, 10.0, 1.0)), milliseconds=5)
    assert (rig.mode, rig.report(Register.FAULT, INT8)) == (Mode.FAULT, 45)


# -- bounds and watches ------------------------------------------------------------------------------


def test_starting_outside_the_bounds_is_a_fault_unless_they_are_ignored() -> None:
    rig = Rig(Settings(position_min=-0.5, position_max=0.5))
    rig.shaft.position = rev(0.7)
    rig.run(5)
    rig.send(position_command(0.0, 0.0, 0.0, LIMITS), milliseconds=20)
    assert (rig.mode, rig.report(Register.FAULT, INT8)) == (Mode.FAULT, 39)
    rig.send(STOP)
    ignore = write(Register.COMMAND_IGNORE_POSITION_BOUNDS, 1.0, resolution=INT8)
    rig.send(mode(Mode.POSITION, write(0x20, 0.7), write(0x27, 10.0), ignore), milliseconds=20)
    assert rig.mode == Mode.POSITION


def test_a_set_point_is_kept_within_the_bounds_and_torque_outwards_fades() -> None:
    rig = Rig(Settings(position_max=0.5))
    rig.send(position_command(2.0, 0.0, 0.0, LIMITS), milliseconds=2000)
    assert rig.shaft.position == pytest.approx(rev(0.5), abs=0.05)
    rig.shaft.position, rig.shaft.locked = rev(0.53), True
    rig.send(torque_command(0.53, 0.5, LIMITS), milliseconds=20)
    assert rig.twin.servo.torque() == pytest.approx(0.0, abs=1e-3)
    assert rig.report(Register.FAULT, INT8) == 103


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        (Settings(fault_position_error=0.1), 49),
        (Settings(fault_velocity_error=0.1), 50),
        (Settings(max_voltage=20.0), 34),
        (Settings(bus_voltage=3.0), 40),
        (Settings(fault_temperature=20.0), 38),
        (Settings(position_max=40000.0), 48),  # bounds that it cannot count
    ],
)
def test_its_fault_monitors(settings: Settings, code: int) -> None:
    rig = Rig(settings)
    rig.shaft.locked = True
    rig.send(position_command(1.0, 0.5, 0.0, LIMITS), milliseconds=30)
    assert (rig.mode, rig.report(Register.FAULT, INT8)) == (Mode.FAULT, code)


def test_it_grows_warm_and_gives_less() -> None:
    rig = Rig(Settings(fault_temperature=40.0, temperature_margin=14.0))
    rig.shaft.locked = True
    rig.send(torque_command(0.0, 9.0, LIMITS), milliseconds=9000)
    assert 26.0 < rig.twin.servo.temperature < 40.0
    assert rig.twin.servo.iq < 39.0
    assert rig.report(Register.FAULT, INT8) == 100


def test_above_its_highest_velocity_the_torque_falls() -> None:
    rig = Rig(Settings(max_velocity=5.0, max_velocity_derate=1.0, fault_velocity_error=nan))
    rig.shaft.load = 0.0
    rig.send(torque_command(0.0, 0.5, LIMITS), milliseconds=1500)
    assert rig.shaft.velocity / tau < 6.0
    assert rig.report(Register.FAULT, INT8) == 96


# -- watchdog ------------------------------------------------------------------------------------------


def test_the_watchdog_timeout_is_that_of_each_command() -> None:
    rig = Rig()
    rig.send(position_command(0.0, 0.0, 0.0, Limits(0.05)), milliseconds=45)
    assert rig.mode == Mode.POSITION
    rig.run(10)
    assert rig.mode == Mode.TIMEOUT


def test_queries_do_not_feed_the_watchdog() -> None:
    rig = Rig()
    rig.send(position_command(0.0, 0.0, 0.0, Limits(0.05)))
    for _ in range(60):
        rig.send(FAST)
    assert rig.mode == Mode.TIMEOUT


@pytest.mark.parametrize(
    ("commanded", "default", "trips"),
    [(0.0, 0.1, True), (0.0, nan, False), (None, 0.1, False), (0.1, nan, True)],
)
def test_without_one_the_configured_one_counts(commanded: float | None, default: float, trips: bool) -> None:
    rig = Rig(Settings(default_timeout_s=default))
    rig.send(mode(Mode.POSITION, write(0x20, 0.0), write(0x27, commanded)), milliseconds=200)
    assert (rig.mode == Mode.TIMEOUT) is trips


def test_a_current_has_no_watchdog() -> None:
    rig = Rig()
    rig.shaft.locked = True
    rig.send(CURRENT_2A, milliseconds=500)
    assert rig.mode == Mode.CURRENT


@pytest.mark.parametrize("timeout_mode", [Mode.STOPPED, Mode.POSITION, Mode.ZERO_VELOCITY, Mode.BRAKE])
def test_what_it_does_after_a_timeout_is_configured(timeout_mode: Mode) -> None:
    rig = Rig(Settings(timeout_mode=timeout_mode, default_accel_limit=100.0))
    rig.shaft.inertia = 5e-4
    rig.send(position_command(None, 2.0, 0.0, Limits(0.3, None, -1.0, None)), milliseconds=290)
    before = rig.shaft.velocity
    rig.run(200)
    assert rig.mode == Mode.TIMEOUT
    if timeout_mode == Mode.STOPPED:
        assert rig.twin.servo.torque() == 0.0
        assert rig.shaft.velocity > 0.4 * before
    else:
        assert abs(rig.shaft.velocity) < 0.2 * before


# -- registers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("resolution", "position", "voltage"),
    [(INT8, 25, 48), (INT16, 2500, 240), (INT32, 25000, 24000), (F32, 0.25, 24.0)],
)
def test_replies_are_rounded_by_their_width(resolution: int, position: float, voltage: float) -> None:
    rig = Rig()
    rig.shaft.position = rev(0.25)
    rig.run(5)
    assert rig.report(Register.POSITION, resolution) == pytest.approx(position)
    assert rig.report(Register.VOLTAGE, resolution) == pytest.approx(voltage)


def test_what_does_not_fit_saturates_and_what_is_none_is_not_given() -> None:
    rig = Rig()
    rig.shaft.position = rev(-99.0)
    rig.run(5)
    assert [rig.report(Register.POSITION, r) for r in (INT8, INT16)] == [-127, -32767]
    assert rig.report(Register.CONTROL_POSITION, INT8) == -128
    raw = rig.report(Register.CONTROL_POSITION, F32)
    assert raw is not None
    assert isnan(raw)


def test_unknown_registers_are_errors_and_their_neighbours_are_read() -> None:
    rig = Rig()
    (answer,) = rig.send(encode(Query(0x07, INT8, 4)))
    assert subframes(answer) == [
        Values(REPLY, 0x07, INT8, (0,)),
        Error(0x31, 0x08, 1),
        Error(0x31, 0x09, 1),
        Values(REPLY, 0x0A, INT8, (0,)),
    ]


def test_model_firmware_serial_and_uuid_are_int32_only() -> None:
    settings = Settings(uuid="0123456789abcdeffedcba9876543210", firmware="0.4.21", model=0x1234)
    rig = Rig(settings)
    assert rig.report(Register.FIRMWARE_VERSION, INT32) == 0x000415
    assert rig.report(Register.MODEL_NUMBER, INT32) == 0x1234
    assert rig.report(Register.REGISTER_MAP_VERSION, INT32) == 5
    assert rig.report(Register.UUID1, INT32) == int.from_bytes(bytes.fromhex("01234567"), "little")
    assert rig.report(Register.SERIAL_NUMBER1, INT32) == int.from_bytes(bytes.fromhex("10325476"), "little")
    for register in (Register.FIRMWARE_VERSION, Register.UUID1, Register.SERIAL_NUMBER3):
        assert rig.report(register, INT16) is None
    assert rig.report(Register.MULTIPLEX_ID, INT32) is None


def test_which_registers_can_be_read() -> None:
    rig = Rig()
    rig.send(position_command(0.1, 0.0, 0.0, LIMITS), milliseconds=10)
    for register in range(0x72):
        if rig.report(register) is None:
            assert register in {
                *(0x08, 0x09, 0x13, 0x17, 0x1F, 0x2E, 0x2F, *range(0x35, 0x38), 0x3E, 0x3F),
                *(*range(0x49, 0x50), *range(0x52, 0x58), *range(0x59, 0x70), 0x71),
            }
    assert rig.report(Register.MILLISECOND_COUNTER, INT16) is not None


def test_a_reply_is_no_longer_than_a_frame() -> None:
    rig = Rig()
    (answer,) = rig.send(encode(Query(0, F32, 8)) + encode(Query(0x20, F32, 8)))
    assert len(answer.data) <= 64
    assert decode(answer.data) is not None


def test_the_output_is_set_and_the_home_state_follows() -> None:
    rig = Rig()
    assert rig.report(Register.HOME_STATE, INT8) == 1
    rig.send(write(Register.SET_OUTPUT_EXACT, 2.5))
    assert rig.value(Register.POSITION) == pytest.approx(2.5)
    assert rig.report(Register.HOME_STATE, INT8) == 2
    rig.send(write(Register.REQUIRE_REINDEX, 1.0))
    assert rig.report(Register.HOME_STATE, INT8) == 0


def test_recapturing_takes_the_set_point_to_the_shaft() -> None:
    rig = Rig()
    rig.shaft.locked = True
    rig.send(position_command(3.0, 0.0, 0.0, LIMITS), milliseconds=20)
    rig.send(write(Register.RECAPTURE_POSITION_VELOCITY, 1.0, resolution=INT8))
    assert rig.value(Register.CONTROL_POSITION) == pytest.approx(rig.shaft.position / tau, abs=0.05)


# -- frames --------------------------------------------------------------------------------------------


def test_only_frames_with_the_reply_bit_get_a_reply() -> None:
    rig = Rig()
    rig.twin.receive(rig.now, make_frame(1, position_command(0.0, 0.0, 0.0, LIMITS) + FAST))
    assert rig.run(20) == []
    assert rig.mode == Mode.POSITION
    (answer,) = rig.send(b"\x50")
    assert (answer.id, answer.data, answer.fd, answer.brs) == (reply_id(1), b"", True, True)


@pytest.mark.parametrize("identifier", [0x8002, 0x8081, 0x18001])
def test_frames_to_others_are_ignored(identifier: int) -> None:
    rig = Rig()
    rig.twin.receive(rig.now, make_frame(identifier, position_command(0.0, 0.0, 0.0, LIMITS) + FAST))
    assert rig.run(20) == []
    assert rig.mode == Mode.STOPPED


def test_the_reply_goes_to_the_querying_host_with_the_prefix() -> None:
    twin = MoteusTwin(device("left", 100, options=Options(can_prefix=0x123)), 0)
    twin.step(0, [])
    twin.receive(0, make_frame(command_id(100, 5, 0x123), FAST))
    ((answer,)) = twin.step(MILLISECOND, [])[1]
    assert isinstance(answer, CanFrame)
    assert (answer.id, answer.extended) == (0x1236405, True)


def test_a_broken_frame_is_obeyed_up_to_the_flaw() -> None:
    rig = Rig()
    rig.send(position_command(0.0, 0.0, 0.0, LIMITS)[:20], milliseconds=20)
    assert rig.mode == Mode.POSITION
    assert rig.value(Register.COMMAND_TIMEOUT) == 0.0  # it was cut off


def test_a_uuid_chooses_one_of_all() -> None:
    first, second = Rig(seed=0), Rig(address=2, seed=1)
    for rig in (first, second):
        answers = rig.send(masked(first.twin.uuid, DISCOVER), to=0x7F)
        assert len(answers) == (rig is first)
        rig.send(masked(first.twin.uuid[:4], mode(Mode.BRAKE)), to=0x7F, milliseconds=20)
        assert (rig.mode == Mode.BRAKE) is (rig is first)
    assert first.send(encode(Values(0, 0x154, INT8, (1,))) + FAST) == []  # a mask is an int32


def test_uuids_come_from_settings_or_address_and_seed() -> None:
    made = {Rig(address=a, seed=s).twin.uuid for a in (1, 2) for s in (0, 1)}
    assert len(made) == 4
    assert Rig(seed=1).twin.uuid == Rig(seed=1).twin.uuid


def test_a_reply_waits_for_its_delay() -> None:
    rig = Rig(Settings(reply_delay_us=3500))
    assert rig.send(FAST, milliseconds=3) == []
    assert rig.twin.due() is not None
    assert len(rig.run(2)) == 1


def test_it_is_due_when_its_watchdog_expires() -> None:
    rig = Rig()
    assert rig.twin.due() is None
    rig.send(position_command(0.0, 0.0, 0.0, Limits(0.05)), milliseconds=20)
    assert rig.twin.due() == pytest.approx(rig.now + 30 * MILLISECOND, abs=2 * MILLISECOND)


def test_before_its_first_step_it_receives_nothing() -> None:
    twin = MoteusTwin(device(), 0)
    twin.receive(0, make_frame(command_id(1), FAST))
    assert twin.step(0, [])[1] == []


def test_what_is_not_finite_is_not_measured() -> None:
    rig = Rig()
    rig.shaft.position = rev(0.5)
    rig.run(3)
    rig.twin.step(rig.now, [Feedback("left", rig.now, nan, nan), Feedback("right", rig.now, 1.0, 1.0)])
    assert rig.value(Register.POSITION) == pytest.approx(0.5, abs=1e-4)


# -- the console -----------------------------------------------------------------------------------------


def test_the_console_gives_the_device_another_id() -> None:
    rig = Rig()
    line = console("conf set id.id 9")
    rig.twin.receive(rig.now, make_frame(1, line[:1] + b"\x01\x05" + b"conf "))
    rig.twin.receive(rig.now, make_frame(1, b"\x40\x01\x0cset id.id 9\n"))
    rig.run(1)
    assert rig.twin.state.address == 9
    (answer,) = rig.send(bytes.fromhex("420130"), to=9)
    reported = decode(answer.data)
    assert reported is not None
    assert reported.console == b"OK\r\n"
    rig.send(console("conf get id.id") + console("conf write") + console("d stop"), to=9)
    (answer,) = rig.send(bytes.fromhex("420130"), to=9)
    reported = decode(answer.data)
    assert reported is not None
    assert reported.console == b"9\r\nOK\r\nERR unknown command\r\n"
