"""Values ↔ bytes, both ways: those of the vendor's package, of others, and of the manual."""

from __future__ import annotations

import struct

import pytest
from robstride_dynamics import protocol as vendor
from robstride_dynamics import table as ends

from protocols.frames import CanFrame
from protocols.messages import Arm, Impedance, Torque
from protocols.plugin import Device
from protocols.reference_vectors import Vector, vectors_of
from protocols.robstride import plugin
from protocols.robstride.options import Options, Settings
from protocols.robstride.table import ANY, CYBERGEAR, HOST, MODELS, REGISTERS, faults_in_status, table_of

VECTORS = {vector.name: vector for vector in vectors_of(plugin)}
# What each is, by the start of its name.
MESSAGES = {
    "enable": "enable", "vendor_enable": "enable", "disable": "disable", "clear": "clear", "zero": "zero",
    "stop_clear": "clear", "set_zero": "zero", "save": "save", "get_": "get_id", "vendor_ping": "get_id",
    "read_": "read", "control": "control", "vendor_mit": "control", "write_": "write", "run_mode": "write",
    "position_mode": "write", "spd_ref": "write", "speed": "write", "loc_ref": "write", "place": "write",
    "iq_ref": "write",
}  # fmt: skip
TO_DEVICE = [name for name, v in VECTORS.items() if v.direction == "to_device" and not v.wrong]
STATES = [name for name, v in VECTORS.items() if {"decoded", "position_rad"} & v.meaning.keys()]
STATES = [name for name in STATES if VECTORS[name].direction == "from_device"]
STATES = [name for name in STATES if not {"index", "unique_id"} & VECTORS[name].meaning.keys()]


def frame_of(name: str) -> CanFrame:
    frame = VECTORS[name].frame
    assert isinstance(frame, CanFrame)
    return frame


def model_of(vector: Vector) -> str:
    """The model by whose ends the source encoded."""
    return CYBERGEAR if "cybergear" in vector.name else str(vector.meaning.get("model", "RS01")).upper()


@pytest.mark.parametrize("name", TO_DEVICE)
def test_what_a_host_sends(name: str) -> None:
    vector, frame = VECTORS[name], frame_of(name)
    table = table_of(model_of(vector).replace("RS-", "RS"))
    decoded = table.decode(frame, "to_device")
    assert decoded is not None
    plain = name.removeprefix("cybergear_")
    assert decoded.name == next(message for start, message in MESSAGES.items() if plain.startswith(start))
    assert decoded.address == vector.meaning.get("motor_id", 127)
    for field, value in vector.meaning.items():
        if field == "value_f32":
            assert struct.unpack("<f", frame.data[4:]) == (value,)
        elif field in decoded.values:  # 4π of the package, 12.57 here; its steps are 1/65,534 of the range
            step = table.row(decoded.name).field(field).step
            assert decoded.values[field] == pytest.approx(value, rel=4e-4, abs=2 * step)
    ours = table.encode(decoded.name, decoded.address, **decoded.values)
    assert ours.data == frame.data
    host = 0 if decoded.name == "control" else (frame.id >> 8 & 0xFF) ^ HOST
    assert ours.id == frame.id ^ host << 8  # the same but for who sends it
    assert (not host) or "host_id = 0xFD" not in vector.source


@pytest.mark.parametrize("name", STATES)
def test_what_a_motor_reports(name: str) -> None:
    vector, frame = VECTORS[name], frame_of(name)
    meaning, table = vector.meaning, table_of(model_of(vector))
    decoded = table.decode(frame, "from_device")
    assert decoded is not None
    values = decoded.values
    assert decoded.name == "status"
    numbers = "position", "velocity", "torque", "temperature"
    keys = "position_rad", "velocity_rad_s", "torque_nm", "temperature_c"
    theirs = [meaning[key] for key in keys] if "position_rad" in meaning else meaning["decoded"]
    for field, value in zip(numbers, theirs, strict=True):
        step = table.row("status").field(field).step
        assert values[field] == pytest.approx(value, rel=4e-4, abs=2 * step)
    assert values["mode"] == meaning.get("mode", 2)
    assert faults_in_status("RS01", values["faults"]) == {bit for bit in (meaning.get("faults", 0),) if bit}
    assert bool(values["faults"]) == bool(meaning.get("warnings"))
    assert table.encode("status", decoded.address, **values) == frame


