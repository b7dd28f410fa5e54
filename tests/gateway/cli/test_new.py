"""`gateway new`: from a scan to a robot that drives, without a file that is edited by hand."""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft7Validator

from gateway.cli import new
from gateway.cli.main import main
from gateway.cli.new import make, parts_in
from gateway.config import cautions, load_robot, parse_robot
from gateway.config.answers import Answers, Question
from gateway.config.bodies import load_body
from gateway.config.new_robot import Part, Plan, needed
from gateway.config.toml_text import shown
from gateway.core.robot import BusSettings, Robot
from gateway.errors import UserError
from gateway.runtime import which_motor
from gateway.runtime.configuration import Motors
from gateway.runtime.scan import Heard, likely
from protocols import messages as msg
from protocols.messages import SECOND, Feedback, Goal, Mission, Nanos, Reach
from tests.gateway.cli.box import AXES, Box, arm_parts, arm_urdf, rover_parts
from tests.sampled import sampled

PAGE = Path(__file__).parents[3] / "docs" / "from-a-box.md"
ROVER = {"slcan:/dev/ttyACM0": "can0", "serial:/dev/ttyUSB0": "sensors"}
ARM = {"slcan:/dev/ttyACM1": "can"}


# -- the page ----------------------------------------------------------------------------------------------


def executed(page: str, capsys: pytest.CaptureFixture[str], plug: Any) -> str:
    """Return a page with what its commands print now; they run in the working directory."""
    text, rest = "", page
    while "```console\n" in rest:
        before, _, rest = rest.partition("```console\n")
        block, _, rest = rest.partition("```\n")
        text += f"{before}```console\n{''.join(_block(block, capsys, plug))}```\n"
    return text + rest


def _block(block: str, capsys: pytest.CaptureFixture[str], plug: Any) -> Iterator[str]:
    command = ""
    for line in block.splitlines(keepends=True):
        if not command and not line.startswith("$ "):
            continue
        command += line
        if line.endswith("\\\n"):
            continue
        yield command + _printed(command.removeprefix("$ ").replace("\\\n", " "), capsys, plug)
        command = ""


def _printed(command: str, capsys: pytest.CaptureFixture[str], plug: Any) -> str:
    line, _, target = command.strip().partition(" > ")
    program, *words = shlex.split(line)
    if program == "cat":
        return Path(words[0]).read_text("utf-8")
    plug(words)
    main(words)
    out, err = capsys.readouterr()
    if target:
        Path(target).write_text(out, "utf-8")
        return str(err)
    return str(out + err)


def test_the_page_is_what_is_printed_and_what_it_writes_drives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rover, arm = Box(rover_parts(), ROVER), Box(arm_parts(tmp_path), ARM)
    monkeypatch.chdir(tmp_path)

    def plug(words: list[str]) -> None:
        (arm if "slcan:/dev/ttyACM1" in words else rover).plug_in(monkeypatch)

    page = PAGE.read_text("utf-8")
    now = executed(page, capsys, plug)
    (tmp_path / PAGE.name).write_text(now)
    assert now == page, f"cp {tmp_path / PAGE.name} {PAGE}"
    for name in ("rover", "six"):
        made = load_robot(tmp_path / f"{name}.toml")
        assert cautions(made) == []
    drives(rover, tmp_path / "rover.toml")
    reaches(arm, tmp_path / "six.toml")


def drives(box: Box, file: Path) -> None:
    robot = load_robot(file)
    with box.session(robot) as session:
        session.submit(Goal(0.3, 0.05))
        for _ in session.run(20.0):
            if session.belief.goal is None:
                break
        assert all(not joint.faults for joint in session.joints.values())
    truth = box.world.world.truth()
    assert (truth.x, truth.y) == pytest.approx((0.3, 0.05), abs=0.1)


def reaches(box: Box, file: Path) -> None:
    robot = load_robot(file)
    assert {name: motor.joint.sign for name, motor in robot.motors.items()}["elbow_joint"] == -1
    targets = {
        "shoulder_pan_joint": 0.5,
        "shoulder_lift_joint": -0.3,
        "elbow_joint": 0.6,
        "wrist_2_joint": -0.4,
    }
    with box.session(robot) as session:
        session.submit(Mission("out", (Reach(tuple(msg.Position(n, at) for n, at in targets.items())),)))
        for tick in session.run(6.0):  # at its end it is let down
            if tick.number == 300:
                break
        at = {name: box.world.world.shaft(name)[0] for name in targets}
    assert at == pytest.approx(targets, abs=0.05)


