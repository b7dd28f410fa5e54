"""The twin's behaviour: NMT, heartbeats, power states, stops, faults, PDOs (README, "The twin")."""

from __future__ import annotations

import pytest

from protocols.canopen import sdo
from protocols.canopen.node import HEARTBEAT_LOST, RPDO_TIMEOUT
from protocols.canopen.objects import ERROR_COUNT, RESTORE, STORE
from protocols.canopen.pdo import Entry, encode_entry
from protocols.canopen.services import NmtCommand, NmtState, heartbeat_id, rpdo_id, sdo_rx_id, sdo_tx_id
from protocols.cia402 import objects as o
from protocols.cia402.faults import FAULTS, OVERCURRENT, register_of
from protocols.cia402.objects import Key
from protocols.cia402.options import Settings
from protocols.cia402.profile import Mode, PowerState
from protocols.cia402.state_machine import TRANSITIONS
from protocols.frames import CanFrame
from protocols.messages import Feedback
from tests.protocols.cia402.transfer import Transfer
from tests.protocols.cia402.twin_bench import HOST, NODE, TwinBench

SEED = 20261121
ON = PowerState.OPERATION_ENABLED
OFF = PowerState.SWITCH_ON_DISABLED
HELD = HOST << 16 | 100
"""1016: the host's heartbeat within 100 ms."""


def spinning(settings: Settings | None = None, target: int = 20_000) -> TwinBench:
    """A drive that turns in CSV."""
    bench = TwinBench(settings)
    bench.enable(Mode.CSV)
    bench.put(o.TARGET_VELOCITY, target)
    bench.run(300)
    assert bench.velocity > 7.0
    return bench


def beat(bench: TwinBench) -> list[CanFrame]:
    return bench.run(1, [CanFrame(heartbeat_id(HOST), b"\x05")])


# -- NMT and heartbeat ---------------------------------------------------------------------------------


def test_the_heartbeats_period_is_what_1017_says() -> None:
    bench = TwinBench(seed=3)
    for period in (100, 20, 0, 50):
        bench.put(o.PRODUCER_HEARTBEAT, period)
        bench.run(120)
        bench.sent.clear()
        bench.run(600)
        assert len(bench.beats()) == (600 // period if period else 0)


@pytest.mark.parametrize("command", [NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION])
def test_a_reset_forgets(command: NmtCommand) -> None:
    bench = spinning(Settings(boot_ms=200))
    bench.put(o.PROFILE_VELOCITY, 777)
    bench.put(o.PRODUCER_HEARTBEAT, 13)
    bench.nmt(NmtCommand.START)
    bench.sent.clear()
    bench.nmt(command)
    silent = command is NmtCommand.RESET_NODE
    assert (bench.request(sdo.Upload(0x1000, 0)) is None) is silent
    bench.run(200)
    assert 0 in bench.beats()
    assert bench.torque == 0.0
    assert bench.read(o.PRODUCER_HEARTBEAT) == 100
    assert bench.read(o.PROFILE_VELOCITY) == (Settings().profile_velocity if silent else 777)
    assert bench.state is (OFF if silent else PowerState.FAULT)


def test_the_hosts_heartbeat_is_monitored_from_the_first_one_on() -> None:
    bench = spinning()
    bench.put(o.CONSUMER_HEARTBEAT, HELD)
    bench.run(500)
    assert bench.state is ON
    for _ in range(5):
        beat(bench)
        bench.run(90)
    assert bench.state is ON
    bench.run(101 - 90)
    assert bench.twin.memory.state is not ON
    bench.run(2)
    assert bench.emergencies() == [HEARTBEAT_LOST]
    assert bench.state is PowerState.FAULT
    assert bench.read(o.ERROR_CODE) == HEARTBEAT_LOST
    assert bench.torque == 0.0


@pytest.mark.parametrize(
    ("option", "state"), [(0, ON), (1, PowerState.FAULT), (2, OFF), (3, OFF)], ids=lambda v: str(v)
)
def test_what_the_drive_does_when_the_host_is_lost(option: int, state: PowerState) -> None:
    bench = spinning(Settings(abort_connection=option, heartbeat_consumer=HELD))
    beat(bench)
    bench.run(500)
    assert bench.emergencies() == [HEARTBEAT_LOST]
    assert bench.state is state
    assert (bench.torque == 0.0) is (state is not ON)


@pytest.mark.parametrize(
    ("behaviour", "state"), [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)]
)
def test_the_nmt_state_after_the_host_is_lost(behaviour: int, state: NmtState) -> None:
    bench = TwinBench(Settings(error_behaviour=behaviour, heartbeat_consumer=HELD))
    bench.nmt(NmtCommand.START)
    beat(bench)
    bench.run(300)
    assert bench.beats()[-1] == state
    assert bench.twin.memory.state is OFF, "it was not armed: no fault"


