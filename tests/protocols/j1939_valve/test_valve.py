"""Values ↔ bytes: those of Open-SAE-J1939, compiled; claims to an address, as can-j1939 made them; a
spool."""

from __future__ import annotations

from typing import Any

import pytest

from protocols import messages as msg
from protocols.bounds import Invalid
from protocols.conformance.bench import ALPHA, NAMES, Bench, make_bench
from protocols.frames import CanFrame
from protocols.j1939_valve import plugin
from protocols.j1939_valve import table as jt
from protocols.j1939_valve.options import Options, Settings
from protocols.j1939_valve.twin import ValveTwin
from protocols.messages import MILLISECOND, Mode
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of

VECTORS = {vector.name: vector.frame for vector in vectors_of(plugin)}
NAME = 0x2000_8400_FFE0_0001
SENT: dict[str, tuple[str, int, dict[str, int]]] = {
    "extend_half": ("command", 1, {"host": 39, "flow": 125, "state": jt.EXTEND, "fail_safe": 0}),
    "retract_full": ("command", 2, {"host": 39, "flow": 250, "state": jt.RETRACT, "fail_safe": 0}),
    "block": ("command", 1, {"host": 39, "flow": 0, "state": jt.BLOCK, "fail_safe": 0}),
    "float": ("command", 15, {"host": 39, "flow": 0, "state": jt.FLOAT, "fail_safe": 0}),
    "address_claimed": ("address claimed", 0, {"host": 39, "name": NAME}),
}
REPORTED: dict[str, tuple[int, dict[str, int]]] = {
    "estimated_flow": (1, {"ecu": 128, "extend": 175, "retract": 75, "state": 1, "fail_safe": 0, "limit": 0}),
    "measured_position": (1, {"ecu": 128, "position": 500, "state": jt.EXTEND}),
}


def test_no_vector_is_left_out() -> None:
    assert set(VECTORS) == {*SENT, *REPORTED}


@pytest.mark.parametrize("name", SENT)
def test_what_a_host_sends(name: str) -> None:
    message, valve, values = SENT[name]
    assert jt.TABLE.encode(message, valve, **values) == VECTORS[name]
    decoded = jt.TABLE.decode(VECTORS[name], "to_device")
    assert decoded is not None
    assert decoded.name == message
    assert decoded.values.items() >= values.items()


@pytest.mark.parametrize("name", REPORTED)
def test_what_a_controller_reports(name: str) -> None:
    valve, values = REPORTED[name]
    frame = VECTORS[name]
    assert jt.TABLE.encode(name.replace("_", " "), valve, **values) == frame
    options = Options(stroke=0.4, retracted=0.7)
    driver = plugin.driver([Device("lift", 1, options, Settings())])
    events = driver.receive(1, frame)
    if name == "estimated_flow":
        assert [event.mode for event in events if isinstance(event, msg.State)] == [Mode.ARMED]
    else:
        assert isinstance(frame, CanFrame)
        (position,) = (event.position for event in events if isinstance(event, msg.Feedback))
        assert position == pytest.approx(0.9)
        beyond = jt.TABLE.encode("measured position", 1, ecu=128, position=0xFFFF, state=0)
        assert [e.position for e in driver.receive(2, beyond) if isinstance(e, msg.Feedback)] == [None]
        foreign = jt.TABLE.encode("measured position", 1, ecu=129, position=500, state=0)
        assert not driver.receive(3, foreign)


@pytest.mark.parametrize(
    ("name", "does"),
    [
        ("extend_half", [msg.Arm("lift"), msg.Velocity("lift", 0.1)]),
        ("retract_full", []),
        ("block", [msg.Idle("lift")]),
        ("float", []),
        ("address_claimed", [msg.Kept("lift", "ADDRESS_CLAIM", 39.0)]),
    ],
)
def test_what_a_valve_obeys(name: str, does: list[msg.Obeyed]) -> None:
    decoder = plugin.decoder([Device("lift", 1, Options(full_flow=0.2), Settings())])
    assert list(decoder.decode(0, VECTORS[name])) == does


@pytest.mark.parametrize("dead_band", [0.0, 0.12, 0.5])
@pytest.mark.parametrize("velocity", [0.0, 1e-6, 0.01, -0.05, 0.2, -0.2])
def test_the_dead_band_is_passed_over(dead_band: float, velocity: float) -> None:
    options = Options(full_flow=0.2, dead_band=dead_band)
    flow = options.flow(velocity)
    assert options.velocity(flow) == pytest.approx(abs(velocity), abs=0.2 / 250 / (1.0 - dead_band))
    assert (flow == 0) is (velocity == 0.0 or (dead_band == 0.0 and abs(velocity) < 1e-4))


