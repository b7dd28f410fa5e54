"""Every setting that a twin has, and every parameter that it lets be written, changes what its shaft or the
wire does: one that changes nothing deceives whoever tries it in simulation before it is set on a motor.

The settings are the fields of `Plugin.settings`, the parameters those of each protocol's own table. Each is
given other values, one after the other, until a session goes on otherwise than with the first. What changes
nothing is declared here, with the reason, and must change nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from itertools import islice, zip_longest
from typing import Any, TypeAlias, TypeVar

import pytest

from protocols import messages as msg
from protocols.bounds import bounds_of, hints
from protocols.canopen.objects import PDO_PARAMETERS, RESTORE, STORE, Object, Objects, title, to_bytes
from protocols.cia402 import objects as cia402
from protocols.conformance.bench import START, STEP, Shaft, build, make_driver, request
from protocols.conformance.case import addresses_of, alternatives, by_name
from protocols.cubemars.table import SERVO
from protocols.ddsm import table as ddsm
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Event, Feedback, Mode, Request
from protocols.moteus.codec import command_id, make_frame, write
from protocols.odrive_ascii.table import line as ascii_line
from protocols.odrive_can import options as odrive
from protocols.odrive_can.table import DIALECTS, OFFSET_CALIBRATION, ControlMode, InputMode, table_of
from protocols.plain.table import encode
from protocols.plain.twin import WRITABLE
from protocols.plugin import Device, Plugin, load_all
from protocols.toolkit.register_motor import RegisterAdapter
from protocols.zlac8015d import table as zlac
from tests.sampled import sampled

PLUGINS = {plugin.name: plugin for plugin in load_all()[0]}
NAME = "left"
T = TypeVar("T")
KNOWN, WRITTEN, ARMS, MOVES, RESTS, LOST = 2000, 20, 1500, 60, 400, 1100
"""Steps: at most until it is known; in which something is written; at most until it is armed; of each motion;
at most until it rests; without a host."""
ASKED: Mapping[type[Request], int] = {msg.Home: 1200, msg.Reboot: 1200, msg.Scan: 400}
"""Steps of a request, if not 25"""


@dataclass(frozen=True, eq=False)
class Way:
    """How a device is used, where it is not as delivered."""

    options: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    told: Sequence[Frame] = ()
    """By another host, whenever it is armed"""
    read: Sequence[str] = ()
    """Parameters that are read"""
    fault: int = 0
    """Code of one that is provoked"""


AS_DELIVERED = Way()


# -- a session ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Step:
    """What a step did."""

    velocity: float
    """Of the shaft"""
    up: tuple[Frame, ...]
    """From the device"""
    events: tuple[Event, ...]
    """What the driver reports."""

    def without(self, holds: Callable[[Frame], bool]) -> object:
        """The same, but for what parameters hold: one that is read back is none the more obeyed."""
        told = [each for each in self.events if not isinstance(each, msg.Parameter)]
        return self.velocity, [_form(frame) if holds(frame) else frame for frame in self.up], told


def _form(frame: Frame) -> object:
    return (frame.id, len(frame.data)) if isinstance(frame, CanFrame) else len(frame)


class Session:
    """A driver and a twin: what the shaft and the wire do, step by step."""

    def __init__(self, plugin: Plugin, way: Way, settings: object, written: Sequence[Frame] = ()) -> None:
        device = Device(NAME, addresses_of(plugin)[0], plugin.options(**way.options), settings)
        self.way, self.written = way, written
        self.spec = plugin.spec(device)
        self.driver, self.twin = make_driver(plugin, [device]), plugin.twin(device, 0)
        self.shaft, self.now = Shaft(friction=0.01), START
        self.mode: Mode | None = None
        self.up: Sequence[Frame] = ()

    def step(self, given: Sequence[Command | Request] = (), load: float = 0.0, *, host: bool = True) -> Step:
        """Advance by a step."""
        self.now += STEP
        events = [event for frame in self.up for event in self.driver.receive(self.now, frame)]
        if host:
            own, down = self.driver.send(self.now, given)
            events += own
            for frame in down:
                self.twin.receive(self.now, frame)
        truth = Feedback(NAME, self.now, self.shaft.position, self.shaft.velocity)
        torques, self.up = self.twin.step(self.now, [truth])
        self.mode = next((e.mode for e in reversed(events) if isinstance(e, msg.State)), self.mode)
        self.shaft.load = load
        self.shaft.turn(math.fsum(each.torque for each in torques), STEP)
        return Step(self.shaft.velocity, tuple(self.up), tuple(events))

    def run(self) -> Iterator[Step]:
        """Read it, write to it, move it in all ways, ask all there is, and leave it without a host."""
        for _ in range(KNOWN):
            yield self.step()
            if self.mode in (Mode.READY, Mode.FAULT):
                break
        yield from self.tell(self.written)
        kinds = by_name(self.spec.commands - {msg.Idle})
        for kind in kinds:
            yield from self.arm(build(kind, NAME, self.spec.ranges))
            yield from self.tell((*self.written, *self.way.told))
            for size, load in ((0.05, 0.0), (1.0, 0.3), (1e9, 0.0)):
                for sign in (1.0, -1.0):
                    goal = self.command(kind, sign * size)
                    for at in range(MOVES):
                        yield self.step([goal], -sign * load)
                        for frame in self.way.told if at == 5 else ():
                            self.twin.receive(self.now, frame)
            if msg.Estop in self.spec.requests:
                yield from (self.step([goal, *([msg.Estop(NAME)] if at == 0 else [])]) for at in range(MOVES))
            yield from self.rest()
        if kinds:
            goal = self.command(kinds[0], 0.5)
            yield from self.arm(goal)
            yield from (self.step([goal]) for _ in range(4 * MOVES))  # so that it knows its host
            yield from (self.step(load=0.05, host=False) for _ in range(LOST))
            yield from self.rest()
        if msg.Home in self.spec.requests and msg.Hold in kinds:
            yield from self.arm(msg.Hold(NAME))
            yield from self.ask(msg.Home, msg.Hold(NAME))
            yield from self.rest()
        if self.way.fault:
            self.twin.provoke(self.way.fault)
            yield from self.rest()
        for wanted in by_name(self.spec.requests - {msg.Estop}):
            yield from self.ask(wanted)

    def ask(self, wanted: type[Request], *given: Command) -> Iterator[Step]:
        """Make the requests of a kind, while this is commanded."""
        for each in self.requests(wanted):
            yield self.step([each, *given])
            yield from (self.step(given) for _ in range(ASKED.get(wanted, 25)))

    def tell(self, frames: Sequence[Frame]) -> Iterator[Step]:
        """Send it frames of another host, whose replies are that one's."""
        for at in range(WRITTEN):
            for frame in frames[at : at + 1]:
                self.twin.receive(self.now, frame)
            velocity = self.step().velocity
            self.up = ()
            yield Step(velocity, (), ())

    def arm(self, goal: Command) -> Iterator[Step]:
        """Command this until it is armed."""
        for _ in range(ARMS):
            yield self.step([goal])
            if self.mode is Mode.ARMED:
                return

    def rest(self) -> Iterator[Step]:
        """Release it, and clear its faults."""
        idle = msg.Idle(NAME)
        yield from (self.step([idle]) for _ in range(MOVES))
        if msg.ClearFault in self.spec.requests:
            yield self.step([idle, msg.ClearFault(NAME)])
        for at in range(RESTS):
            yield self.step([idle])
            if at > MOVES and self.mode is not Mode.ARMED:
                break

    def command(self, kind: type[Command], size: float) -> Command:
        """Return a command of this size, within its ranges."""
        share = math.copysign(min(abs(size), 1.0), size)
        values = (
            {"velocity": 30.0 * size, "torque": 0.5 * size}
            if kind is not msg.Position
            else {"position": 3.0 * share}
        )
        if kind is msg.Impedance:
            values = {"position": 3.0 * share, "torque": 0.1 * share, "stiffness": 2.0, "damping": 0.05}
        return build(kind, NAME, self.spec.ranges, values)

    def requests(self, kind: type[Request]) -> Iterator[Request]:
        """Yield the requests of a kind: of ReadParameter all there are."""
        if kind is msg.ReadParameter:
            names = dict.fromkeys((*self.spec.parameters, *self.spec.configuration, *self.way.read))
            yield from (msg.ReadParameter(NAME, name) for name in names)
        elif kind is not msg.WriteParameter and (one := request(kind, NAME)) is not None:
            yield one


