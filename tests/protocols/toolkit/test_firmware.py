"""The base of twins: arming, watchdog, replies, reports and restarts, by the clock that it is given."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Feedback, Mode, Nanos, Obeyed, WriteParameter
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.assembly import TableDecoder
from protocols.toolkit.firmware import NEVER, Firmware
from protocols.toolkit.table import Decoded, Row, Table, const, uint

MS = MILLISECOND
LOST = 3


class Simple(Firmware):
    """It arms, disarms or replies by a frame's first byte, which also feeds it."""

    faults = {LOST: FaultInfo("lost", "", "")}  # noqa: RUF012 -- a constant of the class, as in every twin
    lost = LOST
    reply_delay = 2 * MS

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        assert isinstance(frame, CanFrame)
        self.feed(t)
        if frame.data == b"a":
            self.arm(t)
        elif frame.data == b"i":
            self.disarm()
        else:
            self.reply(t, frame)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        return 1.0 if self.mode is Mode.ARMED else 0.0

    def report(self, name: str) -> Frame | None:
        return CanFrame(0x100, name.encode())

    def cyclic(self) -> Mapping[str, Nanos]:
        return {"beat": 100 * MS}

    def timeout(self) -> Nanos:
        return 50 * MS if self.mode is Mode.ARMED else 0


def made(address: int = 1, seed: int = 0) -> Simple:
    return Simple(Device("m", address, None, None), seed)


def ask(letter: str) -> CanFrame:
    return CanFrame(1, letter.encode())


def beats(twin: Firmware, until: int, begin: int = 0) -> list[int]:
    """The ms in which it reports."""
    return [ms for ms in range(begin, until) if ask("beat").data in _data(twin.step(ms * MS, [])[1])]


def _data(frames: Sequence[Frame]) -> list[bytes]:
    return [frame.data for frame in frames if isinstance(frame, CanFrame)]


def test_twins_of_one_seed_do_not_report_in_step() -> None:
    first = [beats(made(address), 300) for address in range(1, 9)]
    assert first[0] == [0, 100, 200]
    assert all(len(each) == 3 for each in first)
    starts = sorted(each[0] for each in first)
    assert min(b - a for a, b in pairwise(starts)) >= 5


def test_a_report_that_is_late_is_sent_once_and_the_next_comes_at_its_time() -> None:
    twin = made()
    assert beats(twin, 1) == [0]
    assert beats(twin, 500, begin=350) == [350, 400]
    assert twin.due() == 500 * MS


def test_the_watchdog_trips_after_its_timeout_and_not_before() -> None:
    twin = made()
    twin.step(0, [])
    twin.receive(10 * MS, ask("a"))
    assert twin.due() == 60 * MS + 1
    assert twin.step(60 * MS, [])[0][0].torque == 1.0
    assert twin.step(60 * MS + 1, [])[0][0].torque == 0.0
    assert (twin.mode, twin.fault) == (Mode.FAULT, LOST)
    twin.receive(61 * MS, ask("a"))
    assert twin.mode is Mode.FAULT
    twin.clear()
    twin.receive(62 * MS, ask("a"))
    assert (twin.mode, twin.fault) == (Mode.ARMED, 0)


def test_a_frame_that_comes_after_the_timeout_does_not_save_it() -> None:
    twin = made()
    twin.step(0, [])
    twin.receive(0, ask("a"))
    twin.receive(51 * MS, ask("?"))
    assert twin.mode is Mode.FAULT


def test_a_reply_has_its_delay_and_goes_out_once() -> None:
    twin = made(seed=1)
    twin.step(0, [])
    twin.receive(5 * MS, ask("?"))
    assert twin.due() == 7 * MS
    assert [_data(twin.step(ms * MS, [])[1]) for ms in (6, 7, 8)] == [[], [b"?"], []]


def test_before_its_first_step_and_while_it_restarts_it_neither_receives_nor_sends() -> None:
    twin = made()
    twin.receive(0, ask("a"))
    assert twin.mode is Mode.READY
    twin.step(0, [])
    twin.receive(1 * MS, ask("?"))
    twin.receive(1 * MS, ask("a"))
    twin.restart(2 * MS, 100 * MS)
    twin.step(2 * MS, [])
    assert twin.due() == 102 * MS
    twin.receive(50 * MS, ask("a"))
    assert twin.step(101 * MS, [])[1] == []
    assert twin.mode is Mode.READY
    assert _data(twin.step(102 * MS, [])[1]) == [b"beat"]  # its reply is forgotten
    twin.restart(103 * MS, NEVER)
    twin.step(103 * MS, [])
    assert twin.due() is None


def test_the_shaft_is_what_was_last_measured_of_it_and_finite() -> None:
    twin = made()
    for name, *measured in (("m", 1.0, 2.0), ("m", 3.0), ("m", math.nan), ("x", 9.0)):
        twin.step(0, [Feedback(name, 0, *measured)])
    assert twin.shaft == (3.0, 2.0)


def test_a_fault_that_it_does_not_have_is_refused_with_those_that_it_has() -> None:
    with pytest.raises(ValueError, match="no fault 4; there are 3"):
        made().provoke(4)


def test_a_frame_is_decoded_once_for_all_devices_of_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table([Row("put", (const(0, 3), uint("number", 8)), (uint("value"),))])
    decode, times = table.decode, []

    def counted(*given: Any) -> Decoded | None:
        times.append(given)
        return decode(*given)

    def memory(name: str) -> Any:
        def obey(decoded: Decoded) -> Sequence[Obeyed]:
            return [WriteParameter(name, decoded.name, decoded.values["value"])]

        return SimpleNamespace(obey=obey)

    monkeypatch.setattr(table, "decode", counted)
    decoder = TableDecoder([(table, memory(name), lambda command: command) for name in ("a", "b")])
    assert decoder.decode(0, CanFrame(7, b"\5")) == [WriteParameter(name, "put", 5) for name in ("a", "b")]
    assert len(times) == 1
