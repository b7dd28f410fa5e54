"""Call `Gateway.step` from a loop of your own: here with the simulated world in place of your buses."""

import gateway as gw
from gateway.buses.virtual import open_world

PERIOD = 5_000_000  # ns

robot = gw.load_robot("bench")
core = gw.Gateway(robot)
buses = open_world(robot, seed=1).buses  # yours: whatever reads and writes frames

for now in range(0, 1_000_000_000, PERIOD):
    packets = [packet for bus in buses.values() for packet in bus.read(now)[1]]
    instructions = (gw.Position("right", 3.0),) if now >= 500_000_000 else ()
    outputs = core.step(now, gw.Inputs(packets=tuple(packets), instructions=instructions))
    for packet in outputs.packets:
        buses[packet.bus].write(now, [packet.frame])

for packet in core.leave(now):  # on the way out: the stop action of every joint that was commanded
    buses[packet.bus].write(now, [packet.frame])
feedback = core.joints["right"].feedback
print(f"right: {feedback.position:.2f} rad, {feedback.velocity:.2f} rad/s on the way to 3 rad")