def test_nmt_stop_is_a_lost_connection_for_what_turns() -> None:
    bench = spinning()
    bench.nmt(NmtCommand.STOP)
    bench.run(10)
    assert bench.torque == 0.0
    bench.nmt(NmtCommand.ENTER_PRE_OPERATIONAL)
    assert bench.state is PowerState.FAULT


def test_an_rpdo_that_does_not_come_is_noticed() -> None:
    bench = TwinBench()
    pack = bench.map_pdo(0x1400, rpdo_id(1, NODE), 255, o.CONTROLWORD, o.TARGET_VELOCITY, timer=50)
    bench.put(o.MODE, Mode.CSV)
    bench.nmt(NmtCommand.START)
    for control in (0x06, 0x07, 0x0F):
        bench.rpdo(1, pack, control, 0)
    for _ in range(10):
        bench.rpdo(1, pack, 0x0F, 20_000)
        bench.run(40)
    assert bench.state is ON
    bench.run(60)
    assert bench.emergencies() == [RPDO_TIMEOUT]
    assert bench.torque == 0.0


# -- power states --------------------------------------------------------------------------------------


def test_every_transition_of_the_package_is_ours() -> None:
    """Those that a controlword makes; canopen 2.4.1 `State402.TRANSITIONTABLE`."""
    from canopen.profiles.p402 import State402

    names = {state.value: state for state in PowerState}
    made = {(before, after) for (before, _), after in TRANSITIONS.items()}
    made.add((PowerState.QUICK_STOP, ON))
    automatic = {PowerState.NOT_READY, PowerState.FAULT_REACTION}
    for before, after in State402.TRANSITIONTABLE:
        if before in names and names[before] not in automatic:
            assert (names[before], names[after]) in made


def test_an_unsupported_mode_is_refused() -> None:
    bench = TwinBench(Settings(supported_modes=0x180))
    assert bench.write(o.MODE, Mode.PP) == sdo.BAD_VALUE
    assert bench.write(o.MODE, 99) == sdo.BAD_VALUE
    bench.put(o.MODE, Mode.CSP)
    assert bench.read(o.MODE_DISPLAY) == Mode.CSP


# -- stopping --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "slowest", "end"),
    [
        (0, None, OFF),
        (1, 8.0, OFF),
        (2, 16.0, OFF),
        (3, 100.0, OFF),
        (5, 8.0, PowerState.QUICK_STOP),
        (6, 16.0, PowerState.QUICK_STOP),
        (7, 100.0, PowerState.QUICK_STOP),
    ],
)
def test_quick_stop(option: int, slowest: float | None, end: PowerState) -> None:
    """By 605A: ramps of 6084 (here 20 000 /s², 7.7 rad/s²) and 6085 (40 000), or as fast as it can."""
    bench = spinning(
        Settings(quick_stop_option=option, profile_deceleration=20_000, quick_stop_deceleration=40_000)
    )
    bench.control(0x02)
    bench.run(40)
    speed = bench.velocity
    bench.run(100)
    lost = (speed - bench.velocity) / 0.1
    if slowest is None:
        assert bench.torque == 0.0
    elif slowest < 50.0:
        assert slowest * 0.8 < lost < slowest * 1.2
    else:
        assert abs(bench.velocity) < 0.1
    bench.run(2500)
    assert bench.state is end
    assert end is OFF or abs(bench.velocity) < 0.05


@pytest.mark.parametrize(("control", "key"), [(0x06, o.SHUTDOWN_OPTION), (0x07, o.DISABLE_OPTION)])
@pytest.mark.parametrize("slows", [0, 1])
def test_leaving_with_and_without_slowing_down(control: int, key: Key, slows: int) -> None:
    bench = spinning()
    bench.put(key, slows)
    bench.control(control, steps=2)
    assert (bench.torque != 0.0) is bool(slows)
    bench.run(400)
    assert bench.torque == 0.0
    assert (abs(bench.velocity) < 0.05) is bool(slows)


