"""The host's SDO client: with canopen's LocalNode as server, and with responses that are late or twice."""

from __future__ import annotations

import pytest
from canopen.objectdictionary import ODVariable, datatypes

from protocols.canopen import sdo
from protocols.canopen.client import DOUBLED, QUIET, TRIES, Job, Outcome, Purpose, SdoClient
from protocols.canopen.objects import Key
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND
from tests.protocols.cia402.stack import Slave

NAME, TYPE, POSITION, CONTROLWORD = (0x1008, 0), (0x1000, 0), (0x6064, 0), (0x6040, 0)
TIMEOUT = 100


def client() -> SdoClient:
    return SdoClient(TIMEOUT * MILLISECOND)


def read(key: Key, purpose: Purpose = Purpose.STARTUP) -> Job:
    return Job(purpose, key)


# -- with the package's server --------------------------------------------------------------------------


@pytest.fixture
def slave() -> Slave:
    """A LocalNode that holds an object of any length."""
    slave, variable = Slave(2), ODVariable("anything", 0x2100)
    slave.take_sent()
    variable.data_type, variable.access_type = datatypes.DOMAIN, "rw"
    slave.node.object_dictionary.add_object(variable)
    return slave


def run(slave: Slave, job: Job) -> tuple[Outcome | None, int]:
    """Run a job; return its outcome and the number of requests."""
    host, count = client(), 0
    host.put(job)
    while (request := host.poll(count * MILLISECOND)[0]) is not None:
        slave.receive(CanFrame(0x602, sdo.encode(request)))
        (answer,) = slave.take_sent()
        response, count = sdo.decode_response(answer.data), count + 1
        assert response is not None
        if outcome := host.handle(count * MILLISECOND, response):
            return outcome, count
        assert host.handle(count * MILLISECOND, response) is None, "a response that comes twice"
    return None, count


