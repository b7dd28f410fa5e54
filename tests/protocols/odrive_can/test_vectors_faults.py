"""Conversations of vectors: what devices complain of, what they are asked then, when it is told again.

What vouches: the devices' bytes and the names of error bits are cantools' with the DBCs 0.6.10 and 0.5.6;
what else is expected is derived by hand from the README ("Two firmware lines", "What it does": codes,
verdicts, restarts) and the docstrings of `host_axis`. See `talk`.
"""

from __future__ import annotations

import pytest

from protocols.messages import ClearFault, Idle, Velocity
from tests.protocols.odrive_can.conversation import names_of
from tests.protocols.odrive_can.talk import Talk, standing, standing05


def faults(talk: Talk) -> list[str]:
    """Codes and names of the faults that were told in this stage."""
    return [line.text.split(":")[0] for line in talk.lines if line.text.startswith("Fault ")]


def test_vectors_of_an_axis_of_0_5_whose_components_fail() -> None:
    talk = standing05()
    talk.beat(8)
    talk.run(100, Velocity("axis3", 0.0))
    talk.reports("""
        0 < State axis3 armed: CLOSED_LOOP_CONTROL
        0 > 3:Set_Input_Vel 0 0 | 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0
        10…90 > 3:Set_Input_Vel 0 0
    """)
    talk.beat(1, 0x40, Motor_Error_Flag=1)
    talk.answer("Get_Motor_Error", Motor_Error=0x1001)
    talk.run(100, Velocity("axis3", 0.0))
    # Axis: 5 << 48, motor: 1 << 48. In fault: nothing is said but the question that its flag points to.
    talk.reports("""
        0 < Fault axis3 0x5000000000040 MOTOR_FAILED: *
        0 < State axis3 fault: IDLE
        0 > 3?Get_Motor_Error
        1 < Fault axis3 0x1000000000001 motor PHASE_RESISTANCE_OUT_OF_RANGE: *
        1 < Fault axis3 0x1000000001000 motor CURRENT_LIMIT_VIOLATION: *
    """)
    talk.beat(1, 0x340, Motor_Error_Flag=1, Encoder_Error_Flag=1, Controller_Error_Flag=1)
    talk.answer("Get_Controller_Error", Controller_Error=1)
    talk.run(600, Velocity("axis3", 0.0))
    # Only what is new. Encoder 2 << 48, controller 3 << 48; the encoder's word does not come.
    talk.reports("""
        0 < Fault axis3 0x5000000000100 ENCODER_FAILED: *
        0 < Fault axis3 0x5000000000200 CONTROLLER_FAILED: *
        0 > 3?Get_Encoder_Error | 3?Get_Controller_Error
        1 < Fault axis3 0x3000000000001 controller OVERSPEED: *
        100…400/100 > 3?Get_Encoder_Error
    """)
    talk.report("Get_Encoder_Error", Encoder_Error=4)
    talk.report("Get_Encoder_Error", Encoder_Error=6)
    talk.reports("""
        0 < Fault axis3 0x2000000000004 encoder NO_RESPONSE: *
        0 < Fault axis3 0x2000000000002 encoder CPR_POLEPAIRS_MISMATCH: *
    """)
    talk.beat(1, 0x80)
    talk.answer("Get_Sensorless_Error", Sensorless_Error=1)
    talk.run(100)
    # It has no flag of its own: the axis' bit points to it. Sensorless: 4 << 48.
    talk.reports("""
        0 < Fault axis3 0x5000000000080 SENSORLESS_ESTIMATOR_FAILED: *
        0 > 3?Get_Sensorless_Error
        1 < Fault axis3 0x4000000000001 sensorless UNSTABLE_GAIN: *
    """)
    again = """
        0 < Fault axis3 0x5000000000040 MOTOR_FAILED: *
        0 > 3?Get_Motor_Error
        1 < Fault axis3 0x1000000000001 motor PHASE_RESISTANCE_OUT_OF_RANGE: *
        1 < Fault axis3 0x1000000001000 motor CURRENT_LIMIT_VIOLATION: *
    """
    talk.beat(1, 0x40, Motor_Error_Flag=1)
    talk.run(100)
    talk.reports(again)  # it was gone, and came again
    talk.ask(ClearFault("axis3"))
    talk.run(700)
    talk.reports("""
        0…480-599/100-150 > 3:Clear_Errors
        600 < Refused ClearFault axis3: still in fault: MOTOR_FAILED
    """)
    talk.run(100)
    talk.reports(again)  # what stays is told again, with all its words