def settings_of(plugin: Plugin, way: Way, **others: object) -> object:
    """Return the settings of a device that is used in this way, with others."""
    settings: object = replace(plugin.settings(), **{**way.settings, **others})
    return settings


@cache
def usual_steps(plugin: Plugin, way: Way) -> Sequence[Step]:
    """Return a session without a change."""
    return [*Session(plugin, way, settings_of(plugin, way)).run()]


# -- settings ------------------------------------------------------------------------------------------------

OTHERS: Mapping[str, Sequence[object]] = {
    "firmware": ("0.5.5", "0.6.9", "1.2.3"),
    "uuid": ("0" * 31 + "1",),
    "device_name": ("another",),
    "lacks": ("6079 606C",),
    "other_axis": (3,),
}
"""Other values of settings, of texts above all."""


def other_values(default: object, name: str) -> Iterator[object]:
    """Yield other values of a setting."""
    value, bounds = getattr(default, name), bounds_of(hints(type(default))[name])
    yield from (other for other in OTHERS.get(name, ()) if type(other) is type(value))
    yield from getattr(bounds, "only", ())
    yield from (other for each, other in alternatives(default) if each == name)
    if bounds is None:
        return
    for number in (0.1 * value, 10.0 * value, 0.01, 1.0, bounds.least, bounds.most):
        if math.isfinite(number) and bounds.admit(number):
            yield type(value)(number)


