"""Conversations of vectors: parameters that are read and written by the vendor's names.

What vouches: bytes, names, and which message has which name are cantools' with the DBCs 0.6.10 and 0.5.6;
what is expected is derived by hand from the README ("What it does": requests, "What it cannot do") and
the docstrings of `requests`. See `talk`.
"""

from __future__ import annotations

import math

import pytest

from protocols.messages import ReadParameter, WriteParameter
from tests.protocols.odrive_can.conversation import MESSAGES
from tests.protocols.odrive_can.talk import ROUTINE, Talk, standing, standing05

NOT_READABLE = {
    "Address": "the roll call",
    "TxSdo": "endpoints have other numbers in each firmware",
    "Get_ADC_Voltage": "the driver does not ask for it",
}


def readable(line: str) -> dict[str, str]:
    """Each signal that a device tells, and its message, as the DBC has them."""
    reported = [row for row in MESSAGES[line].values() if any("ODrive" in sender for sender in row.senders)]
    names = [
        (s.name, row.name[6:]) for row in reported for s in row.signals if row.name[6:] not in NOT_READABLE
    ]
    return dict(names)


def answered(talk: Talk) -> list[str]:
    """What was asked for, and how it ended."""
    said = [(line.way, line.text) for line in talk.lines]
    return [text for way, text in said if way == ">" or text.split()[0] in ("Parameter", "Done", "Refused")]


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_vectors_of_every_parameter_that_is_read(line: str) -> None:
    talk, motor = (standing(), "left") if line == "0.6" else (standing05(), "axis3")
    talk.shown = ROUTINE
    values: dict[str, dict[str, int]] = {}
    names = readable(line)
    for at, (name, message) in enumerate(names.items(), 1):
        values.setdefault(message, {})[name] = at
    if line == "0.6":
        values["Get_Version"] |= {"Fw_Version_Major": 0, "Fw_Version_Minor": 6}
    values["Heartbeat"] = dict.fromkeys(values["Heartbeat"], 1) | {
        "Axis_Error": 0x400 if line == "0.6" else 0
    }
    for message, signals in values.items():
        talk.answer(message, **signals)
    talk.beat()
    talk.run(101)
    for name, message in names.items():
        if line == "0.5" and message == "Heartbeat":
            continue
        talk.stage()
        talk.ask(ReadParameter(motor, name))
        talk.run(9)
        assert answered(talk) == [f"3?{message}", f"Parameter {motor} {name} {values[message][name]:g}"]


def test_vectors_of_a_heartbeat_s_parameters_of_0_5() -> None:
    """It cannot be asked for, and comes by itself."""
    talk = standing05()
    talk.shown = ROUTINE
    talk.run(10)
    talk.cycle(
        100, "Heartbeat", Axis_State=1, Controller_Error_Flag=1, Trajectory_Done_Flag=1, Axis_Error=0x200
    )
    values = {
        "Axis_Error": 0x200,
        "Axis_State": 1,
        "Motor_Error_Flag": 0,
        "Encoder_Error_Flag": 0,
        "Controller_Error_Flag": 1,
        "Trajectory_Done_Flag": 1,
    }
    assert set(values) == {name for name, message in readable("0.5").items() if message == "Heartbeat"}
    talk.ask(*(ReadParameter("axis3", name) for name in values))
    talk.run(1)
    wanted = [f"Parameter axis3 {name} {value}" for name, value in values.items()]
    assert [text for text in answered(talk) if "?" not in text] == wanted
    assert "3?Heartbeat" not in talk.requests


def test_vectors_of_counts_below_zero() -> None:
    """They are int32 (odriverobotics/ODrive@f9b5419 `can_simple.cpp`); the DBC has them unsigned."""
    talk = standing05()
    talk.answer("Get_Encoder_Count", Shadow_Count=(1 << 32) - 5, Count_in_CPR=8191)
    talk.ask(ReadParameter("axis3", "Shadow_Count"), ReadParameter("axis3", "Count_in_CPR"))
    talk.run(5)
    assert answered(talk)[1:] == [
        "Parameter axis3 Shadow_Count -5",
        "Parameter axis3 Count_in_CPR 8191",
    ]


def test_vectors_of_a_sensor_that_is_not_there() -> None:
    talk = standing()
    talk.answer("Get_Temperature", FET_Temperature=math.nan, Motor_Temperature=20.0)
    talk.ask(ReadParameter("left", "FET_Temperature"), ReadParameter("left", "Motor_Temperature"))
    talk.run(5)
    assert answered(talk) == [
        "Refused ReadParameter left: the device has no sensor for it",
        "Parameter left Motor_Temperature 20",
    ]


