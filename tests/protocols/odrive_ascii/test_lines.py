"""Values ↔ lines, both ways: the vendor's examples, and the lines of its Arduino library."""

from __future__ import annotations

import math

import pytest

from protocols import messages as msg
from protocols.frames import BusState
from protocols.line import Exchange
from protocols.messages import MILLISECOND, SECOND, Feedback, Obeyed
from protocols.odrive_ascii import plugin
from protocols.odrive_ascii.options import Options, Settings
from protocols.odrive_ascii.table import CUT_OFF, LINES, line, number, plain
from protocols.odrive_can import errors
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of
from tests.protocols.helpers import acts

LEFT = Device("left", 0, Options(firmware="0.5"), Settings())
VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
TAU = math.tau
SENT: dict[str, tuple[str, Obeyed | None]] = {
    "traj_doc": ("t", msg.Position("left", -2 * TAU)),
    "pos_q_doc": ("q", msg.Position("left", -2 * TAU)),
    "pos_p_doc": ("p", msg.Position("left", -2 * TAU)),
    "vel_v_doc": ("v", msg.Velocity("left", TAU)),
    "arduino_setPosition_1.5_0.25_-0.5": ("p", msg.Position("left", 1.5 * TAU, 0.25 * TAU, -0.5)),
    "torque_c": ("c", msg.Torque("left", 0.75)),
    "feedback_req": ("f", None),
    "read_with_checksum_doc": ("r", None),
    "set_state": ("w requested_state", msg.Arm("left")),
    "clear_errors": ("sc", msg.ClearFault("left")),
    "watchdog_feed": ("u", None),
    "arduino_setVelocity_3.5_-0.25": ("v", msg.Velocity("left", 3.5 * TAU, -0.25)),
    "arduino_trapezoidalMove_-2.25": ("t", msg.Position("left", -2.25 * TAU)),
    "arduino_setParameter_input_mode": ("w controller.config.input_mode", None),
    "arduino_setParameter_control_mode": ("w controller.config.control_mode", None),
    "arduino_setParameter_vel_limit": (
        "w",
        msg.WriteParameter("left", "axis0.controller.config.vel_limit", 12.5),
    ),
    "arduino_setState_idle": ("w requested_state", msg.Idle("left")),
    "arduino_getParameter_state": ("r", None),
    "reboot": ("sr", msg.Reboot("left")),
    "save": ("ss", msg.Reboot("left")),
    "info": ("i", None),
}
"""The name of each line, and what an armed axis does on it."""


def frame(name: str) -> bytes:
    found = VECTORS[name].frame
    assert isinstance(found, bytes)
    return found


def test_no_vector_is_left_out() -> None:
    told = {name for name, vector in VECTORS.items() if vector.direction == "from_device"}
    assert VECTORS.keys() == SENT.keys() | told
    assert len(told) == 2


@pytest.mark.parametrize("name", SENT)
def test_what_a_line_does_to_an_axis_in_closed_loop(name: str) -> None:
    letters, does = SENT[name]
    assert plugin.messages(frame(name)) == (letters,)
    assert plugin.spec(LEFT).read_only(frame(name)) is (letters in ("f", "r", "u", "i"))
    decoder = plugin.decoder([LEFT])
    decoder.decode(0, b"w axis0.requested_state 8\n")
    obeyed = acts(decoder.decode(0, frame(name)))
    if does is None:
        assert [each for each in obeyed if not isinstance(each, msg.Velocity | msg.Hold)] == []
        return
    assert does in obeyed or obeyed[-1] == does


@pytest.mark.parametrize("name", ["read_with_checksum_doc"])
def test_our_checksum_is_the_documented_one(name: str) -> None:
    assert line("r vbus_voltage") == frame(name)


def test_another_axis_obeys_nothing_but_what_concerns_the_board() -> None:
    right = Device("right", 1, Options(), Settings())
    moved = {name for name in SENT if acts(plugin.decoder([right]).decode(0, frame(name)))}
    assert moved == {"clear_errors", "reboot", "save"}


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (-1e-9, "0"), (1.5, "1.5"), (-0.25, "-0.25"), (1e-6, "0.000001"), (100.0, "100")],
)
def test_numbers(value: float, text: str) -> None:
    assert number(value) == text
    assert float(text) == pytest.approx(value, abs=5e-7)


