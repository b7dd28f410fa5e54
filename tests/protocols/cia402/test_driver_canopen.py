"""Package canopen 2.4.1 and our driver: its LocalNode as an independent slave of ours, and its bytes for what
we say. A LocalNode has no state machine of CiA 402: it takes a controlword and does nothing; where a
statusword is needed the test writes it.
"""

from __future__ import annotations

import json

import pytest

from protocols import messages as msg
from protocols.cia402 import mapping, sdo
from protocols.cia402 import objects as o
from protocols.cia402.client import Job, Outcome, Purpose, SdoClient
from protocols.cia402.codec import sdo_rx_id
from protocols.cia402.driver import Cia402Driver
from protocols.cia402.mapping import Pdo
from protocols.cia402.options import Options
from protocols.cia402.pdo import encode_entry
from protocols.cia402.profile import PowerState
from protocols.conformance.bench import START, STEP
from protocols.frames import CanFrame
from protocols.messages import Command, Event, Mode, Request
from tests.protocols.cia402 import driver_vectors
from tests.protocols.cia402.driver_stage import device, driver_of
from tests.protocols.cia402.firmware import Drive
from tests.protocols.cia402.stack import Slave

NODE = 5


class Pair:
    """Our driver, and a LocalNode as its device, a millisecond a step."""

    def __init__(self, options: Options | None = None) -> None:
        self.slave = Slave(NODE)
        self.driver: Cia402Driver = driver_of(device("m", NODE, options))
        self.now = START
        self.events: list[Event] = []
        self.down: list[CanFrame] = []
        self.write(o.STATUSWORD, 0x0250)

    def write(self, key: o.Key, value: int) -> None:
        """What the firmware behind the stack would put into its dictionary."""
        data = o.to_bytes(o.OBJECTS[key].type, value)
        self.slave.node.data_store.setdefault(key[0], {})[key[1]] = data

    def step(self, *words: Command | Request) -> None:
        self.now += STEP
        for frame in self.slave.said():
            self.events += self.driver.receive(self.now, frame)
        events, frames = self.driver.send(self.now, words)
        self.events += events
        for raw in frames:
            assert isinstance(raw, CanFrame)
            self.down.append(raw)
            self.slave.receive(raw)
            if raw.id == 0x080:
                self.transmit()

    def transmit(self) -> None:
        """On SYNC the stack's own PdoMaps pack and send: LocalNode leaves that to the firmware."""
        for number in (1, 2, 3):
            known = self.slave.node.tpdo[number]
            known.read()
            if known.enabled and known.trans_type == 1:
                for variable in known.map:
                    variable.raw = self.slave.node.sdo[variable.index].raw
                known.transmit()

    def steps(self, count: int, *words: Command | Request) -> None:
        for _ in range(count):
            self.step(*words)

    def last(self, kind: type[Event]) -> Event:
        return [event for event in self.events if isinstance(event, kind)][-1]


def test_reads_units_identity_and_name_of_an_independent_slave() -> None:
    pair = Pair()
    pair.write(o.POSITION, -123_456)
    pair.steps(200)
    drive = pair.driver.drives[NODE]
    assert drive.profile is not None
    assert drive.profile.units.per_turn == pair.slave.value(0x608F, 1)
    assert drive.device_name == "twin402"  # segmented
    assert drive.profile.serial == (pair.slave.value(0x1018, 4) or None)
    state = pair.last(msg.State)
    assert isinstance(state, msg.State)
    assert (state.mode, state.detail) == (Mode.READY, "SWITCH ON DISABLED")
    feedback = pair.last(msg.Feedback)
    assert isinstance(feedback, msg.Feedback)
    assert all(frame.id == sdo_rx_id(NODE) and frame.data[0] in (0x40, 0x60, 0x70) for frame in pair.down)
    positions = [e.position for e in pair.events if isinstance(e, msg.Feedback) and e.position is not None]
    assert positions[-1] == pytest.approx(drive.profile.units.position(-123_456))