@pytest.mark.parametrize("option", [1, 2, 3])
def test_halt_stops_and_goes_on(option: int) -> None:
    bench = spinning(Settings(halt_option=option))
    bench.control(0x10F, steps=600)
    assert abs(bench.velocity) < 0.05
    assert bench.state is ON
    bench.control(0x0F, steps=300)
    assert bench.velocity > 7.0


@pytest.mark.parametrize("option", [0, 1, 2, 3])
def test_the_fault_reaction(option: int) -> None:
    bench = spinning(Settings(fault_option=option, profile_deceleration=100_000))
    bench.twin.provoke(OVERCURRENT)
    bench.run(2)
    slowing = bench.twin.memory.state is PowerState.FAULT_REACTION
    assert slowing is bool(option)
    assert (bench.torque != 0.0) is bool(option)
    bench.run(800)
    assert bench.state is PowerState.FAULT
    assert bench.torque == 0.0
    assert (abs(bench.velocity) < 0.05) is bool(option)


# -- faults ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", sorted(FAULTS))
def test_every_fault_can_be_provoked(code: int) -> None:
    bench = TwinBench()
    bench.twin.provoke(code)
    bench.run(2)
    assert bench.emergencies() == [code]
    assert bench.state is PowerState.FAULT
    assert bench.read(o.ERROR_CODE) == code
    assert bench.read(o.ERROR_REGISTER) == register_of(code)


def test_an_unknown_fault_cannot_be_provoked() -> None:
    with pytest.raises(ValueError, match="4660"):
        TwinBench().twin.provoke(0x1234)


# -- PDOs ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transmission", [1, 2, 7])
def test_a_tpdo_is_sent_with_every_nth_sync(transmission: int) -> None:
    bench = TwinBench()
    pack = bench.map_pdo(0x1A00 - 0x200, 0x180 + NODE, transmission, o.POSITION, o.STATUSWORD)
    bench.sync(20)
    assert not bench.tpdo(1, bench.sent), "not in pre-operational"
    bench.nmt(NmtCommand.START)
    bench.position = 1.0
    frames = [frame for _ in range(21) for frame in bench.sync(3)]
    reported = [pack.unpack(data) for data in bench.tpdo(1, frames)]
    assert len(reported) == 21 // transmission
    assert reported[-1] == (2608, bench.status)


def test_type_0_is_sent_with_a_sync_when_a_value_has_changed() -> None:
    bench = TwinBench()
    bench.map_pdo(0x1800, 0x180 + NODE, 0, o.POSITION)
    bench.nmt(NmtCommand.START)
    counts = []
    for position in (0.0, 0.0, 1.0, 1.0, 2.0):
        bench.position = position
        bench.run(1)
        counts.append(len(bench.tpdo(1, bench.sync())))
    assert counts == [1, 0, 1, 0, 1]
    bench.position = 3.0
    assert not bench.tpdo(1, bench.run(50))


def test_an_event_timer_and_a_change_of_state_send_a_tpdo() -> None:
    bench = TwinBench()
    bench.map_pdo(0x1800, 0x180 + NODE, 255, o.STATUSWORD, o.POSITION, timer=50)
    bench.nmt(NmtCommand.START)
    bench.run(50)
    frames = bench.run(500)
    assert len(bench.tpdo(1, frames)) == 10
    bench.position = 0.5
    assert not bench.tpdo(1, bench.run(3)), "a position is no event where there is a timer"
    bench.sent.clear()
    bench.control(0x06)
    assert bench.tpdo(1, bench.sent)[0][:2] == b"\x31\x02"


def test_without_a_timer_every_change_is_an_event_but_not_within_the_inhibit_time() -> None:
    bench = TwinBench()
    bench.map_pdo(0x1800, 0x180 + NODE, 254, o.POSITION)
    bench.put((0x1800, o.COB_ID), 1 << 31 | 0x180 + NODE)
    bench.put((0x1800, o.INHIBIT), 100)  # 10 ms
    bench.put((0x1800, o.COB_ID), 0x180 + NODE)
    bench.nmt(NmtCommand.START)
    bench.run(20)
    frames: list[CanFrame] = []
    for step in range(100):
        bench.position = step * 0.01
        frames += bench.run(1)
    assert len(bench.tpdo(1, frames)) == 10
    bench.run(20)
    assert not bench.tpdo(1, bench.run(100))