# -- at which bit rate -------------------------------------------------------------------------------------


def scanned(box: Box, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> list[str]:
    box.plug_in(monkeypatch)
    assert main(["scan", "slcan:/dev/ttyACM0", "--protocol", "vesc"]) == 0
    out: str = capsys.readouterr().out
    return out.splitlines()


FOUND = [f"  vesc         address {at}    hardware type 0" for at in (11, 12, 13, 14)]


def test_frames_and_errors_tell_the_bit_rate(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The status messages of the VESCs are heard; at any other rate nothing is sent."""
    first, second, *rest = scanned(Box(rover_parts(), ROVER), monkeypatch, capsys)
    assert first == "slcan:/dev/ttyACM0 at 1,000,000 bit/s: errors"
    assert second.startswith("slcan:/dev/ttyACM0 at 500,000 bit/s: ")
    assert second.endswith(" frames")
    assert rest[:2] == [f"slcan:/dev/ttyACM0 at {rate} bit/s: errors" for rate in ("250,000", "125,000")]
    assert rest[2:] == ["slcan:/dev/ttyACM0 at 500,000 bit/s: vesc", *FOUND]


def test_on_a_silent_bus_each_rate_is_asked_at_until_one_is_answered(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = rover_parts()
    quiet = {
        name: replace(one, device=replace(one.device, settings=type(one.device.settings)(status_messages=0)))
        for name, one in parts.motors.items()
    }
    box = Box(replace(parts, motors=quiet), ROVER, deaf=True)
    lines = scanned(box, monkeypatch, capsys)
    assert lines[:4] == [
        f"slcan:/dev/ttyACM0 at {rate} bit/s: silent"
        for rate in ("1,000,000", "500,000", "250,000", "125,000")
    ]
    head = "slcan:/dev/ttyACM0 at {} bit/s: vesc"
    asked = [head.format("1,000,000"), "  nothing answers", head.format("500,000"), *FOUND]
    assert lines[4:] == asked


@pytest.mark.parametrize(
    ("heard", "rates"),
    [
        ({1: Heard(errors=True), 2: Heard(7, 5), 3: Heard()}, [2]),
        ({1: Heard(), 2: Heard(errors=True), 3: Heard()}, [1, 3]),
        ({1: Heard(90, 2), 2: Heard(60, 30)}, [2, 1]),
        ({1: Heard(errors=True)}, []),
    ],
)
def test_which_rates_are_likely(heard: dict[int, Heard], rates: list[int]) -> None:
    assert likely(heard) == rates


# -- what is stated ------------------------------------------------------------------------------------------


def part(address: int, protocol: str = "vesc", interface: str = "socketcan:can0", **others: Any) -> Part:
    return Part(interface, protocol, address, 500_000, **others)


STATED = {
    "body": "differential",
    "left.address": "1",
    "right.address": "2",
    "left.sign": "1",
    "right.sign": "-1",
    "gear": "1",
    "pole_pairs": "15",
    "torque_constant": "0.5",
    "min_erpm": "0",
    "wheel_radius": "0.05",
    "wheel_separation": "0.22",
    "length": "0.4",
    "width": "0.3",
    "torque": "2",
}


def made(stated: dict[str, str], *parts: Part, **others: Any) -> str:
    plan = Plan("robot", parts or (part(1), part(2)), Answers(stated), **others)
    return make(plan, None, read=False)


def test_what_is_stated_makes_a_robot() -> None:
    robot = parse_robot(made(STATED))
    assert [(one.device.address, one.joint.sign) for one in robot.motors.values()] == [(1, 1), (2, -1)]
    assert all(not motor.assumed for motor in robot.motors.values())
    base = robot.brain.body.as_base
    assert base is not None
    fastest = (base.max_linear + base.max_angular * 0.11) / 0.05
    assert robot.motors["left"].joint.limits.velocity == pytest.approx(1.25 * fastest, rel=0.01)


SCALES = (
    "gear",
    "pole_pairs",
    "torque_constant",
    "min_erpm",
    "wheel_radius",
    "wheel_separation",
    "left.sign",
)


@pytest.mark.parametrize("key", [*SCALES, "left.address", "torque", "body", "length"])
def test_what_scales_or_limits_is_never_assumed(key: str) -> None:
    stated = {name: value for name, value in STATED.items() if name != key}
    asked = "--motor left" if key == "left.address" else f"--set {key}"
    with pytest.raises(UserError, match=rf"{asked}=…"):
        made(stated)


@pytest.mark.parametrize(
    ("stated", "why"),
    [
        ({"gear": "fast"}, "--set gear=fast: found 'fast', expected a number"),
        ({"wheel_radius": "80"}, "--set wheel_radius=80: found 80, expected a number from 0.005 to 2 m"),
        ({"left.address": "9"}, "left: no motor was found at address 9; found: 1, 2"),
        ({"body": "diferential"}, "--set body=diferential: found 'diferential', expected .*differential"),
        ({"left.sign": "0"}, "--set left.sign=0: found '0', expected 1, -1"),
        ({"wheel_radios": "0.05"}, "stated, and nothing of this robot: wheel_radios"),
    ],
)
def test_what_is_stated_wrongly_is_said(stated: dict[str, str], why: str) -> None:
    with pytest.raises(UserError, match=why):
        made(STATED | stated)


LEFT_OUT = ("boom", "diffbot_mixed", "diffbot_mixed_can", "husky", "jackal", "mobile_arm", "two_arms")
"""Robots of several limbs, with a motor beside their base, whose reports are rare (their timeouts have to be
written), or of recordings, which have no buses"""
SHIPPED = [path.stem for path in sorted(Path("fixtures/robots").glob("*.toml")) if path.stem not in LEFT_OUT]


def answers_of(robot: Robot, table: dict[str, Any]) -> dict[str, str]:
    """What somebody states who knows the robot."""
    kind, base = robot.brain.body.kind, robot.brain.body.as_base is not None
    own: dict[str, Any] = dict(table["brain"].get(kind, {}))
    own |= {"body": kind, "length": 0.4, "width": 0.3} if base else {"body": kind}
    for key in load_body(kind).motor_keys():
        several = own.pop(key)
        own |= {} if isinstance(several, str) else {key: ",".join(several)}
    for name, one in robot.motors.items():
        joint, options = one.joint, one.device.options
        values = {"address": one.device.address, "interface": interface(robot.buses[one.bus])}
        values |= {"sign": joint.sign, "gear": joint.gear, "torque": joint.limits.torque}
        values |= {} if base else {"velocity": joint.limits.velocity}
        values |= {"options.gear" if key == "gear" else key: getattr(options, key) for key in one.spec.scales}
        own |= {f"{name}.{key}": value for key, value in values.items()}
    for name, sensor in robot.sensors.items():
        own |= {f"{sensor.plugin.name}.{sensor.device.address}": name, f"{name}.mount": "0.1,0,0.2,0"}
        own |= {f"{name}.{key}": getattr(sensor.device.options, key) for key in sensor.spec.scales}
    left_out = ("radius", "footprint")
    return {
        key: one if isinstance(one, str) else shown(one) for key, one in own.items() if key not in left_out
    }


def interface(bus: BusSettings) -> str:
    return f"{bus.kind if bus.carries_bytes else 'socketcan'}:{bus.name}"


@pytest.mark.parametrize("name", sampled(SHIPPED, 5))
def test_every_robot_that_ships_can_be_made_so(name: str) -> None:
    robot = load_robot(name)
    table = tomllib.loads(Path(f"fixtures/robots/{name}.toml").read_text("utf-8"))
    parts = []
    for one in robot.devices():
        bus = robot.buses[one.bus]
        rates = bus.bitrate or bus.baudrate, bus.kind, bus.data_bitrate
        parts.append(Part(interface(bus), one.plugin.name, one.device.address, *rates))
    file = table.get("urdf", "")
    text = Path(f"fixtures/robots/{file}").read_text("utf-8") if file else ""
    plan = Plan(name, parts, Answers(answers_of(robot, table)), file, text)
    again = parse_robot(
        make(plan, None, read=False) + (f"[files]\n{shown(file)} = {shown(text)}" if file else "")
    )
    assert again.motors.keys() == robot.motors.keys()
    assert type(again.brain.body) is type(robot.brain.body)
    assert again.brain.body.joints == robot.brain.body.joints
    for motor, one in again.motors.items():
        known, scales = robot.motors[motor], one.spec.scales
        assert (one.device.address, one.joint.sign, one.joint.gear) == (
            known.device.address,
            known.joint.sign,
            known.joint.gear,
        )
        assert [getattr(one.device.options, key) for key in scales] == [
            getattr(known.device.options, key) for key in scales
        ]
        assert one.assumed == ()
    if (base := again.brain.body.as_base) is not None:
        fastest = needed(base)
        assert all(again.motors[one].joint.limits.velocity <= fastest[one][0] * 1.01 for one in base.joints)


def test_one_motor_may_be_another_and_devices_on_two_buses_have_one_address() -> None:
    parts = part(1), part(1, interface="socketcan:can1")
    stated = STATED | {"right.address": "1", "left.interface": "socketcan:can0", "right.pole_pairs": "7"}
    robot = parse_robot(made(stated, *parts))
    assert [(one.bus, one.device.options.pole_pairs) for one in robot.motors.values()] == [
        ("can0", 15),
        ("can1", 7),
    ]


def test_a_scan_that_is_none_or_has_two_devices_with_one_address_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "scan.json"
    row = {"interface": "socketcan:can0", "protocol": "vesc", "address": 1, "rate": 500_000, "kind": "can"}
    row |= {"data_rate": 0, "serial": None, "detail": ""}
    for text, why in (
        ("nothing", "is not what `gateway scan --json` prints"),
        (json.dumps([{**row, "duplicate": True}]), "gateway motor set-id"),
        (json.dumps([{**row, "duplicate": False}] * 2), "gateway motor set-id"),
        ("[]", "nothing was found: give --from"),
    ):
        file.write_text(text)
        assert main(["new", str(tmp_path / "r.toml"), "--from", str(file)]) == 2
        assert why in capsys.readouterr().err
    assert not (tmp_path / "r.toml").exists()
    file.write_text(json.dumps([{**row, "duplicate": False}]))
    assert parts_in(file) == [part(1)]


# -- what a person is asked and shows ------------------------------------------------------------------------


def test_a_person_is_asked_what_is_not_stated_again_if_the_answer_cannot_be_one() -> None:
    asked: list[str] = []
    said: list[str] = []
    given = iter(["many", "15"])

    def ask(question: Question) -> str:
        asked.append(question.key)
        said.extend([question.text] if question.key == "pole_pairs" else [])
        return (
            next(given) if question.key == "pole_pairs" else "" if question.proposal else STATED[question.key]
        )

    plan = Plan("robot", (part(1), part(2)), Answers({}, ask))
    assert parse_robot(make(plan, None, read=False)).motors["left"].device.options.pole_pairs == 15
    assert asked[:3] == ["body", "left.address", "right.address"]
    assert asked.count("pole_pairs") == 2
    assert said[-1].startswith("found 'many', expected from 1 to 100; Electrical revolutions")
    assert "max_linear" in plan.answers.proposed


def test_on_a_terminal_it_is_asked_for_and_an_end_of_the_input_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = {
        "interface": "socketcan:nowhere",
        "protocol": "vesc",
        "rate": 500_000,
        "kind": "can",
        "data_rate": 0,
    }
    row |= {"serial": None, "detail": "", "duplicate": False}
    scan, robot = tmp_path / "scan.json", tmp_path / "r.toml"
    scan.write_text(json.dumps([{**row, "address": at} for at in (1, 2)]))
    typed = {**STATED, "left.address": ""}

    def type_(prompt: str) -> str:
        key = prompt.partition(":")[0]
        if key == "left.address" and not typed[key]:
            raise UserError("the input has ended, and nothing was done")
        return typed.get(key, "")

    monkeypatch.setattr(new, "typed", type_)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    words = ["new", str(robot), "--from", str(scan)]
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert "'socketcan:nowhere'" in out  # the bus is not there: nothing can be shown by hand
    assert "the input has ended, and nothing was done" in err
    assert not robot.exists()
    typed["left.address"] = "1"
    assert main([*words, "--which", "ask"]) == 0
    assert "the devices' own limits are not read: " in capsys.readouterr().out
    assert load_robot(robot).motors["right"].joint.sign == -1
    first, _, table = robot.read_text("utf-8").partition("\n")
    assert first == "#:schema ./robot.schema.json"  # as taplo and Even Better TOML look for it
    schema = json.loads(robot.with_name("robot.schema.json").read_text("utf-8"))
    Draft7Validator(schema).validate(tomllib.loads(table))


TWINS = tuple(part(at, interface="twin") for at in (11, 12, 13))


def shown_plan() -> Plan:
    stated = {"body": "joints", "motors": "a,b,c", "gear": "1", "pole_pairs": "15"}
    return Plan("robot", TWINS, Answers(stated | {"torque_constant": "0.5", "min_erpm": "0"}))


def test_the_shaft_that_is_turned_by_hand_is_seen_and_nothing_is_commanded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(which_motor, "PATIENCE", 5 * SECOND)
    plan = shown_plan()
    turned: dict[str, float] = {}
    said: list[str] = []
    tapped: list[Motors] = []

    @contextmanager
    def opened(plan: Plan, parts: dict[str, Part]) -> Iterator[Motors]:
        with which_motor.motors_of(plan, parts) as motors:
            twins = motors.session.twins
            assert twins is not None
            began: Nanos = motors.session.clock.now()

            def measured(name: str, one: Feedback) -> Feedback:
                by = turned.get(name, 0.0) * ((one.t - began) > 4_000_000_000)
                return replace(one, position=(one.position or 0.0) + by)

            twins.tamper.measured = measured
            tapped.append(motors)
            yield motors
            assert all(joint.mode is not msg.Mode.ARMED for joint in motors.session.joints.values())

    shown = which_motor.by_hand(plan, said.append, opened)
    turned |= {"motor_1": -1.0, "motor_0": 0.05}
    assert shown("a", TWINS) == (TWINS[1], -1)
    assert said == ["turn a FORWARDS by hand, a quarter of a turn or more; all others stand still", said[1]]
    turned |= {"motor_0": 0.9}
    assert shown("b", TWINS) is None  # two were turned
    assert said[-1] == "no shaft was turned alone within 5 s"


def test_motors_turn_one_after_the_other_and_the_person_says_which() -> None:
    plan = shown_plan()
    world: list[Motors] = []
    before: dict[str, float] = {}

    @contextmanager
    def opened(plan: Plan, parts: dict[str, Part]) -> Iterator[Motors]:
        with which_motor.motors_of(plan, parts) as motors:
            world.append(motors)
            yield motors

    def ask(text: str) -> str:
        twins = world[-1].session.twins
        assert twins is not None
        places = {name: twins.world.shaft(name)[0] for name in ("motor_0", "motor_1", "motor_2")}
        moved = {name: places[name] - before.get(name, 0.0) for name in places}
        before.update(places)
        if "which one" in text:
            (name,) = (name for name, by in moved.items() if abs(by) > 0.3)
            return {"motor_0": "c", "motor_1": "-", "motor_2": "a"}[name]
        return "n" if "forwards" in text and before["motor_2"] > 0.3 else ""

    shown = which_motor.by_jog(plan, lambda _: None, ask, opened)
    assert [shown(name, TWINS) for name in "abc"] == [(TWINS[2], -1), None, (TWINS[0], 1)]


def test_the_limits_that_devices_have_are_the_most_that_joints_get() -> None:
    parts = tuple(replace(part(at, "damiao", "twin"), rate=1_000_000) for at in (1, 2))
    stated = {
        "body": "joints",
        "motors": "a,b",
        "a.address": "1",
        "b.address": "2",
        "a.sign": "1",
        "b.sign": "1",
    }
    plan = Plan("robot", parts, Answers(stated | {"gear": "2", "model": "4310"}))
    plan.assign()
    assert which_motor.allowed(plan) == {name: {"velocity": 30.0, "torque": 10.0} for name in "ab"}
    limits = parse_robot(make(plan, None, read=True)).motors["a"].joint.limits
    assert (limits.velocity, limits.torque) == (15.0, 20.0)


def test_the_urdf_of_the_test_has_the_joints_of_a_public_one() -> None:
    assert [name for name in AXES if f'joint name="{name}"' in arm_urdf()] == list(AXES)