def test_configures_and_starts_an_independent_slave() -> None:
    pair = Pair()
    pair.steps(200)
    pair.steps(100, msg.Hold("m"))
    for pdo in mapping.wanted(NODE, Options(), synced=True, absent=()):
        known = (pair.slave.node.rpdo if pdo.kind == "RPDO" else pair.slave.node.tpdo)[pdo.number]
        known.read()
        assert known.enabled
        assert (known.cob_id, known.trans_type) == (pdo.id, pdo.transmission)
        assert [(v.index, v.subindex, v.length) for v in known.map] == [
            (one.index, one.sub, one.bits) for one in pdo.entries
        ]
    assert pair.slave.value(0x1016, 1) == 127 << 16 | 500
    assert pair.slave.node.nmt.state == "OPERATIONAL"


def test_what_it_sends_as_rpdo_is_read_by_an_independent_map_and_its_tpdos_by_us() -> None:
    pair = Pair()
    pair.write(o.POSITION, 4096)
    pair.steps(200)
    pair.steps(100, msg.Hold("m"))
    received = pair.driver.counters.accepted
    pair.write(o.STATUSWORD, 0x0231)
    pair.write(o.POSITION, 8192)
    pair.steps(30, msg.Hold("m"))
    assert pair.driver.drives[NODE].power is PowerState.READY
    assert pair.driver.counters.accepted > received
    assert pair.driver.counters.malformed == 0
    rpdo = pair.slave.node.rpdo[1]
    rpdo.read()
    frame = [f for f in pair.down if f.id == 0x200 + NODE][-1]
    rpdo.on_message(frame.id, bytearray(frame.data), 0.0)
    assert [variable.raw for variable in rpdo.map] == [0x07, 8, 8192]


def test_is_left_alone_where_its_pdos_fit() -> None:
    pair = Pair()
    pair.steps(200)
    pair.steps(100, msg.Hold("m"))
    pair.steps(700, msg.Idle("m"))
    fresh = Pair()
    fresh.slave = pair.slave
    fresh.steps(300)
    fresh.steps(50, msg.Hold("m"))
    writes = [sdo.decode_request(f.data) for f in fresh.down if f.id == sdo_rx_id(NODE)]
    indices = {request.index for request in writes if isinstance(request, sdo.Download)}
    assert indices == {0x1016}


@pytest.mark.parametrize(
    ("request_", "reported"),
    [
        (msg.ReadParameter("m", "6081"), 100_000.0),
        (msg.ReadParameter("m", "Profile velocity"), 100_000.0),
        (msg.ReadParameter("m", "608F:01"), 16_384.0),
        (msg.ReadParameter("m", "5FFF"), "the device has no such object (SDO abort 0x06020000)"),
        (msg.ReadParameter("m", "1018:09"), "the object has no such subindex (SDO abort 0x06090011)"),
        (msg.WriteParameter("m", "6041", 1.0), "the object can only be read (SDO abort 0x06010002)"),
    ],
)
def test_parameters_and_aborts_in_words(request_: Request, reported: float | str) -> None:
    pair = Pair()
    pair.steps(200)
    pair.steps(1, request_)
    pair.steps(20)
    if isinstance(reported, str):
        refused = pair.last(msg.Refused)
        assert isinstance(refused, msg.Refused)
        assert refused.reason == reported
    else:
        parameter = pair.last(msg.Parameter)
        assert isinstance(parameter, msg.Parameter)
        assert parameter.value == reported


def test_writes_are_read_back() -> None:
    pair = Pair()
    pair.steps(200)
    pair.steps(1, msg.WriteParameter("m", "6083", 12_345.0))
    pair.steps(10)
    assert isinstance(pair.last(msg.Done), msg.Done)
    assert pair.slave.value(0x6083) == 12_345


def test_scan_finds_a_slave_that_is_in_no_robot_file() -> None:
    driver, slave, now = driver_of(device("other", 9)), Slave(NODE), START
    events: list[Event] = []
    for at in range(1000):
        now += STEP
        for frame in slave.said():
            events += driver.receive(now, frame)
        reported, frames = driver.send(now, [msg.Scan("can0")] if at == 0 else [])
        events += reported
        for raw in frames:
            assert isinstance(raw, CanFrame)
            slave.receive(raw)
    found = [event for event in events if type(event).__name__ == "Found"]
    assert [(f.address, f.detail) for f in found] == [  # type: ignore[union-attr]
        (NODE, "device profile 402, vendor 0x0, product 0x192")
    ]