@pytest.mark.parametrize(
    ("key", "value", "code"),
    [
        ((0x1600, 1), encode_entry(Entry(0x6040, 0, 16)), sdo.DEVICE_STATE),
        ((0x1600, 0), 0, sdo.DEVICE_STATE),
        ((0x1601, 1), encode_entry(Entry(0x6041, 0, 16)), sdo.NOT_MAPPABLE),
        ((0x1601, 1), encode_entry(Entry(0x6040, 0, 8)), sdo.NOT_MAPPABLE),
        ((0x1601, 1), encode_entry(Entry(0x5FFF, 0, 8)), sdo.NOT_MAPPABLE),
        ((0x1601, 1), encode_entry(Entry(0x1017, 0, 16)), sdo.NOT_MAPPABLE),
        ((0x1601, 0), 9, sdo.BAD_VALUE),
        ((0x1601, 0), 1, sdo.NOT_MAPPABLE),
        ((0x1400, 2), 250, sdo.BAD_VALUE),
        ((0x1400, 1), 0x300, sdo.DEVICE_STATE),
        ((0x1401, 1), 1 << 29 | 0x301, sdo.BAD_VALUE),
        ((0x1401, 1), 0, sdo.BAD_VALUE),
        ((0x1800, 3), 5, sdo.DEVICE_STATE),
    ],
    ids=lambda v: str(v),
)
def test_a_pdo_is_configured_as_cia_301_demands(key: Key, value: int, code: int) -> None:
    bench = TwinBench(Settings(pdos="usual"))
    bench.put((0x1401, 1), 1 << 31 | 0x300 + NODE)
    bench.put((0x1601, 0), 0)
    bench.put((0x1601, 1), encode_entry(Entry(0x6040, 0, 16)))
    bench.twin.memory.node.dictionary.values[0x1601, 1] = 0
    assert bench.write(key, value) == code


def test_the_usual_mapping_stands_when_it_starts() -> None:
    bench = TwinBench(Settings(pdos="usual"))
    assert bench.read((0x1A00, 0)) == 3
    assert bench.read((0x1A00, 1)) == encode_entry(Entry(0x6041, 0, 16))
    assert not bench.read((0x1400, 1)) & 1 << 31
    bench.nmt(NmtCommand.START)
    assert len(bench.tpdo(1, bench.sync(2))) == 1


# -- SDO server --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("other", [sdo.Upload(0x6060, 0), sdo.Abort(0x1008, 0, sdo.GENERAL)])
def test_another_request_or_an_abort_ends_a_segmented_transfer(other: sdo.Request) -> None:
    bench = TwinBench()
    bench.request(sdo.Upload(0x1008, 0))
    bench.request(other)
    assert isinstance(bench.request(sdo.UploadSegment(False)), sdo.Abort)
    assert isinstance(bench.request(sdo.DownloadSegment(False, b"1", True)), sdo.Abort)


def test_a_download_of_less_than_announced_is_refused() -> None:
    bench = TwinBench()
    bench.request(sdo.DownloadStart(0x6083, 0, 9))
    answer = bench.request(sdo.DownloadSegment(False, b"\x11\0\0\0", True))
    assert answer == sdo.Abort(0x6083, 0, sdo.LENGTH_MISMATCH)
    assert bench.read(o.PROFILE_ACCELERATION) != 0x11


def test_a_response_is_delayed() -> None:
    bench = TwinBench(Settings(sdo_delay_ms=5))
    frame = CanFrame(sdo_rx_id(NODE), sdo.encode(sdo.Upload(0x1000, 0)))
    assert [f for f in bench.run(5, [frame]) if f.id == sdo_tx_id(NODE)] == []
    assert [f for f in bench.run(1) if f.id == sdo_tx_id(NODE)]


def test_requests_to_a_slow_drive_are_served_one_after_the_other() -> None:
    reads = [CanFrame(sdo_rx_id(NODE), sdo.encode(sdo.Upload(*key))) for key in (o.MODE, o.POSITION)]
    for waiting, times in ((100, [60, 120]), (0, [60])):
        bench = TwinBench(Settings(sdo_delay_ms=60, sdo_waiting=waiting))
        bench.run(1, reads)
        answered = [ms for ms in range(1, 200) for f in bench.run(1) if f.id == sdo_tx_id(NODE)]
        assert answered == times