@pytest.mark.parametrize("size", [0, 1, 2, 3, 4, 5, 7, 8, 14, 15, 40])
def test_transfers_of_any_length(slave: Slave, size: int) -> None:
    data, requests = bytes(range(1, size + 1)), 1 if 1 <= size <= 4 else 1 + max(1, -(-size // 7))
    written = Job(Purpose.REQUEST, (0x2100, 0), data)
    assert run(slave, written) == (Outcome(written), requests)
    assert slave.node.data_store[0x2100][0] == data
    if size:
        assert run(slave, read((0x2100, 0))) == (Outcome(read((0x2100, 0)), data), requests)


@pytest.mark.parametrize(
    ("key", "data", "code"),
    [
        ((0x5FFF, 0), None, 0x06020000),
        ((0x1018, 9), None, 0x06090011),
        ((0x6041, 0), b"\0\0", 0x06010002),
        ((0x6081, 0), b"12345678", 0x06070010),
    ],
)
def test_refusals_have_their_code(slave: Slave, key: Key, data: bytes | None, code: int) -> None:
    outcome, _ = run(slave, Job(Purpose.REQUEST, key, data))
    assert outcome is not None
    assert outcome.abort == code
    assert f"{code:#010x}" in sdo.abort_text(code)


# -- one transfer at a time -----------------------------------------------------------------------------


def test_an_urgent_job_is_next_and_ends_no_other() -> None:
    host = client()
    host.put(read(TYPE), read(NAME), read(POSITION, Purpose.POLL))
    assert host.poll(0)[0] == sdo.Upload(*TYPE)
    host.put(Job(Purpose.URGENT, CONTROLWORD, b"\6\0"))
    assert host.poll(1) == (None, None)
    assert host.handle(2, sdo.Downloaded(*CONTROLWORD)) is None, "not requested yet"
    assert host.handle(2, sdo.Uploaded(*TYPE, bytes(4))) is not None
    assert host.poll(3)[0] == sdo.Download(*CONTROLWORD, b"\6\0")


def test_polls_and_others_take_turns() -> None:
    host, asked = client(), []
    host.put(*(read((0x2000 + at, 0), Purpose.SETUP) for at in range(12)))
    for at in range(12):
        host.put(read((0x6000 + at, 0), Purpose.POLL))
        request, _ = host.poll(at)
        assert isinstance(request, sdo.Upload)
        asked.append(request.index >> 12)
        host.handle(at, sdo.Uploaded(request.index, 0, bytes(4)))
    assert asked == [2, 2, 6] * 4


def test_without_a_response_a_request_is_repeated_and_given_up() -> None:
    host, times, given_up = client(), [], None
    host.put(read(TYPE))
    for at in range(1000):
        request, outcome = host.poll(at * MILLISECOND)
        times += [at] if request else []
        given_up = given_up or outcome
    assert times == [n * TIMEOUT for n in range(TRIES)]
    assert given_up == Outcome(read(TYPE), abort=sdo.TIMEOUT)


def test_a_transfer_takes_only_responses_to_itself() -> None:
    host = client()
    host.put(read(POSITION))
    host.poll(0)
    for response in (
        sdo.Uploaded(0x6063, 0, bytes(4)),
        sdo.Uploaded(0x6064, 1, bytes(4)),
        sdo.Downloaded(*POSITION),
        sdo.UploadedSegment(False, b"", True),
        sdo.SegmentDownloaded(False),
        sdo.Abort(0x6063, 0, sdo.NO_OBJECT),
    ):
        assert host.handle(1, response) is None
    assert host.handle(1, sdo.Abort(*POSITION, sdo.NO_OBJECT)) == Outcome(read(POSITION), abort=sdo.NO_OBJECT)


def test_a_segmented_value_of_another_length_than_announced_is_refused() -> None:
    host = client()
    host.put(read(NAME))
    host.poll(0)
    host.handle(1, sdo.UploadStart(*NAME, 9))
    host.poll(1)
    outcome = host.handle(2, sdo.UploadedSegment(False, b"seven", True))
    assert outcome == Outcome(read(NAME), abort=sdo.LENGTH_MISMATCH)


def test_segments_that_another_host_interrupts_are_requested_anew_but_not_for_ever() -> None:
    host = client()
    host.put(read(NAME))
    for _ in range(TRIES):
        assert host.poll(0)[0] == sdo.Upload(*NAME)
        host.handle(0, sdo.UploadStart(*NAME, 7))
        assert host.poll(0)[0] == sdo.UploadSegment(False)
        host.handle(0, sdo.Abort(*POSITION, sdo.GENERAL))
    assert host.poll(1) == (None, None)
    assert host.handle(1, sdo.UploadedSegment(False, b"twin402", True)) == Outcome(read(NAME), b"twin402")


# -- responses that come once more ------------------------------------------------------------------------


def test_an_object_rests_while_responses_about_it_may_be_under_way() -> None:
    """A doubled earlier confirmation must not count for a new request."""
    host, count = client(), (0x1600, 0)
    host.put(Job(Purpose.SETUP, count, b"\0"))
    host.poll(0)
    host.handle(1, sdo.Downloaded(*count))
    host.handle(2, sdo.Downloaded(*count))
    host.put(Job(Purpose.SETUP, count, b"\3"))
    assert host.poll(3) == (None, None)
    assert host.handle(4, sdo.Downloaded(*count)) is None
    assert host.due() == 4 + QUIET
    assert host.poll(4 + QUIET)[0] == sdo.Download(*count, b"\3")


def test_responses_that_come_twice_are_counted_in_a_row() -> None:
    host, now = client(), 0
    for count in range(DOUBLED + 1):
        host.put(read((0x6000 + count, 0)))
        host.poll(now := now + MILLISECOND)
        host.handle(now, sdo.Uploaded(0x6000 + count, 0, bytes(4)))
        assert host.doubled == count
        host.handle(now, sdo.Uploaded(0x6000 + count, 0, bytes(4)))
    for count in range(2):
        host.put(read((0x6100 + count, 0)))
        host.poll(now := now + MILLISECOND)
        host.handle(now, sdo.Uploaded(0x6100 + count, 0, bytes(4)))
    assert host.doubled == 0