def test_vectors_of_an_error_word_that_never_comes() -> None:
    """It is requested five times, and does not prevent arming for ever."""
    talk = standing05()
    talk.beat(1, 0x40, Motor_Error_Flag=1)
    talk.run(1500)
    talk.reports("""
        0 < Fault axis3 0x5000000000040 MOTOR_FAILED: *
        0 < State axis3 fault: IDLE
        0…400/100 > 3?Get_Motor_Error
    """)
    talk.ask(ClearFault("axis3"))
    talk.beat()
    talk.run(20, Velocity("axis3", 0.0))
    talk.reports("""
        0 > 3:Clear_Errors
        0 < State axis3 ready: IDLE
        0 < Done ClearFault axis3:*
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        10 > 3:Set_Input_Vel 0 0
    """)


def test_vectors_of_an_axis_of_0_5_whose_invalid_state_is_cleared() -> None:
    """The device takes it back at the next state request, such as that of Idle."""
    talk = standing05()
    talk.run(50, Velocity("axis3", 0.0))
    talk.beat(1, 1)
    talk.run(100, Velocity("axis3", 0.0))
    talk.reports("""
        0 > 3:Set_Controller_Mode 2 1 | 3:Set_Input_Vel 0 0 | 3:Set_Axis_State 8
        10…40 > 3:Set_Input_Vel 0 0
        50 < Fault axis3 0x5000000000001 INVALID_STATE: *
        50 < State axis3 fault: IDLE
    """)
    talk.run(50, Idle("axis3"))
    talk.beat()
    talk.run(200, Idle("axis3"))
    talk.reports("""
        0 > 3:Set_Axis_State 1
        50 < State axis3 ready: IDLE
        50…100/50 > 3:Set_Axis_State 1
    """)


# -- the vendor's words -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("line", "base"), [("0.6", 0), ("0.5", 5 << 48)])
def test_vectors_of_every_bit_of_a_heartbeat(line: str, base: int) -> None:
    talk, name = (standing(), "left") if line == "0.6" else (standing05(), "axis3")
    for bit, word in names_of(line, "Heartbeat", "Axis_Error").items():
        talk.stage()
        talk.beat(1, bit)
        talk.run(100)
        # INITIALIZING is a state: see the restarts.
        reported = [] if word in ("NONE", "INITIALIZING") else [f"Fault {name} {base + bit:#x} {word}"]
        assert faults(talk) == reported


@pytest.mark.parametrize(
    ("message", "number", "bit"),
    [
        ("Motor_Error", 1, 0x40),
        ("Encoder_Error", 2, 0x100),
        ("Controller_Error", 3, 0x200),
        ("Sensorless_Error", 4, 0x80),
    ],
)
def test_vectors_of_every_bit_of_a_component_of_0_5(message: str, number: int, bit: int) -> None:
    part = message.split("_")[0]
    words = names_of("0.5", f"Get_{message}", message)
    known = {value: word for value, word in words.items() if 0 < value < 1 << 32}  # the DBC has 32 bits
    talk = standing05()
    talk.answer(f"Get_{message}", **{message: sum(known)})
    flag = {f"{part}_Error_Flag": 1} if part != "Sensorless" else {}
    talk.report("Heartbeat", 3, False, Axis_State=1, Axis_Error=bit, **flag)
    talk.run(10)
    reported = [
        f"Fault axis3 {(number << 48) + value:#x} {part.lower()} {word}" for value, word in known.items()
    ]
    assert faults(talk)[1:] == reported


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_vectors_of_every_state(line: str) -> None:
    talk, name = (standing(), "left") if line == "0.6" else (standing05(), "axis3")
    for state, word in names_of(line, "Heartbeat", "Axis_State").items():
        if word == "SENSORLESS_CONTROL":  # not in ODriveEnums.h any more
            continue
        talk.stage()
        talk.beat(state)
        talk.run(10)
        mode = {"IDLE": "ready", "CLOSED_LOOP_CONTROL": "armed"}.get(word, "initialising")
        talk.reports(f"0 < State {name} {mode}: {word}" if word != "IDLE" else "")
        talk.beat()
        talk.run(100)
