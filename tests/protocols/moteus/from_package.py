"""The vectors that moteus 1.1.1 makes itself, made again: commands by its `Controller`, answers parsed by it.

Rules. A command's bytes come from the package alone. An answer is built from the layout by hand, and stands
here as bytes; what it means is what the package parses. Nothing of ours is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import moteus
from moteus import multiplex as mp
from moteus.device_info import DeviceAddress
from moteus.protocol import make_uuid_prefix, parse_registers
from moteus.transport import Transport, _make_uuid_query
from moteus.transport_device import TransportDevice

MADE = "moteus 1.1.1 (PyPI) Controller, framed by its Transport"
PARSED = "reply built from the layout, parsed by moteus 1.1.1 (PyPI)"
UUID = bytes.fromhex("0123456789abcdeffedcba9876543210")


def fast() -> Any:
    """The query that our driver sends all the time."""
    query = moteus.QueryResolution()
    query.voltage = query.temperature = mp.IGNORE
    return query


def full() -> Any:
    """The query that it sends now and then."""
    query = moteus.QueryResolution()
    query.q_current = mp.F32
    query.motor_temperature = query.trajectory_complete = query.home_state = mp.INT16
    query.voltage = query.temperature = query.fault = mp.INT16
    return query


MOVE: dict[str, float] = {
    "position": 0.25,
    "velocity": -1.5,
    "feedforward_torque": 0.125,
    "watchdog_timeout": 0.1,
}
PUSH: dict[str, float] = {"feedforward_torque": 0.125, "watchdog_timeout": 0.1}
SOFT: dict[str, float] = {"kp_scale": 0.5, "kd_scale": 0.25, "ilimit_scale": 0.0}
FREE: dict[str, float] = {"velocity_limit": -1.0, "accel_limit": -1.0}
LIMITED: dict[str, float] = {"maximum_torque": 1.5, "velocity_limit": 4.0, "accel_limit": 20.0}
NO_ACCEL: dict[str, float] = {**LIMITED, "accel_limit": math.nan}


def _position(query: Callable[[], Any], **values: float) -> Callable[[Any], Any]:
    return lambda c: c.make_position(**values, query_override=query())


def _torque(query: Callable[[], Any], low: float = math.nan, high: float = math.nan, **values: float) -> Any:
    """Stay-within, with no position either, which the package writes in position control only."""

    def make(c: Any) -> Any:
        within = c.make_stay_within(lower_bound=low, upper_bound=high, **values).data
        nowhere = c.make_position(position=math.nan).data
        asked = c.make_query(query_override=query()).data
        return _joined(c, within[:3], nowhere[3:], within[3:], asked)

    return make


COMMANDS: dict[str, tuple[dict[str, Any], Callable[[Any], Any]]] = {
    # name → arguments of the Controller, the command
    "position_watchdog_0.1s": ({}, _position(fast, **MOVE)),
    "velocity_watchdog_0.1s": ({}, _position(fast, **{**MOVE, "position": math.nan})),
    "torque_watchdog_0.1s": ({}, _torque(fast, **PUSH)),
    "torque_within": ({}, _torque(fast, -0.5, 0.25, **PUSH)),
    "impedance": ({}, _position(fast, **MOVE, **SOFT, **FREE)),
    "impedance_limited": ({}, _position(fast, **MOVE, **SOFT, **FREE, maximum_torque=1.5)),
    "damp": ({}, lambda c: c.make_zero_velocity(query_override=fast())),
    "brake_with_query": ({}, lambda c: c.make_brake(query_override=fast())),
    "position_limited": ({}, _position(fast, **MOVE, **LIMITED)),
    "position_limited_no_accel": ({}, _position(fast, **MOVE, **NO_ACCEL)),
    "velocity_limited": ({}, _position(fast, **{**MOVE, "position": math.nan}, **LIMITED)),
    "torque_limited": ({}, _torque(full, **PUSH, maximum_torque=1.5)),
    "position_full_query": ({}, _position(full, **MOVE)),
    "query_fast": ({}, lambda c: c.make_query(query_override=fast())),
    "query_full": ({}, lambda c: c.make_query(query_override=full())),
    "stop_with_query": ({}, lambda c: c.make_stop(query_override=fast())),
    "stop_id_100": ({"id": 100}, lambda c: c.make_stop(query_override=fast())),
    "stop_host_3": ({"source_can_id": 3}, lambda c: c.make_stop(query_override=fast())),
    "stop_prefix": ({"can_prefix": 0x1ABC}, lambda c: c.make_stop(query_override=fast())),
    "zero_velocity": ({}, lambda c: c.make_zero_velocity(kd_scale=0.5)),
    "stay_within": ({}, lambda c: c.make_stay_within(lower_bound=-0.5, upper_bound=math.nan)),
    "vfoc": ({}, lambda c: c.make_vfoc(theta=0.5, voltage=1.0, query=True)),
    "set_output_exact_0": ({}, lambda c: c.make_set_output_exact(position=0.0, query_override=fast())),
    "require_reindex": ({}, lambda c: c.make_require_reindex()),
    "recapture": ({}, lambda c: c.make_recapture_position_velocity()),
    "read_parameters": ({}, lambda c: c.make_custom_query({0x20: mp.F32, 0x21: mp.F32, 0x70: mp.INT32})),
    "console_conf_write": ({}, lambda c: c.make_diagnostic_write(b"conf write\n")),
    "console_read": ({}, lambda c: c.make_diagnostic_read(48)),
    "set_id_by_uuid": (
        {"id": DeviceAddress(uuid=UUID[:8])},
        lambda c: c.make_diagnostic_write(b"conf set id.id 9\n"),
    ),
    "discover_by_uuid": ({"id": 0x7F}, lambda c: _discover_by_uuid(c)),
    "stop_by_whole_uuid": ({"id": DeviceAddress(uuid=UUID)}, lambda c: c.make_stop(query_override=fast())),
    "set_output_nearest_0.5": ({}, lambda c: c.make_set_output_nearest(position=0.5)),
    "read_power": ({}, lambda c: c.make_custom_query({0x007: mp.F32})),
    "read_home_state": ({}, lambda c: c.make_custom_query({0x00C: mp.INT32})),
    "identify": ({}, lambda c: _joined(c, _read(c, 0x100, 3), _make_uuid_query()[0])),
    "write_output_exact_1.5_read_back": (
        {},
        lambda c: _joined(c, *_exact(c, 1.5)),
    ),
    "write_output_exact_0_read_back": ({}, lambda c: _joined(c, *_exact(c, 0.0))),
    "console_conf_write_read_back": (
        {},
        lambda c: _joined(c, c.make_diagnostic_write(b"conf write\n").data, _read(c, 0x110, 1)),
    ),
}

ANSWERS: dict[str, tuple[int, str]] = {
    # name → id, data
    "reply_fast": (0x500, "21000a" + "2f01000000be0000c03f000040bf" + "210f00"),
    "reply_fast_fault": (0x500, "210001" + "2f010000484200000000cdcccc3d" + "210f26"),
    "reply_full": (
        0x500,
        "21000a2c0401000000be0000c03f000040bf0000204124060a2701 0100 0200 f500 9d01 0000" + "50" * 11,
    ),
    "reply_nan": (0x500, "21000a" + "2f010000c07f0000c07f0000c07f" + "210f00"),
    "reply_int8_nan": (0x500, "2701" + "008000800080" + "2304808080" + "505050"),
    "reply_uuid": (0x500, "2804d002" + UUID.hex() + "21d80201"),
    "reply_errors": (0x500, "31d00201" + "31d10201" + "300f02" + "50"),
    "reply_stopped": (0x500, "210000" + "2f010000803e0000000000000000" + "210f00"),
    "reply_enabling": (0x500, "210002" + "2f010000803e0000000000000000" + "210f00"),
    "reply_timeout": (0x500, "21000b" + "2f010000803e0000000000000000" + "210f00"),
    "reply_zeroed": (0x500, "210000" + "2f010ad7233b0000000000000000" + "210f00"),
    "reply_power": (0x500, "2d070000484150"),
    "reply_power_unknown": (0x500, "310701"),
    "reply_power_not_given": (0x500, "2d070000c07f50"),
    "reply_output_taken": (0x500, "31b10201"),
    "reply_output_refused": (0x500, "30b1020231b10201"),
    "reply_id_unreadable": (0x500, "31900201"),
    "reply_identity": (
        0x500,
        "2b8002" + "04040300" + "04030100" + "05000000" + "2804d002" + UUID.hex() + "21d80201" + "50" * 9,
    ),
    "reply_uuid_other": (0x500, "2804d002" + UUID[::-1].hex() + "21d80201"),
    "reply_uuid_id_9": (0x900, "2804d002" + UUID.hex() + "21d80201"),
    "reply_identity_id_9": (
        0x900,
        "2b8002" + "04040300" + "04030100" + "05000000" + "2804d002" + UUID.hex() + "21d80201" + "50" * 9,
    ),
    "reply_id_100": (0x6400, "210000" + "2f01000000000000000000000000" + "210f00"),
}


def _discover_by_uuid(controller: Any) -> Any:
    command, _ = controller._make_command(query=True)
    command.data = make_uuid_prefix(DeviceAddress(uuid=UUID[:8])) + _make_uuid_query()[0]
    return command


def _read(controller: Any, start: int, count: int, resolution: int = mp.INT32) -> bytes:
    data: bytes = controller.make_custom_query({start + i: resolution for i in range(count)}).data
    return data


def _exact(controller: Any, position: float) -> tuple[bytes, bytes]:
    data: bytes = controller.make_set_output_exact(position=position).data
    return data, _read(controller, 0x131, 1, mp.F32)


def _joined(controller: Any, *data: bytes) -> Any:
    """One frame with what the package sends in several."""
    command, _ = controller._make_command(query=True)
    command.data = b"".join(data)
    return command


def command(name: str) -> dict[str, Any]:
    """One command as an entry of the vectors' file."""
    arguments, make = COMMANDS[name]
    controller = moteus.Controller(**{"id": 5, **arguments}, transport=object())
    frame = Transport([])._command_to_frame(make(controller))
    size = TransportDevice()._round_up_dlc(len(frame.data))
    meaning = {"cmd": name, "parsed_by_moteus": _parsed(frame.data)}
    return {
        "name": name,
        "direction": "to_device",
        "bus": "canfd",
        "id": frame.arbitration_id,
        "extended": frame.is_extended_id,
        "data": (bytes(frame.data) + b"\x50" * (size - len(frame.data))).hex(),
        "meaning": meaning,
        "source": MADE,
        "brs": frame.bitrate_switch,
    }


def answer(name: str) -> dict[str, Any]:
    """One answer as an entry of the vectors' file."""
    identifier, data = ANSWERS[name]
    plain = data.replace(" ", "")
    return {
        "name": name,
        "direction": "from_device",
        "bus": "canfd",
        "id": identifier,
        "extended": identifier > 0x7FF,
        "data": plain,
        "meaning": {"parsed_by_moteus": _parsed(bytes.fromhex(plain))},
        "source": PARSED,
        "brs": True,
    }


def _parsed(data: bytes) -> dict[str, Any]:
    """What the package reads in a frame; None for NaN."""
    if data[:1] in (b"\x40", b"\x42") or b"conf " in bytes(data):
        return {}
    found = parse_registers(data)
    both = {**found.command, **found.response}
    values = {f"{register:03X}": None if value != value else value for register, value in both.items()}
    return {
        **values,
        **({"read": [f"{register:03X}" for register, _ in found.query]} if found.query else {}),
        **(
            {"errors": [[f"{register:03X}", number] for register, number in found.errors]}
            if found.errors
            else {}
        ),
    }


def entries() -> list[dict[str, Any]]:
    """All of them."""
    return [*map(command, COMMANDS), *map(answer, ANSWERS)]
