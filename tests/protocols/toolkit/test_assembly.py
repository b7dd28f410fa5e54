"""What a plugin of motors refuses when it is put together."""

from __future__ import annotations

import pytest

from protocols.plugin import Device, Plugin, load


def device(plugin: Plugin, name: str, address: int) -> Device:
    return Device(name, address, plugin.options(), plugin.settings())


@pytest.mark.parametrize("name", ["damiao", "moteus", "odrive_can", "plain"])
def test_two_devices_with_one_address_are_refused(name: str) -> None:
    plugin = load(name)
    plugin.driver([device(plugin, "left", 1), device(plugin, "right", 2)])
    with pytest.raises(ValueError, match=r"address 1 of (left|right)"):
        plugin.driver([device(plugin, "left", 1), device(plugin, "right", 1)])


@pytest.mark.parametrize("address", [-1, 0, 16, 1000])
def test_an_address_that_a_motor_cannot_have_is_refused(address: int) -> None:
    plugin = load("damiao")
    with pytest.raises(ValueError, match=f"address {address} of left: .* 1 to 15"):
        plugin.spec(device(plugin, "left", address))
