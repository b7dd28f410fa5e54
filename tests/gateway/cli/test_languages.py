"""What `gateway protocols` says of each language, and of one whose spec does not answer."""

from __future__ import annotations

from dataclasses import replace

from gateway.cli.listing import LABEL, WIDTH, listing
from protocols.plugin import Device, Plugin, Spec, load, load_all

LABELS = ["devices", "bus", "commands", "feedback", "watchdog", "trust"]


def blocks(*plugins: Plugin) -> dict[str, dict[str, str]]:
    """By language, what stands behind each label, its lines joined."""
    found: dict[str, dict[str, str]] = {}
    for block in "\n".join(listing(plugins)).split("\n\n"):
        name, *lines = block.splitlines()
        rows: dict[str, str] = {}
        for line in lines:
            assert len(line) <= WIDTH
            label, text = line[:LABEL].strip(), line[LABEL:]
            last = label or list(rows)[-1]
            rows[last] = text if label else f"{rows[last]} {text}"
        found[name] = rows
    return found


def test_every_installed_language_tells_all() -> None:
    plugins, _ = load_all()
    reported = blocks(*plugins)
    assert list(reported) == [plugin.name for plugin in plugins]
    for plugin in plugins:
        rows = reported[plugin.name]
        assert list(rows) == LABELS
        assert all(rows.values())
        assert (rows["devices"], rows["trust"]) == (plugin.title, plugin.trust)


def test_motors_and_sensors_of_one_language_are_told_apart() -> None:
    rows = blocks(load("plain"))["plain"]
    assert rows["commands"] == "Idle, Hold, Position, Velocity, Torque, Impedance (and sensors)"
    assert rows["feedback"] == "sensor: cyclic every 100 ms; motor: cyclic every 5 ms"
    assert rows["watchdog"] == "motor: 100 ms; sensor: none"


def test_a_watchdog_that_is_off_is_not_none_because_somebody_acknowledges_it() -> None:
    assert blocks(load("odrive_can"))["odrive_can"]["watchdog"] == "off as the device comes"


def test_a_spec_that_raises_is_named_and_hinders_nobody() -> None:
    def spec(_: Device) -> Spec:
        raise RuntimeError("boom")

    reported = blocks(replace(load("plain"), name="broken", spec=spec), load("odrive_can"))
    assert reported["broken"]["spec"] == "raises RuntimeError: boom"
    assert reported["odrive_can"]["bus"] == "can"