def test_vectors_of_parameters_that_cannot_be_read() -> None:
    talk = standing()
    talk.ask(ReadParameter("left", "nothing"), ReadParameter("nobody", "Iq_Measured"))
    talk.ask(ReadParameter("left", "Motor_Error"))  # of 0.5.x
    talk.reports("""
        0 < Refused ReadParameter left: CANSimple does not report 'nothing'; it reports *Iq_Measured*
        0 < Refused ReadParameter nobody: *
        0 < Refused ReadParameter left: CANSimple does not report 'Motor_Error'; *
    """)


def test_vectors_of_a_parameter_whose_answer_is_lost() -> None:
    talk = standing()
    talk.ask(ReadParameter("left", "Disarm_Reason"))
    talk.report("Heartbeat", 9, Axis_State=1)  # of a device that only a scan would find
    talk.run(200)
    talk.answer("Get_Error", Disarm_Reason=0x200)
    talk.run(100)
    # An old reason is history, and no fault.
    wanted = """
        0…240/100-150 > 3?Get_Error
        201-260 < Parameter left Disarm_Reason 512
    """
    talk.reports(wanted, foreign=1)


def test_vectors_of_a_parameter_of_one_that_restarts_meanwhile() -> None:
    """What it is, and so what it tells, is not known then."""
    talk = standing()
    talk.ask(ReadParameter("left", "Disarm_Reason"))
    talk.beat(1, 1)
    talk.run(650)
    talk.reports("""
        0 > 3?Get_Error
        0 < State left initialising: IDLE, identifying its firmware
        100 < State left initialising: IDLE
        100-150…480-599/100-150 > 3?Get_Error
        600 < Refused ReadParameter left: the device did not react
    """)


PAIRS = [
    ("Set_Limits", "Velocity_Limit", "Current_Limit"),
    ("Set_Traj_Accel_Limits", "Traj_Accel_Limit", "Traj_Decel_Limit"),
    ("Set_Vel_Gains", "Vel_Gain", "Vel_Integrator_Gain"),
]
SINGLE = [
    ("Set_Traj_Vel_Limit", "Traj_Vel_Limit"),
    ("Set_Traj_Inertia", "Traj_Inertia"),
    ("Set_Pos_Gain", "Pos_Gain"),
]


@pytest.mark.parametrize("line", ["0.5", "0.6"])
@pytest.mark.parametrize(("message", "name"), SINGLE)
def test_vectors_of_a_parameter_that_is_written(line: str, message: str, name: str) -> None:
    talk, motor = (standing(), "left") if line == "0.6" else (standing05(), "axis3")
    talk.ask(WriteParameter(motor, name, 0.125))
    talk.run(10)
    talk.reports(f"""
        0 > 3:{message} 0.125
        0 < Done WriteParameter {motor}: sent; the device does not confirm it
    """)
    talk.ask(WriteParameter(motor, name, 0.0))
    talk.reports(f"0 > 3:{message} 0")


@pytest.mark.parametrize(("message", "first", "second"), PAIRS)
def test_vectors_of_parameters_that_travel_in_pairs(message: str, first: str, second: str) -> None:
    """The first is kept until its partner is written too; from then on each is written with the other."""
    talk = standing()
    talk.ask(WriteParameter("left", second, 0.25))
    talk.reports(f"0 < Refused WriteParameter left: *write {first} too; {second} is kept for it")
    talk.ask(WriteParameter("left", first, 0.125))
    talk.run(100)
    talk.ask(WriteParameter("left", second, 0.5))
    talk.run(10)
    talk.reports(f"""
        0 > 3:{message} 0.125 0.25
        0 < Done WriteParameter left: sent; the device does not confirm it
        100 > 3:{message} 0.125 0.5
        100 < Done WriteParameter left: sent; the device does not confirm it
    """)


def test_vectors_of_what_must_not_be_written() -> None:
    talk = standing()
    talk.ask(WriteParameter("left", "Pos_Gain", -1.0))
    talk.ask(WriteParameter("left", "nothing", 1.0), WriteParameter("left", "save_configuration", 2.0))
    talk.reports("""
        0 < Refused WriteParameter left: -1.0 is not *
        0 < Refused WriteParameter left: CANSimple cannot set 'nothing'; it can set *Pos_Gain*
        0 < Refused WriteParameter left: save_configuration takes 1
    """)
