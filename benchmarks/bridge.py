"""A Damiao motor behind the vendor's serial adapter: ours, and motorbridge, whose core is Rust.

Rules. Both write the same packets to a pty and read what is put into its other end: motorbridge gives its
bytes no other way. So what the kernel takes to carry a packet stands beside, by itself. motorbridge is read
as its own page recommends (`poll_feedback_once`, then `get_state`): its thread looks only every so often.
"""

from __future__ import annotations

import os
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import cycle
from typing import Any, TypeAlias

from benchmarks.measure import Call, Effort, NotMeasured, in_turn, rival
from benchmarks.rows import Row, against
from benchmarks.samples.damiao import ENCODE, NUMBERS, TABLE
from gateway.buses import open_bus
from gateway.buses.adapters.dm_serial import encode_received
from gateway.core.clock import WallClock
from gateway.core.robot import BusSettings
from protocols.frames import CanFrame
from protocols.messages import SECOND

GROUP = "a Damiao motor behind the vendor's serial adapter, on a pty (the same packets)"
SENT, RECEIVED = "a set-point, until it is at the other end", "a feedback, until its numbers can be read"
KERNEL = "the bytes alone, by os.write and os.read"
FEEDBACK = {
    position: encode_received(CanFrame(0x11, bytes.fromhex(data)))
    for data, position in (("11851e799899211c", 0.49992), ("11871e799899211c", 0.69524))
}
"""Packets of two feedbacks, by the position [rad] in them."""
PACKET = 64
"""Bytes: more than a packet has."""

Both: TypeAlias = tuple[Callable[[], object], Callable[[], float]]
"""How a set-point is sent, and how the position is read that was received last."""


def bridge(effort: Effort) -> list[Row]:
    """Both directions."""
    other = rival("motorbridge", "motorbridge")
    sends: dict[str, Callable[[], bytes]] = {}
    receives: dict[str, Call] = {}
    with ExitStack() as stack:
        clients = {"ours": ours} if other.why_not else {"ours": ours, other.name: theirs(other.module)}
        for name, client in clients.items():
            far, near, path = stack.enter_context(line())
            send, position = stack.enter_context(client(path))
            sends[name], receives[name] = sending(send, far), receiving(position, far)
        packets = {name: call() for name, call in sends.items()}
        if len(set(packets.values())) > 1:
            raise NotMeasured(f"different packets: {packets}")
        far, near, _ = stack.enter_context(line())
        sends[KERNEL] = sending(lambda: os.write(near, packets["ours"]), far)
        found = [in_turn(each, effort.of(500, 20)) for each in (sends, receives)]
    beside = [against(each, other.name, KERNEL, missing=(other,)) for each in found]
    return [
        Row(GROUP, what, each["ours"], one)
        for what, each, one in zip((SENT, RECEIVED), found, beside, strict=True)
    ]


@contextmanager
def line() -> Iterator[tuple[int, int, str]]:
    """Yield the far and the near end of a pty, and the path of the latter."""
    far, near = os.openpty()
    tty.setraw(near)
    try:
        yield far, near, os.ttyname(near)
    finally:
        os.close(far)
        os.close(near)


@contextmanager
def ours(path: str) -> Iterator[Both]:
    """Ours, as a bus of the gateway and the codec."""
    with closing(open_bus(BusSettings("can0", "can", f"dm-serial:{path}", 1_000_000), WallClock())) as bus:
        last = 0.0

        def position() -> float:
            nonlocal last
            for packet in bus.read(0)[1]:
                assert isinstance(packet.frame, CanFrame)
                values = TABLE.read("feedback", packet.frame.data) or {}
                last = values["position"]
            return last

        yield lambda: bus.write(0, (ENCODE(1, **NUMBERS),)), position


def theirs(motorbridge: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return the same in motorbridge."""

    @contextmanager
    def client(path: str) -> Iterator[Both]:
        with closing(motorbridge.Controller.from_dm_serial(path)) as controller:
            motor = controller.add_damiao_motor(1, 0x11, "4310")
            numbers = [NUMBERS[name] for name in ("position", "velocity", "stiffness", "damping", "torque")]

            def position() -> float:
                controller.poll_feedback_once()
                state = motor.get_state()
                return 0.0 if state is None else float(state.pos)

            yield lambda: motor.send_mit(*numbers), position

    return client


def sending(send: Callable[[], object], far: int) -> Callable[[], bytes]:
    """Return a call that sends, and reads at the far end."""

    def call() -> bytes:
        send()
        return os.read(far, PACKET)

    return call


def receiving(position: Callable[[], float], far: int) -> Call:
    """Return a call that puts a feedback into the far end, and asks until its position is there: another one
    than before. Raises NotMeasured if it does not come."""
    packets, clock = cycle(FEEDBACK.items()), WallClock()

    def call() -> float:
        expected, packet = next(packets)
        os.write(far, packet)
        end = clock.now() + SECOND
        while abs(position() - expected) > 1e-4:
            if clock.now() > end:
                raise NotMeasured(f"no position of {expected} rad")
        return expected

    return call