def valid_values(plugin: Plugin, way: Way, name: str) -> Iterator[object]:
    """Yield those that the plugin accepts, and that are not the present one."""
    usual: Any = settings_of(plugin, way)
    for value in other_values(usual, name):
        try:
            changed = replace(usual, **{name: value})
        except ValueError:
            continue
        if changed != usual:
            yield value


def changes(plugin: Plugin, way: Way, name: str) -> bool:
    """True if another value of this setting changes a session."""
    for value in valid_values(plugin, way, name):
        changed = Session(plugin, way, settings_of(plugin, way, **{name: value})).run()
        if any(one != other for one, other in zip_longest(usual_steps(plugin, way), changed)):
            return True
    return False


ENDPOINTS = tuple(
    f"{path} {number} {'bool' if kind is bool else 'uint32' if kind is int else 'float'}"
    for number, (path, name) in enumerate(odrive.SETTING_OF.items(), 300)
    for kind in [type(getattr(odrive.Settings(), name))]
)


def odrive_told(name: str, address: int = 1, line: str = "0.6", **values: float) -> Way:
    """Return the way of an ODrive that another host tells something."""
    return Way({"firmware": line}, told=(table_of(line).encode(name, address, **values),))


def spinout(slow: float, most: float) -> Way:
    return Way(
        {"firmware": "0.6"},
        {"spinout_mechanical_power_threshold": -slow, "spinout_electrical_power_threshold": most},
    )


def for_all(names: str, each: T) -> Mapping[str, T]:
    return dict.fromkeys(names.split(), each)


TRAJECTORY = Way({"firmware": "0.6", "position_input": "trap_traj"})
RAMP = odrive_told("Set_Controller_Mode", Control_Mode=ControlMode.VELOCITY, Input_Mode=InputMode.VEL_RAMP)
TORQUE_RAMP = odrive_told(
    "Set_Controller_Mode", Control_Mode=ControlMode.TORQUE, Input_Mode=InputMode.TORQUE_RAMP
)
OF_ODRIVE: Mapping[str, Way] = {
    **for_all("trap_vel_limit trap_accel_limit trap_decel_limit inertia", TRAJECTORY),
    "input_filter_bandwidth": Way({"firmware": "0.6", "position_input": "pos_filter"}),
    "enable_torque_mode_vel_limit": Way({"firmware": "0.6"}, {"vel_limit": 0.1, "vel_limit_tolerance": 0.0}),
    "enable_watchdog": Way({"firmware": "0.6"}, {"watchdog_timeout": 0.2}),
    "watchdog_timeout": Way({"firmware": "0.6"}, {"watchdog_timeout": 0.2, "enable_watchdog": True}),
    "vel_ramp_rate": RAMP,
    "torque_ramp_rate": TORQUE_RAMP,
    "spinout_electrical_power_threshold": spinout(0.01, 100.0),
    "spinout_mechanical_power_threshold": spinout(100.0, 0.01),
    "spinout_power_bandwidth": spinout(0.01, 0.01),
}


