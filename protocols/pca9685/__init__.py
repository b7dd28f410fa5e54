"""NXP PCA9685 on I²C: 16 outputs for hobby servos, or motors by PWM; no feedback (README.md).

Exports `plugin`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from protocols.bounds import Invalid
from protocols.line import Exchange, Rank
from protocols.pca9685 import table as pt
from protocols.pca9685.driver import Pca9685Adapter
from protocols.pca9685.memory import OutputDecoder
from protocols.pca9685.options import Options, Settings
from protocols.pca9685.twin import Pca9685Twin
from protocols.plugin import Device, Driver, Plugin, Spec
from protocols.toolkit import i2c
from protocols.toolkit.assembly import driver_of, fed_by_any_frame, serial_motor

__all__ = ["plugin"]

ADDRESSES = range(pt.BOARD * pt.CHIPS.stop)
NO_WATCHDOG = "a PCA9685 has no watchdog"


def spec(device: Device) -> Spec:
    """Return the contract of one output. Raises ValueError if its address cannot be one."""
    options: Options = device.options
    at, output = device.address, pt.channel(device.address)
    outputs = range(output, output + 1 + (options.kind == "pwm" and options.reversible))
    right = at in ADDRESSES and pt.chip(at) in pt.CHIPS and output in pt.CHANNELS
    if not right or outputs[-1] not in pt.CHANNELS:
        text = f"address {at} of {device.name}: an output, 0 to {pt.CHANNELS.stop - 1}, of the chip at "
        text += f"0x{pt.FIRST_CHIP:02X}; or {pt.BOARD} times the chip's address, 64 to 127, and an output"
        raise Invalid(("address", text))
    off = [i2c.transfer(pt.chip(at), pt.led(each, 0, pt.FULL)) for each in outputs]
    others: dict[str, Any] = {"bus": "i2c"} | options.of_kind
    return serial_motor(
        device,
        pt.read_only,
        ADDRESSES,
        **others,
        **fed_by_any_frame(None, NO_WATCHDOG),
        set_up={
            "MODE1": (float(pt.AWAKE), float(pt.AWAKE | pt.SLEEP)),
            "PRE_SCALE": (float(options.scale),),
        },
        stop=tuple(Exchange(each, i2c.answer(each), Rank.RELEASE) for each in off),
        unprotected=frozenset({*pt.NAMES.values(), "LED", "ALL_LED", "SWRST", "reserved"}),
    )


_driver = driver_of(Pca9685Adapter, spec)


def driver(devices: Sequence[Device]) -> Driver:
    """Return the driver of the outputs on a bus. Raises ValueError if those of one chip want two frequencies,
    or two devices have one output."""
    scales: dict[int, Device] = {}
    held: dict[tuple[int, int], str] = {}
    for one in devices:
        options: Options = one.options
        other = scales.setdefault(pt.chip(one.address), one)
        if other.options.scale != options.scale:
            text = f"{other.name} and {one.name} are on one chip, which has one frequency: found "
            raise ValueError(f"{text}{other.options.frequency:g} and {options.frequency:g} Hz")
        for each in range(1 + (options.kind == "pwm" and options.reversible)):
            name = held.setdefault((pt.chip(one.address), pt.channel(one.address) + each), one.name)
            if name != one.name:
                raise ValueError(f"{name} and {one.name} have output {pt.channel(one.address) + each} both")
    return _driver(devices)


plugin = Plugin(
    name="pca9685",
    title="NXP PCA9685 on I²C: 16 outputs for hobby servos, or motors by PWM (open loop)",
    trust="registers: NXP's data sheet, Rev. 4; bytes: adafruit-circuitpython-pca9685 3.4.22, which drove "
    "the twin. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver,
    decoder=OutputDecoder,
    twin=Pca9685Twin,
    messages=pt.names,
    vectors=("protocols.pca9685", "vectors.json"),
)