# -- steering -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [Options(modes="profile"), Options(modes="profile", feedback="sdo", mapping="keep")],
    ids=["by RPDO", "by SDO"],
)
@pytest.mark.parametrize(
    ("command", "mode", "velocity", "torque"),
    [
        (msg.Velocity("m", -2.0), 3, -5215, 0),  # 16384 / 2π · 2 = 5215.2
        (msg.Velocity("m", 0.5), 3, 1304, 0),  # 1303.8
        (msg.Torque("m", 0.05), 4, 0, 50),  # ‰ of 1 N·m
        (msg.Torque("m", -0.25), 4, 0, -250),
    ],
)
def test_velocity_and_torque_of_the_profile_modes_stand_in_an_independent_dictionary(
    options: Options, command: Command, mode: int, velocity: int, torque: int
) -> None:
    drive, driver, events = Drive(NODE), driver_of(device("m", NODE, options)), list[Event]()
    for at in range(900):
        for frame in drive.speak(at):
            events += driver.receive(START + at * STEP, frame)
        reported, frames = driver.send(START + at * STEP, [command] if at >= 200 else [])
        events += reported
        for raw in frames:
            assert isinstance(raw, CanFrame)
            drive.handle(raw)
    assert drive.state == "OPERATION ENABLED"
    assert (drive.get(0x6060), drive.get(0x60FF), drive.get(0x6071)) == (mode, velocity, torque)
    assert not [event for event in events if isinstance(event, msg.Fault | msg.Refused)]


# -- SDO, segment by segment ----------------------------------------------------------------------------


def _transfer(slave: Slave, key: o.Key, data: bytes | None) -> Outcome:
    client = SdoClient(100)
    client.begin(Job(Purpose.REQUEST, key, data))
    for now in range(50):
        request, given_up = client.poll(now)
        assert given_up is None
        if request is not None:
            slave.receive(CanFrame(sdo_rx_id(NODE), sdo.encode(request)))
        for frame in slave.said():
            answer = sdo.decode_response(frame.data)
            assert answer is not None
            outcome = client.handle(answer)
            if outcome is not None:
                return outcome
    raise AssertionError("no outcome")


@pytest.mark.parametrize("length", [1, 4, 5, 7, 8, 13, 14, 15, 40])
def test_text_of_any_length_is_read_in_segments(length: int) -> None:
    slave = Slave(NODE)
    slave.said()
    text = bytes(range(0x41, 0x41 + length))
    slave.node.data_store[0x1008] = {0: text}
    assert _transfer(slave, o.DEVICE_NAME, None).value == text


def test_what_is_longer_than_four_bytes_is_written_in_segments() -> None:
    slave = Slave(NODE)
    slave.said()
    slave.node.object_dictionary[0x1008].access_type = "rw"
    text = b"a longer name than fits into one frame"
    assert _transfer(slave, o.DEVICE_NAME, text).abort is None
    assert slave.node.data_store[0x1008][0] == text


def test_a_wrong_length_is_refused_by_the_slave() -> None:
    slave = Slave(NODE)
    slave.said()
    assert _transfer(slave, o.PROFILE_VELOCITY, b"\1\2").abort == sdo.LENGTH_MISMATCH


# -- bytes ----------------------------------------------------------------------------------------------


def test_the_vectors_are_those_that_the_package_makes() -> None:
    kept = json.loads(driver_vectors.FILE.read_text("utf-8"))
    assert [e for e in kept if e["source"] == driver_vectors.SOURCE] == driver_vectors.made()


def _timed(pdo: Pdo) -> Pdo:
    return Pdo(pdo.kind, pdo.number, pdo.cob, 255, 10, pdo.entries)


@pytest.mark.parametrize("pdo", [*driver_vectors.pdos(), *map(_timed, driver_vectors.pdos()[3:])])
def test_pdos_are_configured_as_by_pdo_map_save(pdo: Pdo) -> None:
    theirs = [frame.data for frame in driver_vectors.saved(pdo)]
    flag = 1 << 30 if pdo.kind == "TPDO" else 0
    ours = [sdo.encode(sdo.Download(*key, data)) for key, data in mapping.writes(pdo, flag)]
    assert ours == theirs


def test_a_mapping_word_is_index_subindex_and_bits() -> None:
    assert [hex(encode_entry(one)) for one in driver_vectors.pdos()[0].entries] == [
        "0x60400010",
        "0x60600008",
        "0x607a0020",
    ]