def written(name: str, value: int) -> Way:
    """Return the way of an ODrive of which another host writes a property, in ASCII."""
    return Way({"firmware": "0.6"}, told=(ascii_line(f"w axis1.{name} {value}"),))


_INPUT = "controller.config.input_mode"
IN_ASCII: Mapping[str, Way] = {
    **{name: way for name, way in OF_ODRIVE.items() if way.settings},
    **for_all(
        "trap_vel_limit trap_accel_limit trap_decel_limit inertia", written(_INPUT, InputMode.TRAP_TRAJ)
    ),
    "input_filter_bandwidth": written(_INPUT, InputMode.POS_FILTER),
    "vel_ramp_rate": written(_INPUT, InputMode.VEL_RAMP),
    "torque_ramp_rate": written(_INPUT, InputMode.TORQUE_RAMP),
    "procedure_ms": written("requested_state", OFFSET_CALIBRATION),
    "motor_thermal_resistance": Way(read=("axis1.motor.motor_thermistor.temperature",)),
}
MOTEUS_ON = make_frame(command_id(1), bytes((0x01, 0x00, 0x0A)) + write(0x20, None, 0.1, 0.0))
"""Another host's command of a moteus, without a timeout."""
_RATES = "motor_error encoder_error controller_error sensorless_error encoder_count sensorless"
WAYS: Mapping[str, Mapping[str, Way]] = {
    "plain": for_all(" ".join(WRITABLE), Way({"kind": "motor"})),
    "odrive_can": {
        **OF_ODRIVE,
        **for_all(" ".join(f"{each}_rate_ms" for each in _RATES.split()), Way({"firmware": "0.5"})),
        "other_axis": odrive_told("Reboot (0.5.x)", 3, "0.5"),
        "procedure_ms": odrive_told("Set_Axis_State", Axis_Requested_State=OFFSET_CALIBRATION),
    },
    "odrive_ascii": IN_ASCII,
    "cia402": {"digital_inputs": Way(read=("60FD",)), "sdo_waiting": Way(settings={"sdo_delay_ms": 250})},
    "moteus": {
        "position_derate": Way(settings={"position_min": -0.01, "position_max": 0.01}),
        "max_velocity_derate": Way(settings={"max_velocity": 0.5}),
        "default_timeout_s": Way(told=(MOTEUS_ON,)),
    },
    "myactuator": {"timeout_ms": Way({"timeout_ms": 0})},
    "ddsm": {"fault_ms": Way(fault=next(iter(ddsm.FAULTS)))},
    "cubemars": {"supply": Way(told=(SERVO.encode("SET_DUTY", 1, value=0.1),))},
}
"""By protocol, how a setting is used that matters only so."""
SET_BY_DRIVER = "the driver writes it before it arms"
UNUSED: Mapping[str, Mapping[str, str]] = {
    **for_all("odrive_can odrive_ascii", dict.fromkeys(("control_mode", "input_mode"), SET_BY_DRIVER)),
    "cia402": {"heartbeat_consumer": SET_BY_DRIVER},
    "zlac8015d": {"offline_time_ms": SET_BY_DRIVER},
}
"""Settings that change nothing, by protocol, and why."""
IN_0_5, IN_0_6 = Way({"firmware": "0.5"}), Way({"firmware": "0.6"})
WITH_ENDPOINTS = {
    path: replace(way, options={"endpoints": ENDPOINTS, "endpoints_version": "0.6.10", **way.options})
    for path, way in ((path, OF_ODRIVE.get(name, IN_0_6)) for path, name in odrive.SETTING_OF.items())
}
_TRAJECTORY = "Set_Traj_Vel_Limit Set_Traj_Accel_Limits Set_Traj_Inertia"
PROFILE = Way({"modes": "profile"})


def controlword(word: int) -> Way:
    """Return the way of a CiA 402 drive that another host gives a controlword."""
    return Way(told=(CanFrame(0x601, bytes((0x2B, 0x40, 0x60, 0, *word.to_bytes(2, "little"), 0, 0))),))