@pytest.mark.parametrize(("key", "value"), [(o.MODE, 9), (o.CONTROLWORD, 6), (o.PROFILE_VELOCITY, 70_000)])
def test_an_expedited_download_without_a_size_has_the_objects_own(key: Key, value: int) -> None:
    """Command 0x22: s = 0, and n means nothing (CiA 301)."""
    bench = TwinBench()
    request = b"\x22" + key[0].to_bytes(2, "little") + bytes((key[1],)) + value.to_bytes(4, "little")
    [answer] = bench.run(1, [CanFrame(sdo_rx_id(NODE), request)])
    assert answer.data == b"\x60" + request[1:4] + bytes(4)
    assert bench.read(key) == value


def test_an_object_that_it_lacks_is_none() -> None:
    bench = TwinBench(Settings(lacks="60B1 60A9"))
    assert bench.write(o.VELOCITY_OFFSET, 0) == sdo.NO_OBJECT
    assert bench.transfer(Transfer(*o.VELOCITY_UNIT)).abort == sdo.NO_OBJECT
    bench.put((0x1601, 0), 0)
    assert bench.write((0x1601, 1), encode_entry(Entry(0x60B1, 0, 32))) == sdo.NOT_MAPPABLE


# -- what is kept, inputs and outputs ------------------------------------------------------------------------


def test_what_is_saved_stands_after_a_restart_until_it_is_restored() -> None:
    bench = TwinBench(Settings(boot_ms=10))
    defaults = bench.read(o.PROFILE_VELOCITY), bench.read(o.CONSUMER_HEARTBEAT)
    bench.put(o.PROFILE_VELOCITY, 777)
    bench.put(o.CONSUMER_HEARTBEAT, HELD)
    bench.put(o.TARGET_VELOCITY, 5000)
    assert bench.write(STORE, 1) == 0x08000020, "only with its signature"
    for saved, kept in ((STORE, (777, HELD)), (RESTORE, defaults)):
        bench.put(saved, int.from_bytes(b"save" if saved == STORE else b"load", "little"))
        assert bench.read(saved) == 1
        assert bench.read(o.PROFILE_VELOCITY) == 777, "not before the restart"
        bench.nmt(NmtCommand.RESET_NODE)
        bench.run(20)
        assert (bench.read(o.PROFILE_VELOCITY), bench.read(o.CONSUMER_HEARTBEAT)) == kept
        assert bench.read(o.TARGET_VELOCITY) == 0, "a set-point is not kept"


def test_errors_are_listed_newest_first_until_the_list_is_cleared() -> None:
    bench, codes = TwinBench(), sorted(FAULTS)[:10]
    for code in codes:
        bench.twin.provoke(code)
        bench.control(0x00)
        bench.control(0x80)
    assert bench.read(ERROR_COUNT) == 8
    assert [bench.read((0x1003, sub)) for sub in range(1, 9)] == codes[:1:-1]
    assert bench.write(ERROR_COUNT, 1) == sdo.BAD_VALUE
    bench.put(ERROR_COUNT, 0)
    assert bench.transfer(Transfer(0x1003, 1)).abort == sdo.NO_DATA


def test_inputs_outputs_and_the_following_error() -> None:
    bench = TwinBench(Settings(digital_inputs=0x10003))
    assert bench.read(o.DIGITAL_INPUTS) == 0x10003
    bench.put(o.OUTPUTS_MASK, 0x30000)
    bench.put(o.DIGITAL_OUTPUTS, 0x10000)
    assert (bench.read(o.DIGITAL_OUTPUTS), bench.read(o.OUTPUTS_MASK)) == (0x10000, 0x30000)
    bench.locked = True
    bench.enable(Mode.CSP)
    bench.put(o.TARGET_POSITION, 200)
    bench.run(20)
    assert bench.read(o.FOLLOWING_ERROR) == 200


# -- determinism and robustness --------------------------------------------------------------------------


def test_a_measurement_that_is_not_finite_is_ignored() -> None:
    bench = TwinBench()
    bench.position = 1.0
    bench.run(2)
    for position, velocity in ((float("nan"), 0.0), (0.0, float("inf"))):
        bench.twin.step(bench.now, (Feedback("m", bench.now, position, velocity),))
    bench.twin.step(bench.now, (Feedback("other", bench.now, 9.0, 9.0),))
    assert bench.twin.memory.node.dictionary.values[o.POSITION] in (0, 2608)
    assert bench.read(o.POSITION) == 2608
