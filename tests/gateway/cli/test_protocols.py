"""`gateway protocols`: the list of installed protocols, also of one whose spec raises."""

from __future__ import annotations

from dataclasses import replace

from gateway.cli.protocols import LABEL_WIDTH, WIDTH, listing
from protocols.plugin import Device, Plugin, Spec, load, load_all

LABELS = ["devices", "bus", "commands", "feedback", "watchdog", "trust"]


def blocks(*plugins: Plugin) -> dict[str, dict[str, str]]:
    """Return, by protocol, the text behind each label, its lines joined."""
    found: dict[str, dict[str, str]] = {}
    for block in "\n".join(listing(plugins)).split("\n\n"):
        name, *lines = block.splitlines()
        rows: dict[str, str] = {}
        for line in lines:
            assert len(line) <= WIDTH
            label, text = line[:LABEL_WIDTH].strip(), line[LABEL_WIDTH:]
            last = label or list(rows)[-1]
            rows[last] = text if label else f"{rows[last]} {text}"
        found[name] = rows
    return found


def test_every_installed_protocol_has_every_row() -> None:
    plugins, _ = load_all()
    listed = blocks(*plugins)
    assert list(listed) == [plugin.name for plugin in plugins]
    for plugin in plugins:
        rows = listed[plugin.name]
        assert list(rows) == LABELS
        assert all(rows.values())
        assert (rows["devices"], rows["trust"]) == (plugin.title, plugin.trust)


def test_motors_and_sensors_of_one_protocol_are_distinguished() -> None:
    rows = blocks(load("plain"))["plain"]
    assert rows["commands"] == "Idle, Hold, Position, Velocity, Torque, Impedance (and sensors)"
    assert rows["feedback"] == "sensor: cyclic every 100 ms; motor: cyclic every 5 ms"
    assert rows["watchdog"] == "motor: 100 ms; sensor: none"


def test_a_watchdog_that_is_off_is_listed_so_although_an_option_acknowledges_it() -> None:
    assert blocks(load("odrive_can"))["odrive_can"]["watchdog"] == "off as the device comes"


def test_a_spec_that_raises_is_named_and_affects_no_other() -> None:
    def spec(_: Device) -> Spec:
        raise RuntimeError("boom")

    listed = blocks(replace(load("plain"), name="broken", spec=spec), load("odrive_can"))
    assert listed["broken"]["spec"] == "raises RuntimeError: boom"
    assert listed["odrive_can"]["bus"] == "can"