WRITTEN_IN: Mapping[str, Mapping[str, Way]] = {
    "plain": WAYS["plain"],
    "odrive_can 0.5": {
        **dict.fromkeys(DIALECTS["0.5"].writable().values(), IN_0_5),
        **for_all(_TRAJECTORY, Way({"firmware": "0.5", "position_input": "trap_traj"})),
    },
    "odrive_can 0.6": {
        **dict.fromkeys(DIALECTS["0.6"].writable().values(), IN_0_6),
        **for_all(_TRAJECTORY, TRAJECTORY),
    },
    "odrive_can endpoints": WITH_ENDPOINTS,
    "cia402": {
        **for_all("6067 6068 606D 606E 606F 6081 6083 6084 6087 60AA", PROFILE),
        **for_all("6097:01 6097:02", replace(PROFILE, settings={"acceleration_unit": 0})),
        **for_all("6099:02 609A", Way(settings={"homing_method": 33})),
        "605C": controlword(0x07),
        "605D": controlword(0x10F),
        "6066": Way(settings={"following_window": 1}),
        "6092:02": Way(settings={"feed": 10_000}),
        "60C2:02": Way(settings={"interpolation_ms": 20}),
    },
}
"""By table, how the device is used to which a parameter is written, if not as delivered."""
NOT_YET = "the twin does not simulate it yet"
OTHER_MODE = "it counts in another mode than that of the default options"
KEPT: Mapping[str, Mapping[str, str]] = {
    "cia402": {
        "1003": "it ends the history of errors, which is only read",
        "1005": "SYNC is 80h for all here",
        "1006": "a drive produces no SYNC here",
        "1016:01": SET_BY_DRIVER,
        "6075": "current is reported as the share of the rated one that torque is",
        "6099:01": "it has no switches to search for",
        "60FE:01": "it has no outputs",
        "60FE:02": "it has no outputs",
    },
    "zlac8015d": {
        "1005": "SYNC is 80h for all here",
        "200F": "what 60FF:03 does where it is 0 is not known",
        **dict.fromkeys(("6083:02", "6084:02"), "of the other motor, which is another twin"),
    },
    "damiao": {
        **for_all("ACC DEC MAX_SPD KP_ASR KI_ASR KP_APR KI_APR", OTHER_MODE),
        **for_all("KT_Value I_BW GREF Deta V_BW IQ_c1 VL_c1", NOT_YET),
    },
    "robstride": {
        **for_all(
            "CAN_TIMEOUT iq_ref spd_ref loc_ref limit_spd limit_cur loc_kp spd_kp spd_ki acc_rad vel_max "
            "acc_set",
            OTHER_MODE,
        ),
        **for_all("zero_sta cur_kp cur_ki cur_filt_gain spd_filt_gain", NOT_YET),
    },
}
"""Parameters that are kept and change nothing, by protocol, and why."""


SETTINGS = [(name, each.name) for name, plugin in PLUGINS.items() for each in fields(plugin.settings)]


@pytest.mark.sample(15)
@pytest.mark.parametrize(("name", "setting"), sampled(SETTINGS, 8))
def test_every_setting_of_a_twin_changes_its_shaft_or_the_wire(name: str, setting: str) -> None:
    why, way = UNUSED.get(name, {}).get(setting), WAYS.get(name, {}).get(setting, AS_DELIVERED)
    assert changes(PLUGINS[name], way, setting) != bool(why), why


# -- parameters ----------------------------------------------------------------------------------------------

Writes: TypeAlias = Callable[[float], Sequence[Frame]]
"""What writes a value."""


def of_registers(protocol: str) -> Mapping[str, Writes]:
    """Return the writable registers of a motor that has some."""
    plugin = PLUGINS[protocol]
    driver: Any = plugin.driver([Device(NAME, 1, plugin.options(), plugin.settings())])
    adapter: RegisterAdapter = driver.adapter

    def writes(name: str) -> Writes:
        def write(value: float) -> Sequence[Frame]:
            return adapter.about("write", 1, name, value) if not adapter.registers.wrong(name, value) else ()

        return write

    return {name: writes(name) for name, each in adapter.registers.by_name.items() if each.writable}


def of_objects(objects: Objects, without: Iterable[tuple[int, int]]) -> Mapping[str, Writes]:
    """Return the writable objects of a CANopen device, without its commands and PDOs, which its host maps."""

    def writes(each: Object) -> Writes:
        def write(value: float) -> Sequence[Frame]:
            if value != int(value) or not each.type.low <= value <= each.type.high:
                return ()
            data, (index, sub) = to_bytes(each.type, int(value)), each.key
            head = bytes([{1: 0x2F, 2: 0x2B, 4: 0x23}[len(data)], *index.to_bytes(2, "little"), sub])
            return (CanFrame(0x601, (head + data).ljust(8, b"\0")),)

        return write

    without = {*without, STORE, RESTORE}
    rows = [each for key, each in objects.items() if key not in without and key[0] not in PDO_PARAMETERS]
    return {f"{title(each.key)}": writes(each) for each in rows if each.access == "rw"}