def test_a_number_that_may_be_cut_off_is_none() -> None:
    """Firmware 0.5 keeps nine characters."""
    assert plain("24.087744") == 24.087744
    assert plain("214748364") is None
    assert plain("214748364", whole=True) == 214748364
    assert plain("lu") is None
    assert CUT_OFF == 9


def test_what_is_not_finite_is_not_sent() -> None:
    with pytest.raises(ValueError, match="cannot be sent"):
        number(math.nan)


def test_a_wrong_checksum_is_not_obeyed() -> None:
    assert plugin.decoder([LEFT]).decode(0, b"w axis0.requested_state 8 *1\n") == []
    right = line("w axis0.requested_state 8")
    assert msg.Arm("left") in plugin.decoder([LEFT]).decode(0, right)
    assert LINES.read_only(right) is False


def answers(driver_asks: Exchange, *texts: str) -> bytes:
    """What a device answers, with checksums."""
    lines = b""
    for text in texts:
        checksum = 0
        for byte in text.encode():
            checksum ^= byte
        lines += f"{text}*{checksum}\r\n".encode()
    assert driver_asks.answer is not None
    found = driver_asks.answer.find(driver_asks, lines)
    assert found is not None
    return lines[slice(*found)]


def test_an_answer_is_of_the_axis_that_was_asked_and_one_that_nobody_asked_for_is_of_none() -> None:
    right = Device("right", 1, Options(), Settings())
    driver = plugin.driver([LEFT, right])
    events, frames = driver.send(0, ())
    assert not [event for event in events if isinstance(event, msg.Fault)]
    asked = next(each for each in frames if isinstance(each, Exchange) and each.startswith(b"f 1"))
    data = answers(asked, "-12.375000 3.500000")
    (feedback,) = driver.answer(MILLISECOND, asked, data)  # type: ignore[attr-defined]
    assert isinstance(feedback, Feedback)
    assert (feedback.motor, feedback.position, feedback.velocity) == ("right", -12.375 * TAU, 3.5 * TAU)
    assert not driver.receive(2 * MILLISECOND, data)
    assert not driver.answer(3 * MILLISECOND, asked, b"")  # type: ignore[attr-defined]
    driver.bus(4 * MILLISECOND, BusState.BACK)


@pytest.mark.parametrize(("line_", "firmware"), [("0.5", "0.6.10"), ("0.6", "0.5.6")])
def test_another_firmware_than_in_the_robot_file_is_a_fault(line_: str, firmware: str) -> None:
    driver = plugin.driver([Device("left", 0, Options(firmware=line_), Settings())])  # type: ignore[arg-type]
    _, frames = driver.send(0, ())
    asked = next(each for each in frames if isinstance(each, Exchange) and each.startswith(b"i"))
    texts = ("Hardware version: 3.6-56V", f"Firmware version: {firmware}", "Serial number: 2060358F524B")
    driver.answer(MILLISECOND, asked, answers(asked, *texts))  # type: ignore[attr-defined]
    events, _ = driver.send(2 * MILLISECOND, ())
    codes = {event.code for event in events if isinstance(event, msg.Fault)}
    assert codes == {errors.FIRMWARE_06 if line_ == "0.5" else errors.FIRMWARE_05}


@pytest.mark.parametrize("firmware", ["0.5", "0.6"])
def test_a_twin_answers_as_its_firmware_does(firmware: str) -> None:
    twin = plugin.twin(Device("left", 0, Options(firmware=firmware), Settings()), 0)  # type: ignore[arg-type]
    now = MILLISECOND
    twin.step(now, [])

    def ask(text: str) -> str:
        nonlocal now
        twin.receive(now, text.encode())
        now += MILLISECOND
        return b"".join(each for each in twin.step(now, [])[1] if isinstance(each, bytes)).decode()

    assert ask("r vbus_voltage *93\n") == ("24.000000*40\r\n")
    assert ask("f 0\n") == "0.000000 0.000000\r\n"
    assert ask("f 9\n") == "invalid motor 9\r\n"
    assert ask("r axis0.nothing\n") == "invalid property\r\n"
    assert ask("p 0\n") == "invalid command format\r\n"
    assert ask("x\n") == "unknown command\r\n"
    assert ask("f 0 *1\n") == ""
    assert ask("r axis0.motor.error\n") == ("lu\r\n" if firmware == "0.5" else "invalid property\r\n")
    assert ask("v 0 1 0\nw axis0.requested_state 8\nr axis0.current_state\n") == "8\r\n"
    assert ask("w axis0.controller.config.vel_limit 12.5\nr axis0.controller.config.vel_limit\n").startswith(
        "12.5"
    )


