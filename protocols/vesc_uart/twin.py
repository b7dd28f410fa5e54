"""The device's end over a serial line: which packets a controller obeys, and what it answers.

Rules. The controller whose id is `uart_id` is at the end of the line, and obeys what is not forwarded; the
others obey what is forwarded to them. Whether one is at the end of the line or not, the others answer: of the
one between only the time is simulated. PING_CAN is answered for all by the one at the end, or else the
lowest: behind its next answer, since all answers come from one port.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import MILLISECOND, Event, Nanos, Torque
from protocols.plugin import Device, Twin
from protocols.toolkit.packets import LineFirmware
from protocols.toolkit.table import Decoded
from protocols.vesc.motor import Motor, VescFirmware
from protocols.vesc.table import EVERY
from protocols.vesc_uart import table as ut
from protocols.vesc_uart.options import Options, Settings

BOOT: Nanos = 800 * MILLISECOND
PINGED: Nanos = 300 * MILLISECOND
"""Time in which PING_CAN asks all addresses; a real one takes 2.5 s."""
DIRECTLY, FORWARDED = 200_000, 2 * MILLISECOND
"""Until an answer is sent"""
HARDWARE = b"TWIN"
WITH_STATUS = (5, 3)


def motor_of(device: Device) -> Motor:
    """Return a controller as it is when switched on."""
    options: Options = device.options
    here = device.address == options.uart_id
    to = (ut.DIRECT,) if here else (device.address, EVERY)
    return Motor(device.name, to, options, device.settings)


class VescUartTwin(LineFirmware, VescFirmware):
    """One controller with its motor."""

    messages = ut.PACKETS

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, motor_of(device))
        self.here = ut.DIRECT in self.memory.addresses
        self.reply_delay = DIRECTLY if self.here else FORWARDED
        self.answers_pings = True
        self.found: tuple[int, ...] = () if self.here else (device.address,)
        """Who is on the CAN of the controller at the end of the line."""
        self.pinged_until: Nanos | None = None
        """When the ping that it was asked for is over."""
        self.turned, self.stood_at = 0, 0
        """Steps in either direction, and the last one's place"""

    def join(self, others: Sequence[Twin]) -> None:
        """Find the others of the line."""
        twins = sorted((self, *(each for each in others if isinstance(each, VescUartTwin))), key=_place)
        self.answers_pings = twins[0] is self
        self.found = tuple(dict.fromkeys(each.device.address for each in twins if not each.here))

    def takes(self, decoded: Decoded) -> bool:
        return decoded.name == "PING_CAN" or self.memory.takes(decoded)

    def on_message(self, t: Nanos, message: bytes, decoded: Decoded) -> None:
        match decoded.name:
            case "PING_CAN":
                answers = decoded.address == ut.DIRECT and self.answers_pings
                self.pinged_until = t + PINGED if answers else None
            case "FW_VERSION":
                self._answer(t, self._version())
            case "GET_VALUES":
                self._answer(t, self._values(ut.EVERYTHING, selective=False))
            case "GET_VALUES_SELECTIVE":
                self._answer(t, self._values(decoded.values["mask"], selective=True))
            case "REBOOT":
                self.restart(t, BOOT)
                self.timed_out = True
                self.encoder.set_position(0.0)
                self.turned, self.stood_at = 0, 0
            case _:
                self.command(t, decoded)

    def _answer(self, t: Nanos, payload: bytes) -> None:
        self.reply(t, ut.FORMAT.frame(payload))
        if self.pinged_until is not None and t >= self.pinged_until:
            self._answer_ping(t)

    def _answer_ping(self, t: Nanos) -> None:
        self.pinged_until = None
        self.reply(t, ut.FORMAT.frame(bytes((ut.PING_CAN, *self.found))))

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Answer a ping behind which nothing is asked, too; count the steps."""
        if self.pinged_until is not None and now >= self.pinged_until + PINGED:
            self._answer_ping(now)
        stepped = super().step(now, truth)
        at = int(self.measured()["position"])
        self.turned, self.stood_at = self.turned + abs(at - self.stood_at), at
        return stepped

    def _version(self) -> bytes:
        settings: Settings = self.settings
        serial = settings.serial_number or 0x0020_0035_5730_5006_2033_0000 + self.device.address
        version = bytes((ut.FW_VERSION, settings.firmware_major, settings.firmware_minor))
        # Pairing, test version, hardware type, configurations, filter, two pages, radio: none, and no name.
        return version + HARDWARE + b"\0" + serial.to_bytes(12, "big") + bytes(8) + b"\0"

    def _values(self, mask: int, *, selective: bool) -> bytes:
        measured, settings = self.measured(), self.settings
        values = {
            "temp_fet": measured["fet"],
            "temp_motor": measured["motor"],
            "avg_motor_current": measured["current"],
            "avg_input_current": measured["current"] * abs(measured["duty"]),
            "avg_iq": self.torque / self.device.options.torque_constant,
            "duty_cycle_now": measured["duty"],
            "rpm": measured["velocity"],
            "v_in": measured["voltage"],
            "tachometer": measured["position"],
            "tachometer_abs": self.turned,
            "fault_code": self.code,
            "controller_id": self.device.address,
            "status": self.state,
        }
        values |= {f"temp_mos{number}": measured["fet"] for number in (1, 2, 3)}
        payload = ut.encode_values(mask, values, selective=selective)
        has_status = (settings.firmware_major, settings.firmware_minor) >= WITH_STATUS
        return payload if has_status or not mask & ut.BIT["status"] else payload[:-1]

    def restart(self, t: Nanos, silent: Nanos) -> None:
        """Restart: nothing is driven."""
        super().restart(t, silent)
        self.pinged_until = None


def _place(twin: VescUartTwin) -> tuple[bool, int]:
    """Return how near to the end of the line a controller is."""
    return not twin.here, twin.device.address
