"""The host's end: what an output is sent, and what its chip reports of it.

Rules. Each transfer is acknowledged by its chip, and read back: so it is known whether an output has pulses,
and nothing of what is on it. Before the first pulse of an output the prescaler is checked, and written if it
is another: all outputs of the chip stop for that. A chip that lost its supply comes back asleep: its outputs
have no pulses. Hold goes on with the pulse that was sent last, or is read back, and else with that of
position 0. A velocity of 0 and Idle are off to the chip, and told apart by the count at which they would go
on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND, Command, Mode, Nanos
from protocols.pca9685 import table as pt
from protocols.pca9685.memory import Output, output_of
from protocols.pca9685.options import Options
from protocols.plugin import Device
from protocols.toolkit import i2c
from protocols.toolkit.host import Host, Report
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import MotorDriver, Rx
from protocols.toolkit.questions import Questions

CHIP: Nanos = 100 * MILLISECOND
"""Period in which the mode and the prescaler of a chip are read"""
ASLEEP = pt.AWAKE | pt.SLEEP
SILENT = {
    i2c.NO_CHIP: "no chip acknowledges 0x{:02X}: wiring, supply, its address pins",
    i2c.FAILED: "the bus hangs: a chip or a short holds SDA or SCL down: check the pull-ups, the supply",
}


@dataclass(slots=True)
class Channel:
    """What is known of one output, as its chip has it. Plain data."""

    chip: Output
    """The registers that were read back"""
    seen: set[str] = field(default_factory=set)
    """Which were, since it may have restarted"""
    sent: int = 0
    """The counts of its last pulse"""
    woken: bool = False
    """Its mode was written since it was last released"""
    outcome: int = i2c.DONE
    """Of the last transfer"""
    asked: Questions = field(default_factory=Questions)

    def forget(self) -> None:
        """Forget what was read back."""
        self.seen.clear()
        self.woken = False
        self.asked.forget()

    def see(self, transfer: bytes, written: bytes, data: bytes) -> None:
        """Note a transfer that was acknowledged: what was written, or read back."""
        self.outcome = i2c.DONE
        if data:
            self.seen.add(pt.register(written[0]))
            self.chip.load(written[0], data)
        else:
            self.chip.obey(transfer)
            self.woken |= written == bytes((pt.MODE1, pt.AWAKE))

    def fail(self, outcome: int) -> None:
        """Note a transfer that was not."""
        self.outcome = outcome

    def release(self) -> None:
        """Note that it is released."""
        self.woken = False

    def send(self, counts: int) -> None:
        """Note a pulse."""
        self.sent = counts

    @property
    def known(self) -> bool:
        """Whether all was read back that matters"""
        return {"MODE1", "PRE_SCALE", "LED"} <= self.seen

    def state(self) -> tuple[Mode | None, str]:
        """Return its mode; None: not known yet."""
        if not self.known:
            return None, ""
        if not self.chip.awake:
            return Mode.READY, "open loop: the chip sleeps"
        driven = not isinstance(self.chip.does(), msg.Idle)
        return (Mode.ARMED, "open loop: driven") if driven else (Mode.READY, "open loop: off")


class Pca9685Adapter(LineAdapter[Channel]):
    """What outputs are sent, and what their chips report."""

    name = "pca9685"
    blind = True
    """It is commanded without a position: it has none."""

    def own(self, device: Device) -> Channel:
        return Channel(output_of(device))

    def ready(self, host: Host[Channel]) -> bool:
        return host.own.known

    def why_silent(self, host: Host[Channel]) -> str:
        return SILENT.get(host.own.outcome, "").format(pt.chip(host.address))

    # -- received -------------------------------------------------------------------------------------

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[Channel]
    ) -> Sequence[Report[Channel] | Rx]:
        transfer, place = i2c.parse(bytes(asked)), i2c.find(bytes(asked), data)
        host = driver.at.get(int(asked.about.partition(" ")[0] or -1))
        if transfer is None or place is None or host is None:
            return super().heard(t, asked, data, driver)
        answer = data[slice(*place)]
        if answer[1] != i2c.DONE:
            host.own.fail(answer[1])
            return (Rx.IGNORED,)
        host.own.see(bytes(asked), transfer.written, answer[i2c.HEAD :])
        mode, detail = host.own.state()
        return (Report(host, host.address, mode, detail),)

    # -- sent -----------------------------------------------------------------------------------------

    def arm(self, now: Nanos, host: Host[Channel], command: Command) -> Sequence[Frame]:
        """Return what its chip still lacks, one thing in a step; behind that the set-point."""
        own, scale = host.own, host.options.scale
        if own.chip.get(pt.PRE_SCALE) != scale:
            asleep = bytes((pt.PRE_SCALE, scale))
            return (self._write(host, bytes((pt.MODE1, ASLEEP)) if own.chip.awake else asleep, "chip"),)
        if not own.woken or own.chip.get(pt.MODE1) != pt.AWAKE:
            return (self._write(host, bytes((pt.MODE1, pt.AWAKE)), "chip"),)
        return self.command(now, host, command)

    def command(self, now: Nanos, host: Host[Channel], command: Command) -> Sequence[Frame]:
        options, output = host.options, pt.channel(host.address)
        if options.kind == "servo":
            host.own.send(self._counts(host, command))
            return (self._write(host, pt.led(output, 0, host.own.sent), "output"),)
        counts = round(getattr(command, "velocity", 0.0) / options.full_scale * pt.COUNTS)
        pairs = [_driven(counts), _driven(-counts)][: 1 + options.reversible]
        first_off = sorted(enumerate(pairs), key=lambda each: each[1][1] != pt.FULL)  # never both on
        return [self._write(host, pt.led(output + at, *pair), f"output {at}") for at, pair in first_off]

    @staticmethod
    def _counts(host: Host[Channel], command: Command) -> int:
        options: Options = host.options
        if isinstance(command, msg.Position):
            return options.counts(options.pulse(command.position))
        before = host.own.sent or host.own.chip.high()
        return options.counts(before * options.count_us if before else options.centre_us)

    def release(self, now: Nanos, host: Host[Channel]) -> Sequence[Frame]:
        host.own.release()
        output = pt.channel(host.address)
        outputs = range(output, output + 1 + (host.options.kind == "pwm" and host.options.reversible))
        return [self._write(host, pt.led(each, 0, pt.FULL), f"{each} off", Rank.RELEASE) for each in outputs]

    @staticmethod
    def _write(host: Host[Channel], data: bytes, about: str, rank: Rank = Rank.SET_POINT) -> Exchange:
        frame = i2c.transfer(pt.chip(host.address), data)
        return Exchange(frame, i2c.answer(frame), rank, f"{host.address} {about}")

    def poll(self, now: Nanos, host: Host[Channel]) -> Sequence[Frame]:
        own, often = host.own, host.options.feedback_ms * MILLISECOND
        led = pt.LED0 + 4 * pt.channel(host.address)
        reads = {"LED": (led, 4, often)}
        for name, register in (("MODE1", pt.MODE1), ("PRE_SCALE", pt.PRE_SCALE)):
            reads[name] = register, 1, CHIP if own.known else often
        due = [name for name, (_, _, period) in reads.items() if own.asked.take(now, name, period)]
        return [self._read(host, name, *reads[name][:2]) for name in due]

    @staticmethod
    def _read(host: Host[Channel], name: str, register: int, count: int) -> Exchange:
        frame = i2c.transfer(pt.chip(host.address), bytes((register,)), count)
        rank = Rank.QUESTION if name == "LED" or not host.own.known else Rank.BACKGROUND
        return Exchange(frame, i2c.answer(frame), rank, f"{host.address} {name}")

    def poll_due(self, host: Host[Channel]) -> Nanos:
        return host.own.asked.due("LED", host.options.feedback_ms * MILLISECOND)


def _driven(counts: int) -> tuple[int, int]:
    """Return when an output goes on and off that is high for so many counts; of a velocity of 0, or the other
    way round, off in another way than for Idle."""
    if counts <= 0:
        return 1, pt.FULL
    return (pt.FULL, 0) if counts >= pt.COUNTS else (0, counts)