def of_messages(line: str) -> Mapping[str, Writes]:
    """Return what an ODrive is sent by messages of its own: all numbers of one are the same here."""
    table, names = table_of(line), DIALECTS[line].writable()

    def writes(row: str) -> Writes:
        fields_ = [each.name for each in table.row(row).fields if each.name != "address"]
        return lambda value: (table.encode(row, 1, **dict.fromkeys(fields_, value)),)

    return {row: writes(row) for row in dict.fromkeys(names.values()) if row not in ("Set_Axis_State",)}


def of_endpoints() -> Mapping[str, Writes]:
    """Return the endpoints of an ODrive that are settings."""
    registers = odrive.Options(**next(iter(WITH_ENDPOINTS.values())).options).registers()

    def writes(name: str, number: int) -> Writes:
        def write(value: float) -> Sequence[Frame]:
            if registers.wrong(name, value):
                return ()
            raw = registers.raw(name, value)
            return (table_of("0.6").encode("RxSdo", 1, Endpoint_ID=number, Value=raw),)

        return write

    return {name: writes(name, each.number) for name, each in registers.by_name.items()}


def of_plain() -> Mapping[str, Writes]:
    """Return the parameters of a plain motor."""

    def writes(name: str) -> Writes:
        return lambda value: (encode(1, msg.WriteParameter(NAME, name, value)),)

    return {name: writes(name) for name in WRITABLE}


CIA402_COMMANDS = {*cia402.TARGETS, cia402.CONTROLWORD, cia402.MODE}
ZLAC_COMMANDS = {zlac.CONTROL, zlac.MODE, zlac.SET_POINT, *((zlac.TARGET, side) for side in zlac.SIDES)}
ZLAC_LACKS = {key for key in zlac.OBJECTS if key[0] in zlac.LACKS}
TABLES: Mapping[str, Mapping[str, Writes]] = {
    "plain": of_plain(),
    "odrive_can 0.5": of_messages("0.5"),
    "odrive_can 0.6": of_messages("0.6"),
    "odrive_can endpoints": of_endpoints(),
    "cia402": of_objects(cia402.OBJECTS, CIA402_COMMANDS),
    "zlac8015d": of_objects(zlac.OBJECTS, ZLAC_COMMANDS | ZLAC_LACKS),
    "damiao": of_registers("damiao"),
    "robstride": of_registers("robstride"),
}
"""What each twin lets be written; the others let nothing be."""
PARAMETERS = [(name, parameter) for name, table in TABLES.items() for parameter in table]
VALUES = (1.0, 100.0, 0.02, 3.0, 0.0, 33.0, float(0x00B4_4700), float(0x00C0_0300), float(0x0041_0000))
"""The last of them are units: rpm, rpm a second, degrees."""


def is_answer(frame: Frame) -> bool:
    """True of a frame that may hold a parameter: of CANopen, one of SDO."""
    return not isinstance(frame, CanFrame) or frame.id not in range(0x100, 0x500)


def matters(plugin: Plugin, way: Way, writes: Writes, most: int = len(VALUES)) -> bool:
    """True if one of the values, of so many, changes a session when it is written."""
    for frames in islice(filter(None, map(writes, VALUES)), most):
        changed = Session(plugin, way, settings_of(plugin, way), frames).run()
        for one, other in zip_longest(usual_steps(plugin, way), changed):
            if one is None or other is None or one.without(is_answer) != other.without(is_answer):
                return True
    return False


@pytest.mark.sample(7)
@pytest.mark.parametrize(("table", "parameter"), sampled(PARAMETERS, 8))
def test_every_parameter_that_can_be_written_changes_the_shaft_or_the_wire(
    table: str, parameter: str
) -> None:
    plugin, writes = PLUGINS[table.partition(" ")[0]], TABLES[table][parameter]
    why, way = KEPT.get(table, {}).get(parameter), WRITTEN_IN.get(table, {}).get(parameter, AS_DELIVERED)
    assert matters(plugin, way, writes, 2 if why else len(VALUES)) != bool(why), why