def test_a_host_and_a_valve_with_one_address() -> None:
    with pytest.raises(Invalid, match="host is 128, the address of the valve's controller"):
        Options(host=128)


# -- addresses ------------------------------------------------------------------------------------------


def bench(options: Options | None = None, settings: Any = None) -> Bench:
    made = make_bench(plugin, options or Options(), (1, 2), NAMES, settings)
    made.steps(150)
    return made


def claim(name: int, node: int = 39) -> CanFrame:
    return jt.TABLE.encode("address claimed by another", ecu=node, name=name)


def sent(made: Bench, count: int, *commands: msg.Command) -> list[CanFrame]:
    steps = made.steps(count, commands)
    return [frame for step in steps for frame in step.down if isinstance(frame, CanFrame)]


def test_nothing_is_sent_before_a_command_then_the_address_is_claimed_first() -> None:
    made = bench()
    assert not sent(made, 300)
    first, *others = sent(made, 3, msg.Velocity(ALPHA, 0.1))
    assert first == VECTORS["address_claimed"]
    assert {frame.id for frame in others} == {0x0CFE3127}


@pytest.mark.parametrize("host", [128 + 5, 247])
def test_an_address_for_everybody_is_waited_for(host: int) -> None:
    made = bench(Options(host=host))
    frames = sent(made, 249, msg.Velocity(ALPHA, 0.1))
    assert [frame.id for frame in frames] == [0x18EEFF00 | host]
    assert sent(made, 3, msg.Velocity(ALPHA, 0.1))


def test_an_address_is_defended_against_a_higher_name() -> None:
    made = bench()
    sent(made, 250, msg.Velocity(ALPHA, 0.1))
    made.step([msg.Velocity(ALPHA, 0.1)], extra_up=[claim(NAME + 1)])
    assert made.modes[ALPHA] is Mode.ARMED
    assert (
        made.step([msg.Velocity(ALPHA, 0.1)], extra_up=[claim(NAME + 1)]).down[0]
        == VECTORS["address_claimed"]
    )
    assert {frame.id for frame in sent(made, 100, msg.Velocity(ALPHA, 0.1))} == {0x0CFE3127}


def test_an_address_is_lost_to_a_lower_name_and_the_valves_close() -> None:
    made = bench()
    sent(made, 250, msg.Velocity(ALPHA, 0.1))
    assert made.modes[ALPHA] is Mode.ARMED
    step = made.step([msg.Velocity(ALPHA, 0.1)], extra_up=[claim(NAME - 1)])
    faults = [one for one in step.events if isinstance(one, msg.Fault)]
    assert {one.name for one in faults} == {"our address is another's"}
    assert not step.down
    assert not sent(made, 400, msg.Velocity(ALPHA, 0.1))
    twin = made.twins[0]
    assert isinstance(twin, ValveTwin)
    assert twin.mode is Mode.READY
    fresh = bench()  # another's address is no matter of ours
    fresh.step((), extra_up=[claim(NAME - 1, 40)])
    assert len(sent(fresh, 20, msg.Velocity(ALPHA, 0.1))) > 10


# -- the spool ------------------------------------------------------------------------------------------


def test_closed_ports_hold_a_load_if_they_are_tight() -> None:
    for tight in (False, True):
        made = bench(settings=Settings(tight=tight))
        made.shafts[ALPHA].load = 0.05
        made.steps(500)
        assert (abs(made.shafts[ALPHA].velocity) < 0.2) is tight


def test_a_spool_lags_has_a_dead_band_and_may_stick() -> None:
    made = bench(Options(), Settings(dead_band=0.1, lag_ms=50.0))
    twin = made.twins[0]
    assert isinstance(twin, ValveTwin)
    made.steps(400, [msg.Velocity(ALPHA, 0.4)])  # 8 %: within the dead band
    assert abs(made.shafts[ALPHA].velocity) < 0.01
    made.steps(400, [msg.Velocity(ALPHA, 2.75)])
    assert made.shafts[ALPHA].velocity == pytest.approx(5.0 * (0.55 - 0.1) / 0.9, rel=0.05)
    twin.stick()
    made.steps(400, [msg.Idle(ALPHA)])
    assert made.shafts[ALPHA].velocity == pytest.approx(2.5, rel=0.05)
    assert made.modes[ALPHA] is Mode.READY  # the controller believes that it is closed


def test_a_valve_closes_without_commands() -> None:
    made = bench(Options(timeout_ms=300))
    made.steps(400, [msg.Velocity(ALPHA, 1.0)])
    twin = made.twins[0]
    for at in range(1, 302):
        twin.step(made.now + at * MILLISECOND, ())
    assert isinstance(twin, ValveTwin)
    assert twin.mode is Mode.READY
