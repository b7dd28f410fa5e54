"""The driver against its twins, of both firmware lines: they move a shaft together.

What goes out frame by frame is in the conversations (`test_vectors_*.py`); what every driver must do is in
the contract (`protocols.conformance`).
"""

from __future__ import annotations

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame, any_matches
from protocols.odrive_can import plugin
from protocols.odrive_can.dialect import LINE05
from protocols.odrive_can.faults05 import (
    AxisError,
    ControllerError,
    EncoderError,
    MotorError,
    SensorlessError,
)
from protocols.odrive_can.options import Options, Settings
from tests.protocols.helpers import modes, of
from tests.protocols.odrive_can.conversation import names_of
from tests.protocols.odrive_can.helpers import V05, Bench, device, ready


@pytest.mark.parametrize("options", [Options(), V05], ids=["0.6", "0.5"])
def test_velocity_position_and_torque_are_reached_and_idle_disarms(options: Options) -> None:
    bench = ready(device(options=options))
    bench.run(500, msg.Velocity("left", 50.0))
    assert bench.shaft.velocity == pytest.approx(50.0, abs=1.0)
    bench.run(1500, msg.Position("left", 30.0))
    assert bench.shaft.position == pytest.approx(30.0, abs=0.05)
    bench.shaft.locked = True
    bench.run(300, msg.Torque("left", 0.2))
    assert bench.twins[0].servo.torque() == pytest.approx(0.2, abs=1e-3)
    bench.run(300, msg.Idle("left"))
    assert not bench.twins[0].axis.armed
    assert modes(bench.events)[-2:] == ["armed", "ready"]


def test_an_extended_axis_is_driven_beside_a_standard_one_of_that_address() -> None:
    extended = Options(firmware="0.5", is_extended=True)
    bench = ready(
        device("far", 0xFEDCBA, options=extended),
        device("left", 1, options=V05),
        device("same", 1, options=extended),
    )
    bench.run(600, msg.Velocity("far", 5.0), msg.Velocity("left", 6.0), msg.Velocity("same", -7.0))
    assert [shaft.velocity for shaft in bench.shafts] == pytest.approx([5.0, 6.0, -7.0], abs=0.5)
    assert bench.driver.counters.malformed == bench.driver.counters.ignored == 0
    assert of(msg.Fault, bench.events) == []
    spec = plugin.spec(bench.devices[0])
    far = [frame for _, frame in bench.sent if frame.extended and frame.id >> 5 == 0xFEDCBA]
    assert far
    assert all(any_matches(spec.sends, frame) for frame in far)
    assert not spec.read_only(CanFrame(0xFEDCBA << 5 | 0x09, remote=True))
    assert spec.read_only(CanFrame(0xFEDCBA << 5 | 0x09, remote=True, extended=True))


def test_the_faults_of_0_5_are_those_of_the_vendor_s_dbc_all_of_them() -> None:
    tables = [LINE05.axis_faults, *(table for _, table in LINE05.component_faults.values())]
    signals = [
        ("Axis_Error", "Heartbeat", AxisError),
        ("Motor_Error", "Get_Motor_Error", MotorError),
        ("Encoder_Error", "Get_Encoder_Error", EncoderError),
        ("Controller_Error", "Get_Controller_Error", ControllerError),
        ("Sensorless_Error", "Get_Sensorless_Error", SensorlessError),
    ]
    for table, (name, message, bits) in zip(tables, signals, strict=True):
        theirs = {bit: word for bit, word in names_of("0.5", message, name).items() if bit}
        assert theirs == {int(bit): bit.name for bit in bits}, name
        assert {bit: info.name.split()[-1] for bit, info in table.items()} == theirs, name


@pytest.mark.parametrize("settings", [Settings(encoder_msg_rate_ms=0), Settings(heartbeat_msg_rate_ms=0)])
def test_a_device_without_cyclic_estimates_or_heartbeats_is_polled_and_driven(settings: Settings) -> None:
    bench = Bench([device(settings=settings)])
    bench.run(3000, msg.Velocity("left", 30.0))
    assert bench.twin.axis.armed
    assert "armed" in modes(bench.events)
    assert len([e for e in of(msg.Feedback, bench.run(1000)) if e.position is not None]) >= 80


def test_saving_keeps_what_was_written_through_a_reboot() -> None:
    bench = ready()
    bench.ask(msg.WriteParameter("left", "Pos_Gain", 12.0), 200)
    assert of(msg.Done, bench.ask(msg.WriteParameter("left", "save_configuration", 1.0), 2000))
    assert bench.twin.servo.gains.pos_gain == 12.0
    bench.ask(msg.WriteParameter("left", "Pos_Gain", 13.0), 200)
    bench.ask(msg.Reboot("left"), 2000)
    assert bench.twin.servo.gains.pos_gain == 12.0


def test_set_id_assigns_a_node_id_by_serial_number() -> None:
    bench = ready(device("left", 1), device("right", 2))
    assert len(of(msg.Done, bench.ask(msg.SetId("can0", bench.twin.axis.serial, 9), 1000))) == 1
    assert [twin.axis.node for twin in bench.twins] == [9, 2]