def test_what_else_a_motor_sends() -> None:
    expected = {
        "vendor_ping_reply": ("id", 5, {"serial": 0x8877665544332211}),
        "cybergear_get_device_id_reply": ("id", 127, {"serial": 0x8877665544332211}),
        "read_vbus_reply": ("register", 5, {"host": 170, "failed": 0, "number": 0x701C, "value": 0x41C40000}),
        "register_loc_kp": (
            "register",
            127,
            {"host": HOST, "failed": 0, "number": 0x701E, "value": 0x41F00000},
        ),
        "register_failed": ("register", 5, {"host": HOST, "failed": 1, "number": 0x7028, "value": 0}),
        "fault_overvoltage_stall": ("fault", 5, {"host": HOST, "faults": 0x4008, "warnings": 0}),
        "version": ("version", 5, {"host": HOST, "mode": 0, "faults": 0, "version": 0x00020603}),
    }
    for name, content in expected.items():
        assert ANY.decode(frame_of(name), "from_device") == content, name
        values = {key: value for key, value in content[2].items() if key != "unused"}
        assert ANY.encode(content[0], content[1], **values) == frame_of(name), name
    report = ANY.decode(frame_of("report"), "from_device")
    assert report is not None
    assert report.name == "report"
    assert frame_of("report").data == frame_of("status_running").data
    assert {*VECTORS} == {*TO_DEVICE, *STATES, *expected, "report", "cybergear_motion_p1_v-2_kp50_kd1.5"}


def test_a_set_point_with_the_host_in_the_place_of_its_torque_asks_for_the_largest() -> None:
    """What pycybergear 1.0.0 sends as a motion without torque: the decoder that guards our frames sees it."""
    device = Device("left", 127, Options(model="cybergear"), Settings())
    decoder = plugin.decoder([device])
    assert decoder.decode(0, frame_of("cybergear_enable")) == [Arm("left"), Torque("left", 0.0)]
    (asked,) = decoder.decode(0, frame_of("cybergear_motion_p1_v-2_kp50_kd1.5"))
    assert isinstance(asked, Impedance)
    assert asked.torque == pytest.approx(-12.0)


def test_registers_are_those_of_the_vendor_s_package() -> None:
    kinds = {"uint8": "u8", "int8": "u8", "uint16": "u16", "uint32": "u32", "float32": "f32"}
    compared = 0
    for key, value in vars(vendor.ParameterType).items():
        if key.isupper() and value[0] in REGISTERS.by_number:
            number, kind, name = value
            register = REGISTERS.by_number[number]
            assert kinds[kind.__name__] == register.type, name
            misspelt = {
                "lof_ref": "loc_ref",
                "cur_filter_gain": "cur_filt_gain",
                "spd_filter_gain": "spd_filt_gain",
            }
            assert misspelt.get(name, name) == register.name
            compared += 1
    assert compared == 23


def test_where_the_vendor_s_package_has_other_ends_than_the_manuals() -> None:
    differing = set()
    for name, ours in MODELS.items():
        key = f"rs-{name[2:].lower()}"
        if name.startswith("RS"):
            theirs = ends.MODEL_MIT_VELOCITY_TABLE[key], ends.MODEL_MIT_TORQUE_TABLE[key]
            differing |= {name} if theirs != (ours.velocity, ours.torque) else set()
            gains = ends.MODEL_MIT_KP_TABLE[key], ends.MODEL_MIT_KD_TABLE[key]
            assert gains == (ours.stiffness, ours.damping)
            assert ends.MODEL_MIT_POSITION_TABLE[key] == pytest.approx(ours.position, rel=1e-3)
    assert differing == {"RS00", "RS03", "RS05", "RS06"}  # README.md: `velocity_end`, `torque_end`


def test_gains_are_bounded_by_the_model() -> None:
    with pytest.raises(ValueError, match=r"stiffness is 600: at most 500 for RS02; damping is 6: at most 5"):
        Options(stiffness=600.0, damping=6.0)
    assert Options(model="RS03", stiffness=600.0, damping=6.0).gains.stiffness == 600.0