@pytest.mark.parametrize("firmware", ["0.5", "0.6"])
def test_an_axis_that_is_erased_keeps_its_number_and_forgets_what_was_written(firmware: str) -> None:
    twin = plugin.twin(Device("right", 1, Options(firmware=firmware), Settings()), 0)  # type: ignore[arg-type]
    question, told = line("r axis1.controller.config.vel_limit"), list[object]()
    for now, asked in ((1, line("w axis1.controller.config.vel_limit 3")), (2, question), (3, line("se"))):
        twin.step(now * SECOND, ())
        twin.receive(now * SECOND, asked)
        told += twin.step(now * SECOND + MILLISECOND, ())[1]
    twin.step(6 * SECOND, ())
    twin.receive(6 * SECOND, question)
    told += twin.step(6 * SECOND + MILLISECOND, ())[1]
    assert [float(each.partition(b"*")[0]) for each in told if isinstance(each, bytes)] == [3.0, 40.0]


HOMES: dict[str, tuple[tuple[tuple[int, ...], ...], msg.Done | msg.Refused]] = {
    "it ends": (((11, 0, 1), (1, 0, 0)), msg.Done(0, "Home", "left", "it has ended")),
    "without an end stop": (
        ((1, 0, 12), (1, 0, 12)),
        msg.Refused(0, "Home", "left", "HOMING_WITHOUT_ENDSTOP"),
    ),
}
"""State, errors and result as they are reported one after the other, and what the request is answered."""


@pytest.mark.parametrize("case", HOMES)
def test_home_is_requested_until_it_begins_and_ends_with_the_state(case: str) -> None:
    reported, expected = HOMES[case]
    driver = plugin.driver([Device("left", 0, Options(firmware="0.6"), Settings())])
    now, left, found, sent = 0, [*reported], list[msg.Event](), list[bytes]()
    values: tuple[int, ...] = (1, 0, 0)
    while now < 3 * SECOND and not any(isinstance(each, msg.Done | msg.Refused) for each in found):
        requests = [msg.Home("left")] if now == SECOND else []
        events, frames = driver.send(now, requests)
        found += events
        for asked in (each for each in frames if isinstance(each, Exchange) and each.answer is not None):
            if asked.about.startswith("home"):
                values = left.pop(0) if left else values
                sent.append(asked.split(b"*")[0].strip())
            named = {"current_state": values[0], "active_errors": values[1], "procedure_result": values[2]}
            words = [each.partition(b"*")[0].split() for each in asked.splitlines()]
            texts = [f"{named.get(two[-1].decode().partition('.')[2], 0)}" for two in words if two[0] == b"r"]
            texts = ["0.000000 0.000000"] if asked.startswith(b"f") else texts
            if asked.startswith(b"i"):
                texts = ["Hardware version: 5.2-0V", "Firmware version: 0.6.10", "Serial number: 20"]
            answer = answers(asked, *texts)
            found += driver.answer(now + MILLISECOND, asked, answer)  # type: ignore[attr-defined]
        now += 10 * MILLISECOND
    (last,) = (each for each in found if isinstance(each, msg.Done | msg.Refused))
    assert (type(last), last.request, last.name) == (type(expected), "Home", "left")
    assert (getattr(expected, "detail", "") or getattr(expected, "reason", "")) in str(last)
    begun = [each for each in sent if each.startswith(b"w axis0.requested_state 11")]
    assert len(begun) == (1 if case == "it ends" else len(sent))
