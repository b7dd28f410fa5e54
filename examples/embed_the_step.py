"""Call `Gateway.step` from a loop of your own: here with the simulated world in place of your buses."""

import gateway as gw
from gateway.buses.virtual import open_world

PERIOD = 5_000_000  # ns
LATEST = 500_000_000  # ns that leaving takes at most

robot = gw.load_robot("bench")
core = gw.Gateway(robot)
buses = open_world(robot, seed=1).buses  # yours: whatever reads and writes frames


def read(now: int) -> tuple[gw.Packet, ...]:
    """Return what all buses have received."""
    return tuple(packet for bus in buses.values() for packet in bus.read(now)[1])


def write(now: int, packets: tuple[gw.Packet, ...]) -> None:
    """Send frames, each on its bus."""
    for packet in packets:
        buses[packet.bus].write(now, [packet.frame])


for now in range(0, 1_000_000_000, PERIOD):
    instructions = (gw.Position("right", 3.0),) if now >= 500_000_000 else ()
    outputs = core.step(now, gw.Inputs(packets=read(now), instructions=instructions))
    write(now, outputs.packets)

end = now + LATEST
write(now, core.leave(now))  # on the way out: the stop action of every joint that was commanded
while core.releasing() and now < end:  # a serial line has one question under way at a time: the rest waits
    now = max(now + 100_000, min(core.due() or end, end))
    write(now, core.leave(now, gw.Inputs(packets=read(now))))
feedback = core.joints["right"].feedback
print(f"right: {feedback.position:.2f} rad, {feedback.velocity:.2f} rad/s on the way to 3 rad")
